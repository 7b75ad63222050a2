"""What every kind of obstacle promises, the library's own and users' alike."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtmpc_drake.obstacles import (
    Cylinder,
    Ellipsoid,
    Obstacle,
    ObstacleSet,
    Sphere,
    register_obstacle,
)
from dtmpc_drake.obstacles.separation import Turning, separate
from dtmpc_drake.planning import plan
from tests.extensions.obstacle import Box
from tests.test_extension_obstacle import flight

MARGINS = ["norm", "support"]
KINDS = [
    "cylinder",
    "sphere",
    "ellipsoid",
    "box",
    "capsule",
    "own sphere",
    "wall",
    "mixed",
]


@register_obstacle
@dataclasses.dataclass
class OwnSphere(Obstacle):
    """A ball by its surface, whose core is no point."""

    center: list[float]
    radius: float

    def support(self, direction):
        size = np.linalg.norm(direction, axis=-1, keepdims=True)
        return self.center + self.radius * direction / np.maximum(size, 1e-300)

    def nearest(self, point):
        offset = point - np.array(self.center)
        size = np.linalg.norm(offset, axis=-1, keepdims=True)
        return self.center + offset * np.minimum(
            1.0, self.radius / np.maximum(size, 1e-300)
        )


@register_obstacle
@dataclasses.dataclass
class Capsule(Obstacle):
    """All that is nearer than the radius to the line between two points."""

    ends: list[list[float]]
    radius: float

    def support(self, direction):
        a, b = np.array(self.ends)
        return np.where(direction @ (b - a) > 0, 1.0, 0.0)[..., None] * (b - a) + a

    def nearest(self, point):
        a, b = np.array(self.ends)
        share = ((point - a) @ (b - a)) / ((b - a) @ (b - a))
        return a + np.clip(share, 0.0, 1.0)[..., None] * (b - a)

    def swept_radius(self):
        return self.radius


@register_obstacle
@dataclasses.dataclass
class Wall(Obstacle):
    """All that is at most one metre behind a plane: it sees one direction only."""

    normal: list[float]
    place: float

    def shape_matrix(self, num_outputs):
        return np.array([self.normal])

    def support(self, direction):
        return self.place - np.where(direction > 0, 0.0, 1.0)

    def nearest(self, point):
        return np.clip(point, self.place - 1.0, self.place)


def some(kind: str, g: np.random.Generator) -> list[Obstacle]:
    """Obstacles of a kind around the origin."""
    center = g.uniform(-1, 1, 3)
    radius = float(g.uniform(0.2, 1.0))
    if kind == "cylinder":
        return [Cylinder(center[:2].tolist(), radius)]
    if kind == "sphere":
        return [Sphere(center.tolist(), radius)]
    if kind == "own sphere":
        return [OwnSphere(center.tolist(), radius)]
    if kind == "ellipsoid":
        shape = (0.3 * g.normal(size=(3, 3)) + np.eye(3)).tolist()
        return [Ellipsoid(center.tolist(), shape, radius)]
    if kind == "box":
        half = g.uniform(0.1, 1.0, 3).tolist()
        return [Box(center.tolist(), half, yaw=g.uniform(0, 90))]
    if kind == "capsule":
        return [Capsule([center.tolist(), g.uniform(-1, 1, 3).tolist()], radius / 2)]
    if kind == "wall":
        normal = g.normal(size=3)
        return [Wall((normal / np.linalg.norm(normal)).tolist(), center[0])]
    return [o for each in KINDS[:-1] for o in some(each, g)]


def distance(obstacle: Obstacle, p: np.ndarray) -> np.ndarray:
    """Of points to one obstacle, straight from its definition; zero inside a box."""
    if isinstance(obstacle, Box):
        own = np.abs((p - obstacle.center) @ obstacle.axes) - obstacle.half
        return np.linalg.norm(np.maximum(own, 0.0), axis=-1)
    if isinstance(obstacle, Capsule):
        a, b = np.array(obstacle.ends)
        along = (b - a) / np.linalg.norm(b - a)
        share = (p - a) @ along
        beside = np.linalg.norm(p - a - share[..., None] * along, axis=-1)
        beyond = np.maximum(np.maximum(-share, share - np.linalg.norm(b - a)), 0.0)
        return np.hypot(beside, beyond) - obstacle.radius
    if isinstance(obstacle, Wall):
        side = p @ np.array(obstacle.normal) - obstacle.place
        return np.maximum(side, -side - 1.0)
    offset = p - np.pad(obstacle.center, (0, 3 - len(obstacle.center)))
    if isinstance(obstacle, Cylinder):
        offset = offset[..., :2]
    if isinstance(obstacle, Ellipsoid):
        offset = offset @ np.asarray(obstacle.shape).T
    return np.linalg.norm(offset, axis=-1) - obstacle.radius


def inside(obstacle: Obstacle, g: np.random.Generator) -> np.ndarray:
    """Points of an obstacle."""
    points = g.uniform(-3, 3, (6000, 3))
    return points[distance(obstacle, points) <= 0]


def arc(g: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A cubic somewhere near, its tube, and their Bézier points, dense and few."""
    start = g.uniform(-2.5, 2.5, 3)
    controls = start + 0.4 * g.normal(size=(4, 3)).cumsum(axis=0)
    tube = g.uniform(0.0, 0.3, (4, 3))
    t = np.linspace(0, 1, 60)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    return controls, tube, weights


