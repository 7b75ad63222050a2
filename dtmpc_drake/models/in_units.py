"""A model in other units of length and time."""

from collections.abc import Mapping
from typing import Any

from dtmpc_drake.models.base import Model
from dtmpc_drake.models.constant import ConstantUncertainty
from dtmpc_drake.models.wrapped import WrappedModel
from dtmpc_drake.numerics.arrays import Array


class InUnits(WrappedModel):
    """Another model in units in which its own are so large.

    Inputs count in the unit of the n-th derivative, so that B is what it was.  That
    asks for outputs of one order, or for a unit of time that is the user's.  Names, and
    their units, stay those that the user knows.

    Args:
        model: in the user's units.
        rows: the new units of the output and its derivatives up to the n-th, in the
            user's, ``(n + 1, 1)``.
    """

    def __init__(self, model: Model, rows: Array) -> None:
        super().__init__(model)
        self._state, self._highest = rows[:-1], float(rows[-1, 0])
        self._speed = float(rows[1, 0])

    def _shown(self, x: Array) -> Array:
        return x * self._state

    def drift(self, x: Array) -> Array:
        """See base class."""
        return super().drift(self._shown(x)) / self._highest

    def model_error_bound(self, x: Array) -> Array:
        """See base class."""
        return super().model_error_bound(self._shown(x)) / self._highest

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        box = self._shown(x), self._shown(radius)
        return super().drift_bound_over(*box) / self._highest

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        box = self._shown(x), self._shown(radius)
        return super().model_error_bound_over(*box) / self._highest

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class."""
        box = self._shown(x), self._shown(radius)
        return super().model_error_bound_under(*box) / self._highest

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """See base class."""
        return super().true_drift(self._shown(x), parameters) / self._highest

    def inverse_input_matrix(self, x: Array) -> Array:
        """See base class."""
        return super().inverse_input_matrix(self._shown(x))

    def inverse_input_deviation(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return super().inverse_input_deviation(self._shown(x), self._shown(radius))

    def input_matrix(self, x: Array) -> Array:
        """See base class."""
        return super().input_matrix(self._shown(x))

    def constant_model_error_bound(self, speed: float) -> Array:
        """See base class."""
        shown = super().constant_model_error_bound(speed * self._speed)
        return shown / self._highest


def in_units(model: Model, rows: Array) -> Model:
    """A model in other units; see `InUnits`."""
    if isinstance(model, ConstantUncertainty):
        inner, highest = in_units(model.model, rows), float(rows[-1, 0])
        return ConstantUncertainty(inner, model.bound / highest, covers=model.covers)
    return InUnits(model, rows)
