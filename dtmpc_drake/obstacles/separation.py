"""Half-planes that part a plan's pieces from obstacles, and how they may turn.

A half-plane's normal ν lives where its obstacle measures distances, in the image of
H, and stays in here: what leaves are margins, and their derivatives by position, by
tube and by turning.  A margin at a control point is ``ν'z - r_o - size`` with the
control point's offset z from the core's farthest point along ν, and the tube's size.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np

from dtmpc_drake.numerics.arrays import Array, euclidean_norm
from dtmpc_drake.obstacles.field import ObstacleSet
from dtmpc_drake.obstacles.normals import separating_normals, tangent_space, turned

SMALLEST_SIZE = 1e-3
"""Tubes whose size is below this bend as if it were this, in m."""
FLAT = 1e-6
"""Components of a normal that are smaller are in the kink of their magnitude."""
_ROUNDING = 0.1
"""Of the edges of cores, in rad, for derivatives by turning."""
_ROUNDS = 2
"""Of improving the normals that part from a core that is more than a point."""


@dataclasses.dataclass(frozen=True, eq=False)
class Halfplanes:
    """Separating half-planes of pieces and obstacles that are near each other.

    Attributes:
        obstacles: from which they part.
        tube_margin: ``norm`` or ``support``, see `ObstacleSet.clearance`.
        piece, obstacle: indices, ``(P,)``.
        normal: ν in the image of H, ``(P, rows)``.
        margin: at every control point, ``(P, c)``.
        by_tube: what a wider tube Ω takes off the margin, ``(P, c, m)``.
        hull: the control points' offsets z, ``(P, c, rows)``.
    """

    obstacles: ObstacleSet
    tube_margin: str
    piece: Array
    obstacle: Array
    normal: Array
    margin: Array
    by_tube: Array
    hull: Array

    def __len__(self) -> int:
        """How many there are."""
        return len(self.piece)

    def nearer_than(self, reach: float) -> Halfplanes:
        """Those with less margin than this somewhere, in m."""
        near = self.margin.min(axis=1, initial=np.inf) < reach
        arrays: Any = {name: getattr(self, name)[near] for name in _ARRAYS}
        return dataclasses.replace(self, **arrays)

    def where(self, these: Array, other: Halfplanes) -> Halfplanes:
        """Those of these places, ``(P,)``, and the others of another set elsewhere."""

        def chosen(mine: Array, others: Array) -> Array:
            return np.where(these.reshape(-1, *(1,) * (mine.ndim - 1)), mine, others)

        arrays: Any = {
            name: chosen(getattr(self, name), getattr(other, name)) for name in _ARRAYS
        }
        return dataclasses.replace(self, **arrays)

    def at(self, controls: Array, tube: Array) -> Halfplanes:
        """The same half-planes for other control points; arguments as `separate`."""
        return _measured(
            self.obstacles,
            self.tube_margin,
            controls,
            tube,
            self.piece,
            self.obstacle,
            self.normal,
        )

    def turned(self, rotation: Array) -> Halfplanes:
        """The first of these turned by some parameters, ``(at most P, tangents)``.

        Margins are as they were; see `at`.
        """
        normal = self.normal.copy()
        normal[: len(rotation)] = turned(normal[: len(rotation)], rotation)
        return dataclasses.replace(self, normal=normal)

    def by_position(self) -> Array:
        """The margins' derivative by the position, ``(P, m)``."""
        H = self.obstacles.shape[self.obstacle]
        return np.einsum("pij,pi->pj", H, self.normal)

    def by_turning(self, tube: Array, count: int) -> Array:
        """The margins' derivatives by the turning of the first `count`.

        Args:
            tube: as in `separate`.
            count: at most P.

        Returns:
            ``(count, c, tangents)``.
        """
        tangents = tangent_space(self.normal[:count])
        hull = self.hull[:count]
        if self.obstacles.groups:
            # To first order a core's farthest point does not move as the normal turns,
            # but that of a face jumps: its rounding promises neither side too much.
            obstacle, normal = self.obstacle[:count], self.normal[:count]
            rounded, _ = self.obstacles.rounded_support(obstacle, normal, _ROUNDING)
            sharp = self.obstacles.support(obstacle, normal)
            hull = hull + (sharp - rounded)[:, None]
        turn = np.einsum("pci,pti->pct", hull, tangents)
        if self.tube_margin == "support":
            # |H'ν| Ω turns, too; in its kinks it has no slope.
            H = self.obstacles.shape[self.obstacle[:count]]
            direction = self.by_position()[:count]
            sign = np.sign(direction) * (np.abs(direction) > FLAT)
            by_turn = np.einsum("pij,pti->ptj", H, tangents) * sign[:, None]
            turn -= tube[self.piece[:count]] @ by_turn.swapaxes(1, 2)
        return turn

    def lost_by_turning(self) -> Array:
        """Margin that a turn by θ gives up, over |θ|²/2, ``(P, c)``."""
        return np.einsum("pci,pi->pc", self.hull, self.normal)

    def size_curvature(self, row: Array, tube: Array) -> Array:
        """The Hessian by Ω of the tube's size.

        Args:
            row: of which half-planes, ``(k,)``.
            tube: Ω, ``(k, m)``.

        Returns:
            ``(k, m, m)``; zero where the size is linear in Ω.
        """
        if self.tube_margin == "support":
            return np.zeros((*tube.shape, tube.shape[1]))
        H = np.abs(self.obstacles.shape[self.obstacle[row]])
        box = np.einsum("pij,pj->pi", H, tube)
        size = np.maximum(np.linalg.norm(box, axis=1), SMALLEST_SIZE)
        unit = box / size[:, None]
        outer = unit[:, :, None] * unit[:, None, :]
        bend = (np.eye(box.shape[1]) - outer) / size[:, None, None]
        return H.swapaxes(1, 2) @ bend @ H


