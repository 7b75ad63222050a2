"""Shapes behind the pictures: pure functions of a plan and of obstacles.

Pictures live in three dimensions.  Outputs beyond the third are not shown; a
planar vehicle moves in the plane z = 0 and a single output along y.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dtmpc_drake.limits import PositionLimit
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles import ObstacleSet
from dtmpc_drake.obstacles.drawing import Mesh, Outline, Solid, outlines, solids
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.visualization.style import drawn_period

TUBE_PERIOD = 0.05
"""Between two rings of a drawn tube, in s."""
NEAR = 0.12
"""What is beside a flight by less than this part of its length is in the picture."""
_NEAR_BOUND = 0.15  # the same of bounds of the position


def embedding(num_outputs: int) -> FloatArray:
    """E, ``(3, m)``, so that ``E y`` is where an output is drawn."""
    if num_outputs == 1:
        return np.array([[0.0], [1.0], [0.0]])
    return np.eye(3, num_outputs)


def missing_axes(num_outputs: int) -> FloatArray:
    """One for every axis of the picture that no output moves along, ``(3,)``."""
    return 1.0 - embedding(num_outputs).sum(axis=1)


def tube_box(plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Two corners of a box that holds a plan's tube, ``(m,)`` each."""
    samples = plan.sample(drawn_period(plan, TUBE_PERIOD))
    center, half = samples["position"], samples["position_tube"]
    return (center - half).min(axis=0), (center + half).max(axis=0)


def position_bounds(limit: PositionLimit | None, num_outputs: int) -> FloatArray:
    """The least and the largest position, ``(m, 2)``; infinite where there is none."""
    if limit is None:
        return np.tile([-np.inf, np.inf], (num_outputs, 1))
    return limit.both()


def near_bounds(
    bounds: FloatArray, low: FloatArray, high: FloatArray, units: Sequence[str] = ()
) -> FloatArray:
    """Those bounds that are near enough to a box to be in a picture of it.

    Args:
        bounds: as from `position_bounds`, ``(m, 2)``.
        low: one corner of the box, ``(m,)``.
        high: the opposite corner.
        units: of the axes, if they differ: each is measured by those of its unit.

    Returns:
        The same, ``(m, 2)``; infinite where they are further away.
    """
    alike = np.equal.outer(units, units) if units else np.ones(2 * low.shape, bool)
    longest = np.where(alike, high - low, 0.0).max(axis=1)
    away = np.stack([low, -high], axis=1) - bounds * [1.0, -1.0]
    near = away < _NEAR_BOUND * longest[:, None]
    return np.where(near, bounds, [-np.inf, np.inf])


def obstacle_sections(
    obstacles: ObstacleSet,
    position: FloatArray,
    position_tube: FloatArray,
    order: tuple[int, int] = (0, 1),
) -> list[tuple[Outline | None, Outline]]:
    """Every obstacle as seen along an axis, from above if left out.

    Args:
        obstacles: of a vehicle with two outputs or more.
        position: y* at some times, ``(K, m)``.
        position_tube: Ω, ``(K, m)``.
        order: the outputs along the picture's axes, two of the first three.

    Returns:
        As `drawing.outlines`, whose x, y and z are those axes and the one looked along.
    """
    E = embedding(position.shape[1])
    seen = [*order, 3 - sum(order)]
    return outlines(obstacles, E[seen], position, position_tube)


def obstacle_solids(
    obstacles: ObstacleSet, num_outputs: int, low: FloatArray, high: FloatArray
) -> list[Solid | Mesh]:
    """Every obstacle as a solid, cut to a field; see `drawing.solids`."""
    return solids(obstacles, embedding(num_outputs), low, high)


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
    return position[:, None] + np.stack(corners, axis=1)


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
