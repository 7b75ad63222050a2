"""Obstacles of ellipsoidal shape: cylinders, spheres, ellipsoids.

Seen through its H each of them is a ball, whose core is a point.
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles.base import Fault, Obstacle, obstacle_kind


class Ball(Obstacle, abc.ABC):
    """What is a ball in the image of H: all r with ``‖H r - p_c‖ < r_o``.

    Not a dataclass: each kind has these fields in an order of its own.

    Attributes:
        center: as the kind says.
        radius: r_o.
    """

    center: list[float]
    radius: float

    def swept_radius(self) -> float:
        """See base class."""
        return self.radius

    def support(self, direction: FloatArray) -> FloatArray:
        """See base class: the centre, always."""
        return np.broadcast_to(self._point(), direction.shape)

    def nearest(self, point: FloatArray) -> FloatArray:
        """See base class: the centre, always."""
        return np.broadcast_to(self._point(), point.shape)

    def middle(self, num_outputs: int) -> FloatArray:
        """See base class."""
        return self._point()

    @classmethod
    def cores(cls, members: Sequence[Any]) -> None:
        """See base class; there is nothing to ask."""
        return

    def _point(self) -> FloatArray:
        """p_c, in the image of H."""
        return np.asarray(self.center, dtype=float)

    def faults(self, num_outputs: int) -> Sequence[Fault]:
        """See base class."""
        if len(self.center) == num_outputs:
            return ()
        allowed = f"{num_outputs} numbers, one for each output"
        return [Fault("center", self.center, allowed)]


@obstacle_kind
@dataclasses.dataclass
class Cylinder(Ball):
    """A cylinder along z (a disc for a planar vehicle).

    Attributes:
        center: x and y of the axis, in m.
        radius: in m.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0])
    radius: float = 1.0

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, which drops all but the first two outputs."""
        return np.eye(2, num_outputs)

    def faults(self, num_outputs: int) -> Sequence[Fault]:
        """See base class."""
        if len(self.center) == 2 and num_outputs >= 2:
            return ()
        return [Fault("center", self.center, "2 numbers (x, y in m)")]


@obstacle_kind
@dataclasses.dataclass
class Sphere(Ball):
    """A ball in all outputs.

    Attributes:
        center: one coordinate per output, in m.
        radius: in m.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    radius: float = 1.0


@obstacle_kind
@dataclasses.dataclass
class Ellipsoid(Ball):
    """The general shape: all r with ``‖H (r - center)‖ < radius``.

    Attributes:
        center: one coordinate per output, in m.
        shape: H, as rows; distances are measured in this metric.
        radius: r_o, in the unit of ``H r``.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    shape: list[list[float]] = dataclasses.field(
        default_factory=lambda: np.eye(3).tolist()
    )
    radius: float = 1.0

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, as given."""
        return np.asarray(self.shape, dtype=float)

    def _point(self) -> FloatArray:
        return self.shape_matrix(len(self.center)) @ np.asarray(self.center, float)

    def faults(self, num_outputs: int) -> Sequence[Fault]:
        """See base class."""
        H, faults = self.shape, list(super().faults(num_outputs))
        if not (1 <= len(H) <= 100 and all(len(row) == num_outputs for row in H)):
            rows = f"rows of {num_outputs} numbers each, at most 100"
            faults.append(Fault("shape", H, rows))
        elif not np.any(H):
            faults.append(Fault("shape", H, "a matrix that is not zero"))
        return faults
