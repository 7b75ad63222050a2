"""Cores of many obstacles, stacked: farthest points, nearest points, and gaps.

All of it is in the images of the obstacles' matrices H, as offsets from a point p_c
inside of each core.  For an obstacle whose core is that point alone the answers are
zero and nobody is asked.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from dtmpc_drake.numerics.arrays import Array, FloatArray
from dtmpc_drake.obstacles.base import Cores, Indices
from dtmpc_drake.obstacles.normals import nearest_of_box

_SWEEPS = 50
"""At most, of projecting a core and a tube's box onto each other by turns."""
_HALVINGS = 24
"""Of how far a tube that cuts a core is pushed out of it."""
_APART = 1e-5
"""Gaps that are smaller, in parts of the core's width, give no direction."""


@dataclasses.dataclass(frozen=True, eq=False)
class Group:
    """Obstacles of one kind whose cores are more than a point.

    Attributes:
        cores: of all of them that a scenario has.
        rows: of the matrices through which they see.
    """

    cores: Cores
    rows: int


@dataclasses.dataclass(frozen=True, eq=False)
class InUnits:
    """Other cores in units of length that are so large.

    Attributes:
        cores: in the user's unit.
        length: the new unit in the user's.
    """

    cores: Cores
    length: float

    def support(self, member: Indices, direction: FloatArray) -> FloatArray:
        """See `Cores`."""
        return self.cores.support(member, direction) / self.length

    def nearest(self, member: Indices, point: FloatArray) -> FloatArray:
        """See `Cores`."""
        return self.cores.nearest(member, point * self.length) / self.length


@dataclasses.dataclass(frozen=True, eq=False)
class CoreStack:
    """Cores of obstacles as stacked arrays.

    Attributes:
        shape: H, ``(num_obstacles, rows, m)``, padded with zero rows.
        center: p_c in the image of H, ``(num_obstacles, rows)``.
        groups: of those whose cores are more than the point p_c.
        group: which of these each belongs to, ``(num_obstacles,)``; -1 for none.
        member: which of its group it is, ``(num_obstacles,)``.
    """

    shape: FloatArray
    center: FloatArray
    groups: tuple[Group, ...]
    group: Indices
    member: Indices

    def support(self, obstacle: Indices, direction: Array) -> Array:
        """Farthest points of cores in some directions, as offsets from p_c.

        Args:
            obstacle: indices, ``(P,)``.
            direction: ``(P, ..., rows)``.

        Returns:
            The same shape as `direction`.
        """
        result = np.zeros(direction.shape)
        for group, mine, members, center in self._parts(obstacle, direction.ndim):
            far = group.cores.support(members, direction[mine][..., : group.rows])
            result[mine, ..., : group.rows] = far - center
        return result

    def rounded_support(
        self, obstacle: Indices, direction: Array, rounding: float
    ) -> tuple[Array, Array]:
        """Farthest points of cores that move smoothly as the direction turns.

        ``max ν's - ε s's / 2`` over the core is at the point nearest to ``ν / ε`` (the
        Moreau envelope of the support function), and its slope by ν is that point.
        With ε the `rounding` over the core's width an edge is turned around within
        about so many radians.

        Args:
            obstacle: indices, ``(P,)``.
            direction: unit vectors ν, ``(P, rows)``.
            rounding: in rad.

        Returns:
            Points s, as offsets from p_c, ``(P, rows)``; and what the maximum, made as
            large as the support function or larger, has beyond ``ν's``, ``(P,)``.
        """
        width = np.maximum(self.widths[obstacle], 1e-9)
        epsilon = rounding / width
        point = self.nearest(obstacle, direction / epsilon[:, None])
        square = self.widths[obstacle] ** 2 - (point * point).sum(axis=1)
        return point, epsilon * square / 2

    @cached_property
    def widths(self) -> Array:
        """No point of a core is further than this from p_c, ``(o,)``."""
        count, rows = self.center.shape
        axes = np.concatenate([np.eye(rows), -np.eye(rows)])
        each = np.broadcast_to(axes, (count, *axes.shape))
        far = self.support(np.arange(count), each)
        reach = np.abs(np.einsum("oai,ai->oa", far, axes)).reshape(-1, 2, rows)
        return np.linalg.norm(reach.max(axis=1), axis=1)

    def nearest(self, obstacle: Indices, offset: Array) -> Array:
        """Points of cores that are nearest to others; all offsets from p_c.

        Args:
            obstacle: indices, ``(P,)``.
            offset: ``(P, ..., rows)``.

        Returns:
            The same shape as `offset`.
        """
        result = np.zeros(offset.shape)
        for group, mine, members, center in self._parts(obstacle, offset.ndim):
            point = offset[mine][..., : group.rows] + center
            near = group.cores.nearest(members, point)
            result[mine, ..., : group.rows] = near - center
        return result

    def gaps(
        self, obstacle: Indices, offset: Array, tube: Array | None = None
    ) -> Array:
        """Along which normals tubes are best parted from cores.

        Where they are apart, these are the vectors from the core's nearest point to
        the tube's.  A tube that cuts a core is pushed straight away from p_c first,
        until it does not.

        Args:
            obstacle: indices, ``(P,)``.
            offset: of the tubes' middles from p_c, ``(P, rows)``.
            tube: Ω, ``(P, m)``; only points if left out.

        Returns:
            ``(P, rows)``, not of unit length.
        """
        H = self.shape[obstacle]

        def apart(these: Array, push: Array | float) -> Array:
            moved = offset[these] + push
            which, point = obstacle[these], np.zeros_like(moved)
            for _ in range(_SWEEPS):
                gap = moved - point
                if tube is not None:
                    gap = nearest_of_box(gap, H[these], tube[these])
                before, point = point, self.nearest(which, point + gap)
                if np.abs(point - before).max(initial=0.0) < 1e-11 or tube is None:
                    break
            gap = moved - point
            return gap if tube is None else nearest_of_box(gap, H[these], tube[these])

        everywhere = np.arange(len(obstacle))
        gap = apart(everywhere, 0.0)
        outwards = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-300)[:, None]
        outwards[(np.abs(outwards) ** 2).sum(axis=1) < 0.5, 0] = 1.0
        width = (outwards * self.support(obstacle, outwards)).sum(axis=1)
        far = width.copy()
        if tube is not None:
            far += (np.abs(np.einsum("pij,pi->pj", H, outwards)) * tube).sum(axis=1)
        tiny = _APART * np.maximum(far, 1e-9)
        cut = np.flatnonzero(np.linalg.norm(gap, axis=1) < tiny)
        if not len(cut):
            return gap
        low, high = np.zeros(len(cut)), far[cut] + 2 * tiny[cut]
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            trial = apart(cut, middle[:, None] * outwards[cut])
            out = np.linalg.norm(trial, axis=1) >= tiny[cut]
            low, high = np.where(out, low, middle), np.where(out, middle, high)
        gap[cut] = apart(cut, high[:, None] * outwards[cut])
        return gap

    def _parts(
        self, obstacle: Indices, dimensions: int
    ) -> Iterator[tuple[Group, Indices, Indices, Array]]:
        """Each group, its places in `obstacle`, its members there, and their p_c."""
        for k, group in enumerate(self.groups):
            mine = np.flatnonzero(self.group[obstacle] == k)
            which = obstacle[mine]
            center = self.center[which, : group.rows]
            lead = (-1, *[1] * (dimensions - 2))
            yield group, mine, self.member[which], center.reshape(*lead, group.rows)
