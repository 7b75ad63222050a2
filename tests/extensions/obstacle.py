"""An obstacle that the library does not have: a box, turned about z."""

import dataclasses

import numpy as np

from dtmpc_drake.obstacles import Fault, Obstacle, obstacle_kind


@obstacle_kind
@dataclasses.dataclass
class Box(Obstacle):
    """A box.

    Attributes:
        center: in m.
        half: its half-widths along its own axes, in m.
        yaw: by which it is turned about z, in degrees.
    """

    center: list[float]
    half: list[float]
    yaw: float = 0.0

    def support(self, direction):
        along = direction @ self._axes
        return self.center + np.copysign(self.half, along) @ self._axes.T

    def nearest(self, point):
        inside = np.clip((point - self.center) @ self._axes, *self._sides)
        return self.center + inside @ self._axes.T

    def faults(self, num_outputs):
        if len(self.center) != num_outputs or len(self.half) != num_outputs:
            return [Fault("half", self.half, f"{num_outputs} numbers, as the center")]
        return [] if min(self.half) > 0 else [Fault("half", self.half, "positive")]

    @property
    def _sides(self):
        return -np.array(self.half), np.array(self.half)

    @property
    def _axes(self):
        turn, c, s = np.eye(len(self.center)), *_circle(self.yaw)
        turn[:2, :2] = [[c, -s], [s, c]]
        return turn


def _circle(degrees):
    return np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
