"""The search for the best sides: many coarse solves, few fine ones, one plan.

Every way that `sides.propose` finds, and the straight line, starts a sequential
convex program on half as many intervals.  The cheapest are then planned as any
other problem is, warm-started from their coarse plans, and the cheapest certified
plan is taken.  The straight line is one of them, planned exactly as without a search,
unless its coarse solution is hopeless; then it is planned last, if no other plan is
certified.  So a search never loses a plan.

How many are tried follows from a budget in seconds and the fixed prices below.
They are what a solve takes on the machine that they were measured on, in times of the
backend's own price; on a faster or slower one the search takes less or more time, but
never finds another plan.

Candidates are solved in threads.  A convex program runs outside of Python's global
lock, so two cores help, and the result does not depend on how many there are.
"""

from __future__ import annotations

import dataclasses
import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.backend import Effort, backend_of
from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.certify import certify
from dtmpc_drake.planning.search.sides import NEITHER, Way, propose, sides_of
from dtmpc_drake.planning.starts import Guess, along, straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.candidate import (
    BLOCKED,
    EARLIER,
    NOT_TRIED,
    SAME,
    STRAIGHT,
    Candidate,
)
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import Iteration, PlanningResult
from dtmpc_drake.scenario import Planner

FEWEST_INTERVALS = 14
"""Candidates are solved on half of the plan's intervals, but no fewer than this."""
ITERATIONS = 5
"""Convex programs for each candidate: enough to compare costs within some percent."""
COARSE_PRICE, FINE_PRICE = (0.05, 0.2), (0.1, 0.8)
"""Of a coarse solve, and of planning a candidate to its end, for a plan of `PRICED`
intervals, in s; where Δ is constant and where it varies."""
PRICED = 56
FINE_ITERATIONS = 10
"""At most, to plan a candidate to its end; a warm start rarely needs more than 3."""
FINE = 4
"""Candidates that are planned to their end at once."""
RANKING = 100.0
"""Price of a coarse solution's violation in the ranking; finer grids mend small
ones, at a cost."""
PROMISING = 0.05
"""A coarse solution that violates a limit by more is given up, in m, m/s, m/s²."""
ONE_PATH = 0.1
"""Solutions that are nowhere further apart are one, in m."""
SWITCH = 0.9
"""An earlier plan is left only for one that costs less than this part of it."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Coarse:
    """A start, solved on the coarse grid."""

    start: str
    way: Way
    plan: Plan
    cost: float
    violation: float
    history: tuple[Iteration, ...]

    @property
    def merit(self) -> float:
        """By which candidates are ranked."""
        return self.cost + RANKING * self.violation


class Solve(Protocol):
    """`planner.plan_problem`, without a search."""

    def __call__(
        self,
        problem: Problem,
        settings: Planner,
        /,
        *,
        warm_start: Guess | None,
        deadline: Deadline,
    ) -> PlanningResult:
        """Plans a problem."""


def plan_best_side(
    problem: Problem,
    settings: Planner,
    solve: Solve,
    *,
    warm_start: Guess | None = None,
    threads: int | None = None,
    deadline: Deadline = NEVER,
) -> PlanningResult:
    """Plans a problem on the best sides of its obstacles.

    Args:
        problem: to plan.
        settings: with the budget.
        solve: plans from a straight line or from an earlier plan, without a search.
        warm_start: an earlier plan.  It is kept if it is certified and nothing else
            is clearly cheaper (`SWITCH`).
        threads: at most so many at once; as many as there are cores if left out.
        deadline: after which no convex program is begun.

    Returns:
        The result of the best candidate, with the table of all.  Its history is
        that of the candidate alone, its coarse programs first.
    """
    begin = time.perf_counter()
    local = dataclasses.replace(settings, initial_guess="straight_line")
    earlier = None
    if warm_start is not None:
        earlier = solve(problem, local, warm_start=warm_start, deadline=deadline)
    solves, fine = affordable(problem, settings)

    def solve_coarsely(start: tuple[str, Way]) -> _Coarse:
        return _solve_coarsely(problem, local, *start, deadline)

    few = min(FINE_ITERATIONS, settings.max_iterations)
    quick = dataclasses.replace(local, max_iterations=few)

    def plan_finely(k: int) -> PlanningResult:
        if k == 0 and earlier is None:  # as without a search
            return solve(problem, local, warm_start=None, deadline=deadline)
        result = solve(problem, quick, warm_start=coarse[k].plan, deadline=deadline)
        result = _or_coarse(result, coarse[k], problem)
        return dataclasses.replace(result, history=coarse[k].history + result.history)

    straight = Way.along(NEITHER * len(problem.obstacles), _ends(problem))
    starts = [(STRAIGHT, straight)]
    ways = propose(problem, solves - 1)
    starts += [(way.sides, way) for way in ways if way.sides != straight.sides]
    with ThreadPoolExecutor(threads or _cores()) as pool:
        coarse = list(pool.map(solve_coarsely, starts))
        ranked = sorted(range(len(coarse)), key=lambda k: (coarse[k].merit, k))
        status = _first_status(coarse, ranked)
        queue = [k for k in ranked if status[k] == NOT_TRIED]
        if earlier is None and status[0] != BLOCKED:
            # Before all others, so that a search is never dearer than none.
            queue = [0, *(k for k in queue if k != 0)]
        found: dict[int, PlanningResult] = {}
        while queue and len(found) < fine:
            count = min(FINE, fine - len(found))
            batch, queue = queue[:count], queue[count:]
            found |= dict(zip(batch, pool.map(plan_finely, batch), strict=True))
            if any(_is_good(found[k]) for k in batch):
                break
    good = [k for k in found if _is_good(found[k])]
    chosen = min(good, key=lambda k: (found[k].cost, k), default=None)
    best = found[chosen] if chosen is not None else None
    if (
        earlier is not None
        and _is_good(earlier)
        and (best is None or best.cost > SWITCH * earlier.cost)
    ):
        chosen, best = None, earlier
    if best is None:
        chosen = 0
        if earlier is not None or chosen not in found:
            found[chosen] = solve(problem, local, warm_start=None, deadline=deadline)
        best = found[chosen]
        if earlier is not None and not _is_good(best):
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


def _is_good(result: PlanningResult) -> bool:
    """Whether a plan is certified, or would be if the model's bounds were proven."""
    if result.plan is None or result.certificate is None:
        return False
    return result.certificate.kept


