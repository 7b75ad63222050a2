"""A multirotor whose outputs differ in their order: it has to tilt before it moves."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from dtmpc_drake.checks import Setting, require_not_negative, require_positive
from dtmpc_drake.models.base import Model, register_model
from dtmpc_drake.numerics.arrays import Array, euclidean_norm, magnitude


@register_model
@dataclasses.dataclass
class LaggedMultirotor(Model):
    """A multirotor with actuator lag and drag: orders 3, 3, 2 and 1.

    Sideways it accelerates by tilting, which lags behind what is asked for; the thrust
    along z is at hand at once, and so is the rate of the yaw.  With r the place in the
    plane and a the acceleration by thrust,

        r̈ = a - C ‖ṙ‖ ṙ,    da/dt = (u_r - a) / lag,
        z̈ = u_z - C |ż| ż + d_z,    dψ/dt = u_ψ + b + d_ψ.

    So the inputs are the accelerations that are asked for, that along z net of gravity
    compensation, and the yaw rate.  In terms of the outputs alone,

        d³r/dt³ = u_r / lag - (r̈ + C ‖ṙ‖ ṙ) / lag - C d(‖ṙ‖ ṙ)/dt + d_r

    with d(‖ṙ‖ ṙ)/dt = ‖ṙ‖ r̈ + ṙ (ṙ'r̈)/‖ṙ‖.  Of the drag and of the bias b of the
    yaw rate only bounds are known.  Disturbances are in m/s³ along x and y, in m/s²
    along z and in rad/s for the yaw.

    Attributes:
        lag: the time constant of the tilt, in s.
        drag_estimate: Ĉ, in 1/m.
        drag_error_bound: the bound of ``|C - Ĉ|``, in 1/m.
        yaw_bias_bound: the bound of ``|b|``, in rad/s.
        length_unit: in place of the metre.
    """

    lag: float = 0.25
    drag_estimate: float = 0.1
    drag_error_bound: float = 0.0
    yaw_bias_bound: float = 0.0
    length_unit: str = "m"

    # Unannotated, so that they are no fields of the dataclass.
    num_outputs = 4
    orders = 3, 3, 2, 1
    order = 3
    num_positions = 3
    parameter_names = ("drag", "yaw_bias")
    output_names = "x", "y", "z", "yaw"
    input_names = "x acceleration", "y acceleration", "z acceleration", "yaw rate"

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        require_positive(f"{path}.lag", self.lag, "s")
        for name in ("drag_estimate", "drag_error_bound"):
            unit = f"1/{self.length_unit}"
            require_not_negative(f"{path}.{name}", getattr(self, name), unit)
        require_not_negative(f"{path}.yaw_bias_bound", self.yaw_bias_bound, "rad/s")

    @property
    def output_units(self) -> tuple[str, ...]:
        """See base class."""
        return (*(self.length_unit,) * 3, "rad")

    def drift(self, x: Array) -> Array:
        """F̂, with the estimated drag and without a bias."""
        return self.true_drift(x, {"drag": self.drag_estimate, "yaw_bias": 0.0})

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """F; parameters that are left out are what the model takes them for."""
        known = {"drag": self.drag_estimate, "yaw_bias": 0.0, **parameters}
        drag, bias = (np.asarray(known[name])[..., None] for name in known)
        v, a, climb = x[..., 1, :2], x[..., 2, :2], x[..., 1, 2:3]
        speed = euclidean_norm(v)[..., None]
        along = (v * a).sum(axis=-1, keepdims=True) / speed
        pushed = speed * v / self.lag + speed * a + along * v
        return np.concatenate(
            [
                -a / self.lag - drag * pushed,
                -drag * magnitude(climb) * climb,
                bias + 0.0 * climb,
            ],
            axis=-1,
        )

    def _by_drag(self, x: Array) -> Array:
        """What drag does at most, over C, ``(..., 4)``: it grows with every |x|."""
        v, a = magnitude(x[..., 1, :]), magnitude(x[..., 2, :2])
        r, climb = v[..., :2], v[..., 2:3]
        speed, size = euclidean_norm(r)[..., None], euclidean_norm(a)[..., None]
        # (ṙ'r̈)/‖ṙ‖ is at most ‖r̈‖.
        plane = speed * r / self.lag + speed * a + size * r
        return np.concatenate([plane, climb * climb, 0.0 * climb], axis=-1)

    def model_error_bound(self, x: Array) -> Array:
        """Δ = drag_error_bound (‖ṙ‖ |ṙ| / lag + ‖ṙ‖ |r̈| + ‖r̈‖ |ṙ|), and so on."""
        bias = self.yaw_bias_bound * np.eye(4)[3]
        return self.drag_error_bound * self._by_drag(x) + bias

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; no more than the sum of what lag and drag do at most."""
        largest = magnitude(x) + radius
        none = 0.0 * largest[..., 2, 2:]
        lagging = np.concatenate([largest[..., 2, :2] / self.lag, none], axis=-1)
        return lagging + self.drag_estimate * self._by_drag(largest)

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since Δ grows with every speed and acceleration."""
        return self.model_error_bound(magnitude(x) + radius)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since Δ grows with every speed and acceleration."""
        return self.model_error_bound(np.maximum(np.abs(x) - radius, 0.0))

    @property
    def error_bound_varies(self) -> bool:
        """See base class."""
        return self.drag_error_bound != 0

    def inverse_input_matrix(self, x: Array) -> Array:
        """B⁻¹, a constant."""
        inverse = np.diag([self.lag, self.lag, 1.0, 1.0])
        return np.broadcast_to(inverse, (*x.shape[:-2], 4, 4))

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        if name == "yaw_bias":
            return -self.yaw_bias_bound, self.yaw_bias_bound
        if name != "drag":
            raise KeyError(name)
        return (
            self.drag_estimate - self.drag_error_bound,
            self.drag_estimate + self.drag_error_bound,
        )
