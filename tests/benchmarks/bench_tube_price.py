"""What the tube costs: the same plan without it."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.models import DragDoubleIntegrator
from dtmpc_drake.planning import PlanningResult, Problem, plan_problem
from dtmpc_drake.scenario import load_scenario
from tests.benchmarks.bench_common import (
    STAGES,
    Section,
    complaints,
    interleaved,
    median,
    milliseconds,
    outcome,
    summary,
)

VANISHING = 1e-6
"""Reaching rate and first layer of a plan without tube, in m/s² and m/s."""


def without_tube(problem: Problem) -> Problem:
    """No disturbance, no model error: the tube is a micrometre wide.

    Raises:
        ValueError: if the model is not a `DragDoubleIntegrator`.
    """
    if not isinstance(problem.model, DragDoubleIntegrator):
        raise ValueError("only the drag model's error is known how to remove")
    return dataclasses.replace(
        problem,
        model=dataclasses.replace(problem.model, drag_error_bound=0.0),
        disturbance_bound=np.zeros_like(problem.disturbance_bound),
        reaching_rate=VANISHING,
        initial_boundary_layer=np.full_like(problem.initial_boundary_layer, VANISHING),
        initial_error=np.zeros_like(problem.initial_error),
    )


def run(scenario_name: str, repeats: int) -> Section:
    """Measures plans with and without tube in turn."""
    scenario = load_scenario(scenario_name)
    settings = dataclasses.replace(scenario.planner, backend="clarabel")
    tube = Problem.from_scenario(scenario)
    nominal = without_tube(tube)
    low = nominal.bandwidth_min
    problems = {
        "with tube": tube,
        "no tube, bandwidth decided": nominal,
        "no tube, bandwidth at its minimum": dataclasses.replace(
            nominal, bandwidth_max=low, bandwidth_floor=float(low.min())
        ),
    }
    results = interleaved(
        {
            name: lambda _, problem=problem: plan_problem(problem, settings)
            for name, problem in problems.items()
        },
        dict.fromkeys(problems, repeats),
    )
    data = {name: summary(r) for name, r in results.items()}
    for name, row in data.items():
        row["bandwidth_cost"] = median([_bandwidth_cost(r) for r in results[name]])
    reference = data["with tube"]
    rows = [
        [
            name,
            milliseconds(row["time"]),
            f"{reference['time'] / row['time']:.2f}",
            *(milliseconds(row["stages"][s]) for s in STAGES),
            f"{row['iterations']:g}",
            f"{row['cost']:.3f}",
            f"{row['bandwidth_cost']:.3f}",
            f"{reference['cost'] / row['cost']:.2f}",
            outcome(row),
        ]
        for name, row in data.items()
    ]
    return Section(
        title=f"The tube's price, {scenario_name}, cold, clarabel",
        columns=[
            "",
            "ms",
            "tube/this",
            *STAGES,
            "iterations",
            "cost",
            "of it bandwidth",
            "tube/this",
            "outcome",
        ],
        rows=rows,
        notes=[
            f"Medians of {repeats} repeats, interleaved.  Without tube: D = 0, no "
            f"model error, η and Φ(t0) of {VANISHING:g}.",
            "Its programs keep their tube states, so a planner written without tube "
            "would save more time.",
            *complaints(data),
        ],
        data=data,
    )


def _bandwidth_cost(result: PlanningResult) -> float:
    """The part of the cost that pays for bandwidth."""
    problem, plan = result.problem, result.attempt
    if plan is None:
        return float("nan")
    excess = plan.bandwidth_knots - problem.bandwidth_floor
    running = problem.bandwidth_weight * (excess**2).sum(axis=1)
    return float(np.diff(plan.knots) @ (running[1:] + running[:-1]) / 2)
