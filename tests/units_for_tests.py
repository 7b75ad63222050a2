"""The same scenario in other units of length and time."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import numpy as np

from dtmpc_drake.models import DragDoubleIntegrator
from dtmpc_drake.scenario import Scenario


def in_other_units(scenario: Scenario, *, length: float, time: float) -> Scenario:
    """A scenario of order two whose numbers are in units that are smaller by these.

    Args:
        scenario: in m and s.
        length: new units in a metre.
        time: new units in a second.
    """
    s = copy.deepcopy(scenario)
    speed, input_ = length / time, length / time**2

    def times(value: Any, factor: float) -> Any:
        return None if value is None else (np.array(value) * factor).tolist()

    if isinstance(s.model, DragDoubleIntegrator):
        s.model = DragDoubleIntegrator(
            s.model.drag_estimate / length, s.model.drag_error_bound / length
        )
        s.plant = {name: value / length for name, value in s.plant.items()}
    s.disturbance.bound = times(s.disturbance.bound, input_)
    if hasattr(s.disturbance, "hold"):
        s.disturbance.hold = times(s.disturbance.hold, time)
    c, b = s.controller, s.controller.bandwidth
    c.slope = times(c.slope, 1 / time)
    c.reaching_rate *= input_
    c.initial_boundary_layer *= speed
    b.min, b.max, b.fixed = (times(a, 1 / time) for a in (b.min, b.max, b.fixed))
    b.rate_max /= time**2
    s.limits.input *= input_
    s.limits.speed = times(s.limits.speed, speed)
    s.cost.bandwidth = times(s.cost.bandwidth, input_**2 * time**2)
    for end in (s.start, s.goal, s.initial_error):
        if end is not None:
            end.position = times(end.position, length)
            end.velocity = times(end.velocity, speed)
    s.duration *= time
    for obstacle in s.obstacles:
        for name in ("center", "radius"):
            if hasattr(obstacle, name):
                setattr(obstacle, name, times(getattr(obstacle, name), length))
        obstacle.known_from = times(obstacle.known_from, time)
    s.sensing.range = times(s.sensing.range, length)
    s.sensing.period *= time
    s.planner.compute_delay *= time
    s.planner.replan_period = times(s.planner.replan_period, time)
    s.simulation = dataclasses.replace(
        s.simulation,
        max_step_size=s.simulation.max_step_size * time,
        log_period=s.simulation.log_period * time,
    )
    return s
