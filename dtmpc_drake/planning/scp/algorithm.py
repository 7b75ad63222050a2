"""Sequential convex programming on Clarabel (the paper's section VII).

Each iteration linearises everything around an exactly propagated iterate, solves one
convex quadratic program with an exact penalty on a shared slack, and follows the step
as far as the merit function (exact cost plus exact penalty on the worst true
violation) keeps its promise.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.backend import (
    Backend,
    Effort,
    Report,
    Solution,
    register_backend,
)
from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.iterate import Decisions, Iterate
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.scp.clarabel import borrowed
from dtmpc_drake.planning.scp.curvature import Multipliers
from dtmpc_drake.planning.scp.linearise import (
    Program,
    Shape,
    kinked_coordinates,
    program_layout,
)
from dtmpc_drake.planning.starts import Guess, first_decisions
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.result import Iteration
from dtmpc_drake.scenario import Planner

SIMILAR = 16
"""Programs have room for half-planes in multiples of this, so that they are alike."""


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """What a convex program proposes, and what it promises.

    Attributes:
        z: the step.
        merit: where it starts.
        predicted: decrease of the merit.
        penalty: of the violation in the merit.
        tries: 1 for the whole step only, 2 for ever smaller parts of it, 3 for a
            second-order correction before that.
    """

    z: Array
    merit: float
    predicted: float
    penalty: float
    tries: int


@dataclasses.dataclass(frozen=True, eq=False)
class Taken:
    """What came of a step.

    Attributes:
        z: the part of the step that was taken.
        iterate: that it leads to.
        violation: there.
        fraction: of the step; zero where nothing was gained.
    """

    z: Array
    iterate: Iterate
    violation: float
    fraction: float


@dataclasses.dataclass
class State:
    """What iterations carry along.

    Attributes:
        current: the iterate.
        violation: of the iterate.
        shape: of the next program.
        merits: before every step since the penalty was raised last.
        stuck: steps in a row that gained nothing.
        failures: programs that were not solved.
    """

    current: Iterate
    violation: float
    shape: Shape
    merits: list[float] = dataclasses.field(default_factory=list)
    stuck: int = 0
    failures: int = 0


@register_backend
class SequentialConvex(Backend):
    """Coarse grids first: a step there costs half, and refining is exact."""

    name = "clarabel"

    def refine(
        self,
        transcription: Transcription,
        decisions: Decisions,
        *,
        effort: Effort,
        report: Report,
        deadline: Deadline = NEVER,
    ) -> Solution:
        """See base class."""
        solution, _ = _refined(
            transcription, decisions, effort=effort, report=report, deadline=deadline
        )
        return solution

    def solve(
        self,
        problem: Problem,
        settings: Planner,
        *,
        warm_start: Guess | None,
        report: Report,
        deadline: Deadline,
    ) -> Solution:
        """See base class.

        If the way over coarser grids ends infeasible, the bandwidth is held at its
        maximum until the reference is feasible, and released from there; not from a
        warm start, whose way that would forget.
        """
        options = settings.options
        free = warm_start is None and problem.start_bandwidth is None
        free = free and not problem.bandwidth.is_fixed
        few = 10 * options.penalty
        solution = self._over_grids(
            problem,
            settings,
            warm_start=warm_start,
            # Rather than insist, look for another way.
            max_penalty=few if free else options.max_penalty,
            report=report,
            deadline=deadline,
        )
        if solution.feasible or not free or solution.out_of_time:
            return solution
        tr = solution.transcription
        held = dataclasses.replace(
            problem, bandwidth=problem.bandwidth.at(tr.bandwidth.high)
        )
        first = self.solve(
            held, settings, warm_start=None, report=report, deadline=deadline
        )
        start = first.iterate if first.feasible else solution.iterate
        last = self.refine(
            tr,
            start.decisions,
            effort=Effort(
                settings.max_iterations, few if first.feasible else options.max_penalty
            ),
            report=report,
            deadline=deadline,
        )
        if first.feasible and not last.feasible:
            return dataclasses.replace(first, transcription=tr)
        return last

    def _over_grids(
        self,
        problem: Problem,
        settings: Planner,
        *,
        warm_start: Guess | None,
        max_penalty: float,
        report: Report,
        deadline: Deadline,
    ) -> Solution:
        options, grids = settings.options, [settings.intervals]
        coarsest = 2 * options.coarsest
        while warm_start is None and grids[0] % 2 == 0 and grids[0] >= coarsest:
            grids.insert(0, grids[0] // 2)
        decisions: Decisions | None = None
        multipliers: Multipliers | None = None
        for level, intervals in enumerate(grids):
            cold = max(options.near, 0.5**level)
            reach = cold if warm_start is None else options.near
            tr = Transcription(problem, intervals, options, reach=reach)
            if decisions is None:
                decisions = first_decisions(tr, warm_start)
            last = intervals == grids[-1]
            effort = Effort(
                settings.max_iterations if last else options.coarse_iterations,
                max_penalty,
                coarse=not last,
                thorough=warm_start is None,
            )
            solution, multipliers = _refined(
                tr,
                decisions,
                effort=effort,
                report=report,
                deadline=deadline,
                multipliers=multipliers,
            )
            decisions = (
                tr.splines.refined(solution.iterate.coefficients),
                _doubled(solution.iterate.bandwidth),
            )
        return solution


def _doubled(values: Array) -> Array:
    """Linear interpolation to twice as many intervals."""
    result = np.repeat(values, 2, axis=0)[:-1]
    result[1::2] = (values[:-1] + values[1:]) / 2
    return result


def _refined(
    tr: Transcription,
    decisions: Decisions,
    *,
    effort: Effort,
    report: Report,
    deadline: Deadline,
    multipliers: Multipliers | None = None,
) -> tuple[Solution, Multipliers | None]:
    """As `Backend.refine`, and the multipliers of the last program.

    Args:
        tr: of the problem.
        decisions: to start from.
        effort: how far to go.
        report: is given every iteration.
        deadline: after which no convex program is begun.
        multipliers: of an earlier solution for the same obstacles, on a grid half as
            fine.
    """
    options, current = tr.options, tr.evaluate(*decisions)
    worst = tr.violation(current)
    if not np.isfinite([worst, current.cost]).all():
        return Solution(tr, current, np.inf), None
    # Other pieces may come near on the way.
    planes = len(current.planes) + tr.intervals // 4
    planes = -(-planes // SIMILAR) * SIMILAR
    variables = Variables(tr, planes=planes, kinked=kinked_coordinates(tr))
    if multipliers is None:
        prices = Multipliers.none(tr, current)
    else:
        prices = multipliers.refined(tr, current)
    accuracy = options.coarse_accuracy if effort.coarse else options.accuracy
    shape = Shape(options.penalty, options.secant, rigid=worst < options.rigid)
    with borrowed(program_layout(tr, variables)) as solver:
        program = Program(tr, variables, solver, prices, accuracy=accuracy)
        state = State(current, worst, shape)
        solution = _iterate(program, state, effort, report, deadline)
        return solution, program.multipliers


def _iterate(
    program: Program, state: State, effort: Effort, report: Report, deadline: Deadline
) -> Solution:
    """The iterations themselves."""
    tr, options, clock = (
        program.transcription,
        program.transcription.options,
        time.perf_counter,
    )

    def ended(converged: bool = False, failure: str | None = None) -> Solution:
        return Solution(tr, state.current, state.violation, converged, failure)

    max_penalty = effort.max_penalty or options.max_penalty
    tolerance = effort.tolerance or options.tolerance
    for _ in range(effort.max_iterations):
        if deadline.passed:
            return dataclasses.replace(ended(), out_of_time=True)
        t0 = clock()
        program.update(state.current, state.shape)
        t1 = clock()
        z, status = program.solve(deadline)
        if z is None and state.shape.rigid:
            state.shape = dataclasses.replace(state.shape, rigid=False)
            program.update(state.current, state.shape)
            z, status = program.solve(deadline)
        t2 = clock()
        if z is None:
            # Numerical trouble: a shorter step is an easier program.
            state.failures += 1
            if state.failures > options.max_failures:
                return ended(failure=status)
            proximity = max(10 * state.shape.proximity, options.proximity)
            state.shape = dataclasses.replace(state.shape, proximity=proximity)
            continue
        current, worst, shape = state.current, state.violation, state.shape
        slack, whole = max(float(z[-1]), 0.0), program.decided(z)
        merit = current.cost + shape.penalty * _excess(tr, worst)
        model_cost = program.model_cost(z)
        predicted = merit - (model_cost + shape.penalty * _excess(tr, slack))
        little = tolerance * max(current.cost, 1e-3)
        # Where there is next to nothing to gain, it is not worth a correction.
        enough = options.doubt * little if effort.thorough else little
        last = predicted <= enough and worst <= options.backoff
        tries = 2 if effort.thorough or not last else 1
        tries = tries if last or effort.coarse else 3
        step = Step(z, merit, predicted, shape.penalty, tries)
        taken = line_search(program, current, step, deadline)
        trial, fraction = taken.iterate, taken.fraction
        flat = current.local.pack() + program.variables.local(taken.z)
        defect = np.abs(flat - trial.local.pack())
        bound = slice(-tr.order * tr.outputs, None)
        t3 = clock()
        report(
            Iteration(
                intervals=tr.intervals,
                cost=trial.cost,
                violation=taken.violation,
                slack=slack,
                defect=float(defect[:, bound].max()),
                step=float(np.abs(trial.coefficients - current.coefficients).max()),
                fraction=fraction,
                proximity=shape.proximity,
                predicted=predicted,
                update_time=t1 - t0,
                solve_time=t2 - t1,
                evaluate_time=t3 - t2,
                status=status,
            )
        )
        moved = np.abs(trial.local.state - current.local.state)[:, 1:].max(initial=0.0)
        secant = float(np.clip(moved, options.secant / 20, options.secant))
        state.shape = dataclasses.replace(shape, secant=secant)
        state.merits.append(merit)
        feasible, before = worst <= options.backoff, current.cost
        state.current, state.violation = trial, taken.violation
        state.stuck = 0 if fraction else state.stuck + 1
        # What a program promised that could not keep it may be more than it seems.
        little = little if fraction == 1.0 else options.doubt * little
        # A feasible iterate has only its cost to lose.
        settled = feasible and before - model_cost <= little
        reached = trial.cost + shape.penalty * _excess(tr, state.violation)
        slow = len(state.merits) > 2 and state.merits[-3] - reached <= little
        # While programs say that all limits can be kept, they are to be.
        kept = state.violation <= options.backoff or slack > options.backoff
        done = (predicted <= little and kept) or settled or state.stuck > 3
        if state.violation <= options.backoff and (done or (slow and not state.stuck)):
            return ended(converged=True)
        # A program that would rather break its rows than pay for keeping them is
        # not worth converging, but on coarse grids it need only find the way.
        cheap = slack > options.backoff and not effort.coarse
        if shape.penalty < max_penalty and (done or cheap):
            penalty, state.stuck = 10 * shape.penalty, 0
            state.shape = dataclasses.replace(state.shape, penalty=penalty)
            state.merits.clear()
        elif done:
            return ended()
        if fraction < 0.3:
            # One that would at least cost what the whole step promised.
            price = predicted / max(float(whole @ whole), 1e-12)
            proximity = max(4 * shape.proximity, min(options.proximity, price))
            state.shape = dataclasses.replace(state.shape, proximity=proximity)
        elif fraction == 1.0:
            proximity = shape.proximity / 4
            state.shape = dataclasses.replace(state.shape, proximity=proximity)
    return ended()


def line_search(
    program: Program, current: Iterate, step: Step, deadline: Deadline
) -> Taken:
    """Follows a step as far as the merit function keeps its promise.

    Args:
        program: that gave the step.
        current: to start from.
        step: to follow.
        deadline: after which there is no correction.
    """
    tr = program.transcription

    def tried(z: Array, fraction: float) -> Taken:
        iterate = tr.evaluate(*program.decisions(current, z), hint=program.turned(z))
        return Taken(z, iterate, tr.violation(iterate), fraction)

    def kept(trial: Taken) -> bool:
        reached = trial.iterate.cost + step.penalty * _excess(tr, trial.violation)
        return step.merit - reached >= 0.1 * trial.fraction * step.predicted

    trial = tried(step.z, 1.0)
    if kept(trial):
        return trial
    correction = np.zeros_like(step.z)
    if step.tries > 2 and not deadline.passed:
        program.correct(step.z, trial.iterate)
        corrected, _ = program.solve(deadline)
        if corrected is not None:
            trial = tried(corrected, 1.0)
            if kept(trial):
                return trial
            # What is of second order shrinks with the square of the step.
            correction = corrected - step.z
    fraction = 0.5
    while step.tries > 1 and fraction > tr.options.shortest_step:
        trial = tried(fraction * step.z + fraction**2 * correction, fraction)
        if kept(trial):
            return trial
        fraction /= 2
    return Taken(0 * step.z, current, tr.violation(current), 0.0)


def _excess(tr: Transcription, violation: float) -> float:
    """The part of a violation that the merit function counts."""
    return max(violation - tr.options.backoff / 2, 0.0)