seeds = st.integers(0, 2**31)


@pytest.mark.parametrize("margin", MARGINS)
@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds)
def test_a_half_plane_parts_the_tube_from_the_obstacle(kind, margin, seed):
    """By at least its margin, at every control point, and so on the whole piece."""
    g = np.random.default_rng(seed)
    obstacles = some(kind, g)
    controls, tube, weights = arc(g)
    stack = ObstacleSet.stack(obstacles, 3)
    planes = separate(
        stack, controls[None], tube[None], tube_margin=margin, reach=np.inf
    )
    assert planes.obstacle.tolist() == list(range(len(obstacles)))
    turned = planes.turned(g.normal(0, 0.2, (len(planes), stack.tangents)))
    for some_planes in (planes, turned.at(controls[None], tube[None])):
        corners = weights @ controls + np.stack(
            [(weights @ tube) * sign for sign in g.choice([-1, 0, 1], (20, 3))]
        )
        for row, normal in enumerate(some_planes.by_position()):
            theirs = inside(obstacles[row], g) @ normal
            between = (corners @ normal).min() - theirs.max(initial=-np.inf)
            assert between >= some_planes.margin[row].min() - 1e-9


@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds)
def test_half_planes_part_well(kind, seed):
    """Nearly as much as the obstacle and the arc's control points are apart."""
    g = np.random.default_rng(seed)
    obstacles = some(kind, g)
    controls, tube, _ = arc(g)
    stack, zero = ObstacleSet.stack(obstacles, 3), 0 * tube
    planes = separate(stack, controls[None], zero[None], tube_margin="norm", reach=9.0)
    share = g.dirichlet(np.ones(4), 4000)
    apart = stack.clearance(share @ controls).min(axis=0)
    clear = apart > 0.1
    margin = planes.margin.min(axis=1)
    # No more than from any of the dense samples, of which none may be the nearest.
    assert (margin[clear] <= apart[clear] + 1e-9).all()
    assert (margin[clear] >= 0.6 * apart[clear] - 0.05).all()


@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds)
def test_the_clearance_of_a_point_is_its_distance(kind, seed):
    g = np.random.default_rng(seed)
    obstacles = some(kind, g)
    points = g.uniform(-3, 3, (50, 3))
    found = ObstacleSet.stack(obstacles, 3).clearance(points)
    for values, obstacle in zip(found.T, obstacles, strict=True):
        expected = distance(obstacle, points)
        out = expected > 0
        np.testing.assert_allclose(values[out], expected[out], atol=1e-6)
        assert (values[~out] <= 1e-9).all()
        if isinstance(obstacle, Wall):
            np.testing.assert_allclose(values, expected, atol=1e-9)
        if isinstance(obstacle, Box):
            own = np.abs((points - obstacle.center) @ obstacle.axes) - obstacle.half
            depth = own.max(axis=1)[~out]
            assert (values[~out] <= depth + 1e-9).all()


