"""The same scenario in other units of length and time."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.scenario import Scenario


def times(value: Any, factor: float) -> Any:
    """A number, or lists of numbers and None, times a factor."""
    if value is None:
        return None
    if isinstance(value, (list, tuple)):
        return [times(each, factor) for each in value]
    return float(value * factor)


def in_other_units(scenario: Scenario, *, length: float, time: float) -> Scenario:
    """A scenario whose numbers are in units that are smaller by these.

    Args:
        scenario: in m and s, with nothing of a user's own.
        length: new units in a metre.
        time: new units in a second.
    """
    s, n = copy.deepcopy(scenario), scenario.model.order
    of = [length / time**k for k in range(n + 1)]

    if isinstance(s.model, DragDoubleIntegrator):
        s.model.drag_estimate /= length
        s.model.drag_error_bound /= length
        s.plant = times_of(s.plant, 1 / length)
    elif isinstance(s.model, IntegratorChain):
        s.model.error_bound *= of[n]
        s.plant = times_of(s.plant, of[n])
    s.disturbance.bound = times(s.disturbance.bound, of[n])
    for name in ("hold", "correlation_time", "period"):
        if hasattr(s.disturbance, name):
            moved = times(getattr(s.disturbance, name), time)
            setattr(s.disturbance, name, moved)

    c, b = s.controller, s.controller.bandwidth
    c.slope = times(c.slope, 1 / time)
    c.reaching_rate *= of[n]
    c.initial_boundary_layer *= of[n - 1]
    b.min, b.max, b.fixed = (times(a, 1 / time) for a in (b.min, b.max, b.fixed))
    b.rate_max /= time**2

    s.limits.input *= of[n]
    s.limits.speed = times(s.limits.speed, of[1])
    for sides, unit in ((s.limits.position, length), (s.limits.inputs, of[n])):
        if sides is not None:
            sides.min, sides.max = times(sides.min, unit), times(sides.max, unit)
    for norm in s.limits.norms:
        names = ["position", "velocity", "acceleration", "jerk"]
        unit = of[n] if norm.of == "input" else of[names.index(norm.of)]
        norm.bound, norm.offset = norm.bound * unit, times(norm.offset, unit)

    # A cost is an integral of squared inputs.
    cost = of[n] ** 2 * time
    s.cost.bandwidth = times(s.cost.bandwidth, cost * time)
    s.cost.bandwidth_rate = times(s.cost.bandwidth_rate, cost * time**3)
    for weights, lasts in ((s.cost.state, time), (s.cost.terminal, 1.0)):
        for k, name in enumerate(("position", "velocity", "acceleration")[:n]):
            if weights is not None:
                unit = cost / (of[k] ** 2 * lasts)
                setattr(weights, name, times(getattr(weights, name), unit))
    if s.cost.state is not None and s.cost.state.line is not None:
        s.cost.state.line.point = times(s.cost.state.line.point, length)

    for end in (s.start, s.goal, s.initial_error):
        if end is not None:
            end.position = times(end.position, length)
            end.velocity = times(end.velocity, of[1])
            if n > 2:
                end.acceleration = times(end.acceleration, of[2])
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


def times_of(values: dict[str, Any], factor: float) -> dict[str, Any]:
    """All values of a mapping times a factor."""
    return {name: times(value, factor) for name, value in values.items()}


def cost_unit(scenario: Scenario, *, length: float, time: float) -> float:
    """What a cost is multiplied by; see `in_other_units`."""
    return float((length / time**scenario.model.order) ** 2 * time)


def unit_of(text: str, *, length: float, time: float) -> float:
    """What a number in a unit is multiplied by, such as one in ``m/s²``."""
    above, _, below = text.partition("/")
    power = {"": 0, "s": 1, "s²": 2, "s³": 3}[below]
    return {"": 1.0, "s": time, "m": length, "rad": 1.0}[above] / time**power
