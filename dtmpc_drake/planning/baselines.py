"""What dynamic tube MPC is compared with, on the same scenario and planner.

Every baseline is the scenario with something taken away, planned by the same code:

| name | bandwidth | uncertainty | velocity bound |
|---|---|---|---|
| `nominal` | no tube in the plan | none in the plan | |
| `rigid_tube` | the best fixed one | constant | comparison |
| `state_dependent` | the best fixed one | state-dependent | comparison |
| `bandwidth` | decided | constant | comparison |
| `both` | decided | state-dependent | comparison |
| `both_paper` | decided | state-dependent | the paper's |

The best fixed bandwidth is found by a sweep over all that the scenario allows, from
`min` to `max`; see `sweep`.  A `fixed` that a scenario gives is its own experiment's
and bounds no baseline.

All have the same cost function.  It charges α, and so a fixed one all the time; the
nominal plan has no bandwidth, so its cost is that of all else.  It does not
charge the slope λ, with which α makes the loop (`sliding.gain_crossover`): costs of
plans with different λ say nothing unless `crossover` stands beside them.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from dtmpc_drake.method.layer import layer_pieces
from dtmpc_drake.method.sliding import SlidingLaw, gain_crossover
from dtmpc_drake.method.tube import TubeStart, propagate
from dtmpc_drake.models import ConstantUncertainty
from dtmpc_drake.numerics.splines import grouped
from dtmpc_drake.planning.canonical import own_units
from dtmpc_drake.planning.charges import charges
from dtmpc_drake.planning.planner import plan_problem
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.certify import certify
from dtmpc_drake.records.certificate import Certificate
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import PlanningResult, Status
from dtmpc_drake.scenario import Planner, Scenario, validate

STEPS, HALVINGS = 7, 2
"""Of a sweep: steps from the highest bandwidth to the lowest, and how often they are
halved around the best."""
RESOLUTION = 1 / (STEPS * 2**HALVINGS)
"""The last step of a sweep, as a part of the range."""
PATIENCE = 2
"""So many bandwidths in a row that are worse than the best end the way down."""
VANISHING = 1e-6
"""Reaching rate and first layer of a plan without tube, in own units."""

TITLES = {
    "nominal": "nominal MPC, no tube",
    "rigid_tube": "rigid tube",
    "state_dependent": "DTMPC, uncertainty only",
    "bandwidth": "DTMPC, bandwidth only",
    "both": "DTMPC",
    "both_paper": "DTMPC, the paper's velocity bound",
}
"""Of each baseline; DTMPC itself is `both`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Baseline:
    """One way to plan a scenario.

    Attributes:
        name: one of `TITLES`.
        scenario: as this way sees it; its controller flies the plan.
        problem: to solve.
    """

    name: str
    scenario: Scenario
    problem: Problem

    @property
    def title(self) -> str:
        """For a table or a figure."""
        return TITLES[self.name]

    @property
    def is_swept(self) -> bool:
        """Whether its bandwidth is the best fixed one."""
        return self.name in ("rigid_tube", "state_dependent")

    @property
    def fixed_bandwidth(self) -> float | None:
        """With which its plan is flown, in rad/s; None if the plan decides."""
        return self.scenario.controller.bandwidth.fixed

    def at(self, bandwidth: float) -> Baseline:
        """The same with another fixed bandwidth, in rad/s."""
        scenario = _with_bandwidth(self.scenario, bandwidth)
        problem = dataclasses.replace(
            self.problem, bandwidth=self.problem.bandwidth.at(bandwidth)
        )
        return Baseline(self.name, scenario, problem)


