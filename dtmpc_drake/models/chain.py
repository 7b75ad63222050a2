"""Chains of integrators with an additive model error."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from dtmpc_drake.checks import Setting, require_not_negative
from dtmpc_drake.models.base import Model, joined, register_model
from dtmpc_drake.numerics.arrays import Array


@register_model
@dataclasses.dataclass
class IntegratorChain(Model):
    """m chains of n integrators with an additive model error, B = I.

    ``y^(n) = u + f̃ + d`` with ``|f̃| <= error_bound`` on every output.

    Attributes:
        num_outputs: m.
        order: n.
        error_bound: Δ, one number for all outputs, in output unit / s^n.
        orders: n_i of each output, if they differ; m and n follow from them.
        length_unit: of the outputs.
        outputs: their names, if they are not x, y and z.
        inputs: their names, if they are not u0, u1, ...
    """

    num_outputs: int = 3
    order: int = 2
    error_bound: float = 0.0
    orders: list[int] | None = None
    length_unit: str = "m"
    outputs: list[str] = dataclasses.field(default_factory=list)
    inputs: list[str] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        """Takes m and n from the orders, if they are given."""
        if self.orders:
            self.num_outputs, self.order = len(self.orders), max(self.orders)

    # The true model error of every output, in output unit / s^n.
    parameter_names = ("model_error",)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        unit = joined(self.highest_units())
        require_not_negative(f"{path}.error_bound", self.error_bound, unit)

    @property
    def output_names(self) -> tuple[str, ...]:
        """See base class."""
        return tuple(self.outputs) or super().output_names

    @property
    def input_names(self) -> tuple[str, ...]:
        """See base class."""
        return tuple(self.inputs) or super().input_names

    def drift(self, x: Array) -> Array:
        """F̂ = 0."""
        return 0.0 * x[..., 0, :]

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """F = f̃, the same on every output."""
        error = np.asarray(parameters["model_error"])[..., None]
        return self.drift(x) + error

    def model_error_bound(self, x: Array) -> Array:
        """Δ, a constant."""
        return self.drift(x) + self.error_bound

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.drift(x)

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model_error_bound(x)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model_error_bound(x)

    @property
    def error_bound_varies(self) -> bool:
        """See base class."""
        return False

    def constant_model_error_bound(self, speed: float) -> Array:
        """Δ itself."""
        return np.full(self.num_outputs, self.error_bound)

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        if name != "model_error":
            raise KeyError(name)
        return -self.error_bound, self.error_bound
