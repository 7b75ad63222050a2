"""Planning on the way: what is handed over, when, why, and that it is safe."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_diagrams import DISTURBANCES

from dtmpc_drake.diagrams import MakeClosedLoop, Simulate
from dtmpc_drake.disturbances import WorstCase
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.obstacles import Cylinder, Ellipsoid
from dtmpc_drake.planning import Problem, certify, plan, replan
from dtmpc_drake.planning.proof.certify import clearance_ahead
from dtmpc_drake.planning.replanning import carried_start, problem_on_the_way
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import Replan, counted, plans_in_force, table
from dtmpc_drake.scenario import (
    Controller,
    Limits,
    Planner,
    Scenario,
    Sensing,
    Waypoint,
    load_scenario,
    sensing_range_needed,
    validate,
)

_FLIGHTS: dict[tuple[str, str], Flight] = {}


def flight(name: str, disturbance: str) -> Flight:
    """A shipped scenario flown in some wind, once."""
    if (name, disturbance) not in _FLIGHTS:
        scenario = load_scenario(name)
        bound = scenario.disturbance.bound
        scenario.disturbance = DISTURBANCES[disturbance](bound)
        _FLIGHTS[name, disturbance] = Simulate(scenario)
    return _FLIGHTS[name, disturbance]


def assert_safe(scenario: Scenario, log: Flight) -> None:
    assert log.tube_ratios.max() <= 1 + 1e-6
    assert log.clearance.min() > 0
    seen = log.extremes()
    assert seen["largest_input"] <= scenario.limits.input
    assert seen["largest_speed"] <= scenario.limits.speed


def hand_overs(log: Flight) -> list[tuple[float, Plan, Plan]]:
    shown = plans_in_force(log.replans)
    pairs = itertools.pairwise(shown)
    return [(new.start, old.plan, new.plan) for old, new in pairs]


# The shipped flights.


@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_no_wind_brings_the_vehicle_out_of_its_tubes(disturbance: str) -> None:
    scenario = load_scenario("receding_horizon")
    log = flight("receding_horizon", disturbance)
    assert_safe(scenario, log)
    assert {r.status for r in log.replans} == {"certified"}
    np.testing.assert_allclose(log.reference[-1, :2], scenario.goal_state(), atol=1e-6)


def test_the_sensed_field_is_flown_safely_in_the_worst_wind() -> None:
    scenario = load_scenario("sensed_environment")
    log = flight("sensed_environment", "worst_case")
    assert_safe(scenario, log)
    assert {r.status for r in log.replans} == {"certified"}
    assert np.ptp(log.known_since[2:]) > 3.0  # one after the other


@pytest.mark.parametrize(
    ("name", "groups"),
    [
        ("receding_horizon", [(2, 3), (4,)]),
        ("sensed_environment", [(2,), (3,), (4,)]),
    ],
)
def test_each_group_of_obstacles_causes_a_plan(
    name: str, groups: list[tuple[int, ...]]
) -> None:
    log = flight(name, "worst_case")
    revealed = [r for r in log.replans if r.cause == "revealed"]
    assert [r.revealed for r in revealed] == groups
    scenario = load_scenario(name)
    slack = 2 * scenario.sensing.period + scenario.planner.compute_delay
    for r in revealed:
        since = log.known_since[list(r.revealed)]
        assert (since <= r.time).all() and (r.time - since <= slack).all()


def test_the_first_plan_does_not_know_what_is_not_known() -> None:
    """It flies straight through what appears later; the last one does not."""
    log = flight("receding_horizon", "uniform")
    everything = Problem.from_scenario(
        load_scenario("receding_horizon"), np.ones(5, dtype=bool)
    )
    first = certify(log.replans[0].plan, everything)
    assert first.margins["obstacles"].value < -0.3
    assert log.clearance.min() > 0.1


def test_the_bandwidth_rises_beside_what_has_just_been_found() -> None:
    """The paper's second result."""
    scenario, log = (
        load_scenario("receding_horizon"),
        flight("receding_horizon", "uniform"),
    )
    plans = {r.revealed: r.plan for r in log.replans if r.cause != "period"}

    def bandwidth_beside(plan: Plan | None, obstacle: int) -> float:
        assert plan is not None
        time = plan.sample_times()
        along = plan.reference(time)[:, 0, 1]
        middle = scenario.obstacles[obstacle].center[1]
        near = (along > middle - 2.0) & (along < middle)
        return float(plan.bandwidth(time)[near].max())

    assert bandwidth_beside(plans[()], 0) > 3.0  # the gap, known from the start
    for before, after, obstacle in (
        ((), (2, 3), 2),
        ((), (2, 3), 3),
        ((2, 3), (4,), 4),
    ):
        assert bandwidth_beside(plans[before], obstacle) < 0.8
        assert bandwidth_beside(plans[after], obstacle) > 1.5


