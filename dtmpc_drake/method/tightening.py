"""Constraint tightening (the paper's corollaries 1 and 2, Theorem 2).

Everything here is a function of one instant, batched over leading axes and
generic in the scalar: the certificate evaluates it along a plan, both backends
differentiate it numerically.

`reference_radius` (0 at one instant) makes each of them hold for a whole box of
references, which is how the certificate covers the time between samples.
"""

from __future__ import annotations

import numpy as np

from dtmpc_drake.method.sliding import surface_coefficients
from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array, euclidean_norm, magnitude


def feedback_bound(
    *,
    model: Model,
    reference: Array,
    error_bound: Array,
    gain: Array,
    slope: Array,
    reference_radius: Array | float = 0.0,
    gain_radius: Array | float = 0.0,
) -> Array:
    """ū_fb, the bound of ``|B u - y*^(n)|``  (Theorem 2).

    ū_fb = |F̂|_bound + Σ_{k=1}^{n-1} C(n-1,k-1) λ^(n-k) R_k + |K|_bound

    with K(x) = κ + Δ(x) - Δ(x*).  The paper takes κ + (Δ̄ - Δ(x*)) for the last
    term; that is too little where K is negative, which a fast growing layer can
    make it where Δ(x) < Δ(x*).

    Args:
        model: gives F̂ and Δ over a box.
        reference: x*, ``(..., n, m)``.
        error_bound: R_k, ``(..., n, m)``.
        gain: κ = αΦ, ``(..., m)``.
        slope: λ, ``(m,)``.
        reference_radius: of the box around `reference` that holds x*, ``(..., n, m)``.
        gain_radius: how far κ - Δ(x*) may be from its value here, ``(..., m)``.

    Returns:
        Shape ``(..., m)``, in output unit / s^n.
    """
    c = surface_coefficients(slope, model.order)
    damping = (c[:-1] * error_bound[..., 1:, :]).sum(axis=-2)
    box = error_bound + reference_radius
    largest = model.model_error_bound_over(reference, box)
    # 0 <= Δ(x) <= Δ̄, so |K| is at most the larger of κ + Δ̄ - Δ(x*) and
    # Δ(x*) - κ, written without a maximum.
    excess = gain - model.model_error_bound(reference)
    switching = largest / 2 + magnitude(excess + largest / 2) + gain_radius
    return np.asarray(model.drift_bound_over(reference, box) + damping + switching)


def input_bound(
    *,
    model: Model,
    reference: Array,
    highest: Array,
    error_bound: Array,
    gain: Array,
    slope: Array,
    reference_radius: Array | float = 0.0,
    gain_radius: Array | float = 0.0,
) -> Array:
    """A bound of ``‖u‖`` anywhere in the tube  (corollary 2).

    ``‖B⁻¹(x*) y*^(n)‖ + ‖δ |y*^(n)| + (|B⁻¹(x*)| + δ) ū_fb‖`` with δ the bound of
    how much B⁻¹ changes over the tube; the paper's when B is constant.

    Args:
        model: gives B⁻¹, F̂ and Δ over a box.
        reference: x*, ``(..., n, m)``.
        highest: y*^(n), ``(..., m)``.
        error_bound: R_k, ``(..., n, m)``.
        gain: κ = αΦ, ``(..., m)``.
        slope: λ, ``(m,)``.
        reference_radius: see `feedback_bound`.
        gain_radius: see `feedback_bound`.

    Returns:
        Shape ``(...)``, in the unit of the input.
    """
    feedback = feedback_bound(
        model=model,
        reference=reference,
        error_bound=error_bound,
        gain=gain,
        slope=slope,
        reference_radius=reference_radius,
        gain_radius=gain_radius,
    )
    if model.input_is_identity:
        return euclidean_norm(highest) + euclidean_norm(feedback)
    inverse = model.inverse_input_matrix(reference)
    deviation = model.inverse_input_deviation(reference, error_bound + reference_radius)
    nominal = (inverse * highest[..., None, :]).sum(axis=-1)
    worst = (
        deviation * magnitude(highest)[..., None, :]
        + (np.abs(inverse) + deviation) * feedback[..., None, :]
    )
    return euclidean_norm(nominal) + euclidean_norm(worst.sum(axis=-1))


def rate_bound(
    *,
    model: Model,
    reference: Array,
    error_bound: Array,
    gain: Array,
    disturbance_bound: Array,
    reference_radius: Array | float = 0.0,
    gain_radius: Array | float = 0.0,
) -> Array:
    """The bound of ``|dỹ/dt|`` that tightens the speed limit (corollary 1).

    For n >= 2 it is the velocity tube.  For n = 1 the velocity is the highest
    derivative: ``dỹ/dt = f̃ + d - K sat(s/Φ)``.

    Returns:
        Shape ``(..., m)``.
    """
    if model.order > 1:
        return np.asarray(error_bound[..., 1, :])
    largest = model.model_error_bound_over(reference, error_bound + reference_radius)
    excess = largest - model.model_error_bound(reference) + gain_radius
    return np.asarray(disturbance_bound + largest + gain + excess)
