"""Which side of each obstacle: distinct ways from start to goal, shortest first.

The optimisation finds the best plan near its start and hardly ever jumps over an
obstacle.  So the starts have to differ in the sides on which they pass.  For k
obstacles there are 2^k combinations, but few of them are short, and a graph
search finds those first:

1. A plane that holds the straight line, and is as square to the obstacles as
   possible, cuts each of them to an ellipse.
2. Where the gap between two is too narrow for the smallest tube, both are passed
   on the same side.  Connected components of such obstacles are one layer of a
   graph each, in the order of the way; its nodes are the sides to pass on, left
   and right, and in three dimensions above and below what has an end there.
3. `networkx` lists paths through the layers, shortest first (Yen's algorithm).
   Every path is another choice of sides, and all that need no step back occur.
4. Each is pulled tight, pushed out of the inflated obstacles, and measured.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import networkx as nx
import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.obstacles import ObstacleSet
from dtmpc_drake.obstacles.sections import Section, sections, thinness
from dtmpc_drake.planning.problem import Problem

LEFT, RIGHT, ABOVE, BELOW, NEITHER = "LRAB-"

CLOSED = 0.5
"""Gaps narrower than this part of the steady tube at the highest bandwidth are
closed.  Less than one, because the tube is smaller soon after the start."""
POOL = 3
"""Paths that are looked at for every way asked for: the graph orders them by
rough lengths, and some turn out to be blocked."""
LEAST_SAMPLES, SPACING = 41, 0.3
"""Points of a way: at least, and how far apart, in m."""
SWEEPS = 100
"""Of pulling a way tight."""
ROUNDS = 20
"""Of smoothing a way and pushing it out of the obstacles."""
BESIDE = 2.0
"""Obstacles less far behind each other are rather passed together, in m."""
ROOM = 2.0
"""How far beyond the outermost obstacle a way may go around, in m."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Way:
    """A path from start to goal, and the sides on which it passes.

    Attributes:
        sides: one letter per obstacle, as seen along the straight line from start
            to goal: passing ``L`` left, ``R`` right, ``A`` above or ``B`` below
            it; ``-`` where there is nothing to choose.
        points: evenly spaced along the path, ``(K, m)``.
        length: in m.
    """

    sides: str
    points: Array
    length: float

    @classmethod
    def along(cls, sides: str, points: Array) -> Way:
        """A way along a polyline, ``(any number, m)``."""
        straight = float(np.linalg.norm(points[-1] - points[0]))
        count = max(LEAST_SAMPLES, int(np.ceil(straight / SPACING)) + 1)
        size = np.linalg.norm(np.diff(points, axis=0), axis=1)
        travelled = np.concatenate([[0.0], np.cumsum(size)])
        wanted = np.linspace(0, travelled[-1], count)
        even = [np.interp(wanted, travelled, x) for x in points.T]
        return cls(sides, np.stack(even, axis=1), float(travelled[-1]))

    def __repr__(self) -> str:
        """Sides and length."""
        return f"Way({self.sides!r}, {self.length:.2f} m)"


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """The plane in which sides are told apart.

    A point is ``origin + plane q + height up``; q[0] runs along the straight line
    and q[1] to the left of it.

    Attributes:
        origin: the start, ``(m,)``.
        plane: orthonormal columns, ``(m, 2)``.
        up: unit vector square to the plane, ``(m,)``; zero unless m = 3.
        goal: in the plane, ``(2,)``.
    """

    origin: Array
    plane: Array
    up: Array
    goal: Array

    @classmethod
    def of(cls, start: Array, goal: Array, obstacles: ObstacleSet) -> Frame | None:
        """The frame of a straight line; None if there are no sides to tell apart.

        Across the line it takes the direction in which the obstacles are thinnest
        on the whole: sides mean most there, and no cylinder is cut along its axis.
        """
        m, length = len(start), float(np.linalg.norm(goal - start))
        if m < 2 or length < 1e-6 or not len(obstacles):
            return None
        along = (goal - start) / length
        # Among equals the first axes, such as x and y before z.
        total = thinness(obstacles) + 1e-6 * np.diag(np.arange(m, 0, -1.0))
        across = np.eye(m) - np.outer(along, along)
        left = np.linalg.eigh(across @ total @ across)[1][:, -1]
        up = np.zeros(m)
        if m == 2:
            left = np.array([-along[1], along[0]])
        elif m == 3:
            up = np.cross(along, left)
            if up[np.abs(up).argmax()] < 0:
                up, left = -up, -left
        else:
            left = left * np.sign(left[np.abs(left).argmax()])
        return cls(start, np.stack([along, left], 1), up, np.array([length, 0.0]))

    def point(self, q: Array, height: Array | float = 0.0) -> Array:
        """From the plane to outputs, ``(..., 2)`` to ``(..., m)``."""
        rise = np.asarray(height)[..., None] * self.up
        return self.origin + q @ self.plane.T + rise

    def project(self, points: Array) -> Array:
        """From outputs to the plane, ``(..., m)`` to ``(..., 2)``."""
        return (points - self.origin) @ self.plane