def test_unknown_drag_is_no_obstacle_to_planning_again() -> None:
    """Tube geometry and state-dependent uncertainty at once, on the way."""
    scenario = load_scenario("receding_horizon")
    scenario.model.drag_error_bound = 0.1
    scenario.plant = {"drag": 0.2}
    scenario.disturbance = WorstCase(bound=scenario.disturbance.bound)
    scenario.planner.intervals, scenario.planner.replan_period = 48, 4.0
    log = Simulate(scenario)
    assert_safe(scenario, log)
    assert {r.status for r in log.replans} == {"certified"}
    assert len(log.replans) >= 5


def test_other_sides_are_looked_for_when_there_is_news() -> None:
    scenario = load_scenario("receding_horizon")
    scenario.planner.initial_guess = "best_side"
    scenario.planner.replan_period = 2.0
    log = Simulate(scenario)
    assert_safe(scenario, log)
    assert {r.status for r in log.replans} == {"certified"}
    searched, straight = (
        {r.revealed: r.cost for r in some.replans if r.cause != "period"}
        for some in (log, flight("receding_horizon", "uniform"))
    )
    # With all that is known, it is the cheaper way from the first plan on.
    assert searched[()] < straight[()]
    assert searched[(4,)] < straight[(4,)]


def test_plans_are_made_on_the_period_and_take_effect_after_the_delay() -> None:
    log = flight("receding_horizon", "uniform")
    planner = load_scenario("receding_horizon").planner
    periodic = np.array([r.time for r in log.replans if r.cause == "period"])
    np.testing.assert_allclose(periodic % planner.replan_period, 0.01, atol=1e-6)
    for r in log.replans[1:]:
        assert r.hand_over - r.time == pytest.approx(planner.compute_delay)
    times = [r.time for r in log.replans]
    assert times == sorted(times) and len(times) >= 12
    # None when too little time is left for a plan.
    assert times[-1] < load_scenario("receding_horizon").duration - 1.5


@pytest.mark.parametrize("name", ["receding_horizon", "sensed_environment"])
def test_hand_overs_are_continuous(name: str) -> None:
    pairs = hand_overs(flight(name, "worst_case"))
    assert len(pairs) >= 10
    for time, old, new in pairs:
        assert new.start_time == time
        for quantity in ("reference", "bandwidth", "boundary_layer"):
            before, after = getattr(old, quantity)(time), getattr(new, quantity)(time)
            np.testing.assert_allclose(after, before, atol=1e-9, err_msg=quantity)
        # The layer's rate follows from these, up to the tube's interpolation.
        np.testing.assert_allclose(
            new.boundary_layer_rate(time), old.boundary_layer_rate(time), atol=1e-4
        )


def test_a_new_tube_opens_from_the_measured_error_and_never_wider() -> None:
    log = flight("receding_horizon", "worst_case")
    narrower = []
    for time, old, new in hand_overs(log):
        before, after = old.error_bound(time), new.error_bound(time)
        assert (after <= before + 1e-12).all()
        narrower.append(after[0] / before[0])
        i = int(np.abs(log.time - time).argmin())
        error = np.abs(log.state[i] - log.reference[i, :2])
        assert (error <= after + 1e-6).all()
    # The worst wind fills the tube; a mild one leaves most of it.
    mild = [
        new.error_bound(t)[0] / old.error_bound(t)[0]
        for t, old, new in hand_overs(flight("receding_horizon", "uniform"))
    ]
    assert np.mean(mild) < 0.6 < np.mean(narrower)


def test_the_log_knows_which_plan_was_in_force() -> None:
    log = flight("receding_horizon", "bang_bang")
    flown = log.flown_plan()
    assert flown is not None
    between = np.ones(len(log.time), dtype=bool)
    for r in log.replans:
        between &= np.abs(log.time - r.hand_over) > 1e-3
    time, n = log.time[between], 2
    np.testing.assert_allclose(flown.reference(time), log.reference[between], atol=1e-9)
    error = np.abs(log.state[between] - log.reference[between, :n])
    ratio = error / (flown.error_bound(time) + 1e-6)
    np.testing.assert_allclose(
        ratio, log.tube_ratios[between, 1:], rtol=1e-3, atol=1e-5
    )


