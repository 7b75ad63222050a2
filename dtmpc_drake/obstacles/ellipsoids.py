"""Obstacles of ellipsoidal shape: cylinders, spheres, ellipsoids.

Seen through its H each of them is a ball, whose core is a point.
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from dtmpc_drake.checks import (
    Setting,
    require_length,
    require_magnitude,
    require_positive,
)
from dtmpc_drake.errors import require
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles.base import Obstacle, register_obstacle


class Ball(Obstacle, abc.ABC):
    """What is a ball in the image of H: all r with ``‖H r - p_c‖ < r_o``.

    Not a dataclass: each kind has these fields in an order of its own.

    Attributes:
        center: as the kind says.
        radius: r_o.
    """

    center: list[float]
    radius: float
    required = ("center", "radius")

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

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        self._check_center(f"{path}.center", setting.num_outputs)
        for i, value in enumerate(self.center):
            require_magnitude(f"{path}.center[{i}]", value, setting.length_unit)
        require_positive(f"{path}.radius", self.radius, setting.length_unit)
        super().check(path, setting)

    def _check_center(self, field: str, num_outputs: int) -> None:
        require_length(field, self.center, num_outputs)


@register_obstacle
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

    def _check_center(self, field: str, num_outputs: int) -> None:
        ok = len(self.center) == 2 and num_outputs >= 2
        require(field, self.center, ok, "2 numbers (x, y in m)")


@register_obstacle
@dataclasses.dataclass
class Sphere(Ball):
    """A ball in all outputs, or in those that say where the vehicle is.

    Attributes:
        center: one coordinate per such output, in m.
        radius: in m.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    radius: float = 1.0


@register_obstacle
@dataclasses.dataclass
class Ellipsoid(Ball):
    """The general shape: all r with ``‖H (r - center)‖ < radius``.

    Attributes:
        center: one coordinate per output that says where the vehicle is, in m.
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

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        m, H, field = setting.num_outputs, self.shape, f"{path}.shape"
        ok = 1 <= len(H) <= 100 and all(len(row) == m for row in H)
        require(field, H, ok, f"rows of {m} numbers each, at most 100")
        require(field, H, bool(np.any(H)), "a matrix that is not zero")
        for i, row in enumerate(H):
            for j, value in enumerate(row):
                require_magnitude(f"{field}[{i}][{j}]", value, "")
        super().check(path, setting)
