"""All obstacles of a field, stacked: every distance is one batched expression.

Obstacles whose core is a point are arrays alone.  The other cores are asked kind by
kind, and only where there are some.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dtmpc_drake.numerics.arrays import Array, BoolArray, FloatArray
from dtmpc_drake.obstacles.base import OBSTACLES, Indices, Obstacle
from dtmpc_drake.obstacles.cores import CoreStack, Group, InUnits
from dtmpc_drake.obstacles.normals import nearest_of_box


@dataclasses.dataclass(frozen=True, eq=False)
class ObstacleSet(CoreStack):
    """Obstacles as stacked arrays.

    Attributes:
        radius: r_o, by which they reach beyond their cores, ``(num_obstacles,)``.
        index: of each in the scenario, ``(num_obstacles,)``.
    """

    radius: FloatArray
    index: Indices

    @classmethod
    def stack(
        cls,
        obstacles: Sequence[Obstacle],
        num_outputs: int,
        num_positions: int | None = None,
    ) -> ObstacleSet:
        """Stacks the obstacles of a scenario.

        Args:
            obstacles: o of them.
            num_outputs: m.
            num_positions: so many outputs, the first ones, are coordinates in which
                the obstacles are given, and they see no others; all if left out.

        Raises:
            ScenarioError: if one is of no registered class, a subclass included.
        """
        for i, obstacle in enumerate(obstacles):
            OBSTACLES.require(f"obstacles[{i}]", obstacle)
        place = num_outputs if num_positions is None else num_positions
        matrices = [o.shape_matrix(place) for o in obstacles]
        count, rows = len(obstacles), max((len(H) for H in matrices), default=1)
        shape = np.zeros((count, rows, num_outputs))
        center = np.zeros((count, rows))
        alike: dict[tuple[type[Obstacle], int], list[int]] = {}
        for i, (H, o) in enumerate(zip(matrices, obstacles, strict=True)):
            shape[i, : len(H), :place] = H
            center[i, : len(H)] = o.middle(place)
            alike.setdefault((type(o), len(H)), []).append(i)
        groups: list[Group] = []
        group, member = np.full(count, -1), np.zeros(count, dtype=int)
        for (kind, own), these in alike.items():
            cores = kind.cores([obstacles[i] for i in these])
            if cores is not None:
                group[these], member[these] = len(groups), np.arange(len(these))
                groups.append(Group(cores, own))
        radius = np.array([o.swept_radius() for o in obstacles], dtype=float)
        return cls(
            shape=shape,
            center=center,
            groups=tuple(groups),
            group=group,
            member=member,
            radius=radius,
            index=np.arange(count),
        )

    def subset(self, chosen: npt.NDArray[np.bool_]) -> ObstacleSet:
        """Those obstacles for which `chosen`, ``(num_obstacles,)``, is true."""
        return dataclasses.replace(
            self,
            shape=self.shape[chosen],
            center=self.center[chosen],
            radius=self.radius[chosen],
            index=self.index[chosen],
            group=self.group[chosen],
            member=self.member[chosen],
        )

    def in_place(self, place: slice) -> ObstacleSet:
        """The same obstacles for some of the outputs; the others, nobody sees."""
        return dataclasses.replace(self, shape=self.shape[:, :, place])

    def in_units(self, length: float) -> ObstacleSet:
        """The same obstacles in a unit that is so long."""
        groups = [
            dataclasses.replace(group, cores=InUnits(group.cores, length))
            for group in self.groups
        ]
        return dataclasses.replace(
            self,
            center=self.center / length,
            radius=self.radius / length,
            groups=tuple(groups),
        )

    def __len__(self) -> int:
        """The number of obstacles."""
        return len(self.radius)

    @property
    def tangents(self) -> int:
        """In how many directions a half-plane's normal may turn, at most."""
        return self.shape.shape[1] - 1

    def offsets(self, position: FloatArray) -> FloatArray:
        """``H r - p_c`` for every obstacle.

        Args:
            position: r, shape ``(..., m)``.

        Returns:
            Shape ``(..., num_obstacles, rows)``.
        """
        return np.einsum("oij,...j->...oi", self.shape, position) - self.center

    def tube_radii(self, position_tube: FloatArray) -> FloatArray:
        """``|H| Ω``: the box that holds ``H r̃``; shapes as `offsets`."""
        return np.einsum("oij,...j->...oi", np.abs(self.shape), position_tube)

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
            Shape ``(..., num_obstacles)``, negative inside.  Inside it is no more than
            minus the depth.
        """
        # Column-major, for which NumPy adds much faster along the short last axis.
        offset = np.asfortranarray(self.offsets(position))
        tube = np.broadcast_to(position_tube, np.shape(position))
        if not np.any(position_tube):
            distance = self._distance(offset)
        elif margin == "norm":
            radii = self.tube_radii(tube)
            distance = self._distance(offset) - np.linalg.norm(radii, axis=-1)
        else:
            distance = self._distance(offset, tube)
        return distance - self.radius

    def clearance_along(
        self,
        ends: FloatArray,
        position_tube: FloatArray,
        leave: FloatArray,
        margin: str,
    ) -> FloatArray:
        """A lower bound of `clearance` all along some chords, by half-planes.

        ``ν'z - size`` is linear along both chords, that of r* and that of Ω, hence
        smallest at an end, for any ν of unit length.

        Args:
            ends: r* at both, ``(2, q, m)``.
            position_tube: Ω there, the same shape.
            leave: how far r* and Ω together may leave the chords, ``(q, m)``.
            margin: as in `clearance`.

        Returns:
            Shape ``(q, num_obstacles)``.
        """
        offset = self.offsets(ends)
        middle, tube = offset.mean(axis=0), None
        if margin == "support":
            # Any normal is valid; that of the nearest point of the tube is the best.
            tube = position_tube.max(axis=0)
        normal = self._gaps(middle, tube)
        normal = normal / np.maximum(
            np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9
        )
        if margin == "support":
            extent = np.abs(np.einsum("oij,koi->koj", self.shape, normal))
            size = np.einsum("koj,ekj->eko", extent, position_tube)
        else:
            size = np.linalg.norm(self.tube_radii(position_tube), axis=-1)
        bound = ((normal * offset).sum(axis=-1) - size).min(axis=0)
        bound = bound - self._farthest(normal)
        sag = np.linalg.norm(self.tube_radii(leave), axis=-1)
        return bound - self.radius - sag

    def visible(
        self, *, known_from: Array, sensing_range: float, time: float, position: Array
    ) -> BoolArray:
        """Which obstacles can be known at one instant.

        An obstacle is, from its time on or where its surface is within the range.
        The distance is `clearance` over the largest stretch of H: the distance itself
        for cylinders and spheres, and never more than that.

        Args:
            known_from: ``(num_obstacles,)``, in s; infinite if only seen.
            sensing_range: in m; zero without a sensor.
            time: in s.
            position: y of the vehicle, ``(m,)``.

        Returns:
            ``(num_obstacles,)``.
        """
        scheduled = known_from <= time + 1e-9
        if sensing_range <= 0 or not len(self):
            return np.asarray(scheduled)
        stretch = np.linalg.norm(self.shape, ord=2, axis=(1, 2))
        seen = self.clearance(position) <= sensing_range * stretch
        return scheduled | seen

    def core_distance(self, offset: Array) -> Array:
        """From each core to a point at an offset from p_c, ``(..., o)``."""
        distance = np.asarray(np.linalg.norm(offset, axis=-1))
        if self.groups:
            which, flat, _ = self._flat(offset, None)
            apart = np.linalg.norm(flat - self.nearest(which, flat), axis=1)
            distance[..., self._cored()] = apart.reshape(*offset.shape[:-2], -1)
        return distance

    def outputs_seen(self) -> BoolArray:
        """Which outputs some obstacle looks at, ``(m,)``."""
        return np.abs(self.shape).max(axis=(0, 1), initial=0.0) > 0

    def way_out(self, position: FloatArray, position_tube: FloatArray) -> FloatArray:
        """The shortest way for each tube out of each obstacle, to first order.

        Args:
            position: r*, ``(..., m)``.
            position_tube: Ω, ``(m,)``, which inflates the obstacles by ``‖|H| Ω‖``.

        Returns:
            ``(..., num_obstacles, m)``; zero where it is outside.
        """
        inflated = self.radius + np.linalg.norm(self.tube_radii(position_tube), axis=-1)
        offset = self.offsets(position)
        gap = self._gaps(offset)
        size = np.maximum(np.linalg.norm(gap, axis=-1), 1e-9)
        normal = np.einsum("...oi,oij->...oj", gap, self.shape)
        normal /= size[..., None]
        distance = self._distance(offset) if self.groups else size
        slope = np.maximum((normal**2).sum(axis=-1), 1e-9)
        depth = np.maximum(inflated - distance, 0.0) / slope
        return depth[..., None] * normal

    def _cored(self) -> Indices:
        """Which obstacles' cores are more than a point."""
        return np.flatnonzero(self.group >= 0)

    def _gaps(self, offset: Array, tube: Array | None = None) -> Array:
        """`gaps` of every obstacle; offsets ``(..., o, rows)``, Ω ``(..., m)``."""
        result = offset
        if tube is not None:
            result = nearest_of_box(offset, self.shape, tube[..., None, :])
            inside = np.linalg.norm(result, axis=-1, keepdims=True) < 1e-9
            result = np.where(inside, offset, result)
        if self.groups:
            result = np.array(result)
            which, flat, boxes = self._flat(offset, tube)
            result[..., self._cored(), :] = self.gaps(which, flat, boxes).reshape(
                *offset.shape[:-2], -1, self.shape.shape[1]
            )
        return result

    def _farthest(self, normal: Array) -> Array | float:
        """σ of the cores, from p_c, ``(..., o)`` for normals ``(..., o, rows)``."""
        if not self.groups:
            return 0.0
        which, flat, _ = self._flat(normal, None)
        result = np.zeros(normal.shape[:-1])
        far = (self.support(which, flat) * flat).sum(axis=-1)
        result[..., self._cored()] = far.reshape(*normal.shape[:-2], -1)
        return result

    def _distance(self, offset: Array, tube: Array | None = None) -> Array:
        """From each core to a point, or to a tube, ``(..., o)``."""
        nearest = offset
        if tube is not None:
            nearest = nearest_of_box(offset, self.shape, tube[..., None, :])
        distance = np.asarray(np.linalg.norm(nearest, axis=-1))
        if self.groups:
            which, flat, boxes = self._flat(offset, tube)
            gap = self.gaps(which, flat, boxes)
            size = np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-300)
            normal = gap / size
            far = flat - self.support(which, normal)
            along = (normal * far).sum(axis=1)
            if boxes is not None:
                extent = np.abs(np.einsum("pij,pi->pj", self.shape[which], normal))
                along = along - (extent * boxes).sum(axis=1)
            distance[..., self._cored()] = along.reshape(*offset.shape[:-2], -1)
        return distance

    def _flat(
        self, values: Array, tube: Array | None
    ) -> tuple[Indices, Array, Array | None]:
        """Obstacles with a core, their part of some values, and tubes, one a row."""
        mine = values[..., self._cored(), :]
        lead = mine.shape[:-1]
        which = np.broadcast_to(self._cored(), lead).ravel()
        boxes = None
        if tube is not None:
            boxes = np.broadcast_to(tube[..., None, :], (*lead, tube.shape[-1]))
            boxes = boxes.reshape(-1, tube.shape[-1])
        return which, mine.reshape(-1, self.shape.shape[1]), boxes