def test_two_flights_are_equal_whatever_the_clock_says() -> None:
    scenario = load_scenario("receding_horizon")
    scenario.disturbance = DISTURBANCES["uniform"](scenario.disturbance.bound)
    again, first = Simulate(scenario), flight("receding_horizon", "uniform")
    for field in dataclasses.fields(Flight):
        if field.name != "replans":
            np.testing.assert_array_equal(
                getattr(again, field.name), getattr(first, field.name)
            )
    assert again.replans == first.replans  # but for the plans and the solve times
    for one, other in zip(again.replans, first.replans, strict=True):
        assert one.plan is not None and other.plan is not None
        np.testing.assert_array_equal(one.plan.coefficients, other.plan.coefficients)
    assert [r.solve_time for r in again.replans] != [
        r.solve_time for r in first.replans
    ]


def test_a_log_with_many_plans_survives_its_file(tmp_path: Path) -> None:
    log = flight("receding_horizon", "uniform")
    log.save(tmp_path / "log.npz")
    loaded = Flight.load(tmp_path / "log.npz")
    assert loaded.replans == log.replans
    assert loaded.replans[3].solve_time == log.replans[3].solve_time
    np.testing.assert_array_equal(loaded.known_since, log.known_since)
    for one, other in zip(loaded.replans, log.replans, strict=True):
        assert one.plan is not None and other.plan is not None
        np.testing.assert_array_equal(one.plan.tube_times, other.plan.tube_times)
    assert "15 certified plans" in counted(loaded.replans)
    assert len(table(loaded.replans).splitlines()) == 1 + len(log.replans)


def test_the_diagram_has_a_sensor_and_says_what_it_planned() -> None:
    loop = MakeClosedLoop(load_scenario("receding_horizon"))
    assert loop.HasSubsystemNamed("obstacle_sensor")
    context = loop.CreateDefaultContext()
    assert loop.GetOutputPort("known_since").Eval(context)[:2].tolist() == [0.0, 0.0]
    assert loop.GetOutputPort("replans").Eval(context) == ()
    assert not MakeClosedLoop(load_scenario("known_environment")).HasSubsystemNamed(
        "obstacle_sensor"
    )


# Where there is no way on.


def corridor(**changes: Any) -> Scenario:
    """Twelve metres straight on, in the plane; obstacles are to be added."""
    scenario = Scenario(
        name="corridor",
        model=IntegratorChain(2, 2, 0.1),
        plant={"model_error": 0.1},
        disturbance=WorstCase(bound=[0.3] * 2),
        controller=Controller(slope=[2.0] * 2, initial_boundary_layer=0.2),
        limits=Limits(input=5.0, speed=2.0),
        start=Waypoint([0.0, 0.0]),
        goal=Waypoint([0.0, 12.0]),
        duration=10.0,
        planner=Planner(intervals=40),
    )
    for name, value in changes.items():
        setattr(scenario, name, value)
    return scenario


WALL = Ellipsoid([0.0, 8.0], [[0.0, 1.0]], 1.0)  # from y = 7 to 9, without an end


def test_the_vehicle_stops_before_a_wall_that_it_sees_from_far_enough() -> None:
    scenario = corridor(obstacles=[WALL], sensing=Sensing(range=50.0))
    scenario.sensing.range = sensing_range_needed(scenario)
    validate(scenario)
    scenario.planner.replan_period = 2.0
    log = Simulate(scenario)
    assert_safe(scenario, log)
    statuses = [r.status for r in log.replans if r.cause != "period"]
    assert statuses == ["certified", "braking", "kept"]
    braking = next(r for r in log.replans if r.status == "braking")
    assert braking.plan is not None and "no way to the goal" in braking.message
    np.testing.assert_allclose(braking.plan.reference(10.0)[1], 0.0, atol=1e-6)
    # Later ones find no way either, and keep to it.
    assert {r.status for r in log.replans if r.time > braking.time} == {"kept"}
    assert log.status.startswith("kept: ")
    assert np.abs(log.state[-1, 1]).max() < 0.1
    assert log.position[-1, 1] > 5.0  # and not for fear


def test_what_appears_even_later_is_still_stopped_for_where_that_is_possible() -> None:
    """The range that is asked for is enough, not just enough."""
    scenario = corridor(obstacles=[WALL], sensing=Sensing(range=2.5))
    log = Simulate(scenario)
    assert_safe(scenario, log)
    assert [r.status for r in log.replans] == ["certified", "braking", "kept"]
    assert [r.cause for r in log.replans] == ["start", "revealed", "retry"]