@pytest.mark.parametrize("margin", MARGINS)
@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds)
def test_no_point_of_a_tube_is_nearer_than_its_clearance(kind, margin, seed):
    g = np.random.default_rng(seed)
    obstacles = some(kind, g)
    position, tube = g.uniform(-3, 3, 3), g.uniform(0, 0.6, 3)
    stack = ObstacleSet.stack(obstacles, 3)
    found = stack.clearance(position, tube, margin)
    signs = np.concatenate([g.uniform(-1, 1, (400, 3)), g.choice([-1, 0, 1], (27, 3))])
    dense = stack.clearance(position + signs * tube)
    # Inside of an obstacle the clearance is a bound, if an exact one for balls.
    nearest = np.maximum(dense.min(axis=0), 0.0)
    assert (found <= nearest + 1e-9).all()
    if margin == "support":
        clear = found > 0
        assert (nearest[clear] <= found[clear] + 0.35).all()


@given(seed=seeds)
def test_two_boxes_are_as_far_apart_as_their_faces_say(seed):
    g = np.random.default_rng(seed)
    box = Box(g.uniform(-1, 1, 3).tolist(), g.uniform(0.1, 1, 3).tolist())
    position, tube = g.uniform(-3, 3, 3), g.uniform(0, 0.6, 3)
    gaps = np.abs(position - box.center) - tube - box.half
    found = ObstacleSet.stack([box], 3).clearance(position, tube, "support")[0]
    if (gaps > 0).any():
        assert found == pytest.approx(np.linalg.norm(np.maximum(gaps, 0)), abs=1e-6)
    else:
        assert found <= gaps.max() + 1e-9


@pytest.mark.parametrize("margin", MARGINS)
@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds)
def test_the_proven_bound_is_below_every_sample_of_an_arc(kind, margin, seed):
    g = np.random.default_rng(seed)
    obstacles = ObstacleSet.stack(some(kind, g), 3)
    ends, tubes = g.uniform(-2, 2, (2, 1, 3)), g.uniform(0, 0.3, (2, 1, 3))
    ends[1] = ends[0] + 0.3 * g.normal(size=(1, 3))
    # Parabolas that leave their chords by so much in the middle.
    bend, swell = 0.05 * g.normal(size=(2, 3))
    found = obstacles.clearance_along(
        ends, tubes, leave=(np.abs(bend) + np.abs(swell))[None], margin=margin
    )[0]
    t = np.linspace(0, 1, 400)[:, None]
    position = ends[0] + t * (ends[1] - ends[0]) + 4 * t * (1 - t) * bend
    tube = np.maximum(tubes[0] + t * (tubes[1] - tubes[0]) + 4 * t * (1 - t) * swell, 0)
    dense = obstacles.clearance(position, tube, margin)
    # Where a tube cuts a core the clearance itself is only a bound.
    clear = dense.min(axis=0) >= 0
    assert (found <= dense.min(axis=0) + 1e-6)[clear].all()
    points = position + g.uniform(-1, 1, (40, *tube.shape)) * tube
    nearest = obstacles.clearance(points).min(axis=(0, 1))
    assert (found[nearest <= 0] <= 0).all()


@pytest.mark.parametrize("margin", MARGINS)
@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds)
def test_slopes_by_turning_are_those_of_the_margins(kind, margin, seed):
    g = np.random.default_rng(seed)
    stack = ObstacleSet.stack(some(kind, g), 3)
    controls, tube, _ = arc(g)
    planes = separate(
        stack, controls[None], tube[None], tube_margin=margin, reach=np.inf
    )
    count = len(planes)
    turning = Turning(planes, np.arange(count), 0.3)
    given_ = [
        np.broadcast_to(controls, (count, 4, 3)),
        np.broadcast_to(tube, (count, 4, 3)),
        g.normal(0, 0.2, (count, stack.tangents)),
    ]
    by_position, by_tube, by_turn = turning.slopes(*given_)
    step = 1e-6
    for k, slopes in enumerate((by_position[:, None], by_tube, by_turn)):
        move = g.normal(size=given_[k].shape)
        ends = []
        for sign in (1, -1):
            there = list(given_)
            there[k] = given_[k] + sign * step * move
            ends.append(turning.margins(*there))
        by = np.einsum("rcm,rm->rc", slopes, move) if k == 2 else (slopes * move).sum(2)
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), by, atol=2e-5)


