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
        highest: y_i*^(n_i), ``(..., m)``.
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
        """y*^(k) of all outputs of an order above k, or of order n if that is k.

        See `Chains.derivative_of` for outputs whose orders differ, ``(..., m)``.
        """
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
        Shape ``(..., m)``, in output unit / s^n_i.
    """
    largest = law.model.model_error_bound_over(at.state, at.box)
    drift = law.model.drift_bound_over(at.state, at.box)
    return drift + _damping(law, at) + _switching(law, at, largest)


def _damping(law: SlidingLaw, at: Instant) -> Array:
    return (law.coefficients[:-1] * at.error_bound[..., 1:, :]).sum(axis=-2)


def _switching(law: SlidingLaw, at: Instant, largest: Array) -> Array:
    """The bound of |K|, Δ̄ given."""
    # 0 <= Δ(x) <= Δ̄, so |K| is at most the larger of κ + Δ̄ - Δ(x*) and
    # Δ(x*) - κ, written without a maximum.
    excess = at.gain - law.model.model_error_bound(at.state)
    return largest / 2 + magnitude(excess + largest / 2) + at.gain_radius


def input_range(law: SlidingLaw, at: Instant) -> tuple[Array, Array]:
    """Where u may be anywhere in the tube: a middle, and how far from it.

    ``|u - B⁻¹(x*) y*^(n)| <= δ |y*^(n)| + (|B⁻¹(x*)| + δ) ū_fb`` with δ the bound of
    how much B⁻¹ changes over the tube.

    Returns:
        Both ``(..., m)``, in the unit of the input.
    """
    model, feedback = law.model, feedback_bound(law, at)
    if model.input_is_identity:
        return at.highest, feedback
    inverse = model.inverse_input_matrix(at.state)
    deviation = model.inverse_input_deviation(at.state, at.box)
    nominal = (inverse * at.highest[..., None, :]).sum(axis=-1)
    worst = (
        deviation * magnitude(at.highest)[..., None, :]
        + (np.abs(inverse) + deviation) * feedback[..., None, :]
    )
    return nominal, worst.sum(axis=-1)


def input_bound(law: SlidingLaw, at: Instant) -> Array:
    """A bound of ``‖u‖`` anywhere in the tube  (corollary 2).

    Returns:
        Shape ``(...)``, in the unit of the input.
    """
    middle, spread = input_range(law, at)
    return euclidean_norm(middle) + euclidean_norm(spread)


def deviation_bound(law: SlidingLaw, at: Instant, k: int) -> Array:
    """A bound of ``|ỹ^(k)|`` for k up to n_i, which tightens limits (corollary 1).

    The highest derivative is no state of the tube, but
    ``ỹ^(n) = f̃ + d - Σ_{k=1}^{n-1} C(n-1,k-1) λ^(n-k) ỹ^(k) - K sat(s/Φ)``.

    Returns:
        Shape ``(..., m)``; zero for outputs of order below k, of which nothing is
        known.
    """
    if k not in law.chains.orders:
        return at.error_bound[..., k, :]
    largest = law.model.model_error_bound_over(at.state, at.box)
    pushed = law.disturbance_bound + largest
    highest = pushed + _damping(law, at) + _switching(law, at, largest)
    return law.chains.derivative_of(at.error_bound, highest, k)
