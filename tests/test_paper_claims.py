"""The five claims of the paper's section on results, on outputs of the diagram.

Its figures: the optimised tube, 1000 flights in it, three plans in an unknown
environment, the speed that goes with the uncertainty, and the infeasible problem
with a constant bound in its place.
"""

from __future__ import annotations

import numpy as np
import pytest

from dtmpc_drake.diagrams import MakeClosedLoop, Simulate
from dtmpc_drake.experiments.monte_carlo import Batch, fly
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Scenario, load_scenario

LEAD = 1.0
"""The tube is a filter: its bandwidth is high before it has to be thin, in s."""


def distance_from_obstacles(scenario: Scenario, position: np.ndarray) -> np.ndarray:
    return scenario.obstacle_set().clearance(position).min(axis=-1)


@pytest.fixture(scope="module")
def uncertain() -> tuple[Scenario, Flight]:
    scenario = load_scenario("state_dependent_uncertainty")
    return scenario, Simulate(scenario)


@pytest.fixture(scope="module")
def receding() -> tuple[Scenario, Flight]:
    scenario = load_scenario("receding_horizon")
    return scenario, Simulate(scenario)


def bandwidth_and_tube(plan: Plan, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest over the horizontal axes."""
    return (
        plan.bandwidth(time)[:, :2].max(axis=1),
        plan.position_tube(time)[:, :2].max(axis=1),
    )


def test_1_bandwidth_is_high_and_the_tube_compact_near_obstacles_only(
    known_scenario: Scenario, known_result: PlanningResult
) -> None:
    log = Simulate(known_scenario, plan=known_result.plan)
    plan = known_result.plan
    assert plan is not None and log.status == "given"
    bandwidth, tube = bandwidth_and_tube(plan, log.time)
    away = known_scenario.obstacle_set().clearance(log.reference[:, 0])
    in_the_open = log.time > log.time[-1] - 0.5
    assert away[in_the_open].min() > 2.0
    for closest in log.time[away.argmin(axis=0)]:
        before = (log.time >= closest - LEAD) & (log.time <= closest)
        assert bandwidth[before].max() > 3 * bandwidth[in_the_open].max()
        at = np.abs(log.time - closest).argmin()
        assert tube[at] < 0.6 * tube[in_the_open].min()
    assert log.clearance.min() > 0 and log.tube_ratios.max() <= 1


def test_2_a_thousand_flights_stay_in_the_tube(
    known_scenario: Scenario, known_result: PlanningResult
) -> None:
    assert known_result.plan is not None
    batch = Batch("uniform", known_scenario, known_result.plan, range(1000))
    flights = fly(batch)
    assert len(flights) == 1000
    assert flights.safe
    assert 0.1 < flights.worst_ratios.max() <= 1


def test_3_plans_answer_to_obstacles_that_are_found_on_the_way(
    receding: tuple[Scenario, Flight],
) -> None:
    scenario, log = receding
    assert log.clearance.min() > 0 and log.tube_ratios.max() <= 1
    found = {r.hand_over: r for r in log.replans if r.cause == "revealed"}
    times = sorted(found)
    assert len(times) == 2
    np.testing.assert_allclose(times, [6.2, 8.2], atol=0.05)
    everything = scenario.obstacle_set()
    for start in times:
        plan = found[start].plan
        assert plan is not None and found[start].status == "certified"
        time = np.linspace(start, plan.end_time, 1000)
        bandwidth, _ = bandwidth_and_tube(plan, time)
        away = everything.clearance(plan.reference(time)[:, 0])
        for obstacle in found[start].revealed:
            closest = time[away[:, obstacle].argmin()]
            before = (time >= closest - LEAD) & (time <= closest)
            assert bandwidth[before].max() > 2 * bandwidth[-1]
    # The first plan would have met what it did not know.
    first = log.replans[0].plan
    assert first is not None
    time = np.linspace(0, first.end_time, 500)
    assert everything.clearance(first.reference(time)[:, 0]).min() < 0


def test_4_the_vehicle_is_slow_where_the_tube_must_be_thin(
    uncertain: tuple[Scenario, Flight],
) -> None:
    scenario, log = uncertain
    assert log.status == "certified"
    away = distance_from_obstacles(scenario, log.reference[:, 0])
    speed = np.linalg.norm(log.state[:, 1], axis=1)
    gap = (away < 0.2) & (log.time > 1.0)
    open_ = (away > 0.8) & (log.time > 1.0) & (log.time < scenario.duration - 2.0)
    assert gap.any() and open_.any()
    assert speed[gap].min() < 0.9 * speed[open_].max()
    assert log.clearance.min() > 0 and log.tube_ratios.max() <= 1


def test_5_with_a_constant_bound_instead_there_is_no_plan(
    uncertain: tuple[Scenario, Flight],
) -> None:
    scenario = load_scenario("constant_uncertainty")
    diagram = MakeClosedLoop(scenario)
    context = diagram.CreateDefaultContext()
    diagram.ExecuteInitializationEvents(context)
    status = diagram.GetOutputPort("status").Eval(context)
    assert status.startswith("infeasible: cannot keep")
    # From the very start, on the very field, where the state-dependent bound has one.
    other, other_log = uncertain
    assert other_log.status == "certified"
    assert scenario.planner.initial_guess == other.planner.initial_guess
    assert scenario.planner.initial_guess == "straight_line"
    assert scenario.obstacles == other.obstacles
