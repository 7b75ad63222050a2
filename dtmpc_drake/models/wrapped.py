"""A model that is another one but for something."""

from collections.abc import Mapping
from typing import Any

from dtmpc_drake.models.base import Model
from dtmpc_drake.numerics.arrays import Array


class WrappedModel(Model):
    """Another model; subclasses say what is different.

    Args:
        model: the other one.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.num_outputs = model.num_outputs
        self.order, self.orders = model.order, model.orders
        self.num_positions = model.num_positions
        self.parameter_names = model.parameter_names
        self.length_unit = model.length_unit

    @property
    def output_units(self) -> tuple[str, ...]:
        """See base class."""
        return self.model.output_units

    @property
    def output_names(self) -> tuple[str, ...]:
        """See base class."""
        return self.model.output_names

    @property
    def input_names(self) -> tuple[str, ...]:
        """See base class."""
        return self.model.input_names

    @property
    def input_units(self) -> tuple[str, ...]:
        """See base class."""
        return self.model.input_units

    def drift(self, x: Array) -> Array:
        """See base class."""
        return self.model.drift(x)

    def model_error_bound(self, x: Array) -> Array:
        """See base class."""
        return self.model.model_error_bound(x)

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model.drift_bound_over(x, radius)

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model.model_error_bound_over(x, radius)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model.model_error_bound_under(x, radius)

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """See base class."""
        return self.model.true_drift(x, parameters)

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
        return self.model.inverse_input_matrix(x)

    def inverse_input_deviation(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model.inverse_input_deviation(x, radius)

    def input_matrix(self, x: Array) -> Array:
        """See base class."""
        return self.model.input_matrix(x)

    def constant_model_error_bound(self, speed: float) -> Array:
        """See base class."""
        return self.model.constant_model_error_bound(speed)
