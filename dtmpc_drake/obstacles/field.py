"""All obstacles of a field, stacked: every distance is one batched expression."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dtmpc_drake.numerics.arrays import Array, BoolArray, FloatArray
from dtmpc_drake.obstacles.base import OBSTACLES, Obstacle
from dtmpc_drake.obstacles.ellipsoids import Cylinder

_SWEEPS = 20
"""At most, of the search for the nearest point of a tube."""


@dataclasses.dataclass(frozen=True, eq=False)
class ObstacleSet:
    """Obstacles as stacked arrays.

    Attributes:
        shape: H, ``(num_obstacles, rows, m)``, padded with zero rows.
        center: p_c in the image of H, ``(num_obstacles, rows)``.
        radius: r_o, ``(num_obstacles,)``.
        index: of each in the scenario, ``(num_obstacles,)``.
    """

    shape: FloatArray
    center: FloatArray
    radius: FloatArray
    index: npt.NDArray[np.intp]

    @classmethod
    def stack(cls, obstacles: Sequence[Obstacle], num_outputs: int) -> ObstacleSet:
        """Stacks the obstacles of a scenario with `num_outputs` outputs.

        Raises:
            ScenarioError: if one is of no registered class, a subclass included.
        """
        for i, obstacle in enumerate(obstacles):
            OBSTACLES.require(f"obstacles[{i}]", obstacle)
        matrices = [o.shape_matrix(num_outputs) for o in obstacles]
        rows = max((len(H) for H in matrices), default=1)
        shape = np.zeros((len(obstacles), rows, num_outputs))
        center = np.zeros((len(obstacles), rows))
        for i, (H, o) in enumerate(zip(matrices, obstacles, strict=True)):
            shape[i, : len(H)] = H
            c = np.asarray(o.center, dtype=float)
            # A cylinder's centre is already in the image of H.
            center[i, : len(H)] = c if isinstance(o, Cylinder) else H @ c
        radius = np.array([o.radius for o in obstacles], dtype=float)
        return cls(shape, center, radius, np.arange(len(obstacles)))

    def subset(self, chosen: npt.NDArray[np.bool_]) -> ObstacleSet:
        """Those obstacles for which `chosen`, ``(num_obstacles,)``, is true."""
        return ObstacleSet(
            shape=self.shape[chosen],
            center=self.center[chosen],
            radius=self.radius[chosen],
            index=self.index[chosen],
        )

    def __len__(self) -> int:
        """The number of obstacles."""
        return len(self.radius)

    def offsets(self, position: FloatArray) -> FloatArray:
        """``H r - p_c`` for every obstacle.

        Args:
            position: r, shape ``(..., m)``.

        Returns:
            Shape ``(..., num_obstacles, rows)``.
        """
        return np.asarray(
            np.einsum("oij,...j->...oi", self.shape, position) - self.center
        )

    def tube_radii(self, position_tube: FloatArray) -> FloatArray:
        """``|H| Ω``: the box that holds ``H r̃``; shapes as `offsets`."""
        return np.asarray(
            np.einsum("oij,...j->...oi", np.abs(self.shape), position_tube)
        )

    def nearest_offset(
        self, offset: FloatArray, position_tube: FloatArray
    ) -> FloatArray:
        """The offset that is nearest to each centre, anywhere in the tube.

        Minimises ``‖offset + H r̃‖`` over ``|r̃| <= Ω``, one coordinate of r̃ after
        the other.  One sweep is exact where H has orthogonal columns.

        Args:
            offset: as from `offsets`, ``(..., num_obstacles, rows)``.
            position_tube: Ω, ``(..., m)``.

        Returns:
            The same shape as `offset`.
        """
        square = np.maximum((self.shape**2).sum(axis=1), 1e-300)
        error = np.zeros((*offset.shape[:-1], self.shape.shape[2]))
        nearest = np.array(offset)
        for _ in range(_SWEEPS):
            change = 0.0
            for j in range(error.shape[-1]):
                column, limit = self.shape[:, :, j], position_tube[..., None, j]
                along = np.einsum("...oi,oi->...o", nearest, column) / square[:, j]
                step = np.clip(error[..., j] - along, -limit, limit) - error[..., j]
                nearest += step[..., None] * column
                error[..., j] += step
                change = max(change, np.abs(step).max(initial=0.0))
            if change < 1e-6:
                break
        return nearest

    def clearance(
        self,
        position: FloatArray,
        position_tube: FloatArray | float = 0.0,
        margin: str = "norm",
    ) -> FloatArray:
        """Distance from each obstacle's surface to the tube around a position.

        Args:
            position: r*, shape ``(..., m)``.
            position_tube: Ω, the same shape.
            margin: ``norm`` takes ``‖|H| Ω‖`` off the distance (the paper's);
                ``support`` measures to the tube's box itself, which is tight.

        Returns:
            Shape ``(..., num_obstacles)``, negative inside.
        """
        # Column-major, for which NumPy adds much faster along the short last axis.
        offset = np.asfortranarray(self.offsets(position))
        tube = np.broadcast_to(position_tube, np.shape(position))
        if not np.any(position_tube):
            distance = np.linalg.norm(offset, axis=-1)
        elif margin == "norm":
            radii = self.tube_radii(tube)
            distance = np.linalg.norm(offset, axis=-1) - np.linalg.norm(radii, axis=-1)
        else:
            distance = np.linalg.norm(self.nearest_offset(offset, tube), axis=-1)
        return np.asarray(distance - self.radius)


def visible(
    obstacles: ObstacleSet,
    *,
    known_from: Array,
    sensing_range: float,
    time: float,
    position: Array,
) -> BoolArray:
    """Which obstacles can be known at one instant.

    An obstacle is, from its time on or where its surface is within the range.
    The distance is ``‖H r - p_c‖ - r_o`` over the largest stretch of H: the
    distance itself for cylinders and spheres, and never more than that.

    Args:
        obstacles: all that there are.
        known_from: ``(num_obstacles,)``, in s; infinite if only seen.
        sensing_range: in m; zero without a sensor.
        time: in s.
        position: y of the vehicle, ``(m,)``.

    Returns:
        ``(num_obstacles,)``.
    """
    scheduled = known_from <= time + 1e-9
    if sensing_range <= 0 or not len(obstacles):
        return np.asarray(scheduled)
    stretch = np.linalg.norm(obstacles.shape, ord=2, axis=(1, 2))
    seen = obstacles.clearance(position) <= sensing_range * stretch
    return np.asarray(scheduled | seen)
