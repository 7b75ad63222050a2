"""That a plan is one function of time, and the problem's: what a proof rests on."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.margin import Margin, smallest
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.records.plan import Plan

END_TOLERANCE = 1e-6
"""Allowed distance from the start and goal states, in their units."""
HAND_OVER_TOLERANCE = 1e-6
"""Allowed distance from what a hand-over asks for, relative."""
JUMP_TOLERANCE = 1e-9
"""Allowed jumps between pieces, for their rounding: so much, in the unit of what
jumps, and a hundredth of that for each unit of its size."""
TIME_TOLERANCE = 1e-9
"""Allowed deviation of start and duration, for their rounding, relative."""


def plan_faults(plan: Plan, problem: Problem) -> tuple[str, ...]:
    """Why a plan cannot be compared with a problem, one line each.

    Beside `Plan.faults`, its order and number of outputs must be the model's, and its
    knots equally spaced, the grid of its tube within them.
    """
    faults = tuple(plan.faults())
    if faults:
        return faults
    n, m = problem.model.order, problem.model.num_outputs
    if (plan.order, plan.num_outputs) != (n, m):
        return (
            f"coefficients: a plan of order {plan.order} with {plan.num_outputs}"
            f" outputs, where the model has order {n} and {m} outputs",
        )
    if not plan.is_uniform:
        return ("knots: must be equally spaced, and tube_times within them",)
    return ()


def consistency_margins(plan: Plan, problem: Problem) -> dict[str, Margin]:
    """That a plan is continuous, and has the problem's ends and times.

    * ``continuity``: of y*, its first n - 1 derivatives, Φ* and dΦ*/dt.
    * ``time``: start and duration.
    * ``ends``: x* at both ends; what the goal leaves free is free.
    * ``hand_over``: Φ*(t0) and, where they are asked for, y*^(n)(t0) and the
      bandwidth that the layer implies there.

    Args:
        plan: without `plan_faults`.
        problem: that it should solve.
    """
    n, axes, unit = plan.order, problem.model.axes, problem.units.time
    margins: dict[str, Margin] = {}
    jumps = [
        *_jumps(plan.coefficients, plan.knots, n, "y*", axes),
        *_jumps(plan.layer_coefficients, plan.tube_times, 2, "Φ*", axes),
    ]
    if jumps:
        worst = min(jumps, key=lambda margin: margin.value)
        margins["continuity"] = dataclasses.replace(worst, time=worst.time * unit)
    time = np.array([plan.start_time, plan.end_time])
    wanted = np.array([problem.start_time, problem.start_time + problem.duration])
    allowed = TIME_TOLERANCE * (1 + np.abs(wanted).max())
    left = (allowed - np.abs(time - wanted))[:, None] * unit
    margins["time"] = smallest(time * unit, left, "s", ["of the plan"])

    rows = [f"y*^({k}) on {axis}" for k in range(n) for axis in axes]
    ends = plan.reference(time)[:, :n]
    missing = np.abs(ends - np.stack([problem.start, problem.goal]))
    missing[1, [k for k in range(n) if k not in problem.goal_rows]] = 0.0
    left = END_TOLERANCE - missing.reshape(2, -1)
    margins["ends"] = smallest(time * unit, left, "", rows)

    first = plan.reference(time[0])
    layer, layer_rate = plan.layer(time[0])
    implied = problem.law.implied_bandwidth(first[:n], layer, layer_rate)
    asked = {
        "Φ*": (layer, problem.tube_start.layer),
        f"y*^({n})": (first[n], problem.start_highest),
        "α": (implied, problem.start_bandwidth),
    }
    left, names = [], []
    for name, (value, wish) in asked.items():
        if wish is not None:
            allowed = HAND_OVER_TOLERANCE * (1e-3 + np.abs(wish))
            left.append(allowed - np.abs(value - wish))
            names += [f"{name} on {axis}" for axis in axes]
    hand_over = np.concatenate(left)[None]
    margins["hand_over"] = smallest(time[:1] * unit, hand_over, "", names)
    return margins


def _jumps(
    powers: Array, grid: Array, count: int, name: str, axes: list[str]
) -> list[Margin]:
    """What is left of the tolerance at the inner points of a grid.

    Args:
        powers: of the time since a piece began, ``(pieces, p, m)``.
        grid: ``(pieces + 1,)``, in s.
        count: derivatives that must be continuous, the function itself included.
        name: of the function.
        axes: what the outputs are called.
    """
    margins = []
    length = np.diff(grid)[:-1, None, None]
    order = np.arange(powers.shape[1])
    for k in range(count if len(powers) > 1 else 0):
        end = (powers[:-1] * length ** order[: powers.shape[1], None]).sum(axis=1)
        start = powers[1:, 0]
        size = max(1.0, float(np.abs(start).max()) / 100)
        left = JUMP_TOLERANCE * size - np.abs(end - start)
        what = f"{name}^({k})" if k else name
        labels = [f"{what} on {axis}" for axis in axes]
        margins.append(smallest(grid[1:-1], left, "", labels))
        powers = powers[:, 1:] * np.arange(1, powers.shape[1])[:, None]
    return margins