@dataclasses.dataclass(frozen=True)
class SweepPoint:
    """What one fixed bandwidth of a sweep came to.

    Attributes:
        bandwidth: α, in rad/s.
        status: of planning; see `PlanningResult`.
        cost: of the plan; None if there is none.
    """

    bandwidth: float
    status: Status
    cost: float | None


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """What planning a baseline ended with.

    Attributes:
        baseline: that was planned.
        result: of its own problem.
        plan: to fly, with the tube that the plant truly stays in; None if the
            problem has no solution.
        certificate: of `plan`, against everything that the scenario limits; of
            the last attempt if there is no plan.
        plan_time: of all planning, a whole sweep's too, in s.
        sweep: every fixed bandwidth that was tried, from the highest to the
            lowest, if `baseline` has the best of them.
    """

    baseline: Baseline
    result: PlanningResult
    plan: Plan | None
    certificate: Certificate | None
    plan_time: float
    sweep: tuple[SweepPoint, ...] = ()

    @property
    def certified(self) -> bool:
        """Whether the flown plan keeps all limits whatever pushes the plant."""
        return (
            self.plan is not None
            and self.certificate is not None
            and self.certificate.certified
        )

    @property
    def message(self) -> str:
        """Why it is not certified, or what its smallest margin is."""
        if self.plan is None or self.certificate is None:
            return f"{self._tried}{self.result.message}"
        if self.certificate.faults:
            return self.certificate.reason
        name, margin = self.certificate.worst
        return f"smallest margin: {margin.named(name)}"

    @property
    def _tried(self) -> str:
        """What was in vain, and what the rest of the message is about."""
        if not self.sweep:
            return ""
        low, high = self.sweep[-1].bandwidth, self.sweep[0].bandwidth
        return (
            f"no plan at {len(self.sweep)} fixed bandwidths from {low:.4g} to "
            f"{high:.4g} rad/s; the nearest, {self.baseline.fixed_bandwidth:.4g}: "
        )


def make_baselines(scenario: Scenario) -> list[Baseline]:
    """All ways to plan a scenario, in the order of `TITLES`.

    Those with a fixed bandwidth have the highest: a sweep starts there, and it is
    the tightest tube that a nominal plan can be flown in.

    Args:
        scenario: whose bandwidth, uncertainty and velocity bound are replaced.

    Raises:
        ScenarioError: if the scenario makes no sense, or its model does not know
            a constant bound of its error.
    """
    highest = scenario.controller.bandwidth.max
    baselines = []
    for name in TITLES:
        free = name in ("bandwidth", "both", "both_paper")
        constant = name in ("rigid_tube", "bandwidth")
        own = dataclasses.replace(
            _with_bandwidth(scenario, None if free else highest),
            name=f"{scenario.name}_{name}",
            planner=dataclasses.replace(
                scenario.planner,
                uncertainty="constant" if constant else "state_dependent",
                velocity_bound="paper" if name == "both_paper" else "comparison",
            ),
        )
        validate(own)
        problem = Problem.from_scenario(own)
        if name == "nominal":
            problem = without_tube(problem)
        baselines.append(Baseline(name, own, problem))
    return baselines


def _with_bandwidth(scenario: Scenario, fixed: float | None) -> Scenario:
    """The scenario with a fixed bandwidth, or one that is decided."""
    bandwidth = dataclasses.replace(scenario.controller.bandwidth, fixed=fixed)
    controller = dataclasses.replace(scenario.controller, bandwidth=bandwidth)
    return dataclasses.replace(scenario, controller=controller)


def solve(baseline: Baseline) -> Outcome:
    """Plans a baseline with the planner's own code.

    A nominal plan has no tube to fly in.  It gets the tightest that its
    controller can keep: that of the highest bandwidth, from the scenario's own
    first layer.  So it is flown as well as any other plan here; what it lacks
    is room for that tube.
    """
    if baseline.is_swept:
        return sweep(baseline)
    outcome = _plan(baseline)
    if outcome.plan is None or baseline.name != "nominal":
        return outcome
    truth = Problem.from_scenario(baseline.scenario)
    flown = with_fixed_bandwidth(outcome.plan, truth)
    return dataclasses.replace(outcome, plan=flown, certificate=certify(flown, truth))


def _plan(baseline: Baseline, warm_start: Plan | None = None) -> Outcome:
    """Plans a baseline as it is."""
    settings: Planner = baseline.scenario.planner
    result = plan_problem(baseline.problem, settings, warm_start=warm_start)
    total = result.times["total"]
    return Outcome(baseline, result, result.plan, result.certificate, total)


