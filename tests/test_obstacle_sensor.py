"""What the vehicle knows of its obstacles, and how far it must see."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.experiments import compare, monte_carlo
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.stopping import range_needed, stopping_time
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.obstacles import Cylinder, Ellipsoid, Sphere
from dtmpc_drake.scenario import (
    Planner,
    Scenario,
    Sensing,
    load_scenario,
    parse_scenario,
    sensing_range_needed,
    to_yaml,
    validate,
)
from dtmpc_drake.systems import ObstacleSensor


def field(**changes: Any) -> Scenario:
    """Three obstacles at increasing distance along y, and a range of 3 m."""
    scenario = load_scenario("known_environment")
    scenario.obstacles = [Cylinder([2.0, y], 1.0) for y in (2.0, 8.0, 14.0)]
    scenario.sensing = Sensing(range=3.0)
    for name, value in changes.items():
        setattr(scenario, name, value)
    return scenario


def seen_along(scenario: Scenario, positions: list[list[float]]) -> Any:
    """Known masks of a sensor that is carried from point to point, 1 s each."""
    times = np.arange(len(positions), dtype=float)
    state = np.zeros((6, len(positions)))
    state[:3] = np.array(positions).T
    builder = DiagramBuilder()
    trajectory = PiecewisePolynomial.FirstOrderHold(times, state)
    source = builder.AddSystem(TrajectorySource(trajectory))
    sensor = builder.AddSystem(ObstacleSensor(scenario=scenario))
    builder.Connect(source.get_output_port(), sensor.GetInputPort("state"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.Initialize()
    context = sensor.GetMyContextFromRoot(simulator.get_context())
    masks = []
    for time in np.arange(0.0, times[-1] + 1e-9, 0.1):
        simulator.AdvanceTo(time)
        masks.append(sensor.GetOutputPort("measured_obstacles").Eval(context).copy())
    since = sensor.GetOutputPort("known_since").Eval(context).copy()
    return np.array(masks), since


def test_an_obstacle_is_known_as_soon_as_its_surface_is_within_range() -> None:
    masks, since = seen_along(field(), [[2.0, 0.0, 1.0], [2.0, 11.0, 1.0]])
    assert masks[0].tolist() == [True, False, False]
    assert masks[-1].all()
    # 11 m/s along y: 3 m before the surfaces at y = 7 and y = 13.
    assert since[0] == 0.0
    late = since[1:] - np.array([4.0, 10.0]) / 11
    assert (late >= 0).all() and (late <= field().sensing.period).all()


def test_what_was_once_known_stays_known() -> None:
    there_and_back = [[2.0, 0.0, 1.0], [2.0, 10.0, 1.0], [2.0, -20.0, 1.0]]
    masks, _ = seen_along(field(), there_and_back)
    assert not masks[0].all() and masks[-1].all()
    assert (np.diff(masks.astype(int), axis=0) >= 0).all()


def test_a_schedule_reveals_an_obstacle_at_its_time_wherever_the_vehicle_is() -> None:
    scenario = field(sensing=Sensing())
    scenario.obstacles[1].known_from = 0.5
    scenario.obstacles[2].known_from = 1.0
    masks, since = seen_along(scenario, [[50.0, 0.0, 1.0]] * 3)
    assert masks[0].tolist() == [True, False, False]
    assert since.tolist() == [0.0, 0.5, 1.0]


def test_with_a_range_and_a_schedule_the_first_of_both_counts() -> None:
    scenario = field()
    scenario.obstacles[2].known_from = 0.2
    _, since = seen_along(scenario, [[2.0, 0.0, 1.0], [2.0, 10.0, 1.0]])
    assert since[2] == pytest.approx(0.2)
    assert since[1] == pytest.approx(0.4)


def test_without_sensing_everything_is_known_and_nothing_is_planned_again() -> None:
    scenario = load_scenario("known_environment")
    assert scenario.known_at_start().all()
    assert not scenario.is_receding


def test_an_ellipsoid_is_seen_no_later_than_from_its_true_distance() -> None:
    generator = np.random.default_rng(0)
    box = Ellipsoid([0.0, 0.0, 0.0], [[1.0, 0.0, 0.0], [0.0, 2.0, 0.5]], 1.0)
    scenario = field(obstacles=[box])
    angles = np.linspace(0, 2 * np.pi, 400)
    H = np.array(box.shape)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    surface = (np.linalg.pinv(H) @ circle).T
    free = np.linalg.svd(H)[2][2]  # where it has no end
    for position in generator.uniform(-6, 6, (200, 3)):
        along = position - surface
        distance = np.linalg.norm(along - np.outer(along @ free, free), axis=1).min()
        seen = scenario.obstacle_set().visible(
            known_from=np.array([np.inf]),
            sensing_range=3.0,
            time=0.0,
            position=position,
        )
        assert seen[0] or distance > 3.0 - 1e-2


# How far it must see.


@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_the_stopping_time_is_that_of_the_perfect_spline(order: int) -> None:
    """Bang-bang with Chebyshev's switches: nothing stops in less."""
    speed, limit = 2.0, 3.0
    T = stopping_time(speed, limit, order)
    r = order - 1
    switches = (1 - np.cos(np.arange(r + 1) * np.pi / r)) / 2 * T
    time = np.linspace(0, T, 200_001)
    value = limit * (-1.0) ** (np.searchsorted(switches[1:-1], time) + 1)
    for _ in range(r):
        step = np.diff(time) * (value[1:] + value[:-1]) / 2
        value = np.concatenate([[0.0], np.cumsum(step)])
    assert value[-1] == pytest.approx(-speed, rel=1e-3)


