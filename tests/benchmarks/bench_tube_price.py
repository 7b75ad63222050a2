"""What the tube costs: the same plan without it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from dtmpc_drake.planning import Problem, plan_problem
from dtmpc_drake.planning.baselines import VANISHING, bandwidth_cost, without_tube
from dtmpc_drake.records.result import PlanningResult
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


def run(scenario_name: str, repeats: int) -> Section:
    """Measures plans with and without tube in turn."""
    scenario = load_scenario(scenario_name)
    settings = dataclasses.replace(scenario.planner, backend="clarabel")
    tube = Problem.from_scenario(scenario)
    nominal = without_tube(tube)
    problems = {
        "with tube": tube,
        "no tube, bandwidth decided": dataclasses.replace(
            nominal, bandwidth=tube.bandwidth
        ),
        "no tube, bandwidth at its minimum": nominal,
    }

    def planned(problem: Problem) -> Callable[[int], PlanningResult]:
        return lambda _: plan_problem(problem, settings)

    results = interleaved(
        {name: planned(problem) for name, problem in problems.items()},
        dict.fromkeys(problems, repeats),
    )
    data = {name: summary(r) for name, r in results.items()}
    for name, row in data.items():
        row["bandwidth_cost"] = median(
            [bandwidth_cost(r, problems[name]) for r in results[name]]
        )
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
