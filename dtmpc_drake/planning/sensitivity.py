"""How the tube at the end of each piece answers to the decisions.

The exact tube is a nonlinear function of reference and bandwidth.  Its first
derivative is integrated here along an iterate, all pieces at once, through the
linearised filters of `tube.filter_rates`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dtmpc_drake.models import Array, jacobian
from dtmpc_drake.planning import splines
from dtmpc_drake.planning.transcription import TUBE_STEPS, Iterate, Transcription
from dtmpc_drake.tube import filter_rates


def transitions(
    transcription: Transcription, iterate: Iterate, *, secant: float
) -> Array:
    """Derivatives of the tube's states at the end of each piece.

    Args:
        transcription: of the problem.
        iterate: to linearise around.
        secant: half-width of the differences along the state.

    Returns:
        ``(N, S m, S m + 2 m + (n + 2) m)`` with S states: the columns are the
        states at the start, α at both ends, and the spline coefficients that
        act on the piece.
    """
    tr, p = transcription, transcription.problem
    n, m, N = tr.order, tr.outputs, tr.intervals
    # Runge-Kutta steps of about the fastest filter's time constant.
    fastest = float((p.bandwidth_max + n * p.slope).max()) * tr.step
    substeps = 2 if fastest < 2 else 4 if fastest < 4 else 8
    points = 2 * substeps
    stride = TUBE_STEPS // points
    local_time = np.arange(points + 1) / points

    tube = iterate.tube
    rows = [tube.stages]
    if tr.has_velocity_state:
        rows.append(tube.error_bound[:, -1:])
    states = np.concatenate(rows, axis=1)[::stride]
    S = states.shape[1]
    reference = iterate.reference[:: 2 * stride, :n]
    grid = np.arange(N * points + 1) / points
    alpha = np.stack(
        [np.interp(grid, np.arange(N + 1), a) for a in iterate.bandwidth.T], axis=-1
    )

    def rates(reference: Array, bandwidth: Array, states: Array) -> Array:
        return filter_rates(
            model=p.model,
            reference=reference,
            bandwidth=bandwidth,
            states=states,
            slope=p.slope,
            disturbance_bound=p.disturbance_bound,
            reaching_rate=p.reaching_rate,
        )

    if p.model.error_bound_varies:
        derivative = _all_pairs(rates, reference, alpha, states, secant)
    else:
        derivative = _axis_by_axis(rates, reference, alpha, states)
    index = np.arange(N)[:, None] * points + np.arange(points + 1)
    by_state, by_alpha, by_tube = np.split(
        derivative[index], [n * m, n * m + m], axis=-1
    )

    # Columns of the input: α interpolated, the state through its spline.
    weight = local_time[:, None, None]
    basis = np.stack(
        [splines.basis(tr.degree, k, local_time, tr.step) for k in range(n)]
    )
    by_coefficient = np.einsum(
        "jtskm,ktc->jtscm", by_state.reshape(N, points + 1, S * m, n, m), basis
    )
    inputs = np.concatenate(
        [
            np.zeros((N, points + 1, S * m, S * m)),
            by_alpha * (1 - weight),
            by_alpha * weight,
            by_coefficient.reshape(N, points + 1, S * m, -1),
        ],
        axis=-1,
    )
    h = tr.step / substeps
    result = np.zeros((N, S * m, inputs.shape[-1]))
    result[:, :, : S * m] = np.eye(S * m)
    for i in range(0, points, 2):
        A, B = by_tube[:, i : i + 3], inputs[:, i : i + 3]
        k1 = A[:, 0] @ result + B[:, 0]
        k2 = A[:, 1] @ (result + h / 2 * k1) + B[:, 1]
        k3 = A[:, 1] @ (result + h / 2 * k2) + B[:, 1]
        k4 = A[:, 2] @ (result + h * k3) + B[:, 2]
        result = result + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.asarray(result)


def _all_pairs(
    rates: Callable[[Array, Array, Array], Array],
    reference: Array,
    alpha: Array,
    states: Array,
    secant: float,
) -> Array:
    """Every rate by every reference state, bandwidth and tube state."""
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
    return jacobian(flat_rates, flat, step)


def _axis_by_axis(
    rates: Callable[[Array, Array, Array], Array],
    reference: Array,
    alpha: Array,
    states: Array,
) -> Array:
    """The same where Δ is constant: the axes do not see each other."""
    count, S, m = states.shape
    split = reference[0].size

    def moved(offsets: Array) -> Array:
        value = rates(
            reference,
            alpha + offsets[..., :1],
            states + offsets[..., 1:, None],
        )
        return value.reshape(*value.shape[:-2], S * m)

    slopes = jacobian(moved, np.zeros((count, 1 + S))).reshape(count, S, m, 1 + S)
    result = np.zeros((count, S, m, split // m + 1 + S, m))
    axes = np.arange(m)
    result[:, :, axes, split // m :, axes] = np.moveaxis(slopes, 2, 0)
    return result.reshape(count, S * m, -1)