_ARRAYS = ("piece", "obstacle", "normal", "margin", "by_tube", "hull")


@dataclasses.dataclass(frozen=True, eq=False)
class Turning:
    """Margins of some half-planes as functions of position, tube and turning.

    Attributes:
        planes: that turn.
        rows: which of them, ``(R,)``.
        rounding: of the kinks of ``|H'ν|`` and of the edges of cores.
    """

    planes: Halfplanes
    rows: Array
    rounding: float

    @cached_property
    def _obstacle(self) -> Array:
        return self.planes.obstacle[self.rows]

    @cached_property
    def _shape(self) -> Array:
        return self.planes.obstacles.shape[self._obstacle]

    @cached_property
    def _tangents(self) -> Array:
        return tangent_space(self.planes.normal[self.rows])

    def margins(self, controls: Array, tube: Array, rotation: Array) -> Array:
        """Margins at every control point.

        Args:
            controls: of the position, ``(R, c, m)``.
            tube: of Ω, ``(R, c, m)``.
            rotation: of the normals, ``(R, tangents)``.

        Returns:
            ``(R, c)``.
        """
        normal, hull, excess = self._turned(controls, rotation)
        size, _, _ = self._size(tube, np.einsum("pij,pi->pj", self._shape, normal))
        along = np.einsum("pci,pi->pc", hull, normal)
        radius = self.planes.obstacles.radius[self._obstacle] + excess
        return along - radius[:, None] - size

    def slopes(
        self, controls: Array, tube: Array, rotation: Array
    ) -> tuple[Array, Array, Array]:
        """Derivatives of `margins`, whose arguments these are.

        Returns:
            By position, ``(R, m)``; by tube, ``(R, c, m)``; by turning,
            ``(R, c, tangents)``.
        """
        normal, hull, _ = self._turned(controls, rotation)
        length = np.sqrt(1 + (rotation * rotation).sum(axis=1))[:, None, None]
        by_turn = self._tangents / length
        by_turn = by_turn - normal[:, None] * rotation[:, :, None] / length**2
        direction = np.einsum("pij,pi->pj", self._shape, normal)
        _, by_tube, by_direction = self._size(tube, direction)
        turn = np.einsum("pci,pti->pct", hull, by_turn)
        if self.planes.tube_margin == "support":
            moved = np.einsum("pij,pti->ptj", self._shape, by_turn)
            turn = turn - np.einsum("pcj,ptj->pct", by_direction, moved)
        return direction, -by_tube, turn

    def _turned(
        self, controls: Array, rotation: Array
    ) -> tuple[Array, Array, Array | float]:
        """Normals, the control points' offsets from the rounded core, and its excess.

        The excess is what the support function has beyond ``ν's``.
        """
        obstacles, obstacle = self.planes.obstacles, self._obstacle
        normal = turned(self.planes.normal[self.rows], rotation)
        hull = np.einsum("pij,pcj->pci", self._shape, controls)
        hull = hull - obstacles.center[obstacle][:, None]
        if not obstacles.groups:
            return normal, hull, 0.0
        point, excess = obstacles.rounded_support(obstacle, normal, self.rounding)
        return normal, hull - point[:, None], excess

    def _size(
        self, tube: Array, direction: Array
    ) -> tuple[Array, Array, Array | float]:
        """The tube's, and its derivatives by tube and direction H'ν."""
        if self.planes.tube_margin == "norm":
            H = np.abs(self._shape)
            boxes = np.einsum("pij,pcj->pci", H, tube)
            size = euclidean_norm(boxes)
            weight = boxes / size[..., None]
            return size, np.einsum("pij,pci->pcj", H, weight), 0.0
        support = np.sqrt(direction**2 + self.rounding**2)[:, None]
        by_direction = tube * direction[:, None] / support
        return (
            (tube * support).sum(axis=-1),
            np.broadcast_to(support, tube.shape),
            by_direction,
        )


