"""What a plane cuts out of obstacles: on which sides these can be passed.

For the search that tells sides apart in a plane.  Any obstacle can be cut, by looking
along rays for where it ends; balls seen through an H are cut to ellipses exactly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.obstacles.field import ObstacleSet

_DOUBLINGS, _HALVINGS = 40, 50
"""Of a ray from inside of an obstacle, until it is outside; then to where it ends."""


@dataclasses.dataclass(frozen=True, eq=False)
class Section:
    """An obstacle cut by a plane.

    Attributes:
        obstacle: its index.
        center: a point of the cut, ``(2,)``.
        reach: from there to the edge along a unit vector, ``(2,)``, in m.
        heights: over and under the plane at the centre where a tube is clear of the
            obstacle, or None if it has no end there.
    """

    obstacle: int
    center: Array
    reach: Callable[[Array], float]
    heights: tuple[float, float] | None


def sections(
    obstacles: ObstacleSet, *, origin: Array, plane: Array, up: Array, tube: Array
) -> list[Section]:
    """The obstacles that a plane cuts, and that do not cut it in two.

    Args:
        obstacles: to cut.
        origin: a point of the plane, ``(m,)``.
        plane: orthonormal columns that span it, ``(m, 2)``.
        up: a unit vector square to it, ``(m,)``, or zero.
        tube: Ω, ``(m,)``, for the heights.
    """
    found = []
    for i in range(len(obstacles)):
        one = obstacles.subset(np.arange(len(obstacles)) == i)
        cut = (_ray_section if one.groups and one.group[0] >= 0 else _ellipse)(
            one, origin, plane, up, tube
        )
        if cut is not None:
            found.append(dataclasses.replace(cut, obstacle=i))
    return found


def thinness(obstacles: ObstacleSet) -> Array:
    """A quadratic form that is large in directions in which obstacles are thin.

    Returns:
        The sum over all obstacles of ``H'H`` of trace one, ``(m, m)``.
    """
    H = obstacles.shape
    thin = np.einsum("oij,oik->ojk", H, H)
    thin = thin / np.trace(thin, axis1=1, axis2=2)[:, None, None]
    return thin.sum(axis=0)


def _ellipse(
    one: ObstacleSet, origin: Array, plane: Array, up: Array, tube: Array
) -> Section | None:
    """Of a ball: ``‖shape (q - center)‖ < radius``."""
    radius = one.radius[0]
    inflated = radius + np.linalg.norm(one.tube_radii(tube), axis=-1)[0]
    offset = one.offsets(origin)[0]
    shape = one.shape[0] @ plane
    if np.linalg.matrix_rank(shape, tol=1e-6) < 2:
        return None  # a wall: one cannot pass on its sides
    center = -np.linalg.pinv(shape) @ offset
    height = offset + shape @ center
    square = radius**2 - float(height @ height)
    if square <= 0:
        return None
    heights = None
    rise = one.shape[0] @ up
    if np.linalg.norm(rise) > 1e-6:
        # ‖height + h rise‖ = inflated radius
        a, b = float(rise @ rise), float(rise @ height)
        root = np.sqrt(b * b - a * (float(height @ height) - inflated**2))
        heights = (-b + root) / a, (-b - root) / a
    edge = float(np.sqrt(square))

    def reach(direction: Array) -> float:
        return float(edge / np.linalg.norm(shape @ direction))

    return Section(0, center, reach, heights)


def _ray_section(
    one: ObstacleSet, origin: Array, plane: Array, up: Array, tube: Array
) -> Section | None:
    """Of anything else, about the projection of its middle onto the plane."""
    middle = np.linalg.pinv(one.shape[0]) @ one.center[0]
    center = (middle - origin) @ plane
    inside = origin + plane @ center

    def end(direction: Array, size: Array | float) -> float:
        """How far a ray is inside; infinite if it does not end."""

        def out(far: float) -> bool:
            return bool(one.clearance(inside + far * direction, size)[0] >= 0)

        low, high = 0.0, 1.0
        for _ in range(_DOUBLINGS):
            if out(high):
                break
            low, high = high, 2 * high
        else:
            return np.inf
        for _ in range(_HALVINGS):
            far = (low + high) / 2
            low, high = (low, far) if out(far) else (far, high)
        return high

    if one.clearance(inside)[0] >= 0 or not all(
        np.isfinite(end(sign * axis, 0.0)) for axis in plane.T for sign in (-1, 1)
    ):
        return None
    heights = None
    if up.any():
        over, under = end(up, tube), end(-up, tube)
        if np.isfinite(over) and np.isfinite(under):
            heights = over, -under
    return Section(0, center, lambda way: end(plane @ way, 0.0), heights)
