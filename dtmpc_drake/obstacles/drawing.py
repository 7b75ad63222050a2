"""What obstacles look like: outlines from above, intervals, and solids.

Pictures are three-dimensional; E, ``(3, m)``, puts outputs into them.  Balls seen
through an H are ellipses and images of primitives; of any other obstacle the hull of
many of its farthest points is drawn.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np
import numpy.typing as npt
import scipy.spatial

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles.field import ObstacleSet

_UNBOUNDED = 1e-9
"""Below this relative singular value an obstacle has no end in a direction."""
_ENDLESS = 400.0
"""Half-width of what has no end, in lengths of what passes it."""
_POINTS = 600
"""Farthest points that stand for an obstacle."""


class Outline(Protocol):
    """A curve in the plane x, y."""

    def outline(self) -> FloatArray:
        """Points on it, ``(any number, 2)``, the last one the first."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ellipse:
    """The points ``center + axes @ w`` with ``‖w‖ <= 1``, in the plane x, y.

    Attributes:
        center: ``(2,)``.
        axes: ``(2, 2)``, half-axes as columns; huge where unbounded.
    """

    center: FloatArray
    axes: FloatArray

    def outline(self, count: int = 181) -> FloatArray:
        """Points on the boundary, ``(count, 2)``, the last one the first."""
        angle = np.linspace(0.0, 2 * np.pi, count)
        circle = np.stack([np.cos(angle), np.sin(angle)])
        return self.center + (self.axes @ circle).T


@dataclasses.dataclass(frozen=True, eq=False)
class Hull:
    """The convex hull of points in the plane x, y.

    Attributes:
        points: ``(K, 2)``.
    """

    points: FloatArray

    def outline(self) -> FloatArray:
        """Its corners, the last one the first."""
        corners = scipy.spatial.ConvexHull(self.points, qhull_options="QJ").vertices
        return self.points[np.append(corners, corners[0])]


