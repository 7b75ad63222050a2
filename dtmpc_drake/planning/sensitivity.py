"""How the tube at the end of each piece answers to the decisions.

The exact tube is a nonlinear function of reference and bandwidth.  Its first
derivative is integrated here along an iterate, all pieces at once, through the
linearised filters of `tube.filter_rates`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dtmpc_drake.models import Array, bends, jacobian
from dtmpc_drake.planning import splines
from dtmpc_drake.planning.transcription import Iterate, Transcription

SMOOTH = 1.0
"""Second derivatives up to twice this are left to the next linearisation."""


def transitions(
    transcription: Transcription,
    iterate: Iterate,
    *,
    secant: float,
    kinked: Array | None = None,
) -> Array:
    """Derivatives of the tube's states at the end of each piece.

    Args:
        transcription: of the problem.
        iterate: to linearise around.
        secant: half-width of the differences along the state.
        kinked: q coordinates of x*, flattened, in which the model has kinks;
            none if left out.

    Returns:
        ``(N, S m, S m + 2 m + (n + 2) m + 2 q)`` with S states: the columns are
        the states at the start, α at both ends, the spline coefficients that act
        on the piece, and how far the kinked coordinates have moved at both ends.
    """
    tr, p = transcription, transcription.problem
    n, m, N = tr.order, tr.outputs, tr.intervals
    points = 2 * tr.substeps
    stride = tr.tube_steps // points
    local_time = np.arange(points + 1) / points

    states = tr.tube_states(iterate, stride)
    S = states.shape[1]
    reference = iterate.reference[:: 2 * stride, :n]
    grid = np.arange(N * points + 1) / points
    alpha = np.stack(
        [np.interp(grid, np.arange(N + 1), a) for a in iterate.bandwidth.T], axis=-1
    )

    index = np.arange(N)[:, None] * points + np.arange(points + 1)
    weight = local_time[:, None, None]
    h = tr.step / tr.substeps
    width = S * m + 2 * m
    if not p.model.error_bound_varies:
        # The axes do not see each other, nor the reference.
        by_alpha, by_tube = _axis_by_axis(tr.tube_rates, reference, alpha, states)
        by_alpha, by_tube = by_alpha[index], by_tube[index]
        weights = np.concatenate([1 - weight, weight], axis=-1)[..., None, :]
        each = _propagate(by_tube, by_alpha[..., None] * weights, h)
        result = np.zeros((N, S, m, width + (tr.degree + 1) * m))
        axes = np.arange(m)
        for column in range(S + 2):
            result[:, :, axes, column * m + axes] = each[..., column].swapaxes(1, 2)
        return result.reshape(N, S * m, -1)

    if kinked is None:
        kinked = np.zeros(0, dtype=int)
    derivative, bend = _all_pairs(
        tr.tube_rates, reference, alpha, states, secant, kinked
    )
    derivative, bend = derivative[index], bend[index]
    by_state, by_alpha, by_tube = np.split(derivative, [n * m, n * m + m], axis=-1)
    # Columns of the input: α interpolated, the state through its spline.
    basis = np.stack(
        [splines.basis(tr.degree, k, local_time, tr.step) for k in range(n)]
    )
    by_coefficient = np.einsum(
        "jtskm,ktc->jtscm", by_state.reshape(N, points + 1, S * m, n, m), basis
    )
    inputs = np.concatenate(
        [
            by_alpha * (1 - weight),
            by_alpha * weight,
            by_coefficient.reshape(N, points + 1, S * m, -1),
            bend * (1 - weight),
            bend * weight,
        ],
        axis=-1,
    )
    return _propagate(by_tube, inputs, h)


def _propagate(by_state: Array, inputs: Array, step: float) -> Array:
    """Integrates dX/dt = A X + [0 B] from X = [I 0] by Runge-Kutta.

    Args:
        by_state: A at both ends and in the middle of every step,
            ``(N, 2 steps + 1, ..., S, S)``.
        inputs: B, ``(N, 2 steps + 1, ..., S, q)``.
        step: in s.

    Returns:
        X at the end, ``(N, ..., S, S + q)``.
    """
    size = by_state.shape[-1]
    B = np.concatenate([np.zeros_like(by_state), inputs], axis=-1)
    X = np.zeros_like(B[:, 0])
    X[..., :size] = np.eye(size)
    for i in range(0, by_state.shape[1] - 1, 2):
        start, middle, end = (by_state[:, i + j] for j in range(3))
        k1 = start @ X + B[:, i]
        k2 = middle @ (X + step / 2 * k1) + B[:, i + 1]
        k3 = middle @ (X + step / 2 * k2) + B[:, i + 1]
        k4 = end @ (X + step * k3) + B[:, i + 2]
        X = X + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.asarray(X)


def _all_pairs(
    rates: Callable[[Array, Array, Array], Array],
    reference: Array,
    alpha: Array,
    states: Array,
    secant: float,
    kinked: Array,
) -> tuple[Array, Array]:
    """Every rate by every reference state, bandwidth and tube state.

    And how much it bends upwards in the kinked coordinates.
    """
    count, S, m = states.shape
    split = reference[0].size

    def flat_rates(flat: Array) -> Array:
        lead = flat.shape[:-1]
        value = rates(
            flat[..., :split].reshape(*lead, -1, m),
            flat[..., split : split + m],
            flat[..., split + m :].reshape(*lead, S, m),
        )
        return value.reshape(*lead, S * m)

    flat = np.concatenate(
        [reference.reshape(count, -1), alpha, states.reshape(count, -1)], axis=1
    )
    step = np.full(flat.shape[1], 1e-6)
    step[:split] = secant
    # More forcing only makes the tube larger, so the bend may be left to be chosen.
    bend = kinks(bends(flat_rates, flat, step, kinked), secant)
    return jacobian(flat_rates, flat, step), bend


def kinks(bend: Array, secant: Array | float) -> Array:
    """Bends that are kinks: upwards, and more than a smooth function has."""
    return np.asarray(np.where(bend > SMOOTH * secant, bend, 0.0))


def _axis_by_axis(
    rates: Callable[[Array, Array, Array], Array],
    reference: Array,
    alpha: Array,
    states: Array,
) -> tuple[Array, Array]:
    """Every rate by its own axis' bandwidth and states, where Δ is constant.

    Returns:
        By the bandwidth, ``(count, m, S)``, and by the states,
        ``(count, m, S, S)``.
    """
    count, S, m = states.shape

    def moved(offsets: Array) -> Array:
        value = rates(
            reference, alpha + offsets[..., :1], states + offsets[..., 1:, None]
        )
        return value.reshape(*value.shape[:-2], S * m)

    slopes = jacobian(moved, np.zeros((count, 1 + S))).reshape(count, S, m, 1 + S)
    slopes = slopes.swapaxes(1, 2)
    return slopes[..., 0], slopes[..., 1:]
