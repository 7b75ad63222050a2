"""The one function that plans."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from dtmpc_drake.planning.backend import Solution, backend_of
from dtmpc_drake.planning.canonical import canonical
from dtmpc_drake.planning.deadline import Deadline
from dtmpc_drake.planning.for_user import (
    guess_in_units,
    report_for_user,
    result_for_user,
)
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.certify import OF_THE_SAMPLES, certify
from dtmpc_drake.planning.search.best_side import plan_best_side
from dtmpc_drake.planning.starts import Guess
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.certificate import Certificate
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import Iteration, PlanningResult, Status
from dtmpc_drake.scenario import Planner, Scenario, validate


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
    validate(scenario)
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
    own = canonical(problem)
    if own is not problem:
        result = plan_problem(
            own,
            settings,
            report=None if report is None else report_for_user(report, own.units),
            warm_start=guess_in_units(warm_start, own.units),
            deadline=deadline,
        )
        return result_for_user(result, own.units)
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

    solution = backend_of(settings.backend).solve(
        problem, settings, warm_start=warm_start, report=note, deadline=deadline
    )
    before = time.perf_counter()
    tr = solution.transcription
    attempt = tr.plan(solution.iterate)
    certificate = certify(attempt, problem)
    if certificate.broken and OF_THE_SAMPLES.issuperset(certificate.broken):
        # The decisions are good, but the tube that goes with them is too coarse.
        finer = Transcription(problem, tr.intervals, settings.options, refinement=2)
        attempt = finer.plan(finer.evaluate(*solution.iterate.decisions))
        certificate = certify(attempt, problem)
    after = time.perf_counter()
    status, message = _verdict(solution, certificate, deadline)
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
        cost=solution.iterate.cost,
        history=tuple(history),
        times=times,
        backend=settings.backend,
    )


def _check_warm_start(warm_start: Guess | None, problem: Problem) -> None:
    if not isinstance(warm_start, Plan):
        return
    chains, m = problem.law.chains, problem.model.num_outputs
    if warm_start.chains != chains:
        raise ValueError(
            f"warm_start: got a plan of {warm_start.chains.words} with"
            f" {warm_start.num_outputs} outputs, but it must be of {chains.words} with"
            f" {m} outputs, as the model is"
        )


def _verdict(
    solution: Solution, certificate: Certificate, deadline: Deadline
) -> tuple[Status, str]:
    late = f"stopped after {deadline}" if solution.out_of_time else ""
    stopped = f"the solver stopped with {solution.failure}" if solution.failure else ""
    if certificate.certified:
        return "certified", "; ".join(filter(None, [certificate.reason, late, stopped]))
    limits = ""
    if np.isfinite(solution.violation):
        if not solution.feasible and not certificate.kept:
            limits = _complaints(solution)
    elif not certificate.kept:
        limits = certificate.reason
    if late:
        why = limits or certificate.reason
        return "failed", f"{late}, which may be raised; until then: {why}"
    if stopped:
        return "failed", "; until then: ".join(filter(None, [stopped, limits]))
    if not np.isfinite(solution.violation):
        return "failed", limits or "the last iterate is not finite"
    if limits:
        return "infeasible", f"{limits}; no better plan from this start"
    return "not_certified", certificate.reason


def _complaints(solution: Solution) -> str:
    """Which limits cannot be kept together, where and when."""
    found = solution.transcription.complaints(solution.iterate)
    found.sort(reverse=True)
    return "cannot keep " + ", ".join(text for _, text in found)
