"""The optimisation problem that a scenario poses, as arrays."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tube import TubeStart, VelocityBound
from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array, BoolArray
from dtmpc_drake.obstacles import ObstacleSet
from dtmpc_drake.scenario import Scenario


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """One dynamic tube MPC problem (the paper's Problem 2), for any model.

    Attributes:
        law: the controller and its model.
        obstacles: to stay clear of.
        bandwidth_min, bandwidth_max: bounds of α, ``(m,)``; equal if fixed.
        bandwidth_rate_max: bound of abs(dα/dt).
        input_limit: u_m.
        speed_limit: on every axis.
        input_weight, bandwidth_weight: Q and R.
        bandwidth_floor: α̲ in the cost's α̃ = α - α̲.
        start_time, duration: in s.
        start, goal: x* at both ends, ``(n, m)``; a row of NaN in the goal is free.
        tube_start: what the tube opens from.
        tube_margin: ``norm`` or ``support``.
        velocity_bound: ``comparison`` or ``paper``.
        start_highest: y*^(n)(t0), if it must be continuous.
        start_bandwidth: α(t0), if it must be continuous.
    """

    law: SlidingLaw
    obstacles: ObstacleSet
    bandwidth_min: Array
    bandwidth_max: Array
    bandwidth_rate_max: float
    bandwidth_floor: float
    input_limit: float
    speed_limit: float
    input_weight: float
    bandwidth_weight: float
    start_time: float
    duration: float
    start: Array
    goal: Array
    tube_start: TubeStart
    tube_margin: str
    velocity_bound: VelocityBound
    start_highest: Array | None = None
    start_bandwidth: Array | None = None

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
        law = scenario.sliding_law()
        bandwidth = scenario.controller.bandwidth
        low, high = bandwidth.interval()
        m = law.num_outputs
        velocity_bound: VelocityBound = (
            "paper" if scenario.planner.velocity_bound == "paper" else "comparison"
        )
        return cls(
            law=law,
            obstacles=scenario.obstacle_set().subset(known),
            bandwidth_min=np.full(m, low),
            bandwidth_max=np.full(m, high),
            bandwidth_rate_max=bandwidth.rate_max,
            bandwidth_floor=bandwidth.min,
            input_limit=scenario.limits.input,
            speed_limit=scenario.limits.speed,
            input_weight=scenario.cost.input,
            bandwidth_weight=scenario.cost.bandwidth,
            start_time=0.0,
            duration=scenario.duration,
            start=scenario.start_state(),
            goal=scenario.goal_state(),
            tube_start=TubeStart.of_error(
                np.abs(scenario.initial_error_state()),
                scenario.initial_boundary_layer(),
                law.slope,
            ),
            tube_margin=scenario.planner.tube_margin,
            velocity_bound=velocity_bound,
        )

    @property
    def model(self) -> Model:
        """F̂, B, Δ and their bounds, as the controller knows them."""
        return self.law.model

    @property
    def bandwidth_is_fixed(self) -> bool:
        """Whether α is given rather than decided."""
        return bool((self.bandwidth_min == self.bandwidth_max).all())
