"""Limits that a scenario states: read, refused, planned, proven and flown."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagrams import DISTURBANCES

from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.limits import (
    ConvexLimit,
    InputRange,
    Limit,
    NormLimit,
    PositionLimit,
    SpeedLimit,
)
from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning import plan
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Scenario, parse_scenario, to_yaml

FIELD = """
model: !DragDoubleIntegrator {drag_estimate: 0.1, drag_error_bound: 0.05}
start: {position: [0, 0, 1]}
goal: {position: [0, 20, 1]}
duration: 14
obstacles:
  - !Cylinder {center: [0.2, 7.0], radius: 1.0}
  - !Sphere {center: [-0.3, 13.0, 1.2], radius: 1.0}
planner: {intervals: 28, time_limit: 300}
"""

LIMITS = {
    "fence and ceiling": """
  position: {min: [-1.7, null, null], max: [0.5, null, 1.4]}""",
    "every input": """
  inputs: {min: [-2.6, null, -2.6], max: [2.6, 2.4, 2.6]}""",
    "every speed": """
  speed: [2.0, 2.0, 0.3]""",
    "horizontal speed": """
  norms: [{of: velocity, matrix: [[1, 0, 0], [0, 1, 0]], bound: 2.1}]""",
    "acceleration": """
  norms: [{of: acceleration, bound: 4.0}]""",
    "part of the input": """
  norms: [{of: input, matrix: [[1, 0, 0], [0, 1, 0]], offset: [0.3, -0.2], bound: 3}]
""",
    "a ball": """
  norms: [{of: position, offset: [0, -10, -1], bound: 10.2}]""",
}


def limited(name: str) -> Scenario:
    return parse_scenario(f"{FIELD}limits:{LIMITS[name]}")


@pytest.fixture(scope="module")
def plans() -> dict[str, PlanningResult]:
    return {name: plan(limited(name)) for name in LIMITS}


@pytest.fixture(scope="module")
def free() -> PlanningResult:
    """Without any of these limits."""
    return plan(parse_scenario(FIELD))


every = pytest.mark.parametrize("name", LIMITS)


def own_limit(scenario: Scenario) -> Limit:
    """The one that is no default."""
    if scenario.limits.others:
        (limit,) = scenario.limits.others
        return limit
    return SpeedLimit(scenario.limits.speed)


def instants(scenario: Scenario, result: PlanningResult, time: Array) -> Instant:
    law, y = scenario.sliding_law(), result.plan.reference(time)
    gain = law.gain(y[:, :2], result.plan.boundary_layer_rate(time))
    return Instant(y[:, :2], y[:, 2], gain, result.plan.error_bound(time))


# Read and written.


def test_every_form_arrives_and_comes_back() -> None:
    scenario = parse_scenario(
        FIELD
        + """
limits:
  input: 5.0
  speed: [2.5, 2.5, 1.0]
  position: {min: [null, null, 0.2], max: [null, 30.0, 3.0]}
  inputs: {min: [-3, -3, -4.0], max: [3, 3, 8.0]}
  norms:
    - {of: velocity, matrix: [[1, 0, 0], [0, 1, 0]], bound: 2.0}
    - {of: acceleration, bound: 5.0}
    - {of: input, matrix: [[1, 0, 0]], offset: [0.5], bound: 6.0}
"""
    )
    limits = scenario.limits
    assert limits.speed == [2.5, 2.5, 1.0] and limits.fastest == 2.5
    assert limits.position == PositionLimit([None, None, 0.2], [None, 30.0, 3.0])
    assert limits.inputs == InputRange([-3.0, -3.0, -4.0], [3.0, 3.0, 8.0])
    assert limits.norms[1] == NormLimit("acceleration", 5.0)
    assert len(limits.others) == 5
    assert parse_scenario(to_yaml(scenario)) == scenario


@pytest.mark.parametrize(
    ("text", "field", "allowed"),
    [
        ("speed: [1, 2]", "limits.speed", "3 numbers, one for each output"),
        ("speed: [1, 2, 0]", "limits.speed[2]", "greater than 0 m/s"),
        ("speed: [[1, 2, 3]]", "limits.speed", "a number or a list of numbers"),
        ("position: {}", "limits.position", "given a min or a max"),
        ("position: {min: [0, 0]}", "limits.position.min", "3 numbers, one each"),
        (
            "position: {min: [null, null, 2], max: [null, null, 1]}",
            "limits.position.max[2]",
            "greater than limits.position.min[2] = 2 m",
        ),
        ("inputs: {max: [1, 1, 1e300]}", "limits.inputs.max[2]", "in [-1e+12, 1e+12]"),
        ("norms: [{of: jerk, bound: 1}]", "limits.norms[0].of", "one of position"),
        ("norms: [{of: speed, bound: 1}]", "limits.norms[0].of", "acceleration, input"),
        ("norms: [{of: input}]", "limits.norms[0].bound", "given: it is missing"),
        ("norms: [{of: input, bound: 0}]", "limits.norms[0].bound", "greater than 0"),
        (
            "norms: [{of: velocity, bound: 1, matrix: [[1, 0]]}]",
            "limits.norms[0].matrix[0]",
            "3 numbers",
        ),
        (
            "norms: [{of: velocity, bound: 1, offset: [1, 0]}]",
            "limits.norms[0].offset",
            "3 numbers, one for each row of the matrix",
        ),
        (
            "position: {min: [null, null, 1.1]}",
            "start.position",
            "inside limits.position (min of axis z), tube included: 0.1 m are missing",
        ),
        (
            "position: {max: [null, 20.001, null]}",
            "goal.position",
            "inside limits.position (max of axis y), tube included",
        ),
        (
            "norms: [{of: position, offset: [0, 0, -1], bound: 15}]",
            "goal.position",
            "inside limits.norms[0], tube included",
        ),
    ],
)
def test_bad_limits_get_one_line(text: str, field: str, allowed: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(f"{FIELD}limits: {{{text}}}")
    assert caught.value.field == field
    assert allowed in str(caught.value).split(", but it must be ")[1]


def test_an_initial_error_counts_where_a_limit_is_near() -> None:
    near = "limits: {position: {min: [null, null, 0.92]}}\n"
    parse_scenario(FIELD + near)
    with pytest.raises(ScenarioError, match=r"limits.position \(min of axis z\)"):
        parse_scenario(FIELD + near + "initial_error: {position: [0, 0, -0.1]}")


# Planned and proven.


@every
def test_the_limit_binds_and_is_kept_for_all_times(
    name: str, plans: dict[str, PlanningResult], free: PlanningResult
) -> None:
    scenario, result = limited(name), plans[name]
    assert result.certified, result.message
    assert result.cost > free.cost + 1e-3
    limit, time = own_limit(scenario), np.linspace(0, scenario.duration, 20_001)
    law = scenario.sliding_law()
    dense = limit.margins(law, instants(scenario, result, time)).min()
    proven = result.certificate.margins[limit.name].value
    assert 0 <= proven <= dense + 1e-4
    assert dense < 0.12  # it is why the plan is dearer
    worst = limit.margins(law, instants(scenario, free, time)).min()
    assert worst < 0


@every
def test_both_backends_agree(name: str, plans: dict[str, PlanningResult]) -> None:
    scenario = limited(name)
    scenario.planner.backend = "ipopt"
    result = plan(scenario)
    assert result.certified, result.message
    assert result.cost == pytest.approx(plans[name].cost, rel=0.02)


def test_limits_of_all_kinds_go_together() -> None:
    text = """
  speed: [1.5, 2.4, 0.8]
  position: {min: [null, null, 0.4], max: [2.2, null, 2.6]}
  inputs: {min: [-4, -4, -4], max: [4, 4, 4]}
  norms:
    - {of: velocity, matrix: [[1, 0, 0], [0, 1, 0]], bound: 2.3}
    - {of: acceleration, bound: 5.0}
    - {of: velocity, bound: 2.35}
