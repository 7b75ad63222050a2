"""A boat: water holds it back, more across than along, each by the speed there."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from dtmpc_drake.checks import Setting, require_length, require_not_negative
from dtmpc_drake.models import Model, register_model
from dtmpc_drake.numerics.arrays import Array, magnitude


@register_model
@dataclasses.dataclass
class Boat(Model):
    """``ÿ_i = -c_i ẏ_i + u_i / mass``, where c_i is known but for a share of it."""

    damping: list[float] = dataclasses.field(default_factory=lambda: [0.1, 0.4])
    share: float = 0.25
    mass: float = 2.0

    num_outputs, order, parameter_names = 2, 2, ("deviation",)  # (c_i - ĉ_i) / ĉ_i

    def check(self, path: str, setting: Setting) -> None:
        require_length(f"{path}.damping", self.damping, setting.num_outputs)
        require_not_negative(f"{path}.share", self.share, "")

    def parameter_interval(self, name: str) -> tuple[float, float]:
        return -self.share, self.share

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        return (1 + np.asarray(parameters["deviation"])[..., None]) * self.drift(x)

    def drift(self, x: Array) -> Array:
        return -np.array(self.damping) * x[..., 1, :]

    def model_error_bound(self, x: Array) -> Array:
        return self.share * np.array(self.damping) * magnitude(x[..., 1, :])

    # Both grow with every |ẏ_i| alone: over a box its fastest corner is the worst.
    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        return np.array(self.damping) * (magnitude(x) + radius)[..., 1, :]

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        return self.model_error_bound(magnitude(x) + radius)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        return self.model_error_bound(np.maximum(np.abs(x) - radius, 0.0))

    def constant_model_error_bound(self, speed: float) -> Array:
        return self.share * np.array(self.damping) * magnitude(np.asarray(speed))

    def inverse_input_matrix(self, x: Array) -> Array:
        return np.broadcast_to(self.mass * np.eye(2), (*x.shape[:-2], 2, 2))