def test_after_a_stop_the_vehicle_goes_on_where_a_way_opens() -> None:
    """An old plan is kept in mind only; a plan to rest does not end the flight."""
    scenario = corridor(obstacles=[Cylinder([0.1, 5.0], 1.0)])
    flown = plan(scenario)
    assert flown.plan is not None
    problem = Problem.from_scenario(corridor(obstacles=[WALL]))
    known = np.array([True])
    state = flown.plan.reference(3.0)[:2]
    stopped = replan(
        corridor(obstacles=[WALL]),
        flown.plan,
        known=known,
        measured_at=3.0,
        state=state,
        start=3.2,
    )
    assert stopped.status == "braking" and stopped.plan is not None
    assert certify(stopped.plan, dataclasses.replace(problem)).margins
    on = replan(
        scenario,
        stopped.plan,
        known=known,
        measured_at=4.0,
        state=stopped.plan.reference(4.0)[:2],
        start=4.2,
    )
    assert on.status == "certified" and on.plan is not None
    np.testing.assert_allclose(
        on.plan.reference(10.0)[:2], scenario.goal_state(), atol=1e-6
    )


def test_what_appears_far_off_the_way_changes_nothing_that_matters() -> None:
    scenario = corridor(obstacles=[Cylinder([6.0, 8.0], 1.0, known_from=9.0)])
    log = Simulate(scenario)
    assert_safe(scenario, log)
    # Too late for a new plan, and the old one is clear of it.
    assert [r.status for r in log.replans] == ["certified", "kept"]
    assert log.replans[1].revealed == (0,)
    assert log.replans[1].plan is None
    assert "too little time" in log.replans[1].message
    np.testing.assert_allclose(log.reference[-1, 0], scenario.goal.position, atol=1e-6)


def test_what_appears_too_late_is_called_unsafe() -> None:
    """Half a metre ahead: an honest status, no exception, and more tries."""
    scenario = corridor(obstacles=[WALL], sensing=Sensing(range=0.5))
    scenario.planner.intervals = 20
    late = Simulate(scenario)
    statuses = [r.status for r in late.replans]
    assert statuses[:2] == ["certified", "unsafe"]
    assert "nothing is certified" in late.replans[1].message
    assert late.replans[2].cause == "retry"
    assert late.tube_ratios.max() <= 1 + 1e-6  # each tube is true, only not clear


def test_without_a_first_plan_later_tries_are_reported() -> None:
    scenario = corridor(obstacles=[WALL])
    scenario.planner.replan_period = 3.0
    log = Simulate(scenario)
    assert log.replans[0].status == "infeasible"
    assert {r.status for r in log.replans[1:]} == {"kept"}
    assert np.ptp(log.reference[:, 0], axis=0).max() == 0.0
    assert log.tube_ratios.max() <= 1 + 1e-6


# Any order.


@pytest.mark.parametrize("order", [1, 3])
def test_models_of_other_orders_are_planned_again(order: int) -> None:
    scenario = corridor(
        model=IntegratorChain(2, order, 0.05),
        plant={"model_error": 0.05},
        limits=Limits(input={1: 4.0, 3: 25.0}[order], speed=4.0),
        goal=Waypoint([0.0, 6.0]),
        duration=6.0,
        obstacles=[Cylinder([0.15, 4.0], 0.5, known_from=1.0)],
        planner=Planner(intervals=24, replan_period=1.0),
        disturbance=WorstCase(bound=[0.1] * 2),
    )
    validate(scenario)
    log = Simulate(scenario)
    assert_safe(scenario, log)
    assert {r.status for r in log.replans} == {"certified"}
    assert [r.cause for r in log.replans][:2] == ["start", "revealed"]
    for time, old, new in hand_overs(log):
        np.testing.assert_allclose(new.reference(time), old.reference(time), atol=1e-9)
        assert (new.error_bound(time) <= old.error_bound(time) + 1e-7).all()


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_carried_start_is_that_of_the_tube_that_opens_at_the_measurement(
    order: int,
) -> None:
    scenario = corridor(
        model=IntegratorChain(2, order, 0.05),
        limits=Limits(input={1: 4.0, 2: 5.0, 3: 25.0}[order], speed=4.0),
        goal=Waypoint([0.0, 6.0]),
        duration=6.0,
        planner=Planner(intervals=24),
        disturbance=WorstCase(bound=[0.1] * 2),
        plant={},
    )
    flown, first = plan(scenario), Problem.from_scenario(scenario)
    assert flown.certified and flown.plan is not None
    error = 0.2 * flown.plan.error_bound(2.0) * [1.0, -1.0]
    state = flown.plan.reference(2.0)[:order] + error
    kept = {"measured_at": 2.0, "state": state}
    now = carried_start(flown.plan, first, until=2.0, **kept)
    np.testing.assert_allclose(now.highest, np.abs(error[-1]))
    if order > 1:
        np.testing.assert_allclose(now.stages[0], np.abs(error[0]))
    problem = problem_on_the_way(first, flown.plan, start=2.5, **kept)
    opened = carried_start(flown.plan, first, until=2.5, **kept)
    np.testing.assert_array_equal(problem.tube_start.stages, opened.stages)
    np.testing.assert_array_equal(problem.tube_start.highest, opened.highest)
    np.testing.assert_array_equal(opened.layer, flown.plan.boundary_layer(2.5))
    own = flown.plan.error_bound(2.5)
    assert (opened.stages[0] <= own[0] + 1e-12).all()
    assert (opened.highest <= own[-1] + 1e-12).all()
    if order > 1:  # else Ω is Φ, which nothing opens anew
        assert (opened.stages[0] < 0.95 * own[0]).all()
    assert problem.start_time + problem.duration == pytest.approx(6.0)


