"""Planning on the way: from an old plan and a measurement to what is flown next."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.stopping import stopping_time
from dtmpc_drake.method.tightening import Instant, input_bound
from dtmpc_drake.method.tube import (
    Tube,
    TubeStart,
    propagate_error_bounds,
    stages_of_bounds,
)
from dtmpc_drake.numerics.arrays import Array, BoolArray, FloatArray
from dtmpc_drake.planning.canonical import own_units
from dtmpc_drake.planning.deadline import Deadline
from dtmpc_drake.planning.planner import plan_problem
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.certify import clearance_ahead
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import Decision, ReplanStatus
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Scenario

BRAKING = (0.6, 0.4, 0.25, 0.9)
"""Parts of the input that the feedback leaves, with which stops are tried, in order.
The guess brakes half as hard again at its peak, so that 0.6 nearly takes it all."""
STOPS = 2.0
"""A plan to rest is at least this many stopping times long."""
ITERATIONS = 12
"""Convex programs at most for each try: what needs more comes too late."""
LAYER_TOLERANCE = 1e-6
"""By how much a measured |s| may exceed Φ for rounding, relative."""
CLOSE = 1e-3
"""Two states that are no further apart are the same, in own units."""
CARRY_STEP = 5e-3
"""Step at most, with which the measured error is carried to the hand-over, in the own
unit of time."""


@dataclasses.dataclass(frozen=True, eq=False)
class Slowed:
    """An old plan flown ever more slowly until it rests: where a stop starts from.

    Attributes:
        plan: the old one.
        start: when it begins to slow down, in s.
        duration: until it rests, in s; it moves on by half of that.
        highest_bandwidth: that a stop may use, ``(m,)``.
    """

    plan: Plan
    start: float
    duration: float
    highest_bandwidth: Array

    def reference(self, time: FloatArray | float) -> FloatArray:
        """See `Plan.reference`; only the position is right."""
        x = np.clip((np.asarray(time) - self.start) / self.duration, 0.0, 1.0)
        # Its own clock runs at a rate of 1 - 3x² + 2x³.
        return self.plan.reference(self.start + self.duration * (x - x**3 + x**4 / 2))

    def bandwidth(self, time: FloatArray | float) -> FloatArray:
        """The highest, everywhere."""
        return np.broadcast_to(
            self.highest_bandwidth, (*np.shape(time), len(self.highest_bandwidth))
        )


def carried_start(
    plan: Plan, problem: Problem, *, measured_at: float, state: Array, until: float
) -> TubeStart:
    """What a plan's error may have become since it was measured.

    The tube that opens at the measurement is propagated along the plan.  It is
    never larger than the plan's own.

    Args:
        plan: that is flown all the time.
        problem: gives the model and the controller.
        measured_at: in s.
        state: x that was measured, ``(n, m)``.
        until: in s, at least `measured_at`.

    Returns:
        What a new plan's tube opens from then.
    """
    law, n = problem.law, problem.law.order
    error = state - plan.reference(measured_at)[:n]
    start = TubeStart.of_error(
        error, plan.boundary_layer(measured_at), law.slope, law.chains
    )
    stages, highest = start.stages, start.highest
    if until > measured_at:
        longest = CARRY_STEP * own_units(problem).time
        steps = max(2, int(np.ceil((until - measured_at) / longest)))
        times = np.linspace(measured_at, until, 2 * steps + 1)
        tube = _tube_along(plan, problem, times, start)
        stages, highest = tube.stages[-1], law.chains.top(tube.error_bound[-1])
    own = plan.error_bound(until)
    stages = np.minimum(stages, stages_of_bounds(law.chains, own, law.slope))
    stages[-1] = plan.boundary_layer(until)
    return TubeStart(stages, np.minimum(highest, law.chains.top(own)))


def _tube_along(plan: Plan, problem: Problem, time: Array, start: TubeStart) -> Tube:
    """The tube along a part of a plan.

    Args:
        plan: whose layer is used.
        problem: gives the model and the controller.
        time: a half grid, ``(2 M + 1,)``, uniform, in s.
        start: what it opens from at the first of these times.
    """
    reference = plan.reference(time)[:, : problem.model.order]
    layer, layer_rate = plan.layer(time)
    return propagate_error_bounds(
        problem.law,
        reference=reference,
        bandwidth=problem.law.implied_bandwidth(reference, layer, layer_rate),
        layer=layer[::2],
        layer_rate=layer_rate[::2],
        start=start,
        velocity_bound=problem.velocity_bound,
        step=float(time[2] - time[0]),
    )


def problem_on_the_way(
    problem: Problem, plan: Plan, *, measured_at: float, state: Array, start: float
) -> Problem:
    """The same problem from a plan's reference at a later time.

    The new plan goes on with y*, its derivatives up to the n-th, α and Φ of the
    old one, and its tube opens from the measured error.

    Args:
        problem: at the start, with the obstacles that are known by now.
        plan: the old one.
        measured_at: in s.
        state: x that was measured, ``(n, m)``.
        start: when the new plan takes over, in s.
    """
    reference = plan.reference(start)
    n = problem.model.order
    return dataclasses.replace(
        problem,
        start_time=start,
        duration=problem.start_time + problem.duration - start,
        start=reference[:n],
        start_highest=reference[n],
        start_bandwidth=plan.bandwidth(start),
        tube_start=carried_start(
            plan, problem, measured_at=measured_at, state=state, until=start
        ),
    )


def shortest_duration(scenario: Scenario) -> float:
    """Of a plan, in s: with less time left there is no new one to the goal."""
    return fewest_intervals(scenario) * scenario.duration / scenario.planner.intervals


def fewest_intervals(scenario: Scenario) -> int:
    """Of a plan: the least that a scenario may ask for."""
    return 2 * scenario.model.order + 2


def replan(
    scenario: Scenario,
    plan: Plan,
    *,
    known: BoolArray,
    measured_at: float,
    state: Array,
    start: float,
    news: bool = True,
) -> Decision:
    """Decides what is flown from a time on.

    A certified plan to the goal, found from the old plan; else the old plan, if
    its tube is clear of all that is known; else a certified plan to rest anywhere;
    else a certified plan to the goal from a straight line; else whatever of these
    keeps the largest distance, which is called unsafe.  From a plan that does not
    end at the goal the first try is the straight line.

    A stop comes before the second search because it is found quickly: a way on may
    then be looked for while it is flown.

    A vehicle that was measured outside of its boundary layer is not where any tube
    says it is: whatever is found then is called unsafe.

    Args:
        scenario: the whole experiment.
        plan: the old one, which is flown until `start`.
        known: which obstacles are known, ``(o,)``.
        measured_at: in s.
        state: x that was measured, ``(n, m)``.
        start: when the outcome takes effect, in s.
        news: whether the old plan does not know all of `known`.  Where not, the
            sides on which it passes are settled, and `initial_guess: best_side`
            looks for no others.
    """
    whole = Problem.from_scenario(scenario, known)
    problem = problem_on_the_way(
        whole, plan, measured_at=measured_at, state=state, start=start
    )
    decision = _decide(scenario, plan, problem, measured_at=measured_at, news=news)
    outside = _outside(plan, problem, measured_at=measured_at, state=state)
    if outside:
        message = f"{outside}; {decision.status}: {decision.message}"
        return dataclasses.replace(decision, status="unsafe", message=message)
    return decision


def _outside(plan: Plan, problem: Problem, *, measured_at: float, state: Array) -> str:
    """Where a measured state is outside of its layer; nothing if it is inside."""
    error = state - plan.reference(measured_at)[: problem.model.order]
    s = problem.law.sliding_variable(error)
    share = np.abs(s) / plan.boundary_layer(measured_at)
    # What is not a number is nowhere.
    axis = int(np.argmax(np.where(np.isfinite(share), share, np.inf)))
    if share[axis] <= 1 + LAYER_TOLERANCE:
        return ""
    where = f"|s|/Φ = {share[axis]:.3g} on {problem.model.axes[axis]}"
    return f"measured outside of the boundary layer ({where})"


def _decide(
    scenario: Scenario,
    plan: Plan,
    problem: Problem,
    *,
    measured_at: float,
    news: bool,
) -> Decision:
    """What `replan` decides for a vehicle that is inside its boundary layer."""
    start = problem.start_time
    tries = _Tries(scenario)
    left = problem.duration
    enough = left >= shortest_duration(scenario) - 1e-9
    arrives = _heads_for_goal(plan, problem)
    search = news or not arrives
    if enough and tries.certified(problem, left, plan if arrives else None, search):
        return tries.decision("certified")
    why = tries.message or "too little time is left for a new plan"
    distance = np.inf
    if len(problem.obstacles):
        distance = clearance_ahead(plan, problem, measured_at).value
    if distance >= 0:
        return Decision("kept", why, None, None, tries.iterations)

    stop = problem.to_rest()
    best: PlanningResult | None = None
    for seconds in _stopping_times(problem, plan):
        guess = Slowed(plan, start, seconds, problem.bandwidth.high)
        longest = max(left, STOPS * seconds, shortest_duration(scenario))
        if tries.certified(stop, longest, guess):
            return tries.decision("braking", f"no way to the goal: {why}")
        certificate = tries.last.certificate
        clear = certificate.margins.get("obstacles") if certificate else None
        if clear is not None and clear.value > distance:
            best, distance = tries.last, clear.value
    if enough and arrives and tries.certified(problem, left, None):
        return tries.decision("certified")
    unit = problem.model.length_unit
    message = f"nothing is certified; obstacles {distance:+.4f} {unit}"
    if best is None:
        return Decision("unsafe", message, None, None, tries.iterations)
    return Decision("unsafe", message, best.attempt, best.cost, tries.iterations)


def _heads_for_goal(plan: Plan, problem: Problem) -> bool:
    """Whether a plan is to end where the goal says, and not a stop on the way.

    Of a goal that is soft a plan may fall short; one that then rests, farther from
    the goal than from where it is, is taken for a stop.
    """
    n, rows = problem.model.order, problem.goal_rows
    end = plan.reference(plan.end_time)[:n]
    close = CLOSE * own_units(problem).of_rows(n)
    if (np.abs(end - problem.goal) >= close)[rows].any():
        return False
    left, way = (
        float(np.linalg.norm(end[0] - x[0])) for x in (problem.goal, problem.start)
    )
    rests = problem.model.order > 1 and bool((np.abs(end) < close)[1:].all())
    return 0 in rows or not rests or left <= max(way, close[0, 0])


class _Tries:
    """Plans on the way, one after the other, and what they took together."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._deadline = Deadline.after(scenario.planner.time_limit)
        self._results: list[PlanningResult] = []

    def certified(
        self,
        problem: Problem,
        duration: float,
        guess: Plan | Slowed | None,
        search: bool = True,
    ) -> bool:
        """Whether a problem of this duration has a certified plan from this guess."""
        planner = self._scenario.planner
        interval = self._scenario.duration / planner.intervals
        least = fewest_intervals(self._scenario)
        settings = dataclasses.replace(
            planner,
            intervals=max(round(duration / interval), least),
            max_iterations=min(ITERATIONS, planner.max_iterations),
            initial_guess=planner.initial_guess if search else "straight_line",
        )
        problem = dataclasses.replace(problem, duration=duration)
        self._results.append(
            plan_problem(problem, settings, warm_start=guess, deadline=self._deadline)
        )
        return self.last.certified

    @property
    def last(self) -> PlanningResult:
        """The latest result."""
        return self._results[-1]

    @property
    def message(self) -> str:
        """What the latest result says; nothing before the first one."""
        return f"{self.last.status}, {self.last.message}" if self._results else ""

    @property
    def iterations(self) -> int:
        """Convex programs of all tries."""
        return sum(len(result.history) for result in self._results)

    def decision(self, status: ReplanStatus, message: str = "") -> Decision:
        """To fly the latest plan."""
        message = message or self.last.message
        return Decision(
            status, message, self.last.plan, self.last.cost, self.iterations
        )


def _stopping_times(problem: Problem, plan: Plan) -> list[float]:
    """How long a stop from the start of a problem may take, in s, shortest first."""
    at_rest = Instant(
        state=problem.start,
        highest=np.zeros_like(problem.start[0]),
        gain=problem.tube_start.layer * plan.bandwidth(problem.start_time),
        error_bound=plan.error_bound(problem.start_time),
    )
    feedback = input_bound(problem.law, at_rest)
    n = problem.model.order
    reference = plan.reference(problem.start_time)
    speed = max(float(np.linalg.norm(reference[1])), 0.1)
    limit = problem.input.bound
    room = max(limit - float(feedback), 0.1 * limit)
    return [stopping_time(speed, part * room, max(n, 2)) for part in BRAKING]
