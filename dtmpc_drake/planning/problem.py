"""The optimisation problem that a scenario poses."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np

from dtmpc_drake.costs import BandwidthCost, Cost, InputCost, StateCost
from dtmpc_drake.limits import (
    BandwidthLimit,
    ConvexLimit,
    CoverLimit,
    InputLimit,
    Limit,
    ObstacleLimit,
    SampledLimit,
    SpeedLimit,
)
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tube import TubeStart, VelocityBound
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import ConstantUncertainty, Model
from dtmpc_drake.numerics.arrays import Array, BoolArray
from dtmpc_drake.obstacles import ObstacleSet
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.scenario.schema import DERIVATIVES, StateWeights


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """One dynamic tube MPC problem (the paper's Problem 2), for any model.

    Attributes:
        law: the controller and its model.
        obstacles: to stay clear of.
        tube_margin: ``norm`` or ``support``, see `ObstacleSet.clearance`.
        input: the limit of the input's norm.
        speed: the limit of the speed along every axis.
        other_limits: any others.
        bandwidth: the range of the bandwidth, and the limit of its rate.
        costs: of the reference, all the time.
        bandwidth_cost: of the bandwidth and its rate.
        start_time, duration: in s.
        start, goal: x* at both ends, ``(n, m)``; a row of NaN in the goal is free.
        soft: rows of the goal that are no conditions, but where costs draw to.
        terminal: costs of the reference at its end.
        tube_start: what the tube opens from.
        velocity_bound: ``comparison`` or ``paper``.
        start_highest: y*^(n)(t0), if it must be continuous.
        start_bandwidth: α(t0), if it must be continuous.
        units: of all this in those of the user; see `canonical`.
    """

    law: SlidingLaw
    obstacles: ObstacleSet
    tube_margin: str
    input: InputLimit
    speed: SpeedLimit
    bandwidth: BandwidthLimit
    costs: tuple[Cost, ...]
    bandwidth_cost: BandwidthCost
    start_time: float
    duration: float
    start: Array
    goal: Array
    tube_start: TubeStart
    velocity_bound: VelocityBound
    other_limits: tuple[Limit, ...] = ()
    soft: tuple[int, ...] = ()
    terminal: tuple[Cost, ...] = ()
    start_highest: Array | None = None
    start_bandwidth: Array | None = None
    units: Units = Units()

    @classmethod
    def from_scenario(
        cls, scenario: Scenario, known: BoolArray | None = None
    ) -> Problem:
        """The problem at the start of a scenario.

        Args:
            scenario: the whole experiment.
            known: which obstacles to stay clear of, ``(o,)``; those that are known
                at the start if left out.
        """
        if known is None:
            known = scenario.known_at_start()
        law, bandwidth = scenario.sliding_law(), scenario.controller.bandwidth
        low, high = np.tile(bandwidth.interval(), (law.num_outputs, 1)).T
        velocity_bound: VelocityBound = (
            "paper" if scenario.planner.velocity_bound == "paper" else "comparison"
        )
        return cls(
            law=law,
            obstacles=scenario.obstacle_set().subset(known),
            tube_margin=scenario.planner.tube_margin,
            input=InputLimit(scenario.limits.input),
            speed=SpeedLimit(scenario.limits.speed),
            other_limits=scenario.limits.others,
            bandwidth=BandwidthLimit(low, high, bandwidth.rate_max),
            costs=_running_costs(scenario),
            bandwidth_cost=BandwidthCost(
                scenario.cost.bandwidth, bandwidth.min, scenario.cost.bandwidth_rate
            ),
            start_time=0.0,
            duration=scenario.duration,
            start=scenario.start_state(),
            goal=scenario.goal_state(),
            soft=scenario.soft_derivatives(),
            terminal=_state_costs(scenario.cost.terminal, scenario.goal_state()),
            tube_start=TubeStart.of_error(
                np.abs(scenario.initial_error_state()),
                scenario.initial_boundary_layer(),
                law.slope,
                law.chains,
            ),
            velocity_bound=velocity_bound,
        )

    @property
    def model(self) -> Model:
        """F̂, B, Δ and their bounds, as the controller knows them."""
        return self.law.model

    @property
    def goal_rows(self) -> list[int]:
        """The derivatives that the goal prescribes."""
        given = [k for k, row in enumerate(self.goal) if np.isfinite(row).all()]
        return [k for k in given if k not in self.soft]

    def to_rest(self) -> Problem:
        """The same to a rest anywhere, which is no goal to be drawn to."""
        rest = np.zeros_like(self.goal)
        rest[0] = np.nan  # anywhere
        costs = tuple(cost for cost in self.costs if not cost.of_goal)
        return dataclasses.replace(self, goal=rest, soft=(), costs=costs, terminal=())

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """All that a plan must keep, but the bandwidth's."""
        limits: list[Limit] = [self.speed, self.input, *self.other_limits]
        if len(self.obstacles):
            limits.insert(0, ObstacleLimit(self.obstacles, self.tube_margin))
        if isinstance(self.model, ConstantUncertainty) and self.model.covers:
            limits.append(CoverLimit(self.model))
        return tuple(limits)

    @cached_property
    def sampled(self) -> tuple[SampledLimit, ...]:
        """The limits on functions of one instant."""
        return tuple(limit for limit in self.limits if isinstance(limit, SampledLimit))

    @cached_property
    def convex(self) -> tuple[ConvexLimit, ...]:
        """The limits that are convex in a derivative of the output."""
        return tuple(limit for limit in self.limits if isinstance(limit, ConvexLimit))


def _running_costs(scenario: Scenario) -> tuple[Cost, ...]:
    cost = scenario.cost
    target, direction = scenario.goal_state(), None
    if cost.state is not None and cost.state.line is not None:
        target = np.zeros_like(target)
        target[0] = cost.state.line.point
        direction = np.array(cost.state.line.direction, dtype=float)
    of_state = _state_costs(cost.state, target, direction)
    return (InputCost(cost.input), *of_state, *cost.own)


def _state_costs(
    weights: StateWeights | None, target: Array, direction: Array | None = None
) -> tuple[Cost, ...]:
    """The cost of a section of a scenario; none if it weighs nothing."""
    if weights is None:
        return ()
    each = [getattr(weights, name) for name in DERIVATIVES][: len(target)]
    cost = StateCost.of(each, target, direction)
    return (cost,) if len(cost.roots) else ()