def _or_coarse(
    result: PlanningResult, coarse: _Coarse, problem: Problem
) -> PlanningResult:
    """The coarse plan itself, if it is certified and the fine one is no better.

    That happens where the fine programs end in trouble.
    """
    if result.certified and result.cost <= coarse.cost:
        return result
    certificate = certify(coarse.plan, problem)
    if not certificate.certified:
        return result
    return dataclasses.replace(
        result,
        status="certified",
        message=certificate.reason,
        plan=coarse.plan,
        attempt=coarse.plan,
        certificate=certificate,
        cost=coarse.cost,
        history=(),
    )


def _first_status(coarse: list[_Coarse], ranked: list[int]) -> dict[int, str]:
    """What the coarse solutions alone say of each candidate."""
    status = {}
    kept: list[_Coarse] = []
    for k in ranked:
        new = coarse[k]
        if new.violation > PROMISING:
            status[k] = BLOCKED
        elif any(_are_same(new, other) for other in kept):
            status[k] = SAME
        else:
            kept.append(new)
            status[k] = NOT_TRIED
    return status


def _are_same(one: _Coarse, other: _Coarse) -> bool:
    """Whether two coarse solutions pass on the same sides, or are one path."""
    if one.way.sides == other.way.sides:
        return True
    knots = one.plan.knots
    apart = one.plan.reference(knots)[:, 0] - other.plan.reference(knots)[:, 0]
    return float(np.linalg.norm(apart, axis=1).max()) < ONE_PATH


def affordable(problem: Problem, settings: Planner) -> tuple[int, int]:
    """What the budget buys: coarse solves, and plans at most.

    In any budget there is enough for the straight line and one way.  Two thirds of
    a larger one are for the coarse solves.
    """
    varies = problem.model.error_bound_varies
    price = backend_of(settings.backend).price
    budget = settings.time_budget / (settings.intervals / PRICED) / price
    solves = max(2, math.floor(2 / 3 * budget / COARSE_PRICE[varies] + 1e-9))
    left = budget - solves * COARSE_PRICE[varies]
    return solves, max(2, math.floor(left / FINE_PRICE[varies] + 1e-9))


def _coarse_intervals(settings: Planner) -> int:
    return max(
        min(FEWEST_INTERVALS, settings.intervals), math.ceil(settings.intervals / 2)
    )


def _solve_coarsely(
    problem: Problem, settings: Planner, start: str, way: Way, deadline: Deadline
) -> _Coarse:
    transcription = Transcription(
        problem, _coarse_intervals(settings), settings.options, reach=0.5
    )
    if start == STRAIGHT:
        decisions = straight_line(transcription)
    else:
        decisions = along(transcription, way.points)
    history: list[Iteration] = []
    result = backend_of(settings.backend).refine(
        transcription,
        decisions,
        effort=Effort(ITERATIONS, tolerance=0.01, coarse=True),
        report=history.append,
        deadline=deadline,
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
    return plan.reference(time)[:, 0]


def _ends(problem: Problem) -> Array:
    return np.stack([problem.start[0], problem.goal[0]])


def _cores() -> int:
    """That this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
