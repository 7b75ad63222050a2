"""Limits of every input by itself."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.checks import Setting
from dtmpc_drake.limits.base import Facets, SampledLimit, Slopes
from dtmpc_drake.limits.input_slopes import InputSlopes
from dtmpc_drake.limits.sides import Sides
from dtmpc_drake.method.enclosure import Enclosure
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant, input_range
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import joined
from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass
class InputRange(Sides, SampledLimit):
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

    def worth(self, units: Units, order: int) -> float:
        """See base class."""
        return units.of(order)

    def where(self, law: SlidingLaw, column: int) -> str:
        """See base class."""
        return self.side(column, law.model.input_names)

    def _left(self, middle: Array, spread: Array) -> Array:
        normals = self.normals(middle.shape[-1])
        return self.bounds - middle @ normals.T - spread @ np.abs(normals).T

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """See base class."""
        return self._left(*input_range(law, at))

    def proven(self, enclosure: Enclosure) -> Array:
        """See base class; concave in y*^(n), which is linear: least at an end."""
        return self.margins(enclosure.law, enclosure.instant).min(axis=0)

    def slopes(
        self, law: SlidingLaw, at: Instant, secant: float, facets: Facets
    ) -> Slopes:
        """See base class."""
        inputs = InputSlopes(law, at, secant)
        normals = self.normals(law.num_outputs)
        shape = (len(at.state), *normals.shape)
        return inputs.of_rows(
            np.broadcast_to(-normals, shape), np.broadcast_to(-np.abs(normals), shape)
        )

    def flown(self, state: Array, control: Array) -> Array:
        """See base class."""
        return self._left(control, np.zeros_like(control))

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        self.check_sides(path, setting.input_units)
