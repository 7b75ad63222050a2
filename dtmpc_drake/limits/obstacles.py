"""That the tube stays clear of all obstacles."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.limits.base import Limit
from dtmpc_drake.method.enclosure import Corridor, Enclosure
from dtmpc_drake.method.margin import Margin, smallest, worst
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.obstacles import ObstacleSet


@dataclasses.dataclass(frozen=True, eq=False)
class ObstacleLimit(Limit):
    """The distance of the position tube from every obstacle.

    Programs keep it by half-planes, see `obstacles.separation`.

    Attributes:
        field: the obstacles, at least one.
        tube_margin: ``norm`` or ``support``, see `ObstacleSet.clearance`.
    """

    field: ObstacleSet
    tube_margin: str

    name: ClassVar[str] = "obstacles"

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        return law.model.length_unit

    def where(self, law: SlidingLaw, column: int) -> str:
        """See base class."""
        return f"obstacle {self.field.index[column]}"

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """See base class."""
        position, tube = at.state[..., 0, :], at.error_bound[..., 0, :]
        return self.field.clearance(position, tube, self.tube_margin)

    def proven(self, enclosure: Enclosure) -> Array:
        """See base class."""
        corridor = enclosure.corridor
        return self._bounds(corridor, np.arange(len(corridor.time) - 1), 1)

    def certify(self, enclosure: Enclosure) -> dict[str, Margin]:
        """See base class."""
        return {self.name: self.clearance(enclosure.law, enclosure.corridor)}

    def clearance(
        self, law: SlidingLaw, corridor: Corridor, after: float = -np.inf
    ) -> Margin:
        """The smallest for all times from one on: branch and bound.

        An interval is as long as a step of the plan's own tube; those on which the
        bound is negative are halved, down to those of the corridor.

        Args:
            law: the controller.
            corridor: of the plan.
            after: in s.
        """
        stride = corridor.parts
        start: Array = np.arange(0, len(corridor.time) - 1, stride)
        ahead = corridor.time[start + stride] > after
        start = start[ahead] if ahead.any() else start[-1:]  # a plan holds its end
        found: list[Margin] = []
        while len(start):
            values = self._bounds(corridor, start, stride)
            open_ = (values < 0).any(axis=1) & (stride > 1)
            if not open_.all():
                time = corridor.time[start[~open_]] * corridor.units.time
                places = [self.where(law, i) for i in range(values.shape[1])]
                unit, worth = self.unit(law), corridor.units.length
                found.append(smallest(time, values[~open_], unit, places, worth))
            stride //= 2
            start = (start[open_, None] + [0, stride]).ravel()
        return worst(found)

    def _bounds(self, corridor: Corridor, start: Array, stride: int) -> Array:
        """Lower bounds on some intervals.

        Within an interval the reference leaves its chord by at most ``h²/8 max|ÿ*|``,
        and Ω by ``h²/8 max|d²Ω/dt²|``.

        Args:
            corridor: of the plan.
            start: indices into its times, ``(q,)``.
            stride: how many of its intervals make one of these.

        Returns:
            Shape ``(q, num_obstacles)``.
        """
        ends = np.stack([start, start + stride])
        inner = start[:, None] + np.arange(stride)
        curvature = corridor.reference.largest(2) + corridor.position_curvature
        return self.field.clearance_along(
            corridor.reference.at_ends()[ends],
            corridor.position_tube[ends],
            leave=(stride * corridor.step) ** 2 / 8 * curvature[inner].max(axis=1),
            margin=self.tube_margin,
        )
