"""What dynamic tube MPC is compared with, on the same scenario and planner.

Every baseline is the scenario with something taken away, planned by the same code:

| name | bandwidth | uncertainty | velocity bound |
|---|---|---|---|
| `nominal` | no tube in the plan | none in the plan | |
| `rigid_tube` | fixed | constant | comparison |
| `state_dependent` | fixed | state-dependent | comparison |
| `bandwidth` | decided | constant | comparison |
| `both` | decided | state-dependent | comparison |
| `both_paper` | decided | state-dependent | the paper's |

A fixed bandwidth is the scenario's `fixed`, or else its `max`: the tightest tube
that a fixed bandwidth can have.  All have the same cost function.  A fixed
bandwidth α pays for it all the time; the nominal plan has no bandwidth, so its
cost is that of the input alone.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np

from dtmpc_drake.layer import layer_pieces
from dtmpc_drake.models import ConstantUncertainty
from dtmpc_drake.plan import Plan
from dtmpc_drake.planning.certificate import Certificate, certify
from dtmpc_drake.planning.planner import PlanningResult, plan_problem
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.scenario import Planner, Scenario
from dtmpc_drake.tube import propagate

VANISHING = 1e-6
"""Reaching rate and first layer of a plan without tube, in m/s² and m/s."""

TITLES = {
    "nominal": "nominal MPC, no tube",
    "rigid_tube": "rigid tube",
    "state_dependent": "DTMPC, uncertainty only",
    "bandwidth": "DTMPC, bandwidth only",
    "both": "DTMPC",
    "both_paper": "DTMPC, the paper's velocity bound",
}
"""Of each baseline; DTMPC itself is `both`."""


@dataclasses.dataclass(frozen=True)
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

    __hash__: ClassVar[None]  # type: ignore[assignment]

    @property
    def title(self) -> str:
        """For a table or a figure."""
        return TITLES[self.name]


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What planning a baseline ended with.

    Attributes:
        baseline: that was planned.
        result: of its own problem.
        plan: to fly, with the tube that the plant truly stays in; None if the
            problem has no solution.
        certificate: of `plan`, against everything that the scenario limits; of
            the last attempt if there is no plan.
    """

    baseline: Baseline
    result: PlanningResult
    plan: Plan | None
    certificate: Certificate | None

    __hash__: ClassVar[None]  # type: ignore[assignment]

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
            return self.result.message
        if self.certificate.faults:
            return self.certificate.reason
        name, margin = self.certificate.worst
        return f"smallest margin: {margin.named(name)}"


def make_baselines(scenario: Scenario) -> list[Baseline]:
    """All ways to plan a scenario, in the order of `TITLES`.

    Args:
        scenario: whose bandwidth, uncertainty and velocity bound are replaced.

    Raises:
        ScenarioError: if the scenario makes no sense, or its model does not know
            a constant bound of its error.
    """
    bandwidth = scenario.controller.bandwidth
    fixed = bandwidth.max if bandwidth.fixed is None else bandwidth.fixed
    baselines = []
    for name in TITLES:
        free = name in ("bandwidth", "both", "both_paper")
        constant = name in ("rigid_tube", "bandwidth")
        own = dataclasses.replace(
            scenario,
            name=f"{scenario.name}_{name}",
            controller=dataclasses.replace(
                scenario.controller,
                bandwidth=dataclasses.replace(bandwidth, fixed=None if free else fixed),
            ),
            planner=dataclasses.replace(
                scenario.planner,
                uncertainty="constant" if constant else "state_dependent",
                velocity_bound="paper" if name == "both_paper" else "comparison",
            ),
        )
        own.validate()
        problem = Problem.from_scenario(own)
        if name == "nominal":
            problem = without_tube(problem)
        baselines.append(Baseline(name, own, problem))
    return baselines


def solve(baseline: Baseline) -> Outcome:
    """Plans a baseline with the planner's own code.

    A nominal plan has no tube to fly in.  It gets the tightest that its
    controller can keep: that of the fixed bandwidth, from the scenario's own
    first layer.  So it is flown as well as any other plan here; what it lacks
    is room for that tube.
    """
    settings: Planner = baseline.scenario.planner
    result = plan_problem(baseline.problem, settings)
    if result.plan is None or baseline.name != "nominal":
        return Outcome(baseline, result, result.plan, result.certificate)
    truth = Problem.from_scenario(baseline.scenario)
    flown = with_fixed_bandwidth(result.plan, truth)
    return Outcome(baseline, result, flown, certify(flown, truth))


def without_tube(problem: Problem) -> Problem:
    """No disturbance, no model error: the tube is a micrometre wide.

    The bandwidth then has nothing to do; it is fixed at its floor and costs
    nothing.
    """
    floor = np.full_like(problem.bandwidth_min, problem.bandwidth_floor)
    return dataclasses.replace(
        problem,
        model=ConstantUncertainty(
            problem.model, np.zeros_like(problem.slope), covers=False
        ),
        bandwidth_min=floor,
        bandwidth_max=floor,
        disturbance_bound=np.zeros_like(problem.disturbance_bound),
        reaching_rate=VANISHING,
        initial_boundary_layer=np.full_like(problem.initial_boundary_layer, VANISHING),
        initial_error=np.zeros_like(problem.initial_error),
    )


def with_fixed_bandwidth(plan: Plan, problem: Problem) -> Plan:
    """The same reference in the tube of the problem's highest bandwidth.

    Args:
        plan: gives the reference.
        problem: gives model, disturbance, bandwidth and how the tube starts.
    """
    count = len(plan.tube_times) - 1
    half = np.linspace(plan.start_time, plan.end_time, 2 * count + 1)
    layer: dict[str, Any] = {
        "model": problem.model,
        "reference": plan.reference(half)[:, :-1],
        "bandwidth": np.broadcast_to(
            problem.bandwidth_max, (len(half), plan.num_outputs)
        ),
        "disturbance_bound": problem.disturbance_bound,
        "reaching_rate": problem.reaching_rate,
        "initial_boundary_layer": problem.initial_boundary_layer,
        "step": (plan.end_time - plan.start_time) / count,
    }
    tube = propagate(
        slope=problem.slope,
        initial_error=problem.initial_error,
        velocity_bound=problem.velocity_bound,
        **layer,
    )
    return dataclasses.replace(
        plan,
        bandwidth_knots=np.broadcast_to(
            problem.bandwidth_max, plan.bandwidth_knots.shape
        ).copy(),
        tube_times=half[::2],
        layer_coefficients=layer_pieces(**layer),
        bound_samples=tube.error_bound,
        bound_rate_samples=tube.error_bound_rate,
    )


def bandwidth_cost(result: PlanningResult) -> float:
    """The part of a result's cost that pays for bandwidth; the rest is input."""
    problem, plan = result.problem, result.attempt
    if plan is None:
        return float("nan")
    excess = plan.bandwidth_knots - problem.bandwidth_floor
    running = problem.bandwidth_weight * (excess**2).sum(axis=1)
    return float(np.diff(plan.knots) @ (running[1:] + running[:-1]) / 2)
