"""The one function that plans."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from dtmpc_drake.numerics import splines
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.deadline import Deadline
from dtmpc_drake.planning.ipopt.solver import solve_nlp
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.certify import OF_THE_SAMPLES, certify
from dtmpc_drake.planning.scp.algorithm import (
    MAX_PENALTY,
    Effort,
    Result,
    iterate_to_convergence,
)
from dtmpc_drake.planning.scp.curvature import Multipliers
from dtmpc_drake.planning.scp.linearise import BACKOFF, PENALTY
from dtmpc_drake.planning.search.best_side import plan_best_side
from dtmpc_drake.planning.transcription import Guess, Iterate, Transcription
from dtmpc_drake.records.certificate import Certificate
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import Iteration, PlanningResult, Status
from dtmpc_drake.scenario import Planner, Scenario

TOLERANCE = 0.025
"""Iterations stop when the next one promises less than this part of the cost."""
COARSEST = 12
"""Grids are halved for a first solution, down to no less than this."""
NEAREST = 0.3
"""Reach near a solution; from a cold start it is larger, see `Transcription`."""
COARSE_ITERATIONS = 2
"""On each of the coarser grids: they only have to find the way."""


def plan(
    scenario: Scenario,
    *,
    report: Callable[[Iteration], None] | None = None,
    warm_start: Plan | None = None,
) -> PlanningResult:
    """Plans a scenario from its start, with the obstacles that are known then.

    Args:
        scenario: is validated first.
        report: is called with every iteration as it ends.
        warm_start: an earlier plan to start from, instead of the straight line.

    Returns:
        The result; look at its status.

    Raises:
        ScenarioError: if the scenario makes no sense.
        ValueError: if `warm_start` is of another order or number of outputs.
    """
    scenario.validate()
    return plan_problem(
        Problem.from_scenario(scenario),
        scenario.planner,
        report=report,
        warm_start=warm_start,
    )


def plan_problem(
    problem: Problem,
    settings: Planner,
    *,
    report: Callable[[Iteration], None] | None = None,
    warm_start: Guess | None = None,
    deadline: Deadline | None = None,
) -> PlanningResult:
    """Plans any problem, such as one that starts on the way; see `plan`.

    With ``initial_guess: best_side`` a certified plan from `warm_start` is kept
    unless another side is clearly cheaper; see `best_side`.

    Args:
        problem: to plan.
        settings: how.
        report: is called with every iteration as it ends.
        warm_start: to start from, of the problem's order and number of outputs.
        deadline: that counts instead of ``settings.time_limit``.

    Raises:
        ValueError: if `warm_start` has another order or number of outputs.
    """
    _check_warm_start(warm_start, problem)
    deadline = Deadline.after(settings.time_limit) if deadline is None else deadline
    # A goal that is free has no sides to pass on the way.
    if settings.initial_guess == "best_side" and np.isfinite(problem.goal).all():
        best = plan_best_side(
            problem, settings, plan_problem, warm_start=warm_start, deadline=deadline
        )
        if report is not None:
            for iteration in best.history:
                report(iteration)
        return best
    start = time.perf_counter()
    history: list[Iteration] = []

    def note(iteration: Iteration) -> None:
        history.append(iteration)
        if report is not None:
            report(iteration)

    if settings.backend == "ipopt":
        transcription = Transcription(problem, settings.intervals)
        decisions = _first_decisions(transcription, warm_start)
        result = solve_nlp(transcription, decisions, report=note, deadline=deadline)
    else:
        transcription, result = _sequential_convex(
            problem, settings, warm_start=warm_start, report=note, deadline=deadline
        )
    before = time.perf_counter()
    attempt = transcription.plan(result.iterate)
    certificate = certify(attempt, problem)
    if certificate.broken and OF_THE_SAMPLES.issuperset(certificate.broken):
        # The decisions are good, but the tube that goes with them is too coarse.
        finer = Transcription(problem, transcription.intervals, refinement=2)
        decisions = result.iterate.coefficients, result.iterate.bandwidth
        attempt = finer.plan(finer.evaluate(*decisions))
        certificate = certify(attempt, problem)
    after = time.perf_counter()
    status, message = _verdict(transcription, result, certificate, deadline)
    times = {
        "update": sum(i.update_time for i in history),
        "solve": sum(i.solve_time for i in history),
        "evaluate": sum(i.evaluate_time for i in history),
        "certify": after - before,
        "total": after - start,
    }
    return PlanningResult(
        status=status,
        message=message,
        plan=attempt if status in ("certified", "not_certified") else None,
        attempt=attempt,
        certificate=certificate,
        cost=result.iterate.cost,
        history=tuple(history),
        times=times,
        backend=settings.backend,
    )


def _check_warm_start(warm_start: Guess | None, problem: Problem) -> None:
    if not isinstance(warm_start, Plan):
        return
    n, m = problem.model.order, problem.model.num_outputs
    if (warm_start.order, warm_start.num_outputs) != (n, m):
        raise ValueError(
            f"warm_start: got a plan of order {warm_start.order} with"
            f" {warm_start.num_outputs} outputs, but it must be of order {n} with {m}"
            " outputs, as the model is"
        )


def _first_decisions(
    transcription: Transcription, warm_start: Guess | None
) -> tuple[Array, Array]:
    if warm_start is None:
        return transcription.straight_line()
    return transcription.from_plan(warm_start)


def _sequential_convex(
    problem: Problem,
    settings: Planner,
    *,
    warm_start: Guess | None,
    report: Callable[[Iteration], None],
    deadline: Deadline,
) -> tuple[Transcription, Result]:
    """Coarse grids first: a step there costs half, and refining is exact.

    If that ends infeasible, the bandwidth is held at its maximum until the
    reference is feasible, and released from there; not from a warm start, whose
    way that would forget.
    """
    free = warm_start is None and problem.start_bandwidth is None
    free = free and not problem.bandwidth_is_fixed
    grids = [settings.intervals]
    while warm_start is None and grids[0] % 2 == 0 and grids[0] >= 2 * COARSEST:
        grids.insert(0, grids[0] // 2)
    decisions: tuple[Array, Array] | None = None
    multipliers: Multipliers | None = None
    for level, intervals in enumerate(grids):
        reach = NEAREST if warm_start is not None else max(NEAREST, 0.5**level)
        transcription = Transcription(problem, intervals, reach=reach)
        if decisions is None:
            decisions = _first_decisions(transcription, warm_start)
        last = intervals == grids[-1]
        result = iterate_to_convergence(
            transcription,
            decisions,
            effort=Effort(
                tolerance=TOLERANCE,
                max_iterations=settings.max_iterations if last else COARSE_ITERATIONS,
                coarse=not last,
                thorough=warm_start is None,
                # Rather than insist, look for another way.
                max_penalty=10 * PENALTY if free else MAX_PENALTY,
            ),
            report=report,
            multipliers=multipliers,
            deadline=deadline,
        )
        if not last:
            multipliers = result.multipliers
            decisions = (
                splines.refine(result.iterate.coefficients, transcription.degree),
                _doubled(result.iterate.bandwidth),
            )
    if result.violation > BACKOFF and free and not result.out_of_time:
        high = transcription.bandwidth_high
        held = dataclasses.replace(problem, bandwidth_min=high, bandwidth_max=high)
        _, first = _sequential_convex(
            held, settings, warm_start=None, report=report, deadline=deadline
        )
        feasible = first.violation <= BACKOFF
        start = first.iterate if feasible else result.iterate
        result = iterate_to_convergence(
            transcription,
            (start.coefficients, start.bandwidth),
            effort=Effort(
                tolerance=TOLERANCE,
                max_iterations=settings.max_iterations,
                max_penalty=10 * PENALTY if feasible else MAX_PENALTY,
            ),
            report=report,
            deadline=deadline,
        )
        if feasible and result.violation > BACKOFF:
            result = first
    return transcription, result


def _doubled(values: Array) -> Array:
    """Linear interpolation to twice as many intervals."""
    result = np.repeat(values, 2, axis=0)[:-1]
    result[1::2] = (values[:-1] + values[1:]) / 2
    return result


def _verdict(
    transcription: Transcription,
    result: Result,
    certificate: Certificate,
    deadline: Deadline,
) -> tuple[Status, str]:
    late = f"stopped after {deadline}" if result.out_of_time else ""
    stopped = f"the solver stopped with {result.failure}" if result.failure else ""
    if certificate.certified:
        return "certified", "; ".join(filter(None, [certificate.reason, late, stopped]))
    limits = ""
    if np.isfinite(result.violation):
        if result.violation > BACKOFF and not certificate.kept:
            limits = _limits(transcription, result.iterate)
    elif not certificate.kept:
        limits = certificate.reason
    if late:
        why = limits or certificate.reason
        return "failed", f"{late}, which may be raised; until then: {why}"
    if stopped:
        return "failed", "; until then: ".join(filter(None, [stopped, limits]))
    if not np.isfinite(result.violation):
        return "failed", limits or "the last iterate is not finite"
    if limits:
        return "infeasible", f"{limits}; no better plan from this start"
    return "not_certified", certificate.reason


def _limits(transcription: Transcription, iterate: Iterate) -> str:
    """Which constraints cannot be met together, where and when."""
    tr, knots = transcription, transcription.knots
    found = []
    planes = iterate.planes
    if planes.margin.size and planes.margin.min() < 0:
        row, point = np.unravel_index(planes.margin.argmin(), planes.margin.shape)
        when = knots[planes.piece[row]] + tr.step * point / tr.control_degree
        obstacle = tr.problem.obstacles.index[planes.obstacle[row]]
        text = f"obstacle {obstacle} by {-planes.margin.min():.3f} m"
        found.append((-planes.margin.min(), f"{text} at t = {when:.2f} s"))
    worst = -iterate.speed_margin.min()
    if worst > 0:
        piece, _, axis, _ = np.unravel_index(
            iterate.speed_margin.argmin(), iterate.speed_margin.shape
        )
        text = f"speed limit on axis {axis} by {worst:.3f} m/s"
        found.append((worst, f"{text} at t = {knots[piece]:.2f} s"))
    worst = -iterate.input_margin.min()
    if worst > 0:
        when = knots[0] + tr.step * iterate.input_margin.argmin() / tr.tube_steps
        text = f"input limit by {worst:.3f} m/s^{tr.order}"
        found.append((worst, f"{text} at t = {when:.2f} s"))
    worst = -iterate.error_margin.min(initial=np.inf)
    if worst > 0:
        text = f"the constant uncertainty bound by {worst:.3f} m/s^{tr.order}"
        found.append((worst, text))
    found.sort(reverse=True)
    return "cannot keep " + ", ".join(text for _, text in found)
