"""Obstacles of ellipsoidal shape: cylinders, spheres, ellipsoids."""

import dataclasses

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


@register_obstacle
@dataclasses.dataclass
class Cylinder(Obstacle):
    """A cylinder along z (a disc for a planar vehicle).

    Attributes:
        center: x and y of the axis, in m.
        radius: in m.
        known_from: when the vehicle learns of it, in s; if left out, from the start
            or, with a sensor, as soon as that reaches it.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0])
    radius: float = 1.0
    known_from: float | None = None

    required = ("center", "radius")

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, which drops all but the first two outputs."""
        return np.eye(2, num_outputs)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        ok = len(self.center) == 2 and setting.num_outputs >= 2
        require(f"{path}.center", self.center, ok, "2 numbers (x, y in m)")
        _check_numbers(self, path)
        super().check(path, setting)

    def rows(self, num_outputs: int) -> int:
        """See base class."""
        return 2


@register_obstacle
@dataclasses.dataclass
class Sphere(Obstacle):
    """A ball in all outputs.

    Attributes:
        center: one coordinate per output, in m.
        radius: in m.
        known_from: when the vehicle learns of it, in s; if left out, from the start
            or, with a sensor, as soon as that reaches it.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    radius: float = 1.0
    known_from: float | None = None

    required = ("center", "radius")

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, the identity."""
        return np.eye(num_outputs)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        require_length(f"{path}.center", self.center, setting.num_outputs)
        _check_numbers(self, path)
        super().check(path, setting)


@register_obstacle
@dataclasses.dataclass
class Ellipsoid(Obstacle):
    """The general shape: all r with ``‖H (r - center)‖ < radius``.

    Attributes:
        center: one coordinate per output, in m.
        shape: H, as rows; distances are measured in this metric.
        radius: r_o, in the unit of ``H r``.
        known_from: when the vehicle learns of it, in s; if left out, from the start
            or, with a sensor, as soon as that reaches it.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    shape: list[list[float]] = dataclasses.field(
        default_factory=lambda: np.eye(3).tolist()
    )
    radius: float = 1.0
    known_from: float | None = None

    required = ("center", "radius")

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, as given."""
        return np.asarray(self.shape, dtype=float)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        m, H, field = setting.num_outputs, self.shape, f"{path}.shape"
        ok = 1 <= len(H) <= 100 and all(len(row) == m for row in H)
        require(field, H, ok, f"rows of {m} numbers each, at most 100")
        require(field, H, bool(np.any(H)), "a matrix that is not zero")
        for i, row in enumerate(H):
            for j, value in enumerate(row):
                require_magnitude(f"{field}[{i}][{j}]", value, "")
        require_length(f"{path}.center", self.center, m)
        _check_numbers(self, path)
        super().check(path, setting)

    def rows(self, num_outputs: int) -> int:
        """See base class."""
        return len(self.shape)


def _check_numbers(obstacle: Obstacle, path: str) -> None:
    """Centre and radius."""
    for i, value in enumerate(obstacle.center):
        require_magnitude(f"{path}.center[{i}]", value, "m")
    require_positive(f"{path}.radius", obstacle.radius, "m")