def test_the_range_grows_with_speed_delay_and_disturbance() -> None:
    law = SlidingLaw(IntegratorChain(2, 2), np.full(2, 2.0), np.full(2, 0.3), 0.1)
    settings: dict[str, Any] = {
        "law": law,
        "velocity": np.array([0.0, 1.5]),
        "bandwidth": 1.0,
        "layer": np.full(2, 0.2),
        "input_limit": 5.0,
        "delay": 0.5,
    }
    least = range_needed(**settings)
    braking = 1.5 * 0.5 + 1.5**2 / (2 * 5.0)
    assert least > braking  # the feedback and the tube take their part
    for name, value in {
        "velocity": np.array([0.0, 2.0]),
        "delay": 0.7,
        "law": dataclasses.replace(law, disturbance_bound=np.full(2, 0.4)),
        "bandwidth": 0.7,
        "input_limit": 4.0,
    }.items():
        assert range_needed(**settings | {name: value}) > least
    assert range_needed(**settings | {"input_limit": 1.0}) == np.inf


TEXT = """
start: {position: [0, 0, 0]}
goal: {position: [0, 20, 0]}
duration: 20
limits: {speed: 1.5}
obstacles:
  - !Sphere {center: [0, 10, 0], radius: 1.0%s}
sensing: {%s}
planner: {%s}
"""


@pytest.mark.parametrize(
    ("obstacle", "sensing", "planner", "message"),
    [
        ("", "range: 3", "", "sensing.range: got 3, but it must be at least 7.659 m"),
        ("", "range: 0", "", "sensing.range: got 0, but it must be greater than 0 m"),
        ("", "period: 0", "", "sensing.period: got 0, but it must be greater than 0 s"),
        (
            ", known_from: 20",
            "",
            "",
            "obstacles[0].known_from: got 20, but it must be in [0, duration = 20) s",
        ),
        (
            ", known_from: -1",
            "",
            "",
            "obstacles[0].known_from: got -1, but it must be in [0, duration = 20) s",
        ),
        (
            "",
            "",
            "compute_delay: -0.1",
            "planner.compute_delay: got -0.1, but it must be at least 0 s",
        ),
        (
            "",
            "",
            "compute_delay: 0.3, replan_period: 0.2",
            "planner.replan_period: got 0.2, but it must be at least 0.3 s",
        ),
        (
            "",
            "",
            "replan_period: 0.0",
            "planner.replan_period: got 0, but it must be at least 0.2 s",
        ),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(
    obstacle: str, sensing: str, planner: str, message: str
) -> None:
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(TEXT % (obstacle, sensing, planner))
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_a_range_that_is_far_enough_is_accepted_and_one_below_is_not() -> None:
    scenario = load_scenario("sensed_environment")
    needed = sensing_range_needed(scenario)
    assert needed < scenario.sensing.range
    scenario.sensing.range = needed + 1e-6
    validate(scenario)
    scenario.sensing.range = needed - 1e-3
    with pytest.raises(ScenarioError, match=r"to stop at the speed limit"):
        validate(scenario)
    # A schedule is no range: nobody can tell where the vehicle will be.
    for obstacle in scenario.obstacles:
        obstacle.known_from = 5.0
    validate(scenario)


def test_a_vehicle_that_cannot_brake_is_told_so() -> None:
    scenario = load_scenario("sensed_environment")
    scenario.limits.input = 2.0
    with pytest.raises(ScenarioError, match="leaves no input to brake with"):
        validate(scenario)


def test_sensing_and_replanning_survive_their_file() -> None:
    scenario = load_scenario("receding_horizon")
    assert parse_scenario(to_yaml(scenario)) == scenario
    assert [o.known_from for o in scenario.obstacles] == [None, None, 6.0, 6.0, 8.0]
    assert scenario.planner == dataclasses.replace(
        Planner(), intervals=64, replan_period=1.0, compute_delay=0.2
    )
    ball = parse_scenario(TEXT % (", known_from: 3", "", "")).obstacles[0]
    assert ball == Sphere([0.0, 10.0, 0.0], 1.0, known_from=3.0)


@pytest.mark.parametrize("run", [monte_carlo.run, compare.run])
@pytest.mark.parametrize(
    ("name", "period", "field"),
    [
        ("receding_horizon", 1.0, "planner.replan_period"),
        ("receding_horizon", None, "obstacles[2].known_from"),
        ("sensed_environment", None, "sensing.range"),
    ],
)
def test_many_trials_want_one_plan(
    run: Any, name: str, period: float | None, field: str, tmp_path: Path
) -> None:
    scenario = load_scenario(name)
    scenario.planner.replan_period = period
    with pytest.raises(ScenarioError, match="many trials fly one plan") as caught:
        run(scenario, tmp_path / "out", trials=2)
    assert caught.value.field == field
    assert not (tmp_path / "out").exists()