@dataclasses.dataclass(frozen=True, eq=False)
class Solid:
    """An obstacle as an affine image of a primitive.

    Attributes:
        rank: of H; 3 is an image of the unit ball, 2 of the unit cylinder
            (axis along the third coordinate, from -1 to 1), 1 of the slab
            ``|z| <= 1`` cut to a cube of half-width one.
        transform: homogeneous, ``(4, 4)``.
    """

    rank: int
    transform: FloatArray

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Two corners of a box around it, ``(3,)`` each."""
        middle = self.transform[:3, 3]
        extent = np.linalg.norm(self.transform[:3, :3], axis=1)
        return middle - extent, middle + extent


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """An obstacle as triangles.

    Attributes:
        vertices: ``(K, 3)``.
        faces: indices of corners, counter-clockwise from outside, ``(F, 3)``.
    """

    vertices: FloatArray
    faces: npt.NDArray[np.int32]

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Two corners of a box around it, ``(3,)`` each."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)


def outlines(
    obstacles: ObstacleSet,
    embedding: FloatArray,
    position: FloatArray,
    position_tube: FloatArray,
) -> list[tuple[Outline | None, Outline]]:
    """Every obstacle as seen from above.

    Args:
        obstacles: of a vehicle with two outputs or more.
        embedding: E, ``(3, m)``.
        position: y* at some times, ``(K, m)``.
        position_tube: Ω, ``(K, m)``.

    Returns:
        For each obstacle its section at the altitude where the tube comes
        closest (None if it lies above or below all of the tube there), and its
        silhouette.
    """
    nearest = obstacles.clearance(position, position_tube, "support").argmin(axis=0)
    length = np.ptp(position, axis=0).max() + 2 * position_tube.max()
    endless = _ENDLESS * (float(length) or 1.0)
    shapes: list[tuple[Outline | None, Outline]] = []
    for i, k in enumerate(nearest):
        altitude = (embedding @ position[k])[2]
        band = (embedding @ position_tube[k])[2]
        draw = _ellipses if obstacles.group[i] < 0 else _hulls
        shapes.append(draw(obstacles, i, embedding, altitude, band, endless))
    return shapes


def _ellipses(
    obstacles: ObstacleSet,
    i: int,
    E: FloatArray,
    altitude: float,
    band: float,
    endless: float,
) -> tuple[Outline | None, Outline]:
    """Section and silhouette of a ball seen through an H."""
    H = obstacles.shape[i] @ E.T / obstacles.radius[i]
    center = np.linalg.pinv(H) @ obstacles.center[i] / obstacles.radius[i]
    Q = H.T @ H
    # The largest section within the tube's altitudes.
    rise = np.clip(0.0, *(altitude - center[2] + np.array([-band, band])))
    shift = np.linalg.pinv(Q[:2, :2]) @ Q[:2, 2]
    left = 1.0 - rise**2 * (Q[2, 2] - Q[2, :2] @ shift)
    section = None
    if left > 0.0:
        axes = np.sqrt(left) * _half_axes(Q[:2, :2], endless)
        section = Ellipse(center[:2] - shift * rise, axes)
    shadow = Q[:2, :2]
    if Q[2, 2] * endless**2 > 1.0:
        shadow = shadow - np.outer(Q[:2, 2], Q[2, :2]) / Q[2, 2]
    return section, Ellipse(center[:2], _half_axes(shadow, endless))


def _half_axes(Q: FloatArray, longest: float) -> FloatArray:
    """The half-axes of ``{w: wᵀ Q w <= 1}`` as columns, not longer than that."""
    values, vectors = np.linalg.eigh(Q)
    return vectors / np.sqrt(np.maximum(values, longest**-2))


def _hulls(
    obstacles: ObstacleSet,
    i: int,
    E: FloatArray,
    altitude: float,
    band: float,
    endless: float,
) -> tuple[Outline | None, Outline]:
    """Section and silhouette of any obstacle."""
    corner = np.full(3, endless)
    points = _farthest_points(obstacles, i, E, -corner, corner)
    z = points[:, 2]
    # The section nearest to the middle within the tube's altitudes.
    cut = np.clip((z.min() + z.max()) / 2, altitude - band, altitude + band)
    above, below = points[z >= cut], points[z < cut]
    section = None
    if len(above) and len(below):
        high, low = above[:, None], below[None]
        share = (cut - low[..., 2:]) / (high[..., 2:] - low[..., 2:])
        crossings = low[..., :2] + share * (high[..., :2] - low[..., :2])
        section = Hull(crossings.reshape(-1, 2))
    return section, Hull(points[:, :2])


def intervals(obstacles: ObstacleSet) -> FloatArray:
    """The ends of every obstacle of a vehicle with one output, ``(o, 2)``."""
    H = obstacles.shape[:, :, 0]
    stretch = np.linalg.norm(H, axis=1)
    which, along = np.arange(len(obstacles)), H / np.maximum(stretch, 1e-300)[:, None]
    ends = []
    for sign in (-1.0, 1.0):
        far = obstacles.center + obstacles.support(which, sign * along)
        center = (H * far).sum(axis=1) / stretch**2
        ends.append(center + sign * (obstacles.radius / stretch))
    return np.stack(ends, axis=1)


def solids(
    obstacles: ObstacleSet, embedding: FloatArray, low: FloatArray, high: FloatArray
) -> list[Solid | Mesh]:
    """Every obstacle as a solid, cut to a field.

    Where an obstacle does not look, it has no end: there it fills the field.

    Args:
        obstacles: to draw.
        embedding: E, ``(3, m)``.
        low: one corner of the field, ``(3,)``.
        high: the opposite corner.

    Returns:
        One solid for each obstacle.
    """
    found: list[Solid | Mesh] = []
    for i in range(len(obstacles)):
        if obstacles.group[i] < 0:
            found.append(_image_of_a_primitive(obstacles, i, embedding, low, high))
        else:
            found.append(_mesh(_farthest_points(obstacles, i, embedding, low, high)))
    return found


def _image_of_a_primitive(
    obstacles: ObstacleSet, i: int, E: FloatArray, low: FloatArray, high: FloatArray
) -> Solid:
    """An obstacle ``‖H r - p_c‖ <= r_o``."""
    middle, size = (low + high) / 2, high - low
    H3 = obstacles.shape[i] @ E.T
    values, directions, free = _seen_directions(H3)
    if free.sum() == 2:
        # Any basis of the free plane will do: choose an upright one.
        up = np.cross(directions[:, 0], [0.0, 0.0, 1.0])
        if np.linalg.norm(up) > 1e-6:
            directions[:, 1] = up / np.linalg.norm(up)
            directions[:, 2] = np.cross(directions[:, 0], directions[:, 1])
    half = np.abs(directions.T) @ size / 2
    half[~free] = obstacles.radius[i] / values[~free]
    center = np.linalg.pinv(H3) @ obstacles.center[i]
    center = center + directions[:, free] @ (directions[:, free].T @ middle)
    rank = int((~free).sum())
    if rank == 1:  # the bounded direction is the slab's third
        directions, half = directions[:, [1, 2, 0]], half[[1, 2, 0]]
    if np.linalg.det(directions) < 0:
        directions[:, 0] *= -1
    transform = np.eye(4)
    transform[:3, :3] = directions * half
    transform[:3, 3] = center
    return Solid(rank, transform)


def _seen_directions(
    H3: FloatArray,
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """How much H stretches three directions, as columns, and which it does not see."""
    _, values, rows = np.linalg.svd(H3)
    values = np.append(values, np.zeros(3 - len(values)))
    return values, rows.T.copy(), values < _UNBOUNDED * values[0]


def _farthest_points(
    obstacles: ObstacleSet, i: int, E: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Points whose hull is an obstacle, cut to a field, ``(K, 3)``."""
    seen = np.flatnonzero(np.abs(obstacles.shape[i]).any(axis=1))
    unit = np.zeros((_POINTS, obstacles.shape.shape[1]))
    # The same directions every time, those along the axes first.
    spread = np.random.default_rng(0).normal(size=(_POINTS, len(seen)))
    spread[: 2 * len(seen)] = np.concatenate([np.eye(len(seen)), -np.eye(len(seen))])
    unit[:, seen] = spread / np.linalg.norm(spread, axis=1, keepdims=True)
    points = obstacles.center[i] + obstacles.radius[i] * unit
    points = points + obstacles.support(np.full(_POINTS, i), unit)
    H3 = obstacles.shape[i] @ E.T
    _, directions, free = _seen_directions(H3)
    image = points @ np.linalg.pinv(H3).T
    middle, half = (low + high) / 2, np.abs(directions.T) @ (high - low) / 2
    for way, far in zip(directions.T[free], half[free], strict=True):
        image = image + (middle @ way) * way
        image = np.concatenate([image - far * way, image + far * way])
    return np.unique(image, axis=0)


def _mesh(points: FloatArray) -> Mesh:
    """The hull of some points."""
    hull = scipy.spatial.ConvexHull(points, qhull_options="QJ")
    faces = hull.simplices.copy()
    a, b, c = np.moveaxis(points[faces], 1, 0)
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    faces[inwards] = faces[inwards, ::-1]
    used, place = np.unique(faces, return_inverse=True)
    return Mesh(points[used], place.reshape(faces.shape).astype(np.int32))
