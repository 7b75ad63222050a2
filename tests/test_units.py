"""Whatever units a problem is written in, it is planned, proven and flown alike."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_limits_as_data import LIMITS as EVERY_LIMIT
from test_limits_as_data import limited

from dtmpc_drake.checks import derivative_unit, range_of
from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.experiments.simulate import run
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.planning import Problem, certify, plan, plan_problem
from dtmpc_drake.planning.baselines import without_tube
from dtmpc_drake.planning.canonical import canonical, plan_in_units
from dtmpc_drake.records.certificate import Certificate
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import (
    Limits,
    Planner,
    Scenario,
    Waypoint,
    load_scenario,
    parse_scenario,
    validate,
)
from tests.costs_for_tests import with_cost
from tests.units_for_tests import cost_unit, in_other_units, unit_of

LENGTHS = (1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3)
TIMES = (1e-2, 0.1, 10.0, 100.0)
SCENARIOS = "known_environment", "unknown_drag", "state_dependent_uncertainty"
UNITS = [
    *((length, 1.0) for length in LENGTHS),
    *((1.0, time) for time in TIMES),
    *itertools.product((1e-3, 1e3), (1e-2, 100.0)),
    (2.0, 3.0),
]
FEW = [(1e3, 1.0), (1.0, 0.1), (0.01, 100.0)]


@pytest.fixture(scope="module")
def planned() -> dict[str, PlanningResult]:
    """In m and s."""
    return {name: plan(load_scenario(name)) for name in SCENARIOS}


def require_alike(
    base: Scenario, first: PlanningResult, *, length: float, time: float
) -> PlanningResult:
    """The same plan in other units, or the test fails."""
    result = plan(in_other_units(base, length=length, time=time))
    assert result.status == first.status, result.message
    cost = result.cost / cost_unit(base, length=length, time=time)
    assert cost == pytest.approx(first.cost, rel=5e-3)
    assert abs(len(result.history) - len(first.history)) <= 2
    return result


@pytest.mark.parametrize("units", FEW, ids=str)
def test_a_problem_costs_the_same_in_any_unit(planned, units):
    length, time = units
    base = load_scenario("known_environment")
    require_alike(base, planned[base.name], length=length, time=time)


@pytest.mark.slow
@pytest.mark.parametrize("units", UNITS, ids=str)
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_of_the_paper_costs_the_same_in_any_unit(planned, name, units):
    length, time = units
    require_alike(load_scenario(name), planned[name], length=length, time=time)


# Proven alike.


def same_margins(
    got: Certificate, wanted: Certificate, *, length: float, time: float
) -> None:
    """Every margin is the same in its unit."""
    assert got.margins.keys() == wanted.margins.keys()
    assert got.worst[0] == wanted.worst[0]
    for name, margin in got.margins.items():
        first = wanted.margins[name]
        if name in ("tube", "continuity", "time", "ends", "hand_over"):
            assert margin.kept == first.kept  # of rounding, in a problem's own units
            continue
        unit = unit_of(first.unit, length=length, time=time)
        # Two own units that differ by rounding have kinks in other places.
        near = pytest.approx(first.value * unit, rel=1e-4, abs=1e-7 * unit)
        assert margin.value == near, name


@settings(max_examples=8)
@given(length=st.floats(-3, 3), time=st.floats(-2, 2))
def test_the_margins_of_a_plan_are_the_same_in_their_units(planned, length, time):
    """One plan, proven in units of which all are longer than sqrt(2) of another."""
    length, time = 10.0**length, 10.0**time
    base, result = load_scenario("unknown_drag"), planned["unknown_drag"]
    other = in_other_units(base, length=length, time=time)
    moved = plan_in_units(result.plan, Units(1 / length, 1 / time))
    got = certify(moved, Problem.from_scenario(other))
    own = canonical(Problem.from_scenario(other)).units
    assert got.certified
    if own.length == pytest.approx(length) and own.time == pytest.approx(time):
        same_margins(got, result.certificate, length=length, time=time)
    else:  # near the user's, so it was proven in those
        assert own.length == 1.0 or own.time == 1.0


def test_a_plan_that_breaks_a_limit_does_so_in_every_unit(planned):
    """Margins below zero, not only those above."""
    base, result = load_scenario("known_environment"), planned["known_environment"]
    base.limits.speed = 2.0
    base.limits.input = 3.0
    base.obstacles[1] = dataclasses.replace(base.obstacles[1], radius=1.2)
    first = certify(result.plan, Problem.from_scenario(base))
    assert {"speed", "input", "obstacles"} <= set(first.broken)
    for length, time in FEW:
        other = in_other_units(base, length=length, time=time)
        moved = plan_in_units(result.plan, Units(1 / length, 1 / time))
        got = certify(moved, Problem.from_scenario(other))
        assert got.broken == first.broken
        for name in first.broken:
            unit = unit_of(first.margins[name].unit, length=length, time=time)
            wanted = first.margins[name].value * unit
            # A hopeless plan is proven no finer, sooner or later by the units.
            assert got.margins[name].value == pytest.approx(wanted, rel=0.02)


# Every other thing that has a unit.


@pytest.mark.parametrize("name", EVERY_LIMIT)
def test_every_limit_is_the_same_in_millimetres(name):
    base = limited(name)
    result = require_alike(base, plan(base), length=1e3, time=1.0)
    assert result.certified


COSTS = [
    "{state: {position: [0.5, 0.0], velocity: 0.2}, bandwidth_rate: 0.3}",
    "{state: {position: 2.0, line: {point: [0.5, 0], direction: [0, 1]}}}",
]


@pytest.mark.parametrize("cost", COSTS)
def test_every_cost_is_the_same_in_other_units(cost):
    base = with_cost(cost)
    require_alike(base, plan(base), length=1e3, time=0.1)


def test_a_soft_goal_is_missed_by_as_much_in_other_units():
    base = with_cost("{terminal: {position: 2.0, velocity: 0.5}}", soft=True)
    first = plan(base)
    result = require_alike(base, first, length=0.01, time=10.0)
    end, wanted = (
        each.plan.reference(each.plan.end_time)[0] for each in (result, first)
    )
    np.testing.assert_allclose(end / 0.01, wanted, atol=0.02)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_chains_of_every_order_are_the_same_in_other_units(order):
    base = Scenario(
        model=IntegratorChain(2, order, 0.05),
        limits=Limits(input=4.0, speed=2.0),
        start=Waypoint([0.0, 0.0]),
        goal=Waypoint([1.0, 6.0]),
        duration=6.0,
        planner=Planner(intervals=16),
    )
    base.controller.slope = [2.0, 2.0]
    base.disturbance.bound = [0.1, 0.1]
    validate(base)
    first = plan(base)
    assert first.certified
    require_alike(base, first, length=1e3, time=1.0)
    require_alike(base, first, length=1.0, time=0.01)


def test_ipopt_finds_the_same_in_other_units(planned):
    base = load_scenario("known_environment")
    base.planner.backend, base.planner.intervals = "ipopt", 28
    require_alike(base, plan(base), length=1e3, time=1.0)


def test_the_best_side_is_the_same_in_other_units():
    base = load_scenario("best_side")
    require_alike(base, plan(base), length=1e3, time=1.0)


def test_a_plan_without_a_tube_is_the_same_in_other_units():
    base = load_scenario("known_environment")
    other = in_other_units(base, length=1e-3, time=1.0)
    first, result = (
        plan_problem(without_tube(Problem.from_scenario(each)), each.planner)
        for each in (base, other)
    )
    unit = cost_unit(base, length=1e-3, time=1.0)
    assert result.cost / unit == pytest.approx(first.cost, rel=1e-6)
    thickest = [each.plan.position_tube(7.0).max() for each in (first, result)]
    assert thickest[1] == pytest.approx(1e-3 * thickest[0], rel=1e-6)


def test_an_infeasible_problem_says_so_in_its_units():
    base = load_scenario("constant_uncertainty")
    first = plan(base)
    assert first.status == "infeasible"
    other = in_other_units(base, length=1e3, time=1.0)
    other.model.length_unit = "mm"
    result = plan(other)
    assert result.status == "infeasible"
    assert "mm" in result.message


# Flown alike.


def test_a_flight_is_the_same_in_other_units():
    base = load_scenario("unknown_drag")
    first = Simulate(base)
    other = Simulate(in_other_units(base, length=1e3, time=0.1))
    assert other.status == first.status == "certified"
    np.testing.assert_allclose(
        other.clearance.min() / 1e3, first.clearance.min(), rtol=0.02
    )
    assert other.tube_ratios.max() < 1
    assert other.breaches(base) == ()


def test_a_receding_horizon_decides_the_same_in_other_units():
    base = load_scenario("receding_horizon")
    first = Simulate(base)
    other = Simulate(in_other_units(base, length=1e3, time=1.0))
    assert [r.status for r in other.replans] == [r.status for r in first.replans]
    assert other.clearance.min() > 0


# A problem's own units.


RATES = st.floats(1e-4, 1e4)


@given(
    speed=st.floats(1e-6, 1e6), slope=RATES, bandwidth=RATES, order=st.integers(1, 5)
)
def test_own_units_make_problems_alike(speed, slope, bandwidth, order):
    units = Units.own(
        speed=speed, slope=np.array([slope]), bandwidth=bandwidth, orders=[order]
    )
    fastest = max(slope, bandwidth / 2) if order > 1 else bandwidth / 2
    assert 2.0 / 1.5 < fastest * units.time < 2.0 * 1.5
    assert 2.5 / 1.5 < speed * units.time / units.length < 2.5 * 1.5
    back = units.inverse()
    assert back.length * units.length == pytest.approx(1.0)


@pytest.mark.parametrize("broken", [0.0, -1.0, np.nan, np.inf])
def test_broken_numbers_leave_the_users_units(broken):
    units = Units.own(speed=2.5, slope=np.array([2.0]), bandwidth=broken, orders=[1])
    assert units == Units()


def test_a_problem_near_its_own_units_stays_as_it_is():
    problem = Problem.from_scenario(load_scenario("known_environment"))
    assert canonical(problem) is problem


def test_a_plan_returns_from_other_units(planned):
    plan_, units = planned["known_environment"].plan, Units(0.3, 7.0)
    back = plan_in_units(plan_in_units(plan_, units), units.inverse())
    time = np.linspace(plan_.start_time, plan_.end_time, 100)
    np.testing.assert_allclose(back.reference(time), plan_.reference(time), atol=1e-9)
    np.testing.assert_allclose(back.layer(time), plan_.layer(time), atol=1e-9)


# Names.


def test_a_model_names_its_units_outputs_and_inputs(tmp_path):
    scenario = parse_scenario("""
