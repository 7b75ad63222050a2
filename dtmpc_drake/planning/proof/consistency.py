"""That a plan is one function of time, and the problem's: what a proof rests on."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.margin import Margin, smallest, worst
from dtmpc_drake.numerics.arrays import Array, BoolArray
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
    chains, m = problem.law.chains, problem.model.num_outputs
    if plan.chains != chains:
        return (
            f"coefficients: a plan of {plan.chains.words} with {plan.num_outputs}"
            f" outputs, where the model has {chains.words} and {m} outputs",
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
    n, m, unit = plan.order, plan.num_outputs, problem.units.time
    exists, axes = plan.chains.exists, problem.model.axes
    margins: dict[str, Margin] = {}
    jumps = [
        *_jumps(plan.coefficients, plan.knots, exists, "y*", axes),
        *_jumps(
            plan.layer_coefficients, plan.tube_times, np.full((2, m), True), "Φ*", axes
        ),
    ]
    if jumps:
        jump = worst(jumps)
        margins["continuity"] = dataclasses.replace(jump, time=jump.time * unit)
    time = np.array([plan.start_time, plan.end_time])
    wanted = np.array([problem.start_time, problem.start_time + problem.duration])
    allowed = TIME_TOLERANCE * (1 + np.abs(wanted).max())
    left = (allowed - np.abs(time - wanted))[:, None]
    margins["time"] = smallest(time * unit, left, "s", ["of the plan"], unit)

    rows = [f"y*^({k}) on {axes[i]}" for k, i in np.argwhere(exists)]
    ends = plan.reference(time)[:, :n]
    missing = np.abs(ends - np.stack([problem.start, problem.goal]))
    missing[1, [k for k in range(n) if k not in problem.goal_rows]] = 0.0
    left = END_TOLERANCE - plan.chains.pack(missing)
    margins["ends"] = smallest(time * unit, left, "", rows)

    first = plan.reference(time[0])
    layer, layer_rate = plan.layer(time[0])
    implied = problem.law.implied_bandwidth(first[:n], layer, layer_rate)
    highest = [f"y*^({order})" for order in plan.chains.orders]
    asked = (
        (["Φ*"] * m, layer, problem.tube_start.layer),
        (highest, first[n], problem.start_highest),
        (["α"] * m, implied, problem.start_bandwidth),
    )
    left, names = [], []
    for each, value, wish in asked:
        if wish is not None:
            allowed = HAND_OVER_TOLERANCE * (1e-3 + np.abs(wish))
            left.append(allowed - np.abs(value - wish))
            names += [f"{name} on {axes[i]}" for i, name in enumerate(each)]
    hand_over = np.concatenate(left)[None]
    margins["hand_over"] = smallest(time[:1] * unit, hand_over, "", names)
    return margins


def _jumps(
    powers: Array, grid: Array, continuous: BoolArray, name: str, axes: list[str]
) -> list[Margin]:
    """What is left of the tolerance at the inner points of a grid.

    Args:
        powers: of the time since a piece began, ``(pieces, p, m)``.
        grid: ``(pieces + 1,)``, in s.
        continuous: which derivatives must be so, the function itself in the first
            row, ``(count, m)``.
        name: of the function.
        axes: what the outputs are called.
    """
    margins = []
    length = np.diff(grid)[:-1, None, None]
    order = np.arange(powers.shape[1])
    for k in range(len(continuous) if len(powers) > 1 else 0):
        end = (powers[:-1] * length ** order[: powers.shape[1], None]).sum(axis=1)
        start = powers[1:, 0]
        size = max(1.0, float(np.abs(start).max()) / 100)
        left = JUMP_TOLERANCE * size - np.abs(end - start)
        label = f"{name}^({k})" if k else name
        some = np.flatnonzero(continuous[k])
        places = [f"{label} on {axes[i]}" for i in some]
        margins.append(smallest(grid[1:-1], left[:, some], "", places))
        powers = powers[:, 1:] * np.arange(1, powers.shape[1])[:, None]
    return margins
