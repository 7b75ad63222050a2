"""That a constant which stands for the model error's bound covers the true one."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.limits.base import Facets, SampledLimit, Slopes
from dtmpc_drake.method.enclosure import Enclosure
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import ConstantUncertainty, joined
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.differences import differences


@dataclasses.dataclass(frozen=True, eq=False)
class CoverLimit(SampledLimit):
    """Δ of the true model, anywhere in the tube, is at most the constant.

    Attributes:
        model: whose constant is meant.
    """

    model: ConstantUncertainty

    name: ClassVar[str] = "model_error"
    between_knots: ClassVar[bool] = False
    scale: ClassVar[float] = 1.0

    @property
    def title(self) -> str:
        """See base class."""
        return "the constant uncertainty bound"

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        units = law.model.highest_units()
        return joined(units) if column is None else units[column]

    def where(self, law: SlidingLaw, column: int) -> str:
        """See base class."""
        return law.model.axes[column]

    @property
    def size(self) -> Array:
        """See base class."""
        return self.model.bound

    def worth(self, units: Units, order: int) -> float:
        """See base class."""
        return units.of(order)

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """See base class."""
        return self._left(at.state, at.box)

    def _left(self, state: Array, radius: Array) -> Array:
        true = self.model.model.model_error_bound_over(state, radius)
        return self.model.bound - true

    def proven(self, enclosure: Enclosure) -> Array:
        """See base class."""
        return self.margins(enclosure.law, enclosure.instant)

    def slopes(
        self, law: SlidingLaw, at: Instant, secant: float, facets: Facets
    ) -> Slopes:
        """See base class; it does not see y*^(n), nor the gain."""
        slope = differences(self._left, at.state, at.error_bound, secant).slope
        slope = slope.reshape(-1, slope.shape[2])
        nothing = np.zeros((len(slope), law.num_outputs))
        return Slopes(slope, nothing, nothing)
