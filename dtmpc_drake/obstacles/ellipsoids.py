"""Obstacles of ellipsoidal shape: cylinders, spheres, ellipsoids."""

import dataclasses
from typing import Union

import numpy as np

from dtmpc_drake.numerics.arrays import FloatArray


@dataclasses.dataclass
class Cylinder:
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

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, which drops all but the first two outputs."""
        return np.eye(2, num_outputs)


@dataclasses.dataclass
class Sphere:
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

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, the identity."""
        return np.eye(num_outputs)


@dataclasses.dataclass
class Ellipsoid:
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

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, as given."""
        return np.asarray(self.shape, dtype=float)


Obstacle = Union[Cylinder, Sphere, Ellipsoid]  # noqa: UP007, Drake's YAML wants it