"""
    result = plan(parse_scenario(f"{FIELD}limits:{text}"))
    assert result.certified, result.message
    margins = result.certificate.margins
    assert {"position", "inputs", "acceleration_norm"} <= set(margins)
    assert {"velocity_norm", "velocity_norm_2"} <= set(margins)


# Flown.


@every
@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_no_disturbance_breaks_a_limit(
    name: str, disturbance: str, plans: dict[str, PlanningResult]
) -> None:
    scenario = limited(name)
    source = DISTURBANCES[disturbance](scenario.disturbance.bound)
    pushed = dataclasses.replace(scenario, disturbance=source)
    flight = Simulate(pushed, plan=plans[name].plan)
    assert flight.breaches(pushed) == ()
    limit = own_limit(scenario)
    left = limit.flown(flight.state, flight.control)
    if left is None:
        assert isinstance(limit, ConvexLimit) and limit.derivative == 2
        drift = scenario.model.true_drift(flight.state, scenario.plant_parameters())
        value = drift + flight.control + flight.disturbance
        left = limit.left(value, np.zeros_like(value))
    assert left.min() >= -1e-5


def test_a_flight_that_breaks_one_says_which(plans: dict[str, PlanningResult]) -> None:
    scenario = limited("fence and ceiling")
    strict = dataclasses.replace(
        scenario.limits, position=PositionLimit(max=[-0.5, None, None])
    )
    flown = dataclasses.replace(scenario, limits=strict)
    (broken, *_) = Simulate(flown, plan=plans["fence and ceiling"].plan).breaches(flown)
    assert broken.what == "other_limits" and "the position limit was broken" in str(
        broken
    )


def test_each_axis_is_held_to_its_own_speed(plans: dict[str, PlanningResult]) -> None:
    scenario = limited("every speed")
    strict = dataclasses.replace(scenario.limits, speed=[2.0, 2.0, 0.05])
    flown = dataclasses.replace(scenario, limits=strict)
    (broken, *_) = Simulate(flown, plan=plans["every speed"].plan).breaches(flown)
    assert broken.what == "speed"
    assert "(axis z)" in str(broken) and "at most 0.05 m/s" in str(broken)


def test_a_soft_goal_may_be_out_of_bounds() -> None:
    soft = FIELD.replace("[0, 20, 1]}", "[0, 20, 1], soft: true}")
    text = (
        "limits: {position: {max: [null, 19.0, null]}}\ncost: {terminal: {position: 5}}"
    )
    result = plan(parse_scenario(f"{soft}{text}"))
    assert result.certified, result.message
    end = result.plan.reference(14.0)[0, 1]
    tube = result.plan.error_bound(14.0)[0, 1]
    assert 18.5 < end + tube <= 19.0


def test_a_jerk_may_be_limited_where_it_is_a_derivative_of_the_output() -> None:
    text = """
model: !IntegratorChain {num_outputs: 1, order: 3, error_bound: 0.1}
disturbance: !BangBang {bound: [0.1]}
controller: {slope: [2.0], initial_boundary_layer: 0.2}
start: {position: [0]}
goal: {position: [3]}
duration: 5
limits: {input: 20, norms: [{of: jerk, bound: BOUND}, {of: acceleration, bound: 2}]}
planner: {intervals: 20}
"""
    free = plan(parse_scenario(text.replace("BOUND", "20")))
    held = plan(parse_scenario(text.replace("BOUND", "3.2")))
    assert free.certified and held.certified
    assert free.cost < held.cost
    assert 0 <= held.certificate.margins["jerk_norm"].value < 0.1
