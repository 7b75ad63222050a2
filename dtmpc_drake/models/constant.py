"""Another model with its error bound replaced by a constant."""

import numpy as np

from dtmpc_drake.models.base import Model
from dtmpc_drake.models.wrapped import WrappedModel
from dtmpc_drake.numerics.arrays import Array


class ConstantUncertainty(WrappedModel):
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
        super().__init__(model)
        self.covers = covers
        self.bound = np.asarray(bound, dtype=float)

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
    def error_bound_varies(self) -> bool:
        """See base class."""
        return False

    def constant_model_error_bound(self, speed: float) -> Array:
        """The constant itself."""
        return self.bound