model: !IntegratorChain
  {num_outputs: 2, order: 2, length_unit: mm, outputs: [east, north], inputs: [a, b]}
disturbance: !UniformHold {bound: [20, 20]}
controller: {slope: [2, 2], reaching_rate: 10, initial_boundary_layer: 30}
start: {position: [0, 0]}
goal: {position: [0, 900]}
limits:
  {input: 600, speed: 300, position: {min: [-200, null]}, inputs: {max: [500, null]}}
cost: {bandwidth: 1000}
obstacles: [!Sphere {center: [10, 400], radius: 60}]
duration: 6
planner: {intervals: 16}
""")
    experiment = run(scenario, tmp_path)
    assert experiment.result.certified, experiment.result.message
    summary = experiment.summary()
    assert summary["units"] == {
        "length": "mm",
        "time": "s",
        "outputs": {"east": "mm", "north": "mm"},
        "inputs": {"a": "mm/s²", "b": "mm/s²"},
    }
    margins = summary["margins"]
    assert margins["obstacles"]["unit"] == "mm"
    assert margins["speed"]["unit"] == "mm/s"
    assert margins["speed"]["where"] in ("axis east", "axis north")
    assert margins["input"]["unit"] == margins["inputs"]["unit"] == "mm/s²"
    assert margins["inputs"]["where"] == "max of a"
    assert margins["position"]["where"] == "min of axis east"
    assert " m/s" not in repr(experiment) and "mm/s" in repr(experiment)


@pytest.mark.parametrize(
    ("model", "text"),
    [
        ("num_outputs: 2, length_unit: mm/s", "model.length_unit: got 'mm/s'"),
        ("num_outputs: 2, length_unit: ''", "model.length_unit"),
        ("num_outputs: 2, outputs: [x]", "model.output_names: got ['x']"),
        ("num_outputs: 2, outputs: [x, x]", "no two the same"),
        ("num_outputs: 2, inputs: [a, '']", "model.input_names"),
    ],
)
def test_names_that_name_nothing_are_refused(model, text):
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(
            f"model: !IntegratorChain {{{model}}}\n"
            "controller: {slope: [2, 2]}\n"
            "start: {position: [0, 0]}\ngoal: {position: [0, 4]}\nduration: 4"
        )
    assert text in str(caught.value)


def test_errors_name_the_models_units():
    scenario = Scenario(model=DragDoubleIntegrator(length_unit="km"))
    scenario.limits.speed = -1.0
    with pytest.raises(ScenarioError, match="greater than 0 km/s"):
        validate(scenario)
    scenario.limits.speed, scenario.model.drag_estimate = 2.5, -1.0
    with pytest.raises(ScenarioError, match=r"model.drag_estimate"):
        validate(scenario)


def test_a_unit_has_the_range_of_its_kind():
    assert range_of("mm") == range_of("m") and range_of("ft/s") == range_of("m/s")
    assert range_of("km/s³") == range_of(derivative_unit("m", 2))
    assert range_of("1/mm") == range_of("1/m")
    assert range_of("rad/s²") == range_of("m/s²")
