"""Obstacles: a clearance is a promise about every point of the tube."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.obstacles import Cylinder, Ellipsoid, Obstacle, ObstacleSet, Sphere

coordinates = st.floats(-5, 5)
radii = st.floats(0.1, 2)
tubes = st.lists(st.floats(0, 1), min_size=3, max_size=3)
positions = st.lists(st.floats(-6, 6), min_size=3, max_size=3)
cylinders = st.builds(
    Cylinder, center=st.lists(coordinates, min_size=2, max_size=2), radius=radii
)
spheres = st.builds(
    Sphere, center=st.lists(coordinates, min_size=3, max_size=3), radius=radii
)
rows = st.lists(st.floats(-2, 2), min_size=3, max_size=3)
ellipsoids = st.builds(
    Ellipsoid,
    center=st.lists(coordinates, min_size=3, max_size=3),
    shape=st.lists(rows, min_size=1, max_size=4),
    radius=radii,
)
shapes = st.one_of(cylinders, spheres, ellipsoids)


def distance(obstacle: Obstacle, position: np.ndarray) -> np.ndarray:
    """Of points to one obstacle, straight from its definition."""
    p, center = np.asarray(position), np.asarray(obstacle.center)
    if isinstance(obstacle, Cylinder):
        offset = p[..., :2] - center
    elif isinstance(obstacle, Sphere):
        offset = p - center
    else:
        offset = (p - center) @ np.asarray(obstacle.shape).T
    return np.linalg.norm(offset, axis=-1) - obstacle.radius


@given(
    obstacles=st.lists(shapes, min_size=1, max_size=4),
    position=positions,
    tube=tubes,
    seed=st.integers(0, 1000),
)
def test_norm_is_below_support_is_below_the_distance_of_every_point_of_the_tube(
    obstacles: list[Obstacle], position: list[float], tube: list[float], seed: int
) -> None:
    stacked = ObstacleSet.stack(obstacles, 3)
    norm = stacked.clearance(position, np.array(tube), "norm")
    support = stacked.clearance(position, np.array(tube), "support")
    rng = np.random.default_rng(seed)
    unit = np.concatenate(
        [rng.uniform(-1, 1, (100, 3)), rng.choice([-1.0, 0.0, 1.0], (60, 3))]
    )
    points = np.asarray(position) + unit * tube
    nearest = [distance(o, points).min() for o in obstacles]
    assert (norm <= support + 1e-9).all()
    assert (support <= np.array(nearest) + 1e-9).all()


@given(obstacle=st.one_of(cylinders, spheres), position=positions, tube=tubes)
def test_support_is_the_exact_distance_to_the_box(
    obstacle: Cylinder | Sphere, position: list[float], tube: list[float]
) -> None:
    k = len(obstacle.center)
    p, w = np.array(position)[:k], np.array(tube)[:k]
    nearest = np.clip(obstacle.center, p - w, p + w)
    expected = np.linalg.norm(nearest - obstacle.center) - obstacle.radius
    stacked = ObstacleSet.stack([obstacle], 3)
    found = stacked.clearance(position, np.array(tube), "support")
    assert found == pytest.approx([expected], abs=1e-9)


def test_the_papers_margin_is_the_norm_of_the_tube() -> None:
    stacked = ObstacleSet.stack([Cylinder([0.0, 0.0], 1.0)], 3)
    tube = np.array([0.3, 0.4, 7.0])
    assert stacked.clearance([5.0, 0.0, 2.0], tube, "norm") == pytest.approx([3.5])
    assert stacked.clearance([5.0, 0.0, 2.0], tube, "support") == pytest.approx([3.7])


@given(obstacles=st.lists(shapes, max_size=4), position=positions)
def test_without_a_tube_both_margins_are_the_distance(
    obstacles: list[Obstacle], position: list[float]
) -> None:
    stacked = ObstacleSet.stack(obstacles, 3)
    expected = [float(distance(o, np.array(position))) for o in obstacles]
    for margin in ("norm", "support"):
        found = stacked.clearance(position, 0.0, margin)
        assert found == pytest.approx(expected, abs=1e-9)


@given(
    obstacles=st.lists(shapes, min_size=2, max_size=5), position=positions, tube=tubes
)
def test_company_of_other_shapes_changes_no_clearance(
    obstacles: list[Obstacle], position: list[float], tube: list[float]
) -> None:
    together = ObstacleSet.stack(obstacles, 3)
    for margin in ("norm", "support"):
        alone = [
            ObstacleSet.stack([o], 3).clearance(position, np.array(tube), margin)[0]
            for o in obstacles
        ]
        found = together.clearance(position, np.array(tube), margin)
        assert found == pytest.approx(alone, abs=1e-12)


def test_an_ellipsoid_is_a_ball_seen_through_its_shape() -> None:
    # Semi-axes 2, 1 and 0.5 m.
    ellipsoid = Ellipsoid([1.0, 0.0, 0.0], np.diag([0.5, 1.0, 2.0]).tolist(), 1.0)
    stacked = ObstacleSet.stack([ellipsoid], 3)
    surface = [[3.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, -0.5]]
    assert stacked.clearance(surface) == pytest.approx(np.zeros((3, 1)), abs=1e-12)
    assert stacked.clearance([1.0, 0.0, 0.4]) < 0 < stacked.clearance([1.0, 0.0, 0.6])


@given(obstacle=cylinders, position=positions)
def test_a_cylinder_has_no_end(obstacle: Cylinder, position: list[float]) -> None:
    stacked = ObstacleSet.stack([obstacle], 3)
    higher = [*position[:2], position[2] + 100.0]
    assert stacked.clearance(position) == pytest.approx(stacked.clearance(higher))


def test_a_cylinder_is_a_disc_and_a_sphere_a_segment_in_fewer_dimensions() -> None:
    planar = ObstacleSet.stack([Cylinder([1.0, 1.0], 0.5), Sphere([0.0, 0.0], 1.0)], 2)
    assert planar.clearance([1.0, 3.0]) == pytest.approx([1.5, np.sqrt(10) - 1])
    line = ObstacleSet.stack([Sphere([2.0], 0.5)], 1)
    assert line.clearance([0.0], np.array([0.25])) == pytest.approx([1.25])


def test_no_obstacles_no_clearances() -> None:
    nothing = ObstacleSet.stack([], 3)
    assert len(nothing) == 0
    assert nothing.clearance(np.zeros((7, 3)), np.ones((7, 3))).shape == (7, 0)


@given(
    obstacles=st.lists(shapes, min_size=1, max_size=3), seed=st.integers(0, 2**32 - 1)
)
def test_a_batch_of_positions_is_its_entries_one_by_one(
    obstacles: list[Obstacle], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    positions, tubes = rng.uniform(-6, 6, (2, 3, 3)), rng.uniform(0, 1, (2, 3, 3))
    stacked = ObstacleSet.stack(obstacles, 3)
    for margin in ("norm", "support"):
        whole = stacked.clearance(positions, tubes, margin)
        assert whole.shape == (2, 3, len(obstacles))
        for i in np.ndindex(2, 3):
            single = stacked.clearance(positions[i], tubes[i], margin)
            assert whole[i] == pytest.approx(single)


def test_an_obstacle_that_is_not_known_is_not_taken_for_another() -> None:
    class Fence(Cylinder):
        """Lower than a cylinder; nobody here knows that."""

    with pytest.raises(
        ScenarioError, match=r"^obstacles\[1\]: got 'Fence'.* one of Cylinder, Sph"
    ):
        ObstacleSet.stack([Cylinder(), Fence()], 3)
