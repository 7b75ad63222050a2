"""An obstacle that the library does not have: a box, turned about z."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.checks import Setting, require_length, require_positive
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles import Obstacle, register_obstacle


@register_obstacle
@dataclasses.dataclass
class Box(Obstacle):
    """A box, or a rectangle for a planar vehicle.

    Attributes:
        center: in m.
        half: its half-widths along its own axes, in m.
        yaw: by which it is turned about z, in degrees.
    """

    center: list[float]
    half: list[float]
    yaw: float = 0.0

    def support(self, direction: FloatArray) -> FloatArray:
        return self.center + np.copysign(self.half, direction @ self.axes) @ self.axes.T

    def nearest(self, point: FloatArray) -> FloatArray:
        half, own = np.array(self.half), (point - self.center) @ self.axes
        return self.center + np.clip(own, -half, half) @ self.axes.T

    def check(self, path: str, setting: Setting) -> None:
        require_length(f"{path}.center", self.center, setting.num_outputs)
        require_length(f"{path}.half", self.half, setting.num_outputs)
        for i, value in enumerate(self.half):
            require_positive(f"{path}.half[{i}]", value, setting.length_unit)
        super().check(path, setting)

    @property
    def axes(self) -> FloatArray:
        axes, angle = np.eye(len(self.center)), np.deg2rad(self.yaw)
        axes[0, :2], axes[1, :2] = (
            (np.cos(angle), -np.sin(angle)),
            (np.sin(angle), np.cos(angle)),
        )
        return axes