def nominal_tube(problem: Problem) -> Array:
    """Ω at rest with the highest bandwidth and a model without error, ``(m,)``."""
    forcing = problem.law.forcing_of(0.0)
    layer = forcing / problem.bandwidth.high
    return layer / problem.law.slope ** (problem.law.chains.each - 1)


def on_the_way(obstacles: ObstacleSet, frame: Frame, tube: Array) -> list[Section]:
    """What the plane cuts out of the obstacles on the way.

    Left out is what the plane misses, and what lies behind the start or beyond
    the goal: there is nothing to choose.
    """
    cuts = sections(
        obstacles, origin=frame.origin, plane=frame.plane, up=frame.up, tube=tube
    )
    return [cut for cut in cuts if 0 < cut.center[0] < frame.goal[0]]


def propose(problem: Problem, count: int) -> list[Way]:
    """Ways that differ in their sides, shortest first.

    Args:
        problem: gives both ends, the obstacles and the smallest tube.
        count: of ways, at most.

    Returns:
        Ways that are clear of every obstacle, without a tube around them.  Where
        there is nothing to choose, the straight line alone, if it is clear.
    """
    place = slice(problem.model.num_positions)
    start, goal = problem.start[0, place], problem.goal[0, place]
    obstacles = problem.obstacles.in_place(place)
    tube = nominal_tube(problem)[place]
    frame = Frame.of(start, goal, obstacles)
    cuts = on_the_way(obstacles, frame, tube) if frame is not None else []
    if frame is None or not cuts:
        tight = [Way.along(NEITHER * len(obstacles), np.stack([start, goal]))]
    else:
        layers = _layers(cuts, np.abs(frame.plane.T) @ tube)
        choices = itertools.islice(_choices(layers, frame), POOL * count)
        tight = _pulled_tight(list(choices), frame, len(obstacles))
    tight.sort(key=lambda way: (way.length, way.sides))
    longest = problem.speed.size * np.sqrt(len(start)) * problem.duration
    found: list[Way] = []
    for batch in (tight[k : k + count] for k in range(0, len(tight), count)):
        paths = _pushed_out(np.array([w.points for w in batch]), obstacles, tube)
        for sides, points in zip((way.sides for way in batch), paths, strict=True):
            way = Way.along(sides, points)
            clear = (obstacles.clearance(way.points) >= 0).all()
            if clear and way.length <= longest and sides_of(problem, way) == sides:
                found.append(_whole(way, problem))
        if len(found) >= count:
            break
    return sorted(found, key=lambda way: (way.length, way.sides))[:count]


def _whole(way: Way, problem: Problem) -> Way:
    """A way in the space of obstacles with all other outputs, which go straight."""
    first = way.points.shape[1]
    start, goal = problem.start[0, first:], problem.goal[0, first:]
    share = np.linspace(0, 1, len(way.points))[:, None]
    points = np.concatenate([way.points, start + share * (goal - start)], axis=1)
    return dataclasses.replace(way, points=points)


def sides_of(problem: Problem, way: Way) -> str:
    """On which sides a way really passes.

    An obstacle that is turned around counter-clockwise is on the left, so it is
    passed on its right.

    Args:
        problem: gives the straight line and the obstacles.
        way: its own `sides` count only where they are above or below.

    Returns:
        One letter per obstacle; see `Way`.
    """
    letters = [side if side in (ABOVE, BELOW) else NEITHER for side in way.sides]
    place = slice(problem.model.num_positions)
    obstacles = problem.obstacles.in_place(place)
    frame = Frame.of(problem.start[0, place], problem.goal[0, place], obstacles)
    if frame is None:
        return "".join(letters)
    path = frame.project(way.points[:, place])
    for cut in on_the_way(obstacles, frame, nominal_tube(problem)[place]):
        if letters[cut.obstacle] == NEITHER:
            ray = path - cut.center
            turned = np.unwrap(np.arctan2(ray[:, 1], ray[:, 0]))
            letters[cut.obstacle] = RIGHT if turned[-1] > turned[0] else LEFT
    return "".join(letters)


@dataclasses.dataclass(frozen=True, eq=False)
class _Choice:
    """One way to pass one layer: where it crosses each obstacle's own line.

    Attributes:
        side: the letter.
        cuts: the obstacles of the layer.
        gates: across the way at each centre, ``(len(cuts), 2)``: the lowest and
            the highest second coordinate.
        heights: there, ``(len(cuts),)``.
    """

    side: str
    cuts: tuple[Section, ...]
    gates: Array
    heights: Array


