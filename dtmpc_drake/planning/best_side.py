"""The search for the best sides: many coarse solves, few fine ones, one plan.

Every way that `sides.propose` finds, and the straight line, starts a sequential
convex program on half as many intervals.  The cheapest are then planned as any
other problem is, warm-started from their coarse plans, and the cheapest certified
plan is taken.  Where none is certified the next are tried, and last the straight
line exactly as without a search, so that a search never loses a plan.

How many are tried follows from a budget in seconds and the fixed prices below.
They are what a solve takes on the machine that they were measured on; on a faster
or slower one the search takes less or more time, but never finds another plan.

Candidates are solved in threads.  A convex program runs outside of Python's global
lock, so two cores help, and the result does not depend on how many there are.
"""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from dtmpc_drake.models import Array
from dtmpc_drake.plan import Plan
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.scp import Iteration, iterate_to_convergence
from dtmpc_drake.planning.sides import NEITHER, Way, propose, sides_of
from dtmpc_drake.planning.transcription import Guess, Transcription
from dtmpc_drake.scenario import Planner

if TYPE_CHECKING:
    from dtmpc_drake.planning.planner import PlanningResult

COARSEST = 14
"""Candidates are solved on half of the plan's intervals, but no fewer than this."""
ITERATIONS = 5
"""Convex programs for each candidate: enough to compare costs within some percent."""
PRICES = (0.05, 0.2)
"""Of a coarse solve on `PRICED` intervals, in s, where Δ is constant and where it
varies."""
PRICED = 28
FINE_PRICE = 2
"""Of planning one candidate to its end, in coarse solves."""
FINE_ITERATIONS = 15
"""At most, for each of them; a warm start rarely needs more than three."""
FINE = 3
"""Candidates that are planned to their end at once."""
RANKING = 100.0
"""Price of a coarse solution's violation in the ranking; finer grids mend small
ones, at a cost."""
PROMISING = 0.05
"""A coarse solution that violates a limit by more is given up, in m, m/s, m/s²."""
SWITCH = 0.9
"""An earlier plan is left only for one that costs less than this part of it."""

STRAIGHT, EARLIER = "straight line", "earlier plan"
NOT_TRIED, BLOCKED, SAME = "not tried", "blocked", "same"


@dataclasses.dataclass(frozen=True, repr=False)
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
            ``same`` if another one with these sides was better.
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

    __hash__: ClassVar[None]  # type: ignore[assignment]

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


@dataclasses.dataclass(frozen=True)
class _Coarse:
    """A start, solved on the coarse grid."""

    start: str
    way: Way
    plan: Plan
    cost: float
    violation: float
    history: tuple[Iteration, ...]

    __hash__: ClassVar[None]  # type: ignore[assignment]

    @property
    def merit(self) -> float:
        """By which candidates are ranked."""
        return self.cost + RANKING * self.violation


class Solve(Protocol):
    """`planner.plan_problem`, without a search."""

    def __call__(
        self, problem: Problem, settings: Planner, /, *, warm_start: Guess | None
    ) -> PlanningResult:
        """Plans a problem."""


def plan_best_side(
    problem: Problem,
    settings: Planner,
    solve: Solve,
    *,
    warm_start: Guess | None = None,
    threads: int | None = None,
) -> PlanningResult:
    """Plans a problem on the best sides of its obstacles.

    Args:
        problem: to plan.
        settings: with the budget.
        solve: plans from a straight line or from an earlier plan, without a search.
        warm_start: an earlier plan.  It is kept if it is certified and nothing else
            is clearly cheaper (`SWITCH`).
        threads: at most so many at once; as many as there are cores if left out.

    Returns:
        The result of the best candidate, with the table of all.  Its history is
        that of the candidate alone, its coarse programs first.
    """
    begin = time.perf_counter()
    local = dataclasses.replace(settings, initial_guess="straight_line")
    earlier = None
    if warm_start is not None:
        earlier = solve(problem, local, warm_start=warm_start)
    solves, fine = affordable(problem, settings)

    def solve_coarsely(start: tuple[str, Way]) -> _Coarse:
        return _solve_coarsely(problem, local, *start)

    few = min(FINE_ITERATIONS, settings.max_iterations)
    quick = dataclasses.replace(local, max_iterations=few)

    def plan_finely(coarse: _Coarse) -> PlanningResult:
        result = solve(problem, quick, warm_start=coarse.plan)
        return dataclasses.replace(result, history=coarse.history + result.history)

    straight = Way.along(NEITHER * len(problem.obstacles), _ends(problem))
    starts = [(STRAIGHT, straight)]
    starts += [(way.sides, way) for way in propose(problem, solves - 1)]
    with ThreadPoolExecutor(threads or _cores()) as pool:
        coarse = list(pool.map(solve_coarsely, starts))
        ranked = sorted(range(len(coarse)), key=lambda k: (coarse[k].merit, k))
        status = _first_status(coarse, ranked)
        queue = [k for k in ranked if status[k] == NOT_TRIED]
        found: dict[int, PlanningResult] = {}
        while queue and len(found) + FINE <= fine:
            batch, queue = queue[:FINE], queue[FINE:]
            results = pool.map(plan_finely, [coarse[k] for k in batch])
            found |= dict(zip(batch, results, strict=True))
            if any(found[k].certified for k in batch):
                break
    certified = [k for k in found if found[k].certified]
    chosen = min(certified, key=lambda k: (found[k].cost, k), default=None)
    best = found[chosen] if chosen is not None else None
    if (
        earlier is not None
        and earlier.certified
        and (best is None or best.cost > SWITCH * earlier.cost)
    ):
        chosen, best = None, earlier
    if best is None:  # as without a search
        chosen, best = 0, solve(problem, local, warm_start=None)
        found[chosen] = best
        if earlier is not None and not best.certified:
            chosen, best = None, earlier
    table = [
        _candidate(coarse[k], found.get(k), status[k], chosen=k == chosen)
        for k in ranked
    ]
    if earlier is not None:
        table.append(_earlier(problem, earlier, chosen=best is earlier))
    table.sort(key=_order)
    total = time.perf_counter() - begin
    return dataclasses.replace(
        best,
        times={**best.times, "search": total - best.times["total"], "total": total},
        candidates=tuple(table),
    )


