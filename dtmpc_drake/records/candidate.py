"""What became of each start of a search."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from dtmpc_drake.numerics.arrays import Array

STRAIGHT, EARLIER = "straight line", "earlier plan"
NOT_TRIED, BLOCKED, SAME = "not tried", "blocked", "same"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """One start of the search and what became of it.

    Attributes:
        start: ``straight line``, ``earlier plan`` or the sides of a way.
        sides: of the solution, one letter per obstacle; see `sides.Way`.
        length: of the start, in m.
        coarse_cost: on the coarse grid; None if it was not solved there.
        violation: of the coarse solution, in m, m/s or m/s²; None as above.
        status: of the plan; ``not tried`` if the coarse cost was too high or the
            budget spent, ``blocked`` if the coarse solution violates too much,
            ``same`` if a better one has these sides or this path.
        cost: of the plan; None if there is none.
        chosen: whether it is the result.
        path: y* of the best solution known, ``(K, m)``.
    """

    start: str
    sides: str
    length: float
    coarse_cost: float | None
    violation: float | None
    status: str
    cost: float | None
    chosen: bool
    path: Array

    def __repr__(self) -> str:
        """Sides, status and cost."""
        cost = self.cost if self.cost is not None else self.coarse_cost
        return f"Candidate({self.sides!r}, {self.status}, cost {_text(cost, '.3f')})"


def candidates_table(candidates: Iterable[Candidate]) -> str:
    """Candidates as text, one a row, the best first."""
    rows = [("", "start", "sides", "length", "coarse", "violation", "cost", "status")]
    for c in candidates:
        rows.append(
            (
                "*" if c.chosen else "",
                c.start if c.start in (STRAIGHT, EARLIER) else "way",
                c.sides or "none",
                f"{c.length:.2f}",
                _text(c.coarse_cost, ".3f"),
                _text(c.violation, ".1e"),
                _text(c.cost, ".3f"),
                c.status,
            )
        )
    width = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    left = {1, 2, 7}
    return "\n".join(
        " ".join(
            cell.ljust(w) if i in left else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, width, strict=True))
        ).rstrip()
        for row in rows
    )


def _text(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