def _layers(cuts: list[Section], tube: Array) -> list[list[_Choice]]:
    """Obstacles that are passed on the same side, and their sides."""
    together = nx.Graph()
    together.add_nodes_from(range(len(cuts)))
    for (i, a), (j, b) in itertools.combinations(enumerate(cuts), 2):
        between = b.center - a.center
        distance = float(np.linalg.norm(between))
        direction = between / max(distance, 1e-9)
        width = distance - a.reach(direction) - b.reach(direction)
        if width <= 2 * CLOSED * float(np.abs(direction) @ tube):
            together.add_edge(i, j)
    groups = [sorted(group) for group in nx.connected_components(together)]
    groups.sort(key=lambda group: (np.mean([cuts[i].center[0] for i in group]), group))
    edge = np.array([cut.reach(np.array([0.0, 1.0])) for cut in cuts])
    edge += CLOSED * tube[1]
    middle = np.array([cut.center[1] for cut in cuts])
    low, high = min(0.0, *(middle - edge)) - ROOM, max(0.0, *(middle + edge)) + ROOM
    layers = []
    for group in groups:
        members = tuple(cuts[i] for i in group)
        flat = np.zeros(len(group))
        left = np.stack([(middle + edge)[group], flat + high], axis=1)
        right = np.stack([flat + low, (middle - edge)[group]], axis=1)
        choices = [
            _Choice(LEFT, members, left, flat),
            _Choice(RIGHT, members, right, flat),
        ]
        if len(group) == 1 and members[0].heights is not None:
            over = np.stack([middle[group], middle[group]], axis=1)
            for side, height in zip((ABOVE, BELOW), members[0].heights, strict=True):
                choices.append(_Choice(side, members, over, np.array([height])))
        layers.append(choices)
    return layers


def _choices(layers: list[list[_Choice]], frame: Frame) -> Iterator[list[_Choice]]:
    """Combinations of one choice a layer, by their rough length."""
    graph = nx.DiGraph()
    start = _Choice("start", (), np.zeros((0, 2)), np.zeros(0))
    goal = _Choice("goal", (), np.zeros((0, 2)), np.zeros(0))
    whole = [[start], *layers, [goal]]
    corner = [np.zeros((1, 3))]
    corner += [np.array([_corner(choice) for choice in layer]) for layer in layers]
    corner.append(np.array([[*frame.goal, 0.0]]))
    for k in range(len(whole) - 1):
        for i, j in itertools.product(range(len(whole[k])), range(len(whole[k + 1]))):
            step = corner[k + 1][j] - corner[k][i]
            step[0] = max(step[0], BESIDE)
            graph.add_edge((k, i), (k + 1, j), weight=float(np.linalg.norm(step)))
    last = len(whole) - 1
    for path in nx.shortest_simple_paths(graph, (0, 0), (last, 0), weight="weight"):
        yield [whole[k][i] for k, i in path[1:-1]]


def _corner(choice: _Choice) -> Array:
    """Where a way that passes so would roughly be: along, across and up."""
    across = np.clip(0.0, choice.gates[:, 0].max(), None)
    across = min(across, choice.gates[:, 1].min())
    along = np.mean([cut.center[0] for cut in choice.cuts])
    return np.array([along, across, choice.heights.mean()])


def _pulled_tight(
    choices: list[list[_Choice]], frame: Frame, obstacles: int
) -> list[Way]:
    """The shortest polyline that crosses all gates, for each of some choices."""
    cuts = [cut for choice in choices[0] for cut in choice.cuts]
    along = np.array([cut.center[0] for cut in cuts])
    order = np.argsort(along, kind="stable")
    gates = np.array([np.concatenate([c.gates for c in way]) for way in choices])
    heights = np.array([np.concatenate([c.heights for c in way]) for way in choices])
    points = np.zeros((len(choices), len(along) + 2, 3))
    points[:, 1:-1, 0], points[:, 1:-1, 2] = along[order], heights[:, order]
    points[:, -1, :2] = frame.goal
    low, high = np.moveaxis(gates[:, order], 2, 0)
    points[:, 1:-1, 1] = np.clip(0.0, low, high)
    # Every other corner in turn moves to the line between its neighbours.
    x, y = points[0, :, 0], points[:, :, 1]
    span = x[2:] - x[:-2]
    share = np.where(span > 0, (x[1:-1] - x[:-2]) / np.where(span > 0, span, 1), 0.5)
    for sweep in range(SWEEPS):
        now = slice(sweep % 2, None, 2)
        line = (1 - share) * y[:, :-2] + share * y[:, 2:]
        y[:, 1:-1][:, now] = np.clip(line, low, high)[:, now]
    ways = []
    for way, corners in zip(choices, points, strict=True):
        sides = [NEITHER] * obstacles
        for choice in way:
            for cut in choice.cuts:
                sides[cut.obstacle] = choice.side
        line = frame.point(corners[:, :2], corners[:, 2])
        ways.append(Way.along("".join(sides), line))
    return ways


def _pushed_out(paths: Array, obstacles: ObstacleSet, tube: Array) -> Array:
    """Paths clear of the inflated obstacles as far as these leave room, and smooth.

    Args:
        paths: ``(W, K, m)``.
        obstacles: to stay clear of.
        tube: Ω, ``(m,)``, that inflates them.

    Returns:
        The same shape, with the same ends.
    """
    paths = paths.copy()
    for _ in range(ROUNDS):
        paths[:, 1:-1] += (paths[:, :-2] - 2 * paths[:, 1:-1] + paths[:, 2:]) / 4
        paths[:, 1:-1] += obstacles.way_out(paths[:, 1:-1], tube).sum(axis=2)
    return paths