def _first_status(coarse: list[_Coarse], ranked: list[int]) -> dict[int, str]:
    """What the coarse solutions alone say of each candidate."""
    status = {}
    seen: set[str] = set()
    for k in ranked:
        sides = coarse[k].way.sides
        if coarse[k].violation > PROMISING:
            status[k] = BLOCKED
        elif sides in seen:
            status[k] = SAME
        else:
            seen.add(sides)
            status[k] = NOT_TRIED
    return status


def affordable(problem: Problem, settings: Planner) -> tuple[int, int]:
    """What the budget buys: coarse solves, and plans at most.

    There is enough for the straight line and one way, and for `FINE` plans, in any
    budget.  Two thirds of the budget, at most, are for the coarse solves.
    """
    price = PRICES[problem.model.error_bound_varies]
    units = settings.time_budget / (price * _coarse_intervals(settings) / PRICED)
    solves = max(2, math.floor(2 / 3 * units))
    return solves, max(FINE, math.floor((units - solves) / FINE_PRICE))


def _coarse_intervals(settings: Planner) -> int:
    return max(min(COARSEST, settings.intervals), math.ceil(settings.intervals / 2))


def _solve_coarsely(
    problem: Problem, settings: Planner, start: str, way: Way
) -> _Coarse:
    transcription = Transcription(problem, _coarse_intervals(settings))
    if start == STRAIGHT:
        decisions = transcription.straight_line()
    else:
        decisions = transcription.along(way.points)
    history: list[Iteration] = []
    result = iterate_to_convergence(
        transcription,
        decisions,
        tolerance=0.01,
        max_iterations=ITERATIONS,
        report=history.append,
        coarse=True,
    )
    path = Way.along(way.sides, result.iterate.reference[:, 0])
    return _Coarse(
        start=start,
        way=dataclasses.replace(way, sides=sides_of(problem, path)),
        plan=transcription.plan(result.iterate),
        cost=result.iterate.cost,
        violation=result.violation,
        history=tuple(history),
    )


def _candidate(
    coarse: _Coarse, result: PlanningResult | None, status: str, *, chosen: bool
) -> Candidate:
    solved = result is not None and result.plan is not None
    plan = result.plan if result is not None and result.plan else coarse.plan
    return Candidate(
        start=coarse.start,
        sides=coarse.way.sides,
        length=coarse.way.length,
        coarse_cost=coarse.cost,
        violation=coarse.violation,
        status=status if result is None else result.status,
        cost=result.cost if result is not None and solved else None,
        chosen=chosen,
        path=_path(plan),
    )


def _earlier(problem: Problem, result: PlanningResult, *, chosen: bool) -> Candidate:
    """The candidate that was planned from the earlier plan."""
    path = _path(result.attempt) if result.attempt is not None else _ends(problem)
    way = Way.along(NEITHER * len(problem.obstacles), path)
    return Candidate(
        start=EARLIER,
        sides=sides_of(problem, way),
        length=way.length,
        coarse_cost=None,
        violation=None,
        status=result.status,
        cost=result.cost if result.plan is not None else None,
        chosen=chosen,
        path=path,
    )


def _order(candidate: Candidate) -> tuple[bool, float, bool, float, str, str]:
    """Certified ones by their cost, then the others by their coarse cost."""
    cost, coarse = candidate.cost, candidate.coarse_cost
    certified = candidate.status == "certified"
    return (
        not certified,
        cost if certified and cost is not None else math.inf,
        candidate.status == BLOCKED,
        math.inf if coarse is None else coarse,
        candidate.sides,
        candidate.start,
    )


def _path(plan: Plan) -> Array:
    time = np.linspace(plan.start_time, plan.end_time, 4 * len(plan.knots) - 3)
    return np.asarray(plan.reference(time)[:, 0])


def _ends(problem: Problem) -> Array:
    return np.stack([problem.start[0], problem.goal[0]])


def _cores() -> int:
    """That this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