def separate(
    obstacles: ObstacleSet,
    controls: Array,
    tube: Array,
    *,
    tube_margin: str,
    reach: float,
    hint: Halfplanes | None = None,
) -> Halfplanes:
    """The best separating half-plane of every near piece and obstacle.

    Args:
        obstacles: to part from.
        controls: control points of every piece, ``(N, c, m)``.
        tube: control points of Ω on it, the same shape.
        tube_margin: ``norm`` or ``support``.
        reach: pieces and obstacles further apart than this have none, in m.
        hint: half-planes to take where they part more than those found here.
    """
    offsets = obstacles.offsets(controls).swapaxes(1, 2)
    # A cheap lower bound of the distance, to select the pairs.
    middle = offsets.mean(axis=2, keepdims=True)
    spread = np.linalg.norm(offsets - middle, axis=-1).max(axis=2)
    bound = obstacles.core_distance(middle[:, :, 0]) - spread - obstacles.radius
    radii = obstacles.tube_radii(tube.max(axis=1))
    bound = bound - np.linalg.norm(radii, axis=-1)
    piece, obstacle = np.nonzero(bound < reach)
    hull, H = offsets[piece, obstacle], obstacles.shape[obstacle]
    boxes = np.einsum("pij,pcj->pci", np.abs(H), tube[piece])
    size = np.linalg.norm(boxes, axis=-1)
    normal = separating_normals(hull, size)
    if tube_margin == "support":
        # The size depends on the normal: a second pass settles it.
        size = np.einsum("pci,pi->pc", boxes, np.abs(normal))
        normal = separating_normals(hull, size)
    cored = np.flatnonzero(obstacles.group[obstacle] >= 0)
    if len(cored):
        better, room = _parting_from_cores(
            obstacles, hull[cored], obstacle[cored], boxes[cored], tube_margin
        )
        apart = room > 0
        normal[cored[apart]] = better[apart]
    found = _measured(obstacles, tube_margin, controls, tube, piece, obstacle, normal)
    exact = tube_margin == "norm" and obstacles.tangents == 1 and not len(cored)
    if hint is None or exact or not len(hint):
        return found
    place = np.full((len(controls), len(obstacles)), -1)
    place[hint.piece, hint.obstacle] = np.arange(len(hint))
    known = place[piece, obstacle]
    other = np.where((known >= 0)[:, None], hint.normal[known], normal)
    hinted = dataclasses.replace(found, normal=other).at(controls, tube)
    return hinted.where(hinted.margin.min(axis=1) > found.margin.min(axis=1), found)


