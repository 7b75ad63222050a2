"""Limits of every input by itself."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.checks import Setting
from dtmpc_drake.limits.base import Rows
from dtmpc_drake.limits.input_box import InputBoxLimit
from dtmpc_drake.limits.sides import Sides
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import joined


@dataclasses.dataclass
class InputRange(Sides, Rows, InputBoxLimit):
    """``min <= u <= max`` for every input, anywhere in the tube.

    Attributes:
        min: in the unit of the input, one an input; null where there is none.
        max: the same.
    """

    name: ClassVar[str] = "inputs"

    @property
    def size(self) -> float:
        """See base class."""
        return float(np.abs(self.bounds).max())

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        units = law.model.input_units
        return joined(units) if column is None else units[self.of_row(column)]

    def in_units(self, units: Units, order: int) -> InputRange:
        """See base class."""
        return InputRange(*self.sides_in(units.of(order)))

    def where(self, law: SlidingLaw, column: int) -> str:
        """See base class."""
        return self.side(column, law.model.input_names)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        self.check_sides(path, setting.input_units)
