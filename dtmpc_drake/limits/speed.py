"""The limit of the speed along every axis (corollary 1)."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.limits.base import LinearLimit
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass(frozen=True)
class SpeedLimit(LinearLimit):
    """``|dy_i/dt| <= bound`` on every axis.

    Attributes:
        bound: in output unit / s.
    """

    bound: float

    name: ClassVar[str] = "speed"
    derivative: ClassVar[int] = 1

    def unit(self, law: SlidingLaw) -> str:
        """See base class."""
        return "m/s"

    def where(self, column: int) -> str:
        """See base class."""
        return f"axis {column // 2}"

    def normals(self, num_outputs: int) -> Array:
        """Both directions of every axis, one after the other."""
        eye = np.eye(num_outputs)
        return np.stack([eye, -eye], axis=1).reshape(-1, num_outputs)

    @property
    def bounds(self) -> float:
        """See base class."""
        return self.bound

    @property
    def size(self) -> float:
        """See base class."""
        return self.bound
