"""Cost and time against the number of intervals and of obstacles."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import Problem, plan_problem
from dtmpc_drake.scenario import Scenario, load_scenario
from tests.benchmarks.bench_common import (
    Section,
    complaints,
    interleaved,
    milliseconds,
    outcome,
    summary,
)
from tests.benchmarks.casadi_peer import Peer

INTERVALS = (28, 56, 112)
OBSTACLES = (5, 20, 80)
CORRIDOR = 1.8
"""Extra obstacles stay this far from the straight line, in m.  Near enough for
some to enter the programs, far enough to leave the best plan as it is."""


def with_obstacles(scenario: Scenario, count: int) -> Scenario:
    """The scenario with cylinders added on both sides, the same every time."""
    random = np.random.default_rng(0)
    extra = count - len(scenario.obstacles)
    radius = random.uniform(0.3, 0.8, extra)
    aside = CORRIDOR + radius + random.uniform(0.0, 3.0, extra)
    aside *= random.choice([-1.0, 1.0], extra)
    first, last = scenario.start.position, scenario.goal.position
    along = random.uniform(0.0, 1.0, extra)[:, None]
    line = np.array(last[:2]) - np.array(first[:2])
    normal = np.array([line[1], -line[0]]) / np.linalg.norm(line)
    centers = np.array(first[:2]) + along * line + aside[:, None] * normal
    added = [
        Cylinder(center=c.tolist(), radius=float(r))
        for c, r in zip(centers, radius, strict=True)
    ]
    return dataclasses.replace(scenario, obstacles=[*scenario.obstacles, *added])


def run(scenario_name: str, repeats: int) -> Section:
    """Measures every case with ours and the peer in turn."""
    scenario = load_scenario(scenario_name)
    base = scenario.planner.intervals, len(scenario.obstacles)
    cases = [(n, base[1]) for n in INTERVALS]
    cases += [(base[0], n) for n in OBSTACLES if n > base[1]]
    rows, data = [], {}
    for intervals, obstacles in cases:
        problem = Problem.from_scenario(with_obstacles(scenario, obstacles))
        case = _measure(scenario, problem, intervals, repeats)
        ours, peer = case["ours"], case["peer"]
        data[f"N = {intervals}, {obstacles} obstacles"] = case
        rows.append(
            [
                str(intervals),
                str(obstacles),
                milliseconds(ours["time"]),
                f"{ours['iterations']:g}",
                f"{ours['cost']:.3f}",
                outcome(ours),
                milliseconds(peer["time"]),
                f"{peer['iterations']:g}",
                f"{peer['cost']:.3f}",
                f"{100 * case['peer_depth']:.1f}",
                f"{ours['time'] / peer['time']:.2f}",
            ]
        )
    return Section(
        title=f"Intervals and obstacles, {scenario_name}, cold, clarabel",
        columns=[
            "N",
            "obstacles",
            "ours ms",
            "iterations",
            "cost",
            "outcome",
            "peer ms",
            "iterations",
            "cost",
            "cuts cm",
            "ours/peer",
        ],
        rows=rows,
        notes=[
            f"Medians of {repeats} repeats, interleaved.  Extra obstacles are "
            f"cylinders at least {CORRIDOR} m off the straight line.",
            *complaints({name: case["ours"] for name, case in data.items()}),
        ],
        data=data,
    )


def _measure(
    scenario: Scenario, problem: Problem, intervals: int, repeats: int
) -> dict[str, Any]:
    settings = dataclasses.replace(
        scenario.planner, backend="clarabel", intervals=intervals
    )
    peer = Peer(problem, intervals)
    results = interleaved(
        {
            "ours": lambda _: plan_problem(problem, settings),
            "peer": lambda _: peer.solve(),
        },
        {"ours": repeats, "peer": repeats},
    )
    return {
        "ours": summary(results["ours"]),
        "peer": summary(results["peer"]),
        "peer_depth": peer.depth(results["peer"][-1])[1],
    }