@given(seed=seeds)
def test_a_rounded_edge_is_never_cut_off(seed):
    """The rounded support function is not below the true one, nor far above."""
    g = np.random.default_rng(seed)
    stack = ObstacleSet.stack(some("box", g), 3)
    direction = g.normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    which = np.zeros(50, dtype=int)
    true = (stack.support(which, direction) * direction).sum(axis=1)
    point, excess = stack.rounded_support(which, direction, 0.05)
    found = (point * direction).sum(axis=1) + excess
    assert (found >= true - 1e-12).all()
    assert (found <= true + 0.05 / 2 * stack.widths[0] + 1e-12).all()


# The same obstacle, said in two ways.


@pytest.mark.parametrize("margin", MARGINS)
@given(seed=seeds)
def test_a_sphere_is_as_far_whichever_way_it_is_said(margin, seed):
    g = np.random.default_rng(seed)
    center, radius = g.uniform(-1, 1, 3).tolist(), float(g.uniform(0.2, 1))
    position, tube = g.uniform(-3, 3, (30, 3)), g.uniform(0, 0.4, (30, 3))
    one, other = (
        ObstacleSet.stack([kind(center, radius)], 3).clearance(position, tube, margin)
        for kind in (Sphere, OwnSphere)
    )
    clear = one > 1e-3
    np.testing.assert_allclose(other[clear], one[clear], atol=1e-6)
    assert (other[~clear] <= one[~clear] + 1e-9).all()
    if margin == "norm":
        points = [
            ObstacleSet.stack([kind(center, radius)], 3).clearance(position)
            for kind in (Sphere, OwnSphere)
        ]
        np.testing.assert_allclose(*points, atol=1e-5)


@pytest.mark.parametrize("margin", MARGINS)
def test_a_sphere_costs_the_same_whichever_way_it_is_said(margin):
    costs = []
    for kind in (Sphere, OwnSphere):
        scenario = flight(kind([0.3, 4.0, 0.1], 0.8))
        scenario.planner.tube_margin = margin
        result = plan(scenario)
        assert result.certified
        costs.append(result.cost)
    assert costs[1] == pytest.approx(costs[0], rel=0.01)


def test_kinds_side_by_side_are_as_each_alone():
    obstacles = some("mixed", np.random.default_rng(3))
    position = np.random.default_rng(4).uniform(-3, 3, (5, 7, 3))
    tube = np.full(3, 0.1)
    for margin in MARGINS:
        together = ObstacleSet.stack(obstacles, 3).clearance(position, tube, margin)
        for i, obstacle in enumerate(obstacles):
            alone = ObstacleSet.stack([obstacle], 3).clearance(position, tube, margin)
            np.testing.assert_allclose(together[..., i], alone[..., 0], atol=1e-9)
    chosen = np.arange(len(obstacles)) % 2 == 1
    stack = ObstacleSet.stack(obstacles, 3)
    np.testing.assert_array_equal(
        stack.subset(chosen).clearance(position), stack.clearance(position)[..., chosen]
    )


def test_cores_that_are_stacked_answer_as_one_by_one():
    @dataclasses.dataclass
    class Stacked:
        """Boxes without a turn, as arrays."""

        center: np.ndarray
        half: np.ndarray

        def support(self, member, direction):
            c, h = self._of(member, direction)
            return c + np.copysign(h, direction)

        def nearest(self, member, point):
            c, h = self._of(member, point)
            return np.clip(point, c - h, c + h)

        def _of(self, member, given_):
            shape = (-1, *[1] * (given_.ndim - 2), given_.shape[-1])
            return self.center[member].reshape(shape), self.half[member].reshape(shape)

    @register_obstacle
    @dataclasses.dataclass
    class Crate(Box):
        """A box of which there are many."""

        @classmethod
        def cores(cls, members):
            return Stacked(
                np.array([o.center for o in members]),
                np.array([o.half for o in members]),
            )

    g = np.random.default_rng(0)
    given_ = [(g.uniform(-3, 3, 3).tolist(), [0.4, 0.3, 0.2]) for _ in range(20)]
    position, tube = g.uniform(-3, 3, (15, 3)), np.full(3, 0.2)
    boxes, crates = (
        ObstacleSet.stack([kind(*each) for each in given_], 3) for kind in (Box, Crate)
    )
    for margin in MARGINS:
        np.testing.assert_allclose(
            crates.clearance(position, tube, margin),
            boxes.clearance(position, tube, margin),
            atol=1e-12,
        )
