"""Another model with its error bound replaced by a constant."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dtmpc_drake.models.base import Model
from dtmpc_drake.numerics.arrays import Array


class ConstantUncertainty(Model):
    """Another model with its error bound replaced by a constant.

    This is the simplification that the paper's third experiment argues
    against: `bound` must hold wherever the vehicle may go.

    Args:
        model: the model whose Δ(x) is replaced.
        bound: Δ, shape ``(m,)``.
        covers: whether plans must stay where the bound covers the model's own Δ;
            False is for comparison with planners that do not ask.
    """

    def __init__(self, model: Model, bound: Array, *, covers: bool = True) -> None:
        self.model = model
        self.covers = covers
        self.bound = np.asarray(bound, dtype=float)
        self.num_outputs = model.num_outputs
        self.order, self.orders = model.order, model.orders
        self.num_positions = model.num_positions
        self.parameter_names = model.parameter_names

    def drift(self, x: Array) -> Array:
        """See base class."""
        return self.model.drift(x)

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model.drift_bound_over(x, radius)

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """See base class."""
        return self.model.true_drift(x, parameters)

    def model_error_bound(self, x: Array) -> Array:
        """The constant, broadcast over the batch."""
        return np.broadcast_to(self.bound, (*x.shape[:-2], self.num_outputs))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """The constant, broadcast over the batch."""
        return self.model_error_bound(x)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """The constant, broadcast over the batch."""
        return self.model_error_bound(x)

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

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        return self.model.parameter_interval(name)

    @property
    def error_bound_varies(self) -> bool:
        """See base class."""
        return False

    def constant_model_error_bound(self, speed: float) -> Array:
        """The constant itself."""
        return self.bound

    @property
    def bounds_certified(self) -> bool:
        """See base class."""
        return self.model.bounds_certified
