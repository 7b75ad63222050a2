"""The paper's collision avoidance model: a point with drag (section VI)."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from dtmpc_drake.checks import Setting, require_not_negative
from dtmpc_drake.models.base import Model, register_model
from dtmpc_drake.numerics.arrays import Array, euclidean_norm, magnitude


@register_model
@dataclasses.dataclass
class DragDoubleIntegrator(Model):
    """The paper's collision avoidance model (section VI): a point with drag.

    ``r̈ = -C_d ‖ṙ‖ ṙ + u + d`` with ``|C_d - Ĉ_d| <= drag_error_bound``.  The
    input u is net of gravity compensation.

    Attributes:
        drag_estimate: Ĉ_d, in 1/m.
        drag_error_bound: the bound of ``|C_d - Ĉ_d|``, in 1/m.
        length_unit: in place of the metre.
    """

    drag_estimate: float = 0.1
    drag_error_bound: float = 0.0
    length_unit: str = "m"

    # Unannotated, so that they are no fields of the dataclass.
    num_outputs = 3
    order = 2
    parameter_names = ("drag",)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        for name in ("drag_estimate", "drag_error_bound"):
            unit = f"1/{self.length_unit}"
            require_not_negative(f"{path}.{name}", getattr(self, name), unit)

    def drift(self, x: Array) -> Array:
        """F̂ = -Ĉ_d ‖ṙ‖ ṙ."""
        return self.true_drift(x, {"drag": self.drag_estimate})

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """F = -C_d ‖ṙ‖ ṙ."""
        v = x[..., 1, :]
        drag = np.asarray(parameters["drag"])[..., None]
        return -drag * euclidean_norm(v)[..., None] * v

    def model_error_bound(self, x: Array) -> Array:
        """Δ = drag_error_bound ‖ṙ‖ |ṙ|."""
        v = x[..., 1, :]
        if self.drag_error_bound == 0:  # known drag is common, and worth a shortcut
            return 0.0 * v
        return self.drag_error_bound * euclidean_norm(v)[..., None] * magnitude(v)

    def _largest_velocity(self, x: Array, radius: Array) -> Array:
        # Drag grows with every |ṙ_i|, so the corner |ṙ*| + radius is the worst.
        x = np.asarray(x)
        return (magnitude(x) + radius)[..., 1:2, :].repeat(2, axis=-2)

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since drag is monotone in every speed."""
        return -self.drift(self._largest_velocity(x, radius))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since drag is monotone in every speed."""
        if self.drag_error_bound == 0:
            return self.model_error_bound(x)
        return self.model_error_bound(self._largest_velocity(x, radius))

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since drag is monotone in every speed."""
        return self.model_error_bound(np.maximum(np.abs(x) - radius, 0.0))

    @property
    def error_bound_varies(self) -> bool:
        """See base class."""
        return self.drag_error_bound != 0

    def constant_model_error_bound(self, speed: float) -> Array:
        """``drag_error_bound * speed²`` on every axis."""
        return np.full(3, self.drag_error_bound * speed**2)

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        if name != "drag":
            raise KeyError(name)
        return (
            self.drag_estimate - self.drag_error_bound,
            self.drag_estimate + self.drag_error_bound,
        )
