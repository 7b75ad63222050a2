"""Cold plan and warm re-plan on both backends, beside the peer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from dtmpc_drake.planning import Problem, plan_problem
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import load_scenario
from tests.benchmarks.bench_common import (
    STAGES,
    Section,
    complaints,
    interleaved,
    milliseconds,
    moved,
    outcome,
    summary,
)
from tests.benchmarks.casadi_peer import TOLERANCE, Peer, Solution


def run(scenario_name: str, repeats: int, ipopt_repeats: int) -> Section:
    """Measures everything in one interleaved run."""
    scenario = load_scenario(scenario_name)
    problem = Problem.from_scenario(scenario)
    intervals = scenario.planner.intervals
    peer = Peer(problem, intervals)
    peer_first = peer.solve()
    runs: dict[str, Callable[[int], PlanningResult | Solution]] = {}
    counts: dict[str, int] = {}

    def add_ours(backend: str, count: int) -> None:
        settings = dataclasses.replace(scenario.planner, backend=backend)
        first = plan_problem(problem, settings).plan

        def cold(_: int) -> PlanningResult:
            return plan_problem(problem, settings)

        def warm(repeat: int) -> PlanningResult:
            start = moved(problem.start, repeat, count)
            shifted = dataclasses.replace(problem, start=start)
            return plan_problem(shifted, settings, warm_start=first)

        for kind, function in (("cold", cold), ("warm", warm)):
            runs[f"{backend}, {kind}"] = function
            counts[f"{backend}, {kind}"] = count

    def peer_cold(_: int) -> Solution:
        return peer.solve()

    def peer_warm(repeat: int) -> Solution:
        start = moved(problem.start, repeat, repeats)
        return peer.solve(start=start, previous=peer_first)

    add_ours("clarabel", repeats)
    runs |= {"peer, cold": peer_cold, "peer, warm": peer_warm}
    counts |= {"peer, cold": repeats, "peer, warm": repeats}
    if ipopt_repeats:
        add_ours("ipopt", ipopt_repeats)

    results = {name: summary(r) for name, r in interleaved(runs, counts).items()}
    rows = []
    for name, row in results.items():
        reference = results[f"peer, {name.split(', ')[1]}"]
        row["ratio"] = row["time"] / reference["time"]
        stages: dict[str, Any] = row.get("stages", {})
        rows.append(
            [
                name,
                milliseconds(row["time"]),
                f"{row['ratio']:.2f}",
                *(milliseconds(stages[s]) if stages else "" for s in STAGES),
                f"{row['iterations']:g}",
                f"{row['cost']:.3f}",
                outcome(row),
            ]
        )
    depths = {}
    for count in (intervals, intervals // 2):
        coarse = peer if count == intervals else Peer(problem, count)
        at_knots, anywhere = coarse.depth(coarse.solve())
        depths[count] = {"at_knots": at_knots, "anywhere": anywhere}
    notes = [
        f"Medians of {repeats} repeats (ipopt: {ipopt_repeats}), interleaved; warm: "
        "the start moved 5 cm, another way each time.",
        "Ours includes building its programs and the certificate.  The peer's "
        f"{1e3 * peer.build_time:.0f} ms",
        f"of building are left out; IPOPT tol {TOLERANCE:g}, knots only, and its "
        "cost is that of its own problem.",
        *(
            f"The peer's tube cuts {100 * d['anywhere']:.1f} cm into an obstacle "
            f"between knots at N = {count} ({100 * d['at_knots']:.2f} cm at knots)."
            for count, d in depths.items()
        ),
        *complaints(results),
    ]
    return Section(
        title=f"Plan and re-plan, {scenario_name}, N = {intervals}",
        columns=[
            "",
            "ms",
            "/peer",
            *STAGES,
            "iterations",
            "cost",
            "outcome",
        ],
        rows=rows,
        notes=notes,
        data={"runs": results, "peer_depth": depths, "peer_build": peer.build_time},
    )