def test_records_compare_without_the_clock() -> None:
    record = Replan(1.0, 1.2, "period", (), "certified", "", 2, 3.0, None, 0.05)
    assert record == dataclasses.replace(record, solve_time=9.0)
    assert record != dataclasses.replace(record, iterations=3)
    assert "period: certified" in repr(record)


def random_field(seed: int) -> Scenario:
    """Six pillars, and across every third field a wall; seen from the range needed."""
    generator = np.random.default_rng(seed)
    pillars: list[Any] = [
        Cylinder(
            [float(generator.uniform(-2.5, 2.5)), float(generator.uniform(3, 15))],
            float(generator.uniform(0.4, 1.2)),
        )
        for _ in range(6)
    ]
    if seed % 3 == 0:
        pillars.append(Ellipsoid([0.0, 11.0], [[0.0, 1.0]], 0.5))
    bound = [0.4] * 2
    scenario = corridor(
        name=f"field_{seed}",
        disturbance=list(DISTURBANCES.values())[seed % 5](bound),
        goal=Waypoint([0.0, 18.0]),
        duration=14.0,
        obstacles=pillars,
        planner=Planner(intervals=56, replan_period=2.0),
        sensing=Sensing(range=100.0),
    )
    scenario.sensing.range = sensing_range_needed(scenario)
    scenario.simulation.seed = seed
    validate(scenario)
    return scenario


@pytest.mark.slow
def test_nothing_that_is_seen_from_the_range_needed_is_ever_met() -> None:
    ends = []
    for seed in range(15):
        scenario = random_field(seed)
        log = Simulate(scenario)
        if log.replans[0].status != "certified":
            continue  # what is known at the start cannot be passed
        assert_safe(scenario, log)
        statuses = {r.status for r in log.replans}
        assert "unsafe" not in statuses, (seed, table(log.replans))
        ends.append("braking" in statuses)
        if not ends[-1]:
            end = log.reference[-1, 0]
            np.testing.assert_allclose(end, scenario.goal.position, atol=1e-6)
    assert len(ends) >= 10
    assert 0 < sum(ends) < len(ends)  # both kinds of ends occur


@pytest.mark.parametrize("share", [0.99, 1.01, 3.0, np.nan])
def test_outside_of_its_layer_nothing_is_called_safe(known_result, share) -> None:
    """The disturbance was larger than its bound, so no tube holds the vehicle."""
    scenario, plan = load_scenario("known_environment"), known_result.plan
    state = plan.reference(4.0)[:2].copy()
    state[1, 1] += share * plan.boundary_layer(4.0)[1]
    decision = replan(
        scenario,
        plan,
        known=np.ones(5, dtype=bool),
        measured_at=4.0,
        state=state,
        start=4.2,
    )
    if share < 1:
        assert decision.status in ("certified", "kept")
    else:
        assert decision.status == "unsafe"
        assert f"|s|/Φ = {share:.3g} on axis y" in decision.message


def test_a_plan_may_be_asked_for_after_its_end(known_result, known_problem) -> None:
    """It holds its last value, which is as clear as it was."""
    plan, problem = known_result.plan, known_problem
    at_end = clearance_ahead(plan, problem, plan.end_time - 1e-3)
    assert clearance_ahead(plan, problem, plan.end_time + 5.0) == at_end
