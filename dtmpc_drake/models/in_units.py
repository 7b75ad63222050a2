"""A model in other units of length and time."""

from collections.abc import Mapping
from typing import Any

from dtmpc_drake.models.base import Model
from dtmpc_drake.models.constant import ConstantUncertainty
from dtmpc_drake.numerics.arrays import Array


class InUnits(Model):
    """Another model in units in which its own are so large.

    Inputs count in the unit of the n-th derivative, so that B is what it was.

    Args:
        model: in the user's units.
        rows: the new units of the output and its derivatives up to the n-th, in the
            user's, ``(n + 1, 1)``.
    """

    def __init__(self, model: Model, rows: Array) -> None:
        self.model = model
        self.num_outputs, self.order = model.num_outputs, model.order
        self.parameter_names = model.parameter_names
        self._state, self._highest = rows[:-1], float(rows[-1, 0])

    def _shown(self, x: Array) -> Array:
        return x * self._state

    def drift(self, x: Array) -> Array:
        """See base class."""
        return self.model.drift(self._shown(x)) / self._highest

    def model_error_bound(self, x: Array) -> Array:
        """See base class."""
        return self.model.model_error_bound(self._shown(x)) / self._highest

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        box = self._shown(x), self._shown(radius)
        return self.model.drift_bound_over(*box) / self._highest

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        box = self._shown(x), self._shown(radius)
        return self.model.model_error_bound_over(*box) / self._highest

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class."""
        box = self._shown(x), self._shown(radius)
        return self.model.model_error_bound_under(*box) / self._highest

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """See base class."""
        return self.model.true_drift(self._shown(x), parameters) / self._highest

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        return self.model.parameter_interval(name)

    @property
    def bounds_certified(self) -> bool:
        """See base class."""
        return self.model.bounds_certified

    @property
    def error_bound_varies(self) -> bool:
        """See base class."""
        return self.model.error_bound_varies

    @property
    def input_is_identity(self) -> bool:
        """See base class."""
        return self.model.input_is_identity

    def inverse_input_matrix(self, x: Array) -> Array:
        """See base class."""
        return self.model.inverse_input_matrix(self._shown(x))

    def inverse_input_deviation(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model.inverse_input_deviation(self._shown(x), self._shown(radius))

    def input_matrix(self, x: Array) -> Array:
        """See base class."""
        return self.model.input_matrix(self._shown(x))


def in_units(model: Model, rows: Array) -> Model:
    """A model in other units; see `InUnits`."""
    if isinstance(model, ConstantUncertainty):
        inner, highest = in_units(model.model, rows), float(rows[-1, 0])
        return ConstantUncertainty(inner, model.bound / highest, covers=model.covers)
    return InUnits(model, rows)
