"""What the benchmarks share: interleaved runs, medians, tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dtmpc_drake.experiments.tables import text_table
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.records.result import PlanningResult
from tests.benchmarks.casadi_peer import Solution

STAGES = ("update", "solve", "evaluate", "certify", "other")
SHIFT = 0.05
"""How far the start moves for a warm re-plan, in m."""


@dataclasses.dataclass
class Section:
    """One table of the output.

    Attributes:
        title: of the table.
        columns: headings.
        rows: cells, as text.
        notes: lines below the table.
        data: the numbers behind it, for the JSON file.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: list[str]
    data: dict[str, Any]

    def __str__(self) -> str:
        """The table as text."""
        table = text_table(self.columns, self.rows)
        return "\n".join([self.title, "=" * len(self.title), table, *self.notes])


def interleaved(
    runs: dict[str, Callable[[int], Any]], repeats: dict[str, int]
) -> dict[str, list[Any]]:
    """Calls all in turn, so that whatever else the machine does hits all alike.

    Args:
        runs: each is given the number of the repeat.
        repeats: how often to call each.  What is called most often is called once
            more before, to warm up.
    """
    most = max(repeats.values())
    for name, run in runs.items():
        if repeats[name] == most:
            run(0)
    results: dict[str, list[Any]] = {name: [] for name in runs}
    for i in range(most):
        for name, run in runs.items():
            if i < repeats[name]:
                results[name].append(run(i))
    return results


def moved(start: Array, repeat: int, repeats: int) -> Array:
    """x*(t0), 5 cm aside, in another direction of the x-y plane every time."""
    angle = 2 * np.pi * repeat / repeats
    result = start.copy()
    result[0, :2] += SHIFT * np.array([np.cos(angle), np.sin(angle)])
    return np.asarray(result)


def median(values: Sequence[float]) -> float:
    """The median, as a float."""
    return float(np.median(values))


def milliseconds(seconds: float) -> str:
    """For a table."""
    return f"{1e3 * seconds:.1f}"


def summary(results: Sequence[PlanningResult] | Sequence[Solution]) -> dict[str, Any]:
    """Medians over repeats of ours or of the peer, and all times, in s."""
    first = results[0]
    if isinstance(first, Solution):
        peer = [r for r in results if isinstance(r, Solution)]
        times = [r.solve_time for r in peer]
        return {
            "time": median(times),
            "times": times,
            "cost": median([r.cost for r in peer]),
            "iterations": median([r.iterations for r in peer]),
            "succeeded": sum(r.success for r in peer),
            "repeats": len(peer),
            "statuses": sorted({r.status for r in peer}),
        }
    ours = [r for r in results if isinstance(r, PlanningResult)]
    times = [r.times["total"] for r in ours]
    stages = {s: [r.times[s] for r in ours] for s in STAGES if s != "other"}
    stages["other"] = [
        total - sum(stages[s][i] for s in stages) for i, total in enumerate(times)
    ]
    return {
        "time": median(times),
        "times": times,
        "stages": {s: median(stages[s]) for s in STAGES},
        "cost": median([r.cost for r in ours]),
        "iterations": median([len(r.history) for r in ours]),
        "succeeded": sum(r.certified for r in ours),
        "repeats": len(ours),
        "statuses": sorted({r.status for r in ours}),
        "messages": sorted({r.message for r in ours if not r.certified}),
    }


def outcome(row: dict[str, Any]) -> str:
    """How many of the runs succeeded, and what became of the others."""
    if row["succeeded"] == row["repeats"]:
        return f"{row['statuses'][0]} {row['succeeded']}/{row['repeats']}"
    return f"{'/'.join(row['statuses'])}: good {row['succeeded']}/{row['repeats']}"


def complaints(rows: dict[str, dict[str, Any]]) -> list[str]:
    """One line for everything of ours that was not certified."""
    return [
        f"! {name}: {message}"
        for name, row in rows.items()
        for message in row.get("messages", [])
    ]
