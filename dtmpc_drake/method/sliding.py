"""Boundary-layer sliding control (the paper's section IV).

Shapes: an error or a reference has shape ``(..., n, m)`` with the derivatives
along the last but one axis; slope, gain and layer have shape ``(..., m)``.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
from pydrake.math import max as drake_max
from pydrake.math import min as drake_min

from dtmpc_drake.method.chains import Chains, surface_coefficients
from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array


def _weighted_sum(weights: Array, rows: Array) -> Array:
    """Σ_k w_k row_k, row by row: NumPy's own sum is slow along so short an axis.

    Args:
        weights: shape ``(..., n, m)``.
        rows: shape ``(..., n, m)``.

    Returns:
        Shape ``(..., m)``; zero without rows.
    """
    terms = [weights[..., k, :] * rows[..., k, :] for k in range(rows.shape[-2])]
    return np.asarray(sum(terms[1:], start=terms[0]) if terms else rows.sum(axis=-2))


def sliding_variable(error: Array, slope: Array, chains: Chains | None = None) -> Array:
    """S = (d/dt + λ)^(n-1) ỹ  (eq. s), shape ``(..., m)``.

    Args:
        error: ỹ and its derivatives, ``(..., n, m)``.
        slope: λ, ``(m,)``.
        chains: gives the order of each output; all n if left out.
    """
    if chains is None:
        return _weighted_sum(surface_coefficients(slope, error.shape[-2]), error)
    return _weighted_sum(chains.coefficients(slope), error)


def saturation(value: Array) -> Array:
    """sat: the identity on [-1, 1], constant outside; generic in the scalar."""
    if value.dtype != object:
        return np.minimum(np.maximum(value, -1.0), 1.0)  # np.clip is slower
    flat = [drake_max(drake_min(v, v * 0 + 1.0), v * 0 - 1.0) for v in value.flat]
    return np.array(flat, dtype=object).reshape(value.shape)


def gain_crossover(*, bandwidth: Array, slope: Array, order: int) -> Array:
    """ω_c, the bandwidth of the whole loop: the largest ω at which |L(jω)| = 1.

    Inside the layer the control law is linear in ỹ, but for F̂, which it cancels.  With
    p the Laplace variable the loop, broken at the plant's input, is

        L(p) = [(p + α)(p + λ)^(n-1) - p^n] / p^n.

    So α is the bandwidth of the whole loop only for n = 1.  For n = 2,
    ω_c² = [(α + λ)² + √((α + λ)⁴ + 4α²λ²)] / 2.  Whatever α and λ, ω_c is within a
    few per cent of α + (n - 1) λ.

    Args:
        bandwidth: α, shape ``(..., m)``, in rad/s; where it varies, ω_c is that of
            the loop with α as it is at the time.
        slope: λ, shape ``(m,)``, in 1/s.
        order: n.

    Returns:
        Shape ``(..., m)``, in rad/s.
    """
    scale = bandwidth + (order - 1) * slope  # the leading term of p^n L, so near ω_c
    c = surface_coefficients(np.broadcast_to(slope, scale.shape) / scale, order)
    # The numerator's coefficients of p^k, with time in units of 1 / scale.
    numerator = c * (bandwidth / scale)[..., None, :]
    numerator[..., 1:, :] += c[..., :-1, :]
    # |numerator(jω)|² in powers of ω²: i^(k-l) is real where k + l is even.
    power = np.zeros_like(numerator)
    for k in range(order):
        for j in range(k % 2, order, 2):
            sign = (-1.0) ** ((k - j) // 2)
            power[..., (k + j) // 2, :] += (
                sign * numerator[..., k, :] * numerator[..., j, :]
            )
    # Companion matrices of ω^(2n) - |numerator|², whose roots are ω².
    companion = np.zeros((*scale.shape, order, order))
    companion[..., 1:, :-1] = np.eye(order - 1)
    companion[..., :, -1] = np.moveaxis(power, -2, -1)
    roots = np.linalg.eigvals(companion)
    crossings = np.where(abs(roots.imag) <= 1e-6 * abs(roots), roots.real, 0.0)
    return scale * np.sqrt(crossings.max(axis=-1))


@dataclasses.dataclass(frozen=True, eq=False)
class SlidingLaw:
    """The controller: a model, and the constants of its sliding surface and gain.

    Attributes:
        model: F̂, B, Δ and their bounds, as the controller knows them.
        slope: λ, ``(m,)``, in 1/s.
        disturbance_bound: D, ``(m,)``, in output unit / s^n_i.
        reaching_rate: η, one number, in output unit / s^n_i of every output.
    """

    model: Model
    slope: Array
    disturbance_bound: Array
    reaching_rate: float

    @cached_property
    def chains(self) -> Chains:
        """The orders of the model's outputs."""
        return Chains.of(self.model)

    @property
    def order(self) -> int:
        """The model's n, the largest of its orders."""
        return self.model.order

    @property
    def num_outputs(self) -> int:
        """The model's m."""
        return self.model.num_outputs

    @property
    def coefficients(self) -> Array:
        """c_k of the sliding surface, ``(n, m)``; see `Chains.coefficients`."""
        return self.chains.coefficients(self.slope)

    def sliding_variable(self, error: Array) -> Array:
        """S of an error ``(..., n, m)``; see the function of that name."""
        return sliding_variable(error, self.slope, self.chains)

    def forcing_of(self, model_error: Array | float) -> Array:
        """What drives the boundary layer where the model error is at most so much.

        Δ + D + η  (eqs. K and phidot), in output unit / s^n.

        Args:
            model_error: Δ, ``(..., m)``.
        """
        return model_error + self.disturbance_bound + self.reaching_rate

    def forcing(self, x: Array) -> Array:
        """Δ(x) + D + η at a state ``(..., n, m)``, shape ``(..., m)``."""
        return self.forcing_of(self.model.model_error_bound(x))

    def gain(self, x: Array, layer_rate: Array) -> Array:
        """K(x) = Δ(x) + D + η - dΦ*/dt  (eq. K), in output unit / s^n.

        Args:
            x: ``(..., n, m)``.
            layer_rate: dΦ*/dt, ``(..., m)``.
        """
        return self.forcing(x) - layer_rate

    def implied_bandwidth(self, x: Array, layer: Array, layer_rate: Array) -> Array:
        """α = K(x*) / Φ*: the bandwidth that a layer implies (eq. phidot), rad/s."""
        return self.gain(x, layer_rate) / layer

    def control(
        self, *, state: Array, reference: Array, layer: Array, layer_rate: Array
    ) -> Array:
        """The tracking control law u  (eq. u, in the form of eq. uff).

        Args:
            state: x, ``(..., n, m)``.
            reference: x* and, in the last row, y_i*^(n_i), ``(..., n + 1, m)``.
            layer: Φ*, ``(..., m)``.
            layer_rate: the exact dΦ*/dt, ``(..., m)``.

        Returns:
            u, shape ``(..., m)``.
        """
        order, coefficients = self.order, self.coefficients
        error = state - reference[..., :order, :]
        # y_r^(n) = y*^(n) - Σ_{k=1}^{n-1} C(n-1, k-1) λ^(n-k) ỹ^(k), with n = n_i;
        # errors that do not exist are zero.
        damping = _weighted_sum(coefficients[..., :-1, :], error[..., 1:, :])
        s = _weighted_sum(coefficients, error)
        demand = (
            reference[..., order, :]
            - self.model.drift(state)
            - damping
            - self.gain(state, layer_rate) * saturation(s / layer)
        )
        return self.model.input_for(state, demand)
