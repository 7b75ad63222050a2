"""The shipped scenario with a floor: certified, tube included, and flown above it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagrams import DISTURBANCES

from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.planning import plan
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Scenario, load_scenario
from dtmpc_drake.visualization import plot_histories


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("over_ground")


@pytest.fixture(scope="module")
def result(scenario: Scenario) -> PlanningResult:
    return plan(scenario)


def lowest(planned: Plan | None) -> float:
    """Of the tube, between the knots, too."""
    assert planned is not None
    samples = planned.sample(1e-3)
    return float((samples["position"] - samples["position_tube"])[:, 2].min())


def with_planner(scenario: Scenario, **changes: str) -> Scenario:
    planner = dataclasses.replace(scenario.planner, **changes)
    return dataclasses.replace(scenario, planner=planner)


def test_without_the_floor_the_plan_goes_under_ground(scenario: Scenario) -> None:
    limits = dataclasses.replace(scenario.limits, position=None)
    free = plan(dataclasses.replace(scenario, limits=limits))
    assert free.certified and free.cost == pytest.approx(7.27, abs=0.01)
    assert lowest(free.plan) == pytest.approx(-0.63, abs=0.02)


def test_the_floor_binds_and_all_of_the_tube_is_above_it(
    result: PlanningResult,
) -> None:
    assert result.certified and result.certificate is not None
    assert result.cost == pytest.approx(7.57, abs=0.02)
    margin = result.certificate.margins["position"]
    assert margin.where == "min of axis z"
    assert 0.0 <= margin.value <= lowest(result.plan) < 0.02


def test_ipopt_agrees(scenario: Scenario, result: PlanningResult) -> None:
    other = plan(with_planner(scenario, backend="ipopt"))
    assert other.certified and other.cost == pytest.approx(result.cost, rel=0.02)


def test_below_the_ball_is_no_room_and_the_straight_line_says_so(
    scenario: Scenario,
) -> None:
    stuck = plan(with_planner(scenario, initial_guess="straight_line"))
    assert stuck.status == "infeasible"
    assert "obstacle 0" in stuck.message
    assert "position limit on min of axis z" in stuck.message


@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_no_disturbance_drives_it_into_the_ground(
    scenario: Scenario, result: PlanningResult, disturbance: str
) -> None:
    source = DISTURBANCES[disturbance](scenario.disturbance.bound)
    pushed = dataclasses.replace(scenario, disturbance=source)
    assert result.plan is not None
    flight = Simulate(pushed, plan=result.plan)
    assert flight.breaches(pushed) == ()
    assert flight.position[:, 2].min() > 0.0


def test_histories_show_height_above_the_floor(
    scenario: Scenario, result: PlanningResult
) -> None:
    assert result.plan is not None
    figure = plot_histories(scenario=scenario, plan=result.plan)
    (height,) = (axes for axes in figure.axes if axes.get_title() == "along z")
    drawn = [np.asarray(line.get_ydata(), float) for line in height.lines]
    assert any((y == 0.0).all() for y in drawn)
    assert all(y.min() >= 0.0 for y in drawn)  # the tube's lower edge is one of them
