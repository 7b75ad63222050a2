"""What planning ended with."""

from __future__ import annotations

import dataclasses
from typing import Literal

from dtmpc_drake.records.candidate import Candidate, candidates_table
from dtmpc_drake.records.certificate import Certificate
from dtmpc_drake.records.plan import Plan

Status = Literal["certified", "not_certified", "infeasible", "failed"]

# Title, width, field of `Iteration`, format.
_COLUMNS = (
    ("N", 3, "intervals", "d"),
    ("cost", 9, "cost", ".4f"),
    ("violation", 9, "violation", ".2e"),
    ("slack", 8, "slack", ".1e"),
    ("defect", 8, "defect", ".1e"),
    ("step", 7, "step", ".4f"),
    ("fraction", 8, "fraction", ".3f"),
    ("trust", 7, "proximity", ".1e"),
    ("predicted", 9, "predicted", ".2e"),
    ("update s", 8, "update_time", ".4f"),
    ("solve s", 8, "solve_time", ".4f"),
    ("eval s", 8, "evaluate_time", ".4f"),
    ("solver", 8, "status", ""),
)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class PlanningResult:
    """What planning ended with; a failed solve is a status, not an exception.

    Attributes:
        status: ``certified``; ``not_certified`` (solved, but a margin is
            negative or a bound not proven); ``infeasible`` (constraints cannot
            be met from this start); ``failed`` (the solver gave up, or its time was
            over).
        message: one line that says which margin or constraint, where and when.
        plan: the plan if solved, else None.
        attempt: the last iterate as a plan, whatever the status; never to fly.
        certificate: of `attempt`.
        cost: of `attempt`.
        history: every convex program, coarse grids first.
        times: ``update``, ``solve``, ``evaluate``, ``certify`` and ``total``, s.
        backend: that solved it.
        candidates: of the search for the best sides, the best first; empty
            without a search.
    """

    status: Status
    message: str
    plan: Plan | None
    attempt: Plan | None
    certificate: Certificate | None
    cost: float
    history: tuple[Iteration, ...]
    times: dict[str, float]
    backend: str
    candidates: tuple[Candidate, ...] = ()

    @property
    def certified(self) -> bool:
        """Whether the plan is certified."""
        return self.status == "certified"

    def table(self) -> str:
        """The history as text."""
        return "\n".join([table_header(), *map(table_row, self.history)])

    def candidates_table(self) -> str:
        """The candidates of the search as text, with a star at the chosen one."""
        return candidates_table(self.candidates)

    def __repr__(self) -> str:
        """Status, cost, time and the message."""
        return (
            f"PlanningResult({self.status}, cost {self.cost:.3f}, "
            f"{len(self.history)} iterations in {self.times['total']:.3f} s on "
            f"{self.backend}: {self.message})"
        )


def table_header() -> str:
    """The header of the history's table."""
    return " ".join(title.rjust(width) for title, width, _, _ in _COLUMNS)


def table_row(iteration: Iteration) -> str:
    """One row of the history's table."""
    return " ".join(
        format(getattr(iteration, field), form).rjust(width)
        for _, width, field, form in _COLUMNS
    )


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One row of the history.

    Attributes:
        intervals: of the grid that was used.
        cost: of the iterate that the step led to.
        violation: worst true constraint violation there, all limits counted as
            lengths.
        slack: that the convex program needed.
        defect: largest difference between the program's tube and the exact
            tube at the new iterate, in m.
        step: largest change of the reference, in m.
        fraction: of the program's step that was taken.
        proximity: weight of the proximal term (the soft trust region).
        predicted: decrease of the merit function that the program promised.
        update_time, solve_time, evaluate_time: in s.
        status: of the convex solver.
    """

    intervals: int
    cost: float
    violation: float
    slack: float
    defect: float
    step: float
    fraction: float
    proximity: float
    predicted: float
    update_time: float
    solve_time: float
    evaluate_time: float
    status: str
