"""Outputs of different order, planned, proven, flown and refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from math import comb
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.systems.primitives import FirstOrderTaylorApproximation
from test_diagrams import DISTURBANCES as SINGLE

from dtmpc_drake.diagrams import FlyTrials, MakeClosedLoop, Simulate, draw_trials
from dtmpc_drake.disturbances import Constant, WorstCase
from dtmpc_drake.disturbances.base import DISTURBANCES
from dtmpc_drake.experiments.compare import run as run_comparison
from dtmpc_drake.experiments.simulate import run
from dtmpc_drake.limits import NormLimit
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.models import IntegratorChain, LaggedMultirotor, Model
from dtmpc_drake.numerics.arrays import euclidean_norm
from dtmpc_drake.obstacles import Cylinder, Sphere
from dtmpc_drake.planning import Problem, certify, plan, plan_problem, replan
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.replanning import carried_start, problem_on_the_way
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.plan import Plan, join
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import (
    Limits,
    Planner,
    Scenario,
    ScenarioError,
    Sensing,
    Waypoint,
    load_scenario,
    parse_scenario,
    to_yaml,
    validate,
)
from dtmpc_drake.scenario.schema import StateWeights
from dtmpc_drake.systems import Plant, tube_ratios
from tests.models_for_tests import (
    SkewedChains,
    make_problem,
    models_of_mixed_orders,
    name_of,
)

SHORT = Scenario(
    name="short",
    model=LaggedMultirotor(drag_error_bound=0.05, yaw_bias_bound=0.05),
    disturbance=WorstCase(bound=[0.4, 0.4, 0.3, 0.1], model_error=True),
    start=Waypoint(position=[0.0, 0.0, 1.0, 0.0]),
    goal=Waypoint(position=[0.0, 4.0, 1.5, 0.8]),
    limits=Limits(input=9.0),
    duration=6.0,
    obstacles=[Sphere([0.7, 2.0, 1.0], 0.5)],
    planner=Planner(intervals=24, time_limit=600.0),
)
SHORT.controller.slope = [2.0] * 4


@pytest.fixture(scope="module")
def shipped() -> Scenario:
    return load_scenario("actuator_lag")


@pytest.fixture(scope="module")
def shipped_result(shipped: Scenario) -> PlanningResult:
    result = plan(shipped)
    assert result.certified, result.message
    return result


@pytest.fixture(scope="module")
def short_result() -> PlanningResult:
    result = plan(SHORT)
    assert result.certified, result.message
    return result


# The shipped scenario.


def assert_that_backends_agree(scenario: Scenario, result: PlanningResult) -> None:
    ipopt = dataclasses.replace(scenario.planner, backend="ipopt", time_limit=600.0)
    other = plan_problem(Problem.from_scenario(scenario), ipopt)
    assert other.certified, other.message
    assert other.cost == pytest.approx(result.cost, rel=0.02)


@pytest.mark.slow
def test_both_backends_certify_it_at_the_same_cost(
    shipped: Scenario, shipped_result: PlanningResult
) -> None:
    assert_that_backends_agree(shipped, shipped_result)


def test_both_backends_find_the_same_short_plan(short_result: PlanningResult) -> None:
    assert_that_backends_agree(SHORT, short_result)


# Other tests may have registered more.
KINDS = sorted(
    k.__name__ for k in DISTURBANCES if k.__module__.startswith("dtmpc_drake.")
)


@pytest.mark.parametrize("kind", KINDS)
def test_no_disturbance_brings_a_flight_out_of_its_bounds(
    shipped: Scenario, shipped_result: PlanningResult, kind: str
) -> None:
    """Layer, tubes, obstacles, limits: for parameters at their ends, too."""
    made = DISTURBANCES.kind(kind)
    bound = shipped.disturbance.bound
    hard = made(bound=bound) if made.short_name is None else made.hard(bound)
    pushed = dataclasses.replace(shipped, disturbance=hard)
    flights = FlyTrials(
        pushed, plan=shipped_result.plan, trials=draw_trials(pushed, range(8))
    )
    assert flights.outside == 0, flights.violations


@pytest.mark.parametrize("push", ["constant", "worst_model", "gust"])
def test_many_flights_side_by_side_are_those_of_one(
    short_result: PlanningResult, push: str
) -> None:
    one = dataclasses.replace(SHORT, disturbance=SINGLE[push](SHORT.disturbance.bound))
    trials = draw_trials(one, range(3))
    flights = FlyTrials(one, plan=short_result.plan, trials=trials)
    alone = Simulate(trials[2].scenario(one), plan=short_result.plan)
    np.testing.assert_array_equal(flights.record[2], alone.record)


# What is proven.


def bounds_along(problem: Problem, at: Plan, time: np.ndarray) -> dict[str, np.ndarray]:
    """Everything that can be reached, output by output, from the formulas alone."""
    law, model = problem.law, problem.model
    orders, lam = law.chains.orders, law.slope
    derivatives, bound = at.derivatives(time), at.error_bound(time)
    state = law.chains.state_of(derivatives)
    known = model.model_error_bound(state)
    largest = model.model_error_bound_over(state, bound)
    drift = model.drift_bound_over(state, bound)
    rate = at.boundary_layer_rate(time)
    reach = np.zeros((*derivatives.shape, 2))  # of every derivative: low and high
    feedback = np.zeros(known.shape)
    for i, order in enumerate(orders):
        gain = known[:, i] + law.disturbance_bound[i] + law.reaching_rate - rate[:, i]
        switching = np.maximum(gain + largest[:, i] - known[:, i], known[:, i] - gain)
        damping = sum(
            comb(order - 1, k - 1) * lam[i] ** (order - k) * bound[:, k, i]
            for k in range(1, order)
        )
        feedback[:, i] = drift[:, i] + damping + switching
        top = law.disturbance_bound[i] + largest[:, i] + damping + switching
        for k in range(order + 1):
            wide = bound[:, k, i] if k < order else top
            for side, sign in enumerate((-1, 1)):
                reach[:, k, i, side] = derivatives[:, k, i] + sign * wide
    inverse = np.abs(model.inverse_input_matrix(state))
    highest = law.chains.highest_of(derivatives)
    nominal = model.input_for(state, highest)
    spread = (inverse * feedback[:, None]).sum(axis=-1)
    return {"reach": reach, "nominal": nominal, "spread": spread}


PLANTED: dict[str, tuple[NormLimit, int | None, int]] = {
    # Name, and the derivative and output that is looked at.
    "jerk of x, of order 3": (NormLimit("jerk", 1.0, [[1.0, 0, 0, 0]]), 3, 0),
    "acceleration of y": (NormLimit("acceleration", 1.0, [[0, 1.0, 0, 0]]), 2, 1),
    "acceleration of z, of order 2": (
        NormLimit("acceleration", 1.0, [[0, 0, 1.0, 0]]),
        2,
        2,
    ),
    "speed of z": (NormLimit("velocity", 1.0, [[0, 0, 1.0, 0]]), 1, 2),
    "rate of the yaw, of order 1": (
        NormLimit("velocity", 1.0, [[0, 0, 0, 1.0]]),
        1,
        3,
    ),
    "yaw": (NormLimit("position", 1.0, [[0, 0, 0, 1.0]]), 0, 3),
    "input of x": (NormLimit("input", 1.0, [[1.0, 0, 0, 0]]), None, 0),
    "yaw rate that is asked for": (NormLimit("input", 1.0, [[0, 0, 0, 1.0]]), None, 3),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_limit_that_is_broken_by_a_hair_is_found_broken(
    short_result: PlanningResult, name: str
) -> None:
    """And one that is kept by little more is proven, between all knots."""
    problem, made = Problem.from_scenario(SHORT), short_result.plan
    limit, k, i = PLANTED[name]
    time = np.linspace(0, 6, 40_001)
    found = bounds_along(problem, made, time)
    if k is None:
        worst = (np.abs(found["nominal"]) + found["spread"])[:, i].max()
    else:
        worst = np.abs(found["reach"][:, k, i]).max()
    for factor, kept in ((1 - 1e-4, False), (1.03, True)):
        bound = dataclasses.replace(limit, bound=float(factor * worst))
        bounded = dataclasses.replace(problem, other_limits=(bound.limit(),))
        certificate = certify(made, bounded)
        assert certificate.kept == kept, (certificate, worst)


def test_margins_of_speed_and_input_are_those_of_the_formulas(
    short_result: PlanningResult,
) -> None:
    problem, made = Problem.from_scenario(SHORT), short_result.plan
    found = bounds_along(problem, made, np.linspace(0, 6, 20_001))
    speed = problem.speed.bound - np.abs(found["reach"][:, 1]).max()
    used = euclidean_norm(found["nominal"]) + euclidean_norm(found["spread"])
    margins = short_result.certificate.margins
    assert margins["speed"].value == pytest.approx(speed, abs=0.01)
    assert margins["speed"].value <= speed + 1e-6
    assert margins["input"].value == pytest.approx(9.0 - used.max(), abs=0.03)
    assert margins["input"].value <= 9.0 - used.max() + 1e-6


def spoilt(made: Plan, **changes: Callable[[np.ndarray], None]) -> Plan:
    arrays: dict[str, Any] = {}
    for name, change in changes.items():
        arrays[name] = getattr(made, name).copy()
        change(arrays[name])
    return dataclasses.replace(made, **arrays)


def shrink(k: int, i: int) -> Callable[[np.ndarray], None]:
    def change(array: np.ndarray) -> None:
        array[:, k, i] *= 0.9

    return change


@pytest.mark.parametrize(
    ("k", "i"), [(0, 0), (1, 1), (2, 0), (0, 2), (1, 2), (0, 3)], ids=str
)
def test_a_tube_that_claims_too_little_of_one_output_is_caught(
    short_result: PlanningResult, k: int, i: int
) -> None:
    change = shrink(k, i)
    less = spoilt(short_result.plan, bound_samples=change, bound_rate_samples=change)
    certificate = certify(less, Problem.from_scenario(SHORT))
    assert certificate.margins["tube"].value < 0


H = 0.25  # a piece of the short plan is so long
JUMPS = {
    # What jumps, of which output, and what is added to a piece, in powers of t.
    "y*": (3, [1e-6, 0.0, 0.0]),
    "y*^(1)": (2, [0.0, -1e-5 * H, 1e-5, 0.0]),
    "y*^(2)": (1, [0.0, 0.0, 1e-5 * H**2, -2e-5 * H, 1e-5]),
}


@pytest.mark.parametrize("what", JUMPS)
def test_a_jump_of_what_is_a_state_is_caught(
    short_result: PlanningResult, what: str
) -> None:
    """Alone: all derivatives below it stay continuous."""
    i, powers = JUMPS[what]

    def change(array: np.ndarray) -> None:
        array[5, : len(powers), i] += powers

    assert np.diff(short_result.plan.knots) == pytest.approx(H)
    jumping = spoilt(short_result.plan, coefficients=change)
    certificate = certify(jumping, Problem.from_scenario(SHORT))
    margin = certificate.margins["continuity"]
    assert margin.value < 0
    assert margin.where.startswith(f"{what} on ")


def bend(array: np.ndarray) -> None:
    array[3, 3, 3] = 1e-3  # the yaw is of degree 2


def invent(array: np.ndarray) -> None:
    array[:, 1, 3] = 0.1  # the yaw's rate is no state


@pytest.mark.parametrize(
    ("field", "change"),
    [("coefficients", bend), ("bound_samples", invent), ("bound_rate_samples", invent)],
)
def test_what_cannot_be_of_such_an_output_is_no_plan(
    short_result: PlanningResult, field: str, change: Callable[[np.ndarray], None]
) -> None:
    """y_i*^(n_i) is linear: all proofs rest on that."""
    certificate = certify(
        spoilt(short_result.plan, **{field: change}), Problem.from_scenario(SHORT)
    )
    assert not certificate.certified
    assert certificate.faults[0].startswith(field)


@pytest.mark.parametrize(
    "orders",
    [[3, 3, 2, 2], [3, 3, 2], [3, 3, 2, 0], [2, 3, 2, 4], [3.0, 3.0, 2.0, 1.0]],
)
def test_a_plan_of_other_orders_is_none_of_the_problem(
    short_result: PlanningResult, orders: list
) -> None:
    other = dataclasses.replace(short_result.plan, orders=np.array(orders))
    certificate = certify(other, Problem.from_scenario(SHORT))
    assert not certificate.certified
    assert certificate.faults


# Random chains.


@settings(max_examples=4)
@given(
    orders=st.lists(st.integers(1, 3), min_size=2, max_size=4),
    seed=st.integers(0, 2**16),
)
def test_random_chains_are_planned_certified_and_flown_in_their_tubes(
    orders: list[int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    m = len(orders)
    scenario = Scenario(
        name="chains",
        model=IntegratorChain(orders=orders, error_bound=0.1),
        disturbance=WorstCase(bound=[0.2] * m, hold=0.8, model_error=True),
        start=Waypoint(position=[0.0] * m),
        goal=Waypoint(position=rng.uniform(-2, 2, m).tolist()),
        initial_error=Waypoint(position=rng.uniform(-0.01, 0.01, m).tolist()),
        limits=Limits(input=14.0),
        duration=5.0,
        planner=Planner(intervals=16, time_limit=600.0),
    )
    scenario.controller.slope = rng.uniform(1.5, 2.5, m).tolist()
    result = plan(scenario)
    assert result.certified, result.message
    trials = draw_trials(scenario, range(6))
    flights = FlyTrials(scenario, plan=result.plan, trials=trials)
    assert flights.outside == 0, flights.violations


@pytest.mark.parametrize("backend", ["clarabel", "ipopt"])
def test_outputs_that_see_each_other_are_planned_by_both(backend: str) -> None:
    problem = make_problem(SkewedChains(), duration=4.0)
    result = plan_problem(
        problem, Planner(intervals=16, backend=backend, time_limit=300.0)
    )
    assert result.certified, result.message


@pytest.mark.parametrize("model", models_of_mixed_orders(), ids=name_of)
@pytest.mark.parametrize("velocity_bound", ["comparison", "paper"])
def test_programs_read_the_bounds_off_the_tubes_states(
    model: Model, velocity_bound: str
) -> None:
    tr = Transcription(make_problem(model, velocity_bound=velocity_bound), 12)
    iterate = tr.evaluate(*straight_line(tr))
    states = tr.tube_states(iterate).reshape(13, -1)
    found = np.stack([states @ bound.T for bound in tr.state_bounds], axis=1)
    assert found == pytest.approx(iterate.local.error_bound, abs=1e-12)
    layout = Variables(tr, planes=0, kinked=np.zeros(0, dtype=int))
    both = np.concatenate([states[:-1], states[1:]], axis=1)
    controls = np.einsum("cis,ps->pci", layout.tube_matrix, both)
    assert controls[:, 0] == pytest.approx(found[:-1, 0])
    assert controls[:, -1] == pytest.approx(found[1:, 0])


# Obstacles and what says where it is.


def test_obstacles_see_the_place_alone(short_result: PlanningResult) -> None:
    field = SHORT.obstacle_set()
    assert field.outputs_seen().tolist() == [True, True, True, False]
    here, turned = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 2.0]])
    tube, loose = np.array([[0.1, 0.1, 0.1, 0.0], [0.1, 0.1, 0.1, 5.0]])
    for wide in (tube, loose):
        expected = field.clearance(here, tube)
        assert field.clearance(turned, wide) == pytest.approx(expected)
    assert short_result.certificate.margins["obstacles"].value >= 0


def test_a_sphere_has_a_coordinate_for_each_output_that_says_where_it_is() -> None:
    wrong = dataclasses.replace(SHORT, obstacles=[Sphere([0.0, 2.0, 1.0, 0.0], 0.5)])
    with pytest.raises(ScenarioError, match=r"obstacles\[0\].center.*3 numbers"):
        validate(wrong)


def test_the_search_for_sides_is_one_of_the_place(shipped: Scenario) -> None:
    settings_ = dataclasses.replace(
        shipped.planner,
        initial_guess="best_side",
        time_budget=1.0,
        intervals=28,
        time_limit=600.0,
    )
    result = plan_problem(Problem.from_scenario(shipped), settings_)
    assert result.certified, result.message
    # The sphere may also be passed above and below.
    assert {c.sides[2] for c in result.candidates} & set("AB")
    assert all(c.path.shape[1] == 4 for c in result.candidates)


# What is refused.


def test_the_orders_of_a_chain_can_be_given() -> None:
    text = "name: a\nmodel: !IntegratorChain {orders: [3, 3, 2, 1]}\n"
    model = parse_scenario(
        text
        + "controller: {slope: [2, 2, 2, 2]}\n"
        + "disturbance: !Constant {bound: [0, 0, 0, 0]}\n"
        + "start: {position: [0, 0, 0, 0]}\ngoal: {position: [1, 1, 1, 1]}\n"
        + "limits: {input: 9}\nduration: 5\nobstacles: []\n"
    ).model
    assert (model.order, model.num_outputs) == (3, 4)


def test_a_scenario_of_mixed_orders_survives_its_file(shipped: Scenario) -> None:
    assert parse_scenario(to_yaml(shipped)) == shipped
    chains = dataclasses.replace(
        SHORT, model=IntegratorChain(orders=[3, 3, 2, 1]), obstacles=[]
    )
    assert parse_scenario(to_yaml(chains)) == chains


def changed(**changes: Any) -> Scenario:
    return dataclasses.replace(SHORT, **changes)


def limited(**norm: Any) -> Scenario:
    limits = dataclasses.replace(SHORT.limits, norms=[NormLimit(**norm)])
    return changed(limits=limits)


def cost(**weights: Any) -> Scenario:
    weighed = dataclasses.replace(SHORT.cost, terminal=StateWeights(**weights))
    return changed(cost=weighed)


REFUSED: dict[str, tuple[Scenario, str]] = {
    "start.acceleration[2]": (
        changed(start=Waypoint([0.0] * 4, None, [0.0, 0.0, 1.0, 0.0])),
        "0: axis z is of order 2",
    ),
    "goal.velocity[3]": (
        changed(goal=Waypoint([0.0, 4.0, 1.5, 0.8], [0.0, 0.0, 0.0, 0.3])),
        "0: axis yaw is of order 1",
    ),
    "initial_error.velocity[3]": (
        changed(initial_error=Waypoint([0.0] * 4, [0.0, 0.0, 0.0, 0.1])),
        "0: axis yaw is of order 1",
    ),
    "limits.norms[0]": (
        limited(of="acceleration", bound=4.0),
        "does not look at axis yaw.*order 1, and nothing bounds its acceleration",
    ),
    "limits.norms[0] ": (
        limited(of="jerk", bound=4.0, matrix=[[1.0, 0, 0, 0], [0, 0, 1.0, 0]]),
        "does not look at axis z.*order 2, and nothing bounds its jerk",
    ),
    "cost.terminal.velocity": (cost(velocity=1.0), "0 for axis yaw.*order 1"),
    "cost.terminal.acceleration": (
        cost(acceleration=[1.0, 1.0, 0.5, 0.0]),
        "0 for axis z.*order 2",
    ),
    "model.orders[1]": (
        changed(model=IntegratorChain(orders=[3, 0, 2, 1]), obstacles=[]),
        r"a whole number in \[1, 3\]",
    ),
    "planner.uncertainty": (
        changed(planner=Planner(intervals=24, uncertainty="constant")),
        "state_dependent",
    ),
}


@pytest.mark.parametrize("field", REFUSED)
def test_what_an_output_does_not_have_is_refused_by_name(field: str) -> None:
    scenario, why = REFUSED[field]
    with pytest.raises(ScenarioError, match=why) as raised:
        plan(scenario)
    assert raised.value.field == field.strip()


def test_limits_and_costs_of_what_there_is_are_accepted() -> None:
    limits = dataclasses.replace(
        SHORT.limits,
        norms=[
            NormLimit("velocity", 3.0),
            NormLimit("acceleration", 6.0, [[1.0, 0, 0, 0], [0, 0, 1.0, 0]]),
            NormLimit("jerk", 20.0, [[1.0, 0, 0, 0], [0, 1.0, 0, 0]]),
        ],
    )
    weights = StateWeights(velocity=[1.0, 1.0, 1.0, 0.0], position=1.0)
    costs = dataclasses.replace(SHORT.cost, terminal=weights)
    result = plan(changed(limits=limits, cost=costs))
    assert result.certified, result.message


# Files, parts and what follows on the way.


def test_a_plan_keeps_its_orders(short_result: PlanningResult, tmp_path) -> None:
    made, path = short_result.plan, tmp_path / "plan.npz"
    made.save(path)
    loaded = Plan.load(path)
    assert loaded.chains.orders == (3, 3, 2, 1)
    assert "orders 3, 3, 2, 1" in repr(loaded)
    time = np.linspace(-1, 7, 50)
    np.testing.assert_array_equal(loaded.reference(time), made.reference(time))
    part = join([made.between(0.0, 3.0), made.between(3.0, 6.0)], [0.0, 3.0])
    assert part.chains == made.chains
    assert part.derivatives(time) == pytest.approx(made.derivatives(time), abs=1e-9)


def test_a_plan_that_was_saved_without_orders_is_one_of_equal_ones(tmp_path) -> None:
    made = plan(Scenario(duration=8.0, planner=Planner(intervals=16))).plan
    path = tmp_path / "plan.npz"
    made.save(path)
    with np.load(path) as data:
        old = {name: data[name] for name in data if name != "plan_orders"}
    np.savez(path, **old)
    assert Plan.load(path).chains.orders == (2, 2, 2)


def test_derivatives_and_drakes_trajectory_are_the_reference_of_each_output(
    short_result: PlanningResult,
) -> None:
    made = short_result.plan
    trajectory = made.trajectory()
    for time in np.linspace(0.05, 5.95, 13):
        rows = made.derivatives(time)
        for k in range(4):
            found = trajectory.EvalDerivative(time, k).ravel()
            for i, order in enumerate(made.chains.orders):
                if k <= order:
                    assert rows[k, i] == pytest.approx(found[i], abs=1e-6)
        reference = made.reference(time)
        highest = [rows[order, i] for i, order in enumerate(made.chains.orders)]
        np.testing.assert_array_equal(reference[-1], highest)
        np.testing.assert_array_equal(
            reference[:-1], np.where(made.chains.exists, rows[:-1], 0.0)
        )


def test_a_new_plan_goes_on_where_the_old_one_is(short_result: PlanningResult) -> None:
    whole, old = Problem.from_scenario(SHORT), short_result.plan
    rng, time, start = np.random.default_rng(0), 1.0, 1.4
    chains = old.chains
    error = 0.2 * rng.uniform(-1, 1, chains.exists.shape) * old.error_bound(time)
    state = old.reference(time)[:-1] + error
    opened = carried_start(old, whole, measured_at=time, state=state, until=start)
    own = old.error_bound(start)
    assert (opened.highest <= chains.top(own) + 1e-12).all()
    assert opened.layer == pytest.approx(old.boundary_layer(start))
    problem = problem_on_the_way(whole, old, measured_at=time, state=state, start=start)
    result = plan_problem(
        dataclasses.replace(problem, duration=6.0 - start), Planner(intervals=20)
    )
    assert result.certified, result.message
    new = result.plan
    assert new.reference(start) == pytest.approx(old.reference(start), abs=1e-6)
    assert new.bandwidth(start) == pytest.approx(old.bandwidth(start), abs=1e-6)
    decision = replan(
        SHORT,
        old,
        known=np.array([True]),
        measured_at=time,
        state=state,
        start=start,
    )
    assert decision.status == "certified"


@pytest.mark.slow
def test_obstacles_that_are_seen_on_the_way_are_avoided() -> None:
    sensed = changed(
        obstacles=[Sphere([0.4, 5.0, 1.0], 0.4)],
        goal=Waypoint(position=[0.0, 10.0, 1.5, 0.8]),
        limits=Limits(input=9.0, speed=2.0),
        duration=11.0,
        sensing=Sensing(range=9.0),
        start=Waypoint(position=[0.0, -5.0, 1.0, 0.0]),
        planner=Planner(intervals=44, replan_period=3.0, compute_delay=0.4),
    )
    log = Simulate(sensed)
    assert not log.breaches(sensed)
    assert {r.status for r in log.replans} == {"certified"}
    assert log.clearance.min() > 0


@pytest.mark.slow
def test_what_is_held_without_a_plan_has_the_tube_that_it_says() -> None:
    short = changed(
        start=Waypoint([0.0, 0.0, 1.0, 0.0], [0.0, 0.3, 0.1, 0.0]),
        limits=Limits(input=0.5),
        duration=3.0,
        goal=Waypoint(position=[0.0, 1.0, 1.5, 0.8]),
    )
    log = Simulate(short)
    assert log.status.startswith("infeasible")
    assert 0.1 < log.tube_ratios.max() <= 1 + 1e-6


# Systems.


def test_the_plants_state_has_no_more_numbers_than_there_are() -> None:
    plant = Plant(model=SHORT.model)
    assert plant.GetOutputPort("state").size() == 3 + 3 + 2 + 1
    context = plant.CreateDefaultContext()
    x = np.arange(1.0, 10.0) / 10
    context.SetContinuousState(x)
    u, d = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.1, 0.2, 0.3, 0.4])
    plant.GetInputPort("control").FixValue(context, u)
    plant.GetInputPort("disturbance").FixValue(context, d)
    rates = plant.EvalTimeDerivatives(context).CopyToVector()
    # x, y, z, yaw; then ẋ, ẏ, ż; then ẍ, ÿ.
    np.testing.assert_array_equal(rates[:3], x[4:7])
    np.testing.assert_array_equal(rates[4:6], x[7:])
    state = np.array([x[:4], [*x[4:7], 0], [*x[7:], 0, 0]])
    forced = SHORT.model.true_drift(state, {"drag": 0.1}) + u / [0.25, 0.25, 1, 1] + d
    assert rates[[7, 8, 6, 3]] == pytest.approx(forced)


def test_an_output_without_a_velocity_uses_as_much_of_its_tube_as_of_its_layer(
    short_result: PlanningResult,
) -> None:
    made, time, slope = short_result.plan, 2.0, np.full(4, 2.0)
    bound = made.error_bound(time)
    for share in (0.5, 0.25):
        state = made.reference(time)[:-1] + share * bound
        ratios = tube_ratios(plan=made, time=time, state=state, slope=slope)
        assert ratios[1, :3] == pytest.approx(share, abs=1e-4)
        assert ratios[2] == pytest.approx(share, abs=1e-4)
        assert ratios[:, 3] == pytest.approx(share, abs=1e-4)  # the yaw's
        s = sliding_variable(share * bound, slope, made.chains)
        assert ratios[0] == pytest.approx(s / made.boundary_layer(time), abs=1e-4)


def test_plant_and_tracker_can_be_linearised(short_result: PlanningResult) -> None:
    plant = Plant(model=SHORT.model)
    context = plant.CreateDefaultContext()
    context.SetContinuousState(np.full(9, 0.3))
    plant.GetInputPort("control").FixValue(context, np.zeros(4))
    plant.GetInputPort("disturbance").FixValue(context, np.zeros(4))
    linear = FirstOrderTaylorApproximation(
        plant,
        context,
        plant.GetInputPort("control").get_index(),
        plant.GetOutputPort("state").get_index(),
    )
    assert linear.A()[0] == pytest.approx(np.eye(9)[4])
    assert linear.B()[[7, 8, 6, 3]] == pytest.approx(np.diag([4.0, 4.0, 1.0, 1.0]))
    loop = MakeClosedLoop(SHORT, plan=short_result.plan)
    tracker = loop.GetSubsystemByName("tracker")
    assert tracker.ToAutoDiffXd() is not None
    assert tracker.ToSymbolic() is not None


def test_an_experiment_writes_all_its_files(tmp_path) -> None:
    experiment = run(changed(disturbance=Constant(bound=[0.2] * 4)), tmp_path)
    assert experiment.safe
    names = {path.name for path in experiment.files}
    assert {"replay.html", "figure.png", "histories.png", "plan.npz"} <= names


@pytest.mark.slow
def test_the_method_is_compared_without_its_parts(tmp_path) -> None:
    scenario = Scenario(
        name="few",
        model=IntegratorChain(orders=[2, 1], error_bound=0.1),
        disturbance=WorstCase(bound=[0.2, 0.2]),
        start=Waypoint(position=[0.0, 0.0]),
        goal=Waypoint(position=[0.0, 4.0]),
        duration=5.0,
        obstacles=[Cylinder([0.5, 2.0], 0.4)],
        planner=Planner(intervals=16),
    )
    scenario.controller.slope = [2.0, 2.0]
    found = run_comparison(scenario, tmp_path, trials=4)
    assert found.rows["both"].flights.outside == 0
