"""Constraint tightening (the paper's corollaries 1 and 2, Theorem 2).

Everything here is a function of one instant, batched over leading axes and
generic in the scalar: the certificate evaluates it along a plan, both backends
differentiate it.  An `Instant` may stand for a whole box of references, which is how
the certificate covers the time between samples.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.numerics.arrays import Array, euclidean_norm, magnitude


@dataclasses.dataclass(frozen=True, eq=False)
class Instant:
    """What is known of reference and tube at one instant, or in a box around it.

    Attributes:
        state: x*, ``(..., n, m)``.
        highest: y*^(n), ``(..., m)``.
        gain: κ = αΦ, ``(..., m)``.
        error_bound: R_k, the bounds of ``|ỹ^(k)|``, ``(..., n, m)``.
        state_radius: of the box around `state` that holds x*, ``(..., n, m)``.
        gain_radius: how far κ - Δ(x*) may be from its value here, ``(..., m)``.
    """

    state: Array
    highest: Array
    gain: Array
    error_bound: Array
    state_radius: Array | float = 0.0
    gain_radius: Array | float = 0.0

    def derivative(self, k: int) -> Array:
        """y*^(k), ``(..., m)``."""
        return self.highest if k == self.state.shape[-2] else self.state[..., k, :]

    @property
    def box(self) -> Array:
        """How far x may be from `state`: the tube and the box, ``(..., n, m)``."""
        return self.error_bound + self.state_radius


def feedback_bound(law: SlidingLaw, at: Instant) -> Array:
    """ū_fb, the bound of ``|B u - y*^(n)|``  (Theorem 2).

    ū_fb = |F̂|_bound + Σ_{k=1}^{n-1} C(n-1,k-1) λ^(n-k) R_k + |K|_bound

    with K(x) = κ + Δ(x) - Δ(x*).  The paper takes κ + (Δ̄ - Δ(x*)) for the last
    term; that is too little where K is negative, which a fast growing layer can
    make it where Δ(x) < Δ(x*).

    Returns:
        Shape ``(..., m)``, in output unit / s^n.
    """
    model = law.model
    damping = (law.coefficients[:-1] * at.error_bound[..., 1:, :]).sum(axis=-2)
    largest = model.model_error_bound_over(at.state, at.box)
    # 0 <= Δ(x) <= Δ̄, so |K| is at most the larger of κ + Δ̄ - Δ(x*) and
    # Δ(x*) - κ, written without a maximum.
    excess = at.gain - model.model_error_bound(at.state)
    switching = largest / 2 + magnitude(excess + largest / 2) + at.gain_radius
    return model.drift_bound_over(at.state, at.box) + damping + switching


def input_bound(law: SlidingLaw, at: Instant) -> Array:
    """A bound of ``‖u‖`` anywhere in the tube  (corollary 2).

    ``‖B⁻¹(x*) y*^(n)‖ + ‖δ |y*^(n)| + (|B⁻¹(x*)| + δ) ū_fb‖`` with δ the bound of
    how much B⁻¹ changes over the tube; the paper's when B is constant.

    Returns:
        Shape ``(...)``, in the unit of the input.
    """
    model, feedback = law.model, feedback_bound(law, at)
    if model.input_is_identity:
        return euclidean_norm(at.highest) + euclidean_norm(feedback)
    inverse = model.inverse_input_matrix(at.state)
    deviation = model.inverse_input_deviation(at.state, at.box)
    nominal = (inverse * at.highest[..., None, :]).sum(axis=-1)
    worst = (
        deviation * magnitude(at.highest)[..., None, :]
        + (np.abs(inverse) + deviation) * feedback[..., None, :]
    )
    return euclidean_norm(nominal) + euclidean_norm(worst.sum(axis=-1))


def deviation_bound(law: SlidingLaw, at: Instant, k: int) -> Array:
    """A bound of ``|ỹ^(k)|``, ``(..., m)``, for k < n, or k = n = 1."""
    if k == 1:
        return rate_bound(law, at)
    return at.error_bound[..., k, :]


def rate_bound(law: SlidingLaw, at: Instant) -> Array:
    """The bound of ``|dỹ/dt|`` that tightens the speed limit (corollary 1).

    For n >= 2 it is the velocity tube.  For n = 1 the velocity is the highest
    derivative: ``dỹ/dt = f̃ + d - K sat(s/Φ)``.

    Returns:
        Shape ``(..., m)``.
    """
    if law.order > 1:
        return at.error_bound[..., 1, :]
    largest = law.model.model_error_bound_over(at.state, at.box)
    excess = largest - law.model.model_error_bound(at.state) + at.gain_radius
    return law.disturbance_bound + largest + at.gain + excess
