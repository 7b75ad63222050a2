"""Floors, ceilings and fences: limits of the position along every axis."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from dtmpc_drake.checks import Setting
from dtmpc_drake.limits.base import LinearLimit
from dtmpc_drake.limits.sides import Sides
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import joined


@dataclasses.dataclass
class PositionLimit(Sides, LinearLimit):
    """``min <= y <= max`` along every axis, tube included.

    Attributes:
        min: in m, one an axis; null where there is none.
        max: the same.
    """

    name: ClassVar[str] = "position"
    derivative: ClassVar[int] = 0
    size: ClassVar[None] = None

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        units = law.model.output_units
        return joined(units) if column is None else units[self.of_row(column)]

    def in_units(self, units: Units, order: int) -> PositionLimit:
        """See base class."""
        return PositionLimit(*self.sides_in(units.length))

    def where(self, law: SlidingLaw, column: int) -> str:
        """See base class."""
        return self.side(column, law.model.axes)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        self.check_sides(path, setting.output_units)
