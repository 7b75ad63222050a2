"""A kind of obstacle from a user's file does all that the library's own do."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.obstacles import ObstacleSet
from dtmpc_drake.obstacles.drawing import Mesh
from dtmpc_drake.planning import Problem, certify, plan
from dtmpc_drake.planning.search.sides import propose
from dtmpc_drake.scenario import (
    Scenario,
    ScenarioError,
    Waypoint,
    parse_scenario,
    to_yaml,
    validate,
)
from dtmpc_drake.visualization import ShownFlight, plot_plan, write_replay
from dtmpc_drake.visualization.geometry import obstacle_sections, obstacle_solids
from tests.extensions.obstacle import Box


def flight(*obstacles: Box, **changes) -> Scenario:
    """8 m along y, from rest to rest."""
    scenario = Scenario(
        model=IntegratorChain(num_outputs=3, order=2),
        start=Waypoint(position=[0.0, 0.0, 0.0]),
        goal=Waypoint(position=[0.0, 8.0, 0.0]),
        duration=8.0,
        obstacles=list(obstacles),
    )
    scenario.disturbance.bound = [0.3] * 3
    scenario.controller.slope = [2.0] * 3
    scenario.planner.intervals = 28
    for name, value in changes.items():
        setattr(scenario, name, value)
    validate(scenario)
    return scenario


PILLAR = Box([0.4, 4.0, 0.0], [0.7, 0.5, 5.0], yaw=20.0)


def corners(box: Box) -> np.ndarray:
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * len(box.half)), axis=-1)
    return box.center + (signs.reshape(-1, len(box.half)) * box.half) @ box.axes.T


@pytest.fixture(scope="module")
def planned():
    return plan(flight(PILLAR))


@pytest.mark.parametrize("margin", ["norm", "support"])
@pytest.mark.parametrize("backend", ["clarabel", "ipopt"])
def test_a_box_is_planned_around(margin, backend):
    scenario = flight(PILLAR)
    scenario.planner.tube_margin, scenario.planner.backend = margin, backend
    result = plan(scenario)
    assert result.certified, result.message
    time = np.linspace(0, 8, 4001)
    position, tube = result.plan.reference(time)[:, 0], result.plan.position_tube(time)
    # Every corner of the tube, in the box's own frame, straight from its definition.
    signs = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 1, 3)
    own = np.abs((position + signs * tube - PILLAR.center) @ PILLAR.axes)
    assert (own > PILLAR.half).any(axis=-1).all()


def test_its_certificate_is_no_formality(planned):
    wider = dataclasses.replace(PILLAR, half=[2.0, 0.5, 5.0])
    problem = Problem.from_scenario(flight(wider))
    certificate = certify(planned.plan, problem)
    assert not certificate.certified
    assert certificate.margins["obstacles"].value < 0


def test_a_flight_stays_clear_of_a_box(planned):
    log = Simulate(flight(PILLAR), plan=planned.plan)
    assert log.breaches(flight(PILLAR)) == ()
    own = np.abs((log.state[:, 0] - PILLAR.center) @ PILLAR.axes) - PILLAR.half
    assert own.max(axis=1).min() > 0


@pytest.mark.slow
def test_a_box_is_passed_on_either_side_and_a_low_one_above():
    scenario = flight(PILLAR)
    ways = propose(Problem.from_scenario(scenario), 10)
    assert [way.sides for way in ways][:2] == ["L", "R"]
    assert all(way.length > 10 for way in ways[2:])  # over five metres
    low = flight(dataclasses.replace(PILLAR, half=[0.7, 0.5, 0.4]))
    found = {way.sides for way in propose(Problem.from_scenario(low), 10)}
    assert found == set("LRAB")
    scenario.planner.initial_guess = "best_side"
    assert plan(scenario).certified


def test_a_box_looks_like_one(planned, tmp_path):
    scenario = flight(PILLAR)
    obstacles = scenario.obstacle_set()
    low, high = np.full(3, -10.0), np.full(3, 10.0)
    (mesh,) = obstacle_solids(obstacles, 3, low, high)
    assert isinstance(mesh, Mesh)
    distance = np.linalg.norm(mesh.vertices[:, None] - corners(PILLAR), axis=-1)
    assert len(mesh.vertices) == 8
    np.testing.assert_allclose(distance.min(axis=0), 0.0, atol=1e-6)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    outwards = (np.cross(b - a, c - a) * (a - PILLAR.center)).sum(axis=1)
    assert (outwards > 0).all()
    volume = outwards.sum() / 6
    assert volume == pytest.approx(8 * np.prod(PILLAR.half), rel=1e-6)

    samples = planned.plan.sample()
    ((section, silhouette),) = obstacle_sections(
        obstacles, samples["position"], samples["position_tube"]
    )
    for outline in (section.outline(), silhouette.outline()):
        apart = np.linalg.norm(outline[:, None] - corners(PILLAR)[:, :2], axis=-1)
        np.testing.assert_allclose(apart.min(axis=0), 0.0, atol=1e-6)
        x, y = outline.T
        area = abs((x[1:] * y[:-1] - x[:-1] * y[1:]).sum()) / 2
        assert area == pytest.approx(4 * PILLAR.half[0] * PILLAR.half[1])

    plot_plan(scenario=scenario, plan=planned.plan).savefig(tmp_path / "plan.png")
    flown = ShownFlight.of(Simulate(scenario, plan=planned.plan))
    write_replay(
        tmp_path / "replay.html", scenario=scenario, plan=planned.plan, flight=flown
    )
    assert (tmp_path / "replay.html").stat().st_size > 100_000


def test_a_rectangle_fills_the_picture_of_a_planar_vehicle():
    stack = ObstacleSet.stack([Box([1.0, 4.0], [0.5, 0.2], yaw=45.0)], 2)
    (mesh,) = obstacle_solids(stack, 2, np.array([-5, 0, -1.0]), np.array([5, 8, 1.0]))
    assert isinstance(mesh, Mesh)
    assert sorted({*mesh.vertices[:, 2].round(9)}) == [-1.0, 1.0]
    assert len(mesh.vertices) == 8


def test_a_box_is_seen_from_its_surface_on():
    scenario = flight(PILLAR)
    scenario.sensing.range = 3.0
    front = np.array(PILLAR.center) - PILLAR.axes[:, 1] * PILLAR.half[1]
    for distance, seen in ((2.99, True), (3.01, False)):
        position = front - PILLAR.axes[:, 1] * distance
        assert scenario.visible_obstacles(0.0, position).tolist() == [seen]


def test_a_box_survives_its_file_and_is_refused_by_name():
    text = to_yaml(flight(PILLAR, duration=9.0))
    assert "!Box" in text
    assert parse_scenario(text).obstacles == [PILLAR]
    with pytest.raises(ScenarioError, match=r"^obstacles\[0\]\.half: got \[1, 1\]"):
        flight(Box([0.0, 4.0, 0.0], [1.0, 1.0]))
    with pytest.raises(ScenarioError, match=r"^obstacles\[0\]\.half: got None"):
        parse_scenario(text.replace("half:", "halves:").replace("  halves", "  #"))
    with pytest.raises(ScenarioError, match=r"^goal\.position: .* outside obstacles"):
        flight(dataclasses.replace(PILLAR, center=[0.0, 7.6, 0.0]))