def sweep(baseline: Baseline) -> Outcome:
    """Plans a baseline at the best of many fixed bandwidths, the same on all axes.

    Certified plans are better than others that were solved, and those better than
    what is infeasible; among plans the cheaper is better, without one that which
    breaks its limits less.  The way goes down from the highest bandwidth in `STEPS`
    steps, until `PATIENCE` in a row were worse than the best; then the steps are
    halved around the best, `HALVINGS` times.  Each plan starts from the one with the
    nearest bandwidth.

    Why the way down may end early: with the same reference a lower α has a thicker
    layer and a wider position tube at all times (the comparison lemma on
    dΦ/dt = -αΦ + Δ + D + η).  Only the gain κ = αΦ may be smaller, while it has not
    come to Δ + D + η yet; that is what may make the highest bandwidth too high.

    Args:
        baseline: with the fixed bandwidth `max`.

    Returns:
        The outcome at the best bandwidth, with the record of all that were tried.
    """
    bounds = baseline.scenario.controller.bandwidth
    fine: int = 2**HALVINGS
    grid = np.unique(np.linspace(bounds.min, bounds.max, STEPS * fine + 1))[::-1]
    found: dict[int, Outcome] = {}

    def best() -> int:
        return min(found, key=lambda k: (_rank(found[k]), k))

    def attempt(k: int) -> None:
        if k in found or not 0 <= k < len(grid):
            return
        near = sorted(found, key=lambda j: (abs(j - k), j))
        plans = (found[j].plan for j in near if found[j].plan is not None)
        found[k] = _plan(baseline.at(float(grid[k])), next(plans, None))

    for k in range(0, len(grid), fine):
        attempt(k)
        if k - best() >= PATIENCE * fine:
            break
    for _ in range(HALVINGS):
        fine //= 2
        center = best()
        attempt(center - fine)
        attempt(center + fine)
    points = tuple(
        SweepPoint(
            bandwidth=float(grid[k]),
            status=found[k].result.status,
            cost=None if found[k].plan is None else found[k].result.cost,
        )
        for k in sorted(found)
    )
    total = sum(outcome.plan_time for outcome in found.values())
    return dataclasses.replace(found[best()], sweep=points, plan_time=total)


def _rank(outcome: Outcome) -> tuple[bool, bool, float]:
    """The smaller the better."""
    certificate = outcome.certificate
    if outcome.plan is not None:
        return not outcome.certified, False, outcome.result.cost
    if certificate is None or certificate.faults:
        return True, True, math.inf
    return True, True, -certificate.worst[1].rank


def without_tube(problem: Problem) -> Problem:
    """No disturbance, no model error: the tube is a micrometre wide.

    The bandwidth then has nothing to do; it is fixed at its floor and costs
    nothing.
    """
    law = problem.law
    nothing, units = np.zeros_like(law.slope), own_units(problem)
    layer = nothing + VANISHING * units.of(law.order - 1)
    return dataclasses.replace(
        problem,
        law=SlidingLaw(
            model=ConstantUncertainty(law.model, nothing, covers=False),
            slope=law.slope,
            disturbance_bound=nothing,
            reaching_rate=VANISHING * units.of(law.order),
        ),
        bandwidth=problem.bandwidth.at(problem.bandwidth_cost.floor),
        tube_start=TubeStart.of_error(
            np.zeros_like(problem.start),
            layer,
            law.slope,
            law.chains,
        ),
    )


def with_fixed_bandwidth(plan: Plan, problem: Problem) -> Plan:
    """The same reference in the tube of the problem's highest bandwidth.

    Args:
        plan: gives the reference.
        problem: gives model, disturbance, bandwidth and how the tube starts.
    """
    count = len(plan.tube_times) - 1
    half = np.linspace(plan.start_time, plan.end_time, 2 * count + 1)
    reference = plan.reference(half)[:, :-1]
    bandwidth = np.broadcast_to(problem.bandwidth.high, (len(half), plan.num_outputs))
    step = (plan.end_time - plan.start_time) / count
    tube = propagate(
        problem.law,
        reference=reference,
        bandwidth=bandwidth,
        start=problem.tube_start,
        velocity_bound=problem.velocity_bound,
        step=step,
    )
    layer = layer_pieces(
        problem.law,
        reference=reference,
        bandwidth=bandwidth,
        initial=problem.tube_start.layer,
        step=step,
    )
    return dataclasses.replace(
        plan,
        bandwidth_knots=np.broadcast_to(
            problem.bandwidth.high, plan.bandwidth_knots.shape
        ).copy(),
        tube_times=half[::2],
        layer_coefficients=layer,
        bound_samples=tube.error_bound,
        bound_rate_samples=tube.error_bound_rate,
    )


def bandwidth_cost(result: PlanningResult, problem: Problem) -> float:
    """The part of a result's cost that pays for bandwidth and its rate."""
    plan = result.attempt
    return float("nan") if plan is None else charges(plan, problem)["bandwidth"]


def crossover(plan: Plan, scenario: Scenario) -> float:
    """The bandwidth of the whole loop, its mean over time and axes, in rad/s."""
    alpha = plan.bandwidth(plan.sample_times())
    slope, found = scenario.slope(), np.empty_like(alpha)
    for order, some in grouped(plan.chains.orders):
        found[:, some] = gain_crossover(
            bandwidth=alpha[:, some], slope=slope[some], order=order
        )
    return float(found.mean())
