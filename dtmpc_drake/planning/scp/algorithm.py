"""TODO."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.scp.clarabel import borrowed
from dtmpc_drake.planning.scp.curvature import (
    Multipliers,
)
from dtmpc_drake.planning.scp.layout import Variables
from dtmpc_drake.planning.scp.linearise import (
    BACKOFF,
    INPUT_SCALE,
    RIGID,
    SECANT,
    Program,
    Shape,
    kinked_coordinates,
)
from dtmpc_drake.planning.transcription import (
    Iterate,
    Transcription,
)
from dtmpc_drake.records.result import Iteration

MAX_PENALTY = 1e6
SIMILAR = 16
"""Programs have room for half-planes in multiples of this, so that they are alike."""
ACCURACY, COARSE_ACCURACY = 5e-4, 2e-3
"""Tolerance of the duality gap; a fiftieth of it for feasibility."""
DOUBT = 0.6
"""Part of the tolerance that is left where a step was not walked to its end."""
PROXIMITY = 0.1
"""First weight of the square of the step, at most, after one that failed."""
MAX_FAILURES = 3
"""Programs that the solver may fail to solve before the iterations end."""
SHORTEST = 0.02
"""Steps are not walked by less than this fraction."""


def violation(iterate: Iterate) -> float:
    """The worst violation of obstacles, speed and (scaled) input, in their units.

    Measured from the backed-off limits: at most `BACKOFF` is feasible.
    """
    margins = [iterate.speed_margin.min(), iterate.input_margin.min() / INPUT_SCALE]
    for some in (iterate.error_margin, iterate.planes.margin):
        margins.append(some.min(initial=np.inf))
    # What is not a number violates everything.
    return float(np.nan_to_num(np.maximum(0.0, BACKOFF - np.min(margins)), nan=np.inf))


def _excess(violation: float) -> float:
    """The part of a violation that the merit function counts."""
    return max(violation - BACKOFF / 2, 0.0)


@dataclasses.dataclass
class Result:
    """What the iterations ended with.

    Attributes:
        iterate: the best found.
        converged: whether the merit function cannot fall by more than the
            tolerance any more.
        violation: of the iterate.
        failure: the solver's status, if it is what ended the iterations.
        out_of_time: whether it was the deadline.
        multipliers: of the last convex program.
    """

    iterate: Iterate
    converged: bool
    violation: float
    failure: str | None = None
    out_of_time: bool = False
    multipliers: Multipliers | None = None


def _walk(
    program: Program,
    current: Iterate,
    z: Array,
    merit: float,
    predicted: float,
    penalty: float,
    tries: int,
    deadline: Deadline,
) -> tuple[Array, Iterate, float, float]:
    """Walks along a step as far as the merit function keeps its promise.

    Args:
        program: that gave the step.
        current: to start from.
        z: the step.
        merit: at the start.
        predicted: decrease of the merit.
        penalty: of the violation.
        tries: 1 for the whole step only, 2 for ever smaller parts of it, 3 for a
            second-order correction before that.
        deadline: after which there is no correction.

    Returns:
        The step, the iterate that it leads to, the violation there, and the
        fraction of the step; the fraction is zero where nothing was gained.
    """
    tr = program.transcription

    def tried(z: Array) -> tuple[Iterate, float]:
        hint = program.turned(z)
        iterate = tr.evaluate(*program.decisions(current, z), hint=hint)
        return iterate, violation(iterate)

    def kept(iterate: Iterate, worst: float, fraction: float) -> bool:
        reached = iterate.cost + penalty * _excess(worst)
        return merit - reached >= 0.1 * fraction * predicted

    trial, worst = tried(z)
    if kept(trial, worst, 1.0):
        return z, trial, worst, 1.0
    bend = np.zeros_like(z)
    if tries > 2 and not deadline.passed:
        program.correct(z, trial)
        corrected, _ = program.solve(deadline)
        if corrected is not None:
            trial, worst = tried(corrected)
            if kept(trial, worst, 1.0):
                return corrected, trial, worst, 1.0
            # What is of second order shrinks with the square of the step.
            bend = corrected - z
    fraction = 0.5
    while tries > 1 and fraction > SHORTEST:
        part = fraction * z + fraction**2 * bend
        trial, worst = tried(part)
        if kept(trial, worst, fraction):
            return part, trial, worst, fraction
        fraction /= 2
    return 0 * z, current, violation(current), 0.0


@dataclasses.dataclass(frozen=True)
class Effort:
    """How far to go.

    Attributes:
        tolerance: stop when a program promises less than this fraction of the
            cost.
        max_iterations: at most so many convex programs.
        max_penalty: largest weight of the slack that is tried.
        coarse: solve the programs less accurately, and do without the
            second-order correction of steps that fail.
        thorough: correct and walk a step that promises little, too.
    """

    tolerance: float
    max_iterations: int
    max_penalty: float = MAX_PENALTY
    coarse: bool = False
    thorough: bool = True


def iterate_to_convergence(
    transcription: Transcription,
    decisions: tuple[Array, Array],
    *,
    effort: Effort,
    report: Callable[[Iteration], None],
    multipliers: Multipliers | None = None,
    deadline: Deadline = NEVER,
) -> Result:
    """Runs the sequential convex program from a start.

    Args:
        transcription: of the problem.
        decisions: coefficients and bandwidth to start from.
        effort: how far to go.
        report: is given every iteration.
        multipliers: of an earlier result for the same obstacles, on a grid half as
            fine.
        deadline: after which no convex program is begun.
    """
    tr = transcription
    current = tr.evaluate(*decisions)
    worst = violation(current)
    if not np.isfinite([worst, current.cost]).all():
        return Result(current, False, np.inf)
    # Other pieces may come near on the way.
    planes = len(current.planes.piece) + tr.intervals // 4
    planes = -(-planes // SIMILAR) * SIMILAR
    variables = Variables(tr, planes=planes, kinked=kinked_coordinates(tr))
    with borrowed(variables.layout) as solver:
        program = Program(
            tr,
            variables,
            solver,
            accuracy=COARSE_ACCURACY if effort.coarse else ACCURACY,
        )
        if multipliers is not None:
            program.multipliers = multipliers.refined(tr)
        result = _iterate(program, current, worst, effort, report, deadline)
        return dataclasses.replace(result, multipliers=program.multipliers)


def _iterate(
    program: Program,
    current: Iterate,
    worst: float,
    effort: Effort,
    report: Callable[[Iteration], None],
    deadline: Deadline,
) -> Result:
    """The iterations themselves, from an iterate with this worst violation."""
    tr, clock = program.transcription, time.perf_counter
    merits: list[float] = []
    stuck = failures = 0
    shape = Shape(rigid=worst < RIGID)
    for _ in range(effort.max_iterations):
        if deadline.passed:
            return Result(current, False, worst, out_of_time=True)
        t0 = clock()
        program.update(current, shape)
        t1 = clock()
        z, status = program.solve(deadline)
        if z is None and shape.rigid:
            shape = dataclasses.replace(shape, rigid=False)
            program.update(current, shape)
            z, status = program.solve(deadline)
        t2 = clock()
        if z is None:
            # Numerical trouble: a shorter step is an easier program.
            failures += 1
            if failures > MAX_FAILURES:
                return Result(current, False, worst, status)
            proximity = max(10 * shape.proximity, PROXIMITY)
            shape = dataclasses.replace(shape, proximity=proximity)
            continue
        slack, whole = max(float(z[-1]), 0.0), program.decided(z)
        merit = current.cost + shape.penalty * _excess(worst)
        model_cost = program.model_cost(z)
        predicted = merit - (model_cost + shape.penalty * _excess(slack))
        little = effort.tolerance * max(current.cost, 1e-3)
        # Where there is next to nothing to gain, it is not worth a correction.
        enough = DOUBT * little if effort.thorough else little
        last = predicted <= enough and worst <= BACKOFF
        tries = 2 if effort.thorough or not last else 1
        tries = tries if last or effort.coarse else 3
        step = _walk(
            program, current, z, merit, predicted, shape.penalty, tries, deadline
        )
        z, trial, trial_worst, fraction = step
        flat = current.local.pack() + program.variables.local(z)
        defect = np.abs(flat - trial.local.pack())
        bound = slice(-tr.order * tr.outputs, None)
        t3 = clock()
        report(
            Iteration(
                intervals=tr.intervals,
                cost=trial.cost,
                violation=trial_worst,
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
        secant = float(np.clip(moved, SECANT / 20, SECANT))
        shape = dataclasses.replace(shape, secant=secant)
        merits.append(merit)
        feasible, before = worst <= BACKOFF, current.cost
        current, worst = trial, trial_worst
        stuck = 0 if fraction else stuck + 1
        # What a program promised that could not keep it may be more than it seems.
        little = little if fraction == 1.0 else DOUBT * little
        # A feasible iterate has only its cost to lose.
        settled = feasible and before - model_cost <= little
        reached = current.cost + shape.penalty * _excess(worst)
        slow = len(merits) > 2 and merits[-3] - reached <= little
        # While programs say that all limits can be kept, they are to be.
        kept = worst <= BACKOFF or slack > BACKOFF
        done = (predicted <= little and kept) or settled or stuck > 3
        if worst <= BACKOFF and (done or (slow and not stuck)):
            return Result(current, True, worst)
        # A program that would rather break its rows than pay for keeping them is
        # not worth converging, but on coarse grids it need only find the way.
        cheap = slack > BACKOFF and not effort.coarse
        if shape.penalty < effort.max_penalty and (done or cheap):
            shape, stuck = dataclasses.replace(shape, penalty=10 * shape.penalty), 0
            merits.clear()
        elif done:
            return Result(current, False, worst)
        if fraction < 0.3:
            # One that would at least cost what the whole step promised.
            first = min(PROXIMITY, predicted / max(float(whole @ whole), 1e-12))
            proximity = max(4 * shape.proximity, first)
            shape = dataclasses.replace(shape, proximity=proximity)
        elif fraction == 1.0:
            shape = dataclasses.replace(shape, proximity=shape.proximity / 4)
    return Result(current, False, worst)
