"""The limit of the speed along every axis (corollary 1)."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.limits.base import LinearLimit
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import joined
from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass(frozen=True, eq=False)
class SpeedLimit(LinearLimit):
    """``|dy_i/dt| <= bound`` on every axis.

    Attributes:
        bound: in output unit / s, one for all axes or one for each.
    """

    bound: float | list[float]

    name: ClassVar[str] = "speed"
    derivative: ClassVar[int] = 1

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        units = law.model.units_of(1)
        return joined(units) if column is None else units[column // 2]

    def where(self, law: SlidingLaw, column: int) -> str:
        """See base class."""
        return law.model.axes[column // 2]

    def normals(self, num_outputs: int) -> Array:
        """Both directions of every axis, one after the other."""
        eye = np.eye(num_outputs)
        return np.stack([eye, -eye], axis=1).reshape(-1, num_outputs)

    def in_units(self, units: Units, order: int) -> SpeedLimit:
        """See base class."""
        if isinstance(self.bound, list):
            return SpeedLimit([bound / units.of(1) for bound in self.bound])
        return SpeedLimit(self.bound / units.of(1))

    @property
    def bounds(self) -> Array | float:
        """See base class."""
        if isinstance(self.bound, list):
            return np.repeat(np.array(self.bound), 2)
        return self.bound

    @property
    def size(self) -> float:
        """The largest."""
        return float(np.max(self.bound))
