"""Time to a plan that is safe, ours beside a peer that inflates its obstacles.

The peer looks at obstacles at the knots only and cuts into them in between.  Here it
gets, on every grid, the smallest inflation of all radii with which it does not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from dtmpc_drake.planning import Problem, certify, plan_problem
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Planner, load_scenario
from tests.benchmarks.bench_common import (
    Section,
    complaints,
    interleaved,
    milliseconds,
    outcome,
    summary,
)
from tests.benchmarks.casadi_peer import SAMPLES, Peer, Solution

HALVES = range(-4, 5)
"""Grids: the scenario's N times 2 to the power of half of these, 14 to 224 for 56.
On coarser ones, 7 and 10, the peer finds no clear plan of `known_environment`; finer
ones only take longer."""
STEP_MM = 1
"""Inflations are tried in these steps, in mm."""
LARGEST_MM = 1000
"""The largest inflation, in mm: it doubles the radius of our scenarios' obstacles."""


def smallest_inflation(peer: Peer) -> float | None:
    """The smallest inflation, in m, with which the peer's plan is clear anywhere.

    All are tried from 0 on rather than bisected: IPOPT goes another way round an
    obstacle now and then, so that more inflation need not cut less.

    Returns:
        None if the peer finds no clear plan with any up to `LARGEST_MM`.
    """
    for millimetres in range(0, LARGEST_MM + STEP_MM, STEP_MM):
        inflation = millimetres / 1000
        solution = peer.solve(inflation=inflation)
        if solution.success and peer.depth(solution)[1] <= 0:
            return inflation
    return None


def run(
    scenario_name: str, repeats: int, grids: Sequence[int] | None = None
) -> Section:
    """Finds the inflations, untimed, then measures all grids of both in turn.

    Args:
        scenario_name: of the scenario, whose own N is measured in any case.
        repeats: of every solve.
        grids: N to try, rather than those of `HALVES`.
    """
    scenario = load_scenario(scenario_name)
    problem = Problem.from_scenario(scenario)
    own = scenario.planner.intervals
    if grids is None:
        grids = [round(own * 2 ** (half / 2)) for half in HALVES]
    grids = sorted({own, *grids})
    peers = {n: Peer(problem, n) for n in grids}
    found = {n: smallest_inflation(peer) for n, peer in peers.items()}
    inflations = {n: i for n, i in found.items() if i is not None}
    runs: dict[str, Callable[[int], PlanningResult | Solution]] = {}
    for n in grids:
        runs[_ours(n)] = _our_run(problem, scenario.planner, n)
        if n in inflations:
            runs[_peer(n)] = _peer_run(peers[n], inflations[n])
    results = interleaved(runs, dict.fromkeys(runs, repeats))
    data = {name: summary(r) for name, r in results.items()}
    for n, inflation in inflations.items():
        data[_peer(n)]["inflation"] = inflation
        certificate = certify(peers[n].plan(results[_peer(n)][-1]), problem)
        data[_peer(n)]["certified"] = certificate.certified
        data[_peer(n)]["certificate"] = certificate.reason

    reference = data[_ours(own)]["time"]
    rows: list[Sequence[str]] = []
    for n in grids:
        ours = data[_ours(n)]
        row = [
            str(n),
            milliseconds(ours["time"]),
            f"{ours['iterations']:g}",
            f"{ours['cost']:.3f}",
            outcome(ours),
        ]
        if n in inflations:
            peer = data[_peer(n)]
            row += [
                f"{100 * peer['inflation']:.1f}",
                milliseconds(peer["time"]),
                f"{peer['iterations']:g}",
                f"{peer['cost']:.3f}",
                outcome(peer),
                _kept(peer),
                f"{ours['time'] / peer['time']:.2f}",
                f"{reference / peer['time']:.2f}",
            ]
        else:
            row += ["none", *[""] * 7]
        rows.append(row)
    return Section(
        title=f"Time to a safe plan, {scenario_name}, cold, clarabel",
        columns=[
            "N",
            "ours ms",
            "iterations",
            "cost",
            "outcome",
            "inflated cm",
            "peer ms",
            "iterations",
            "cost",
            "outcome",
            "its certificate",
            "ours/peer",
            f"ours {own}/peer",
        ],
        rows=rows,
        notes=[
            f"Medians of {repeats} repeats, interleaved.  Ours includes building its "
            "programs and the certificate, the peer's is IPOPT only.",
            "The peer's obstacles are inflated by the least, in steps of "
            f"{STEP_MM} mm up to {LARGEST_MM / 10:.0f} cm, with which its own plan's "
            "exact tube is clear",
            f"at {SAMPLES} samples an interval; the search is not timed.  Its other "
            "limits hold at knots only: the certificate says what",
            "that breaks.  Costs are those of either's own problem.",
            *_picks(data, own, list(inflations)),
            *complaints({_ours(n): data[_ours(n)] for n in grids}),
        ],
        data={"runs": data, "inflations": found},
    )


