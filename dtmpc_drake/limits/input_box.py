"""Limits on the input, which may be anywhere in a box around its middle."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.limits.base import Facets, SampledLimit, Slopes, Tightened
from dtmpc_drake.limits.input_slopes import InputSlopes
from dtmpc_drake.method.enclosure import Enclosure
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant, input_range
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array


class InputBoxLimit(Tightened, SampledLimit):
    """A limit on the input that is told what is left of it in a box of inputs."""

    def worth(self, units: Units, order: int) -> float:
        """See base class."""
        return units.of(order)

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """See base class."""
        return self.left(*input_range(law, at))

    def proven(self, enclosure: Enclosure) -> Array:
        """See base class; concave in y*^(n), which is linear: least at an end."""
        return self.margins(enclosure.law, enclosure.instant).min(axis=0)

    def slopes(
        self, law: SlidingLaw, at: Instant, secant: float, facets: Facets
    ) -> Slopes:
        """See base class."""
        inputs = InputSlopes(law, at, secant)
        return inputs.of_rows(*self.left_slopes(inputs.nominal, inputs.spread))

    def flown(self, state: Array, control: Array) -> Array:
        """See base class."""
        return self.left(control, np.zeros_like(control))