def _measured(
    obstacles: ObstacleSet,
    tube_margin: str,
    controls: Array,
    tube: Array,
    piece: Array,
    obstacle: Array,
    normal: Array,
) -> Halfplanes:
    """Half-planes of given normals, with their margins."""
    H, tube = obstacles.shape[obstacle], tube[piece]
    hull = _offsets(obstacles, controls[piece], obstacle, normal)
    if tube_margin == "norm":
        boxes = np.einsum("pij,pcj->pci", np.abs(H), tube)
        size = np.linalg.norm(boxes, axis=-1)
        weight = boxes / np.maximum(size, 1e-9)[..., None]
        by_tube = np.einsum("pij,pci->pcj", np.abs(H), weight)
    else:
        support = np.abs(np.einsum("pij,pi->pj", H, normal))
        by_tube = np.broadcast_to(support[:, None], tube.shape)
        size = (by_tube * tube).sum(axis=-1)
    along = np.einsum("pci,pi->pc", hull, normal)
    margin = along - obstacles.radius[obstacle][:, None] - size
    return Halfplanes(
        obstacles=obstacles,
        tube_margin=tube_margin,
        piece=piece,
        obstacle=obstacle,
        normal=normal,
        margin=margin,
        by_tube=by_tube,
        hull=hull,
    )


def _offsets(
    obstacles: ObstacleSet, controls: Array, obstacle: Array, normal: Array
) -> Array:
    """Control points as offsets from the farthest points of cores, ``(P, c, rows)``."""
    hull = np.einsum("pij,pcj->pci", obstacles.shape[obstacle], controls)
    hull = hull - obstacles.center[obstacle][:, None]
    if obstacles.groups:
        hull = hull - obstacles.support(obstacle, normal)[:, None]
    return np.asarray(hull)


def _parting_from_cores(
    obstacles: ObstacleSet,
    hull: Array,
    obstacle: Array,
    boxes: Array,
    tube_margin: str,
) -> tuple[Array, Array]:
    """Normals that part hulls well from cores that are more than a point.

    Tried are those along which control points, and points midway between two, are
    nearest to the core.  Then the core's farthest point along the best one stands for
    the core, and gives way to the next.

    Args:
        obstacles: of all.
        hull: offsets of control points from p_c, ``(P, c, rows)``.
        obstacle: indices, ``(P,)``.
        boxes: ``|H| Ω``, ``(P, c, rows)``.
        tube_margin: ``norm`` or ``support``.

    Returns:
        Normals, ``(P, rows)``, and how far apart hull and core are, without a tube.
    """
    first, second = np.triu_indices(hull.shape[1], 0)
    points = (hull[:, first] + hull[:, second]) / 2
    count, tries, rows = points.shape
    which = obstacle.repeat(tries)
    gaps = obstacles.gaps(which, points.reshape(-1, rows)).reshape(points.shape)
    size = np.maximum(np.linalg.norm(gaps, axis=-1, keepdims=True), 1e-300)
    candidates, places = gaps / size, np.arange(count)

    def sizes(normal: Array) -> Array:
        """Of the tubes, ``(P, k, c)`` for normals ``(P, k, rows)``."""
        if tube_margin == "norm":
            return np.linalg.norm(boxes, axis=-1)[:, None]
        return np.abs(normal) @ boxes.swapaxes(1, 2)

    for round_ in range(_ROUNDS + 1):
        farthest = obstacles.support(obstacle, candidates)
        here = sizes(candidates)
        margins = candidates @ hull.swapaxes(1, 2) - here
        margins = margins.min(axis=2) - (candidates * farthest).sum(axis=2)
        best = margins.argmax(axis=1)
        normal, point = candidates[places, best], farthest[places, best]
        if round_ == _ROUNDS:
            break
        size = np.broadcast_to(here, (count, candidates.shape[1], hull.shape[1]))
        better = separating_normals(hull - point[:, None], size[places, best])
        candidates = np.stack([normal, better], axis=1)
    between = np.einsum("pci,pi->pc", hull - point[:, None], normal)
    return np.asarray(normal), np.asarray(between.min(axis=1))