def _ours(intervals: int) -> str:
    return f"ours, N = {intervals}"


def _peer(intervals: int) -> str:
    return f"peer, N = {intervals}"


def _our_run(
    problem: Problem, settings: Planner, intervals: int
) -> Callable[[int], PlanningResult]:
    chosen = dataclasses.replace(settings, backend="clarabel", intervals=intervals)
    return lambda _: plan_problem(problem, chosen)


def _peer_run(peer: Peer, inflation: float) -> Callable[[int], Solution]:
    return lambda _: peer.solve(inflation=inflation)


def _kept(peer: dict[str, Any]) -> str:
    """A cell: certified, or which limit is broken by how much."""
    if peer["certified"]:
        return "certified"
    return str(peer["certificate"]).split(" at t =")[0]


def _picks(data: dict[str, Any], own: int, safe: Sequence[int]) -> list[str]:
    """Notes on the peers that one could choose, each beside ours."""
    if not safe:
        return ["! The peer has no clear plan on any grid."]

    def fastest(among: Sequence[int]) -> int:
        return min(among, key=lambda n: float(data[_peer(n)]["time"]))

    picks = {"coarsest clear": min(safe), "fastest clear": fastest(safe)}
    if len(set(picks.values())) == 1:
        picks = {"coarsest and fastest clear": min(safe)}
    certified = [n for n in safe if data[_peer(n)]["certified"]]
    if certified:
        picks["fastest certified"] = fastest(certified)
    lines = [_pick(kind, data, own, n) for kind, n in picks.items()]
    return lines if certified else [*lines, "No clear plan of the peer is certified."]


def _pick(kind: str, data: dict[str, Any], own: int, intervals: int) -> str:
    """One line: a peer beside ours, and beside ours that is as good."""
    peer, ours = data[_peer(intervals)], data[_ours(own)]
    line = (
        f"Peer, {kind}: N = {intervals}, {100 * peer['inflation']:.1f} cm, "
        f"{milliseconds(peer['time'])} ms, cost {peer['cost']:.3f}.  Ours at "
        f"N = {own}: {ours['time'] / peer['time']:.2f} of its time, "
        f"{ours['cost'] / peer['cost']:.2f} of its cost"
    )
    as_good = {
        name: row
        for name, row in data.items()
        if name.startswith("ours")
        and row["succeeded"] == row["repeats"]
        and row["cost"] <= peer["cost"]
    }
    if not as_good:
        return f"{line}; none of ours is as cheap."
    name, best = min(as_good.items(), key=lambda item: item[1]["time"])
    grid = name.removeprefix("ours, ")
    return (
        f"{line}; the fastest of ours\nthat costs no more, {grid}: "
        f"{best['time'] / peer['time']:.2f} of its time, cost {best['cost']:.3f}."
    )
