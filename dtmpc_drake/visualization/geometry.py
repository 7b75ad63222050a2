"""Shapes behind the pictures: pure functions of a plan and of obstacles.

Pictures live in three dimensions.  Outputs beyond the third are not shown; a
planar vehicle moves in the plane z = 0 and a single output along y.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles import ObstacleSet

_UNBOUNDED = 1e-9
"""Below this relative singular value an obstacle has no end in a direction."""


def embedding(num_outputs: int) -> FloatArray:
    """E, ``(3, m)``, so that ``E y`` is where an output is drawn."""
    if num_outputs == 1:
        return np.array([[0.0], [1.0], [0.0]])
    return np.eye(3, num_outputs)


def missing_axes(num_outputs: int) -> FloatArray:
    """One for every axis of the picture that no output moves along, ``(3,)``."""
    return np.asarray(1.0 - embedding(num_outputs).sum(axis=1))


@dataclasses.dataclass(frozen=True, eq=False)
class Ellipse:
    """The points ``center + axes @ w`` with ``‖w‖ <= 1``, in the plane x, y.

    Attributes:
        center: ``(2,)``, in m.
        axes: ``(2, 2)``, half-axes as columns, in m; huge where unbounded.
    """

    center: FloatArray
    axes: FloatArray

    def outline(self, count: int = 181) -> FloatArray:
        """Points on the boundary, ``(count, 2)``, the last one the first."""
        angle = np.linspace(0.0, 2 * np.pi, count)
        circle = np.stack([np.cos(angle), np.sin(angle)])
        return np.asarray(self.center + (self.axes @ circle).T)


def obstacle_sections(
    obstacles: ObstacleSet, position: FloatArray, position_tube: FloatArray
) -> list[tuple[Ellipse | None, Ellipse]]:
    """Every obstacle as seen from above.

    Args:
        obstacles: of a vehicle with two outputs or more.
        position: y* at some times, ``(K, m)``.
        position_tube: Ω, ``(K, m)``.

    Returns:
        For each obstacle its section at the altitude where the tube comes
        closest (None if it lies above or below all of the tube there), and its
        silhouette.
    """
    E = embedding(position.shape[1])
    nearest = obstacles.clearance(position, position_tube, "support").argmin(axis=0)
    shapes = []
    for i, k in enumerate(nearest):
        H = obstacles.shape[i] @ E.T / obstacles.radius[i]
        center = np.linalg.pinv(H) @ obstacles.center[i] / obstacles.radius[i]
        Q = H.T @ H
        altitude, band = (E @ position[k])[2], (E @ position_tube[k])[2]
        # The largest section within the tube's altitudes.
        rise = np.clip(0.0, *(altitude - center[2] + np.array([-band, band])))
        shift = np.linalg.pinv(Q[:2, :2]) @ Q[:2, 2]
        left = 1.0 - rise**2 * (Q[2, 2] - Q[2, :2] @ shift)
        section = None
        if left > 0.0:
            axes = np.sqrt(left) * _half_axes(Q[:2, :2])
            section = Ellipse(center[:2] - shift * rise, axes)
        shadow = Q[:2, :2]
        if Q[2, 2] > _UNBOUNDED:
            shadow = shadow - np.outer(Q[:2, 2], Q[2, :2]) / Q[2, 2]
        shapes.append((section, Ellipse(center[:2], _half_axes(shadow))))
    return shapes


def obstacle_intervals(obstacles: ObstacleSet) -> FloatArray:
    """The ends of every obstacle of a vehicle with one output, ``(o, 2)``."""
    H = obstacles.shape[:, :, 0]
    stretch = np.linalg.norm(H, axis=1)
    center = (H * obstacles.center).sum(axis=1) / stretch**2
    half = obstacles.radius / stretch
    return np.stack([center - half, center + half], axis=1)


def _half_axes(Q: FloatArray) -> FloatArray:
    """The half-axes of ``{w: wᵀ Q w <= 1}`` as columns, at most 10⁴ long."""
    values, vectors = np.linalg.eigh(Q)
    return np.asarray(vectors / np.sqrt(np.maximum(values, 1e-8)))


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


def obstacle_solids(
    obstacles: ObstacleSet, num_outputs: int, low: FloatArray, high: FloatArray
) -> list[Solid]:
    """Every obstacle ``‖H r - p_c‖ <= r_o`` as a solid, cut to a field.

    Where H does not look, an obstacle has no end: there it fills the field.

    Args:
        obstacles: to draw.
        num_outputs: m.
        low: one corner of the field, ``(3,)``.
        high: the opposite corner.

    Returns:
        One solid for each obstacle.
    """
    E = embedding(num_outputs)
    middle, size = (low + high) / 2, high - low
    solids = []
    for H, c, radius in zip(
        obstacles.shape, obstacles.center, obstacles.radius, strict=True
    ):
        H3 = H @ E.T
        _, values, rows = np.linalg.svd(H3)
        values = np.append(values, np.zeros(3 - len(values)))
        free = values < _UNBOUNDED * values[0]
        directions = rows.T.copy()
        if free.sum() == 2:
            # Any basis of the free plane will do: choose an upright one.
            up = np.cross(directions[:, 0], [0.0, 0.0, 1.0])
            if np.linalg.norm(up) > 1e-6:
                directions[:, 1] = up / np.linalg.norm(up)
                directions[:, 2] = np.cross(directions[:, 0], directions[:, 1])
        half = np.abs(directions.T) @ size / 2
        half[~free] = radius / values[~free]
        center = np.linalg.pinv(H3) @ c
        center = center + directions[:, free] @ (directions[:, free].T @ middle)
        rank = int((~free).sum())
        if rank == 1:  # the bounded direction is the slab's third
            directions, half = directions[:, [1, 2, 0]], half[[1, 2, 0]]
        if np.linalg.det(directions) < 0:
            directions[:, 0] *= -1
        transform = np.eye(4)
        transform[:3, :3] = directions * half
        transform[:3, 3] = center
        solids.append(Solid(rank, transform))
    return solids


def travel_frames(velocity: FloatArray) -> FloatArray:
    """Frames that look along the travel: forward, left, up as columns.

    Left stays horizontal.  Where the vehicle hardly moves sideways it keeps
    its last heading, and along a vertical path up is where it came from.

    Args:
        velocity: embedded, ``(K, 3)``.

    Returns:
        Rotations, ``(K, 3, 3)``.
    """
    horizontal = velocity * [1.0, 1.0, 0.0]
    speed = np.linalg.norm(horizontal, axis=1)
    known = speed > 0.02 * max(float(speed.max()), 1e-9)
    if not known.any():
        horizontal, known = np.tile([0.0, 1.0, 0.0], (len(velocity), 1)), speed > -1.0
    # The last known heading, and before the first one the first.
    source = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    source[source < 0] = known.argmax()
    heading = horizontal[source]
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    left = np.stack([-heading[:, 1], heading[:, 0], np.zeros(len(heading))], axis=1)
    total = np.linalg.norm(velocity, axis=1, keepdims=True)
    moving = (total > 0.02 * max(float(total.max()), 1e-9)) & known[:, None]
    forward = np.where(moving, velocity / np.maximum(total, 1e-9), heading)
    return np.stack([forward, left, np.cross(forward, left)], axis=2)


def tube_rings(
    position: FloatArray, velocity: FloatArray, half_axes: FloatArray
) -> FloatArray:
    """Rectangles across the travel that hold the silhouette of the box ±Ω.

    Each half-width is the box's support function, so no point of the box
    around a position lies outside, seen along the travel.

    Args:
        position: embedded y*, ``(K, 3)``.
        velocity: embedded, ``(K, 3)``.
        half_axes: embedded Ω, ``(K, 3)``.

    Returns:
        Corners in order around the travel, upper left first, ``(K, 4, 3)``.
    """
    frames = travel_frames(velocity)
    side, up = frames[:, :, 1], frames[:, :, 2]
    # A vehicle that turns back must not twist its tube.
    sign = np.cumprod(np.where((side[1:] * side[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
    side = side * np.concatenate([[1.0], sign])[:, None]
    width = (np.abs(side) * half_axes).sum(axis=1)[:, None] * side
    height = (np.abs(up) * half_axes).sum(axis=1)[:, None] * up
    corners = [width + height, width - height, -width - height, height - width]
    return np.asarray(position[:, None] + np.stack(corners, axis=1))


def swept_mesh(
    rings: FloatArray, *, closed: bool = True, capped: bool = True
) -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """Triangles between consecutive rings, and over both ends if `capped`.

    Args:
        rings: ``(K, R, 3)``.
        closed: whether a ring's last point is joined to its first.
        capped: whether the ends are closed.

    Returns:
        Vertices ``(K * R, 3)`` and faces ``(F, 3)``.
    """
    K, R = rings.shape[:2]
    start = np.arange(K - 1)[:, None] * R + np.arange(R)
    turn = np.roll(start, -1, axis=1)
    sides = np.stack([start, start + R, turn, turn, start + R, turn + R], axis=-1)
    if not closed:
        sides = sides[:, :-1]
    fan = np.stack([np.zeros(R - 2), np.arange(1, R - 1), np.arange(2, R)], axis=-1)
    caps = [fan, (K - 1) * R + fan[:, ::-1]] if capped else []
    faces = np.concatenate([*caps, sides.reshape(-1, 3)]).astype(np.int32)
    return rings.reshape(-1, 3), faces


def swept_boxes(low: FloatArray, high: FloatArray) -> FloatArray:
    """Quadrilaterals whose union is a rectangle swept through all samples.

    Between two samples the rectangle's corners move on straight lines, so the
    union is exact: every rectangle, and what each of its edges sweeps over.

    Args:
        low: one corner at the samples, ``(K, 2)``.
        high: the opposite corner, at least `low`.

    Returns:
        Shape ``(Q, 4, 2)``, all counter-clockwise.
    """
    x, y = np.stack([low[:, 0], high[:, 0]]), np.stack([low[:, 1], high[:, 1]])
    corners = np.stack(
        [np.stack([x[i], y[j]], axis=-1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))],
        axis=1,
    )
    start, end = corners, np.roll(corners, -1, axis=1)
    edges = np.stack([start[:-1], end[:-1], end[1:], start[1:]], axis=2)
    quads = np.concatenate([corners, edges.reshape(-1, 4, 2)])
    x, y = quads[..., 0], quads[..., 1]
    area = (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)
    quads[area < 0] = quads[area < 0, ::-1]
    return quads
