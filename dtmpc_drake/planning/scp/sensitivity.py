"""How the tube along each piece answers to the decisions.

The exact tube is a nonlinear function of reference and bandwidth.  Its first
derivative is integrated here along an iterate, all pieces at once, through the
linearised filters of `tube.filter_rates`.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.tube import filter_rates
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.differences import Differences, differences
from dtmpc_drake.planning.iterate import Iterate
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.transcription import Transcription

SMOOTH = 1.0
"""Second derivatives up to twice this are left to the next linearisation."""


def transitions(
    transcription: Transcription,
    iterate: Iterate,
    *,
    secant: float,
    kinked: Array | None = None,
) -> Array:
    """Derivatives of the tube's states along each piece.

    Args:
        transcription: of the problem.
        iterate: to linearise around.
        secant: half-width of the differences along the state.
        kinked: q coordinates of x*, flattened, in which the model has kinks;
            none if left out.

    Returns:
        ``(N, substeps + 1, S m, S m + 2 m + (n + 2) m + 2 q)`` with S states, at equal
        times from the start of each piece to its end: the columns are the states at
        the start, α at both ends, the spline coefficients that act on the piece, and
        how far the kinked coordinates have moved at both ends.
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
    by_alpha, by_tube = _axis_by_axis(p, alpha, states)
    if not p.model.error_bound_varies:
        # The axes do not see each other, nor the reference.
        weights = np.concatenate([1 - weight, weight], axis=-1)[..., None, :]
        inputs = by_alpha[index][..., None] * weights
        each = _propagate(by_tube[index], inputs, h, tr.is_stiff)
        width = (S + 2) * m + (tr.degree + 1) * m
        result = np.zeros((*each.shape[:2], S, m, width))
        axes = np.arange(m)
        for column in range(S + 2):
            by_axis = each[..., column].swapaxes(2, 3)
            result[:, :, :, axes, column * m + axes] = by_axis
        return result.reshape(*each.shape[:2], S * m, -1)

    if kinked is None:
        kinked = np.zeros(0, dtype=int)
    error = _by_model_error(tr, reference, states, secant)
    by_alpha, by_tube = _all_axes(by_alpha[..., None]), _all_axes(by_tube)
    by_tube = by_tube + error.slope[:, :, n * m :] @ np.concatenate(tr.state_bounds)
    by_alpha, by_tube = by_alpha[index], by_tube[index]
    by_state = error.slope[index, :, : n * m]
    # More forcing only makes the tube larger, so the kink may be left to be chosen.
    second = kinks(error.second[index][..., kinked], secant)
    # Columns of the input: α interpolated, the state through its spline.
    basis = tr.splines.values(local_time)[:, :n].swapaxes(0, 1)
    by_state = by_state.reshape(N, points + 1, S * m, n, m)
    if tr.chains.are_alike:
        by_coefficient = np.einsum("jtskm,ktc->jtscm", by_state, basis[..., 0])
    else:
        by_coefficient = np.einsum("jtskm,ktcm->jtscm", by_state, basis)
    inputs = np.concatenate(
        [
            by_alpha * (1 - weight),
            by_alpha * weight,
            by_coefficient.reshape(N, points + 1, S * m, -1),
            second * (1 - weight),
            second * weight,
        ],
        axis=-1,
    )
    return _propagate(by_tube, inputs, h, tr.is_stiff)


def _propagate(by_state: Array, inputs: Array, step: float, stiff: bool) -> Array:
    """Integrates dX/dt = A X + [0 B] from X = [I 0], fourth order in the step.

    Args:
        by_state: A at both ends and in the middle of every step,
            ``(N, 2 steps + 1, ..., S, S)``.
        inputs: B, ``(N, 2 steps + 1, ..., S, q)``.
        step: in s.
        stiff: whether some filter is faster than a step.

    Returns:
        X at the ends of all steps and at the start, ``(N, steps + 1, ..., S, S + q)``.
    """
    size = by_state.shape[-1]
    B = np.concatenate([np.zeros_like(by_state), inputs], axis=-1)
    X = np.zeros_like(B[:, 0])
    X[..., :size] = np.eye(size)
    found, advance = [X], _lobatto if stiff else _runge_kutta
    for i in range(0, by_state.shape[1] - 1, 2):
        three = range(i, i + 3)
        X = advance([by_state[:, j] for j in three], [B[:, j] for j in three], X, step)
        found.append(X)
    return np.stack(found, axis=1)


def _runge_kutta(A: list[Array], B: list[Array], X: Array, step: float) -> Array:
    """One explicit step; A and B are given at its start, middle and end."""
    k1 = A[0] @ X + B[0]
    k2 = A[1] @ (X + step / 2 * k1) + B[1]
    k3 = A[1] @ (X + step / 2 * k2) + B[1]
    k4 = A[2] @ (X + step * k3) + B[2]
    return X + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _lobatto(A: list[Array], B: list[Array], X: Array, step: float) -> Array:
    """One step of Lobatto IIIC, which forgets what a fast filter forgets.

    Its three stages are at the same times (Hairer and Wanner, Solving Ordinary
    Differential Equations II, 1996, table IV.5.9).
    """
    size = X.shape[-2]
    weights = np.array([[2, -4, 2], [2, 5, -1], [2, 8, 2]]) / 12
    blocks = [[-step * w * A[i] for w in row] for i, row in enumerate(weights)]
    system = np.eye(3 * size) + np.concatenate(
        [np.concatenate(row, axis=-1) for row in blocks], axis=-2
    )
    right = np.concatenate([a @ X + b for a, b in zip(A, B, strict=True)], axis=-2)
    stages = np.linalg.solve(system, right)
    k1, k2, k3 = (stages[..., i * size : (i + 1) * size, :] for i in range(3))
    return X + step / 6 * (k1 + 4 * k2 + k3)


def kinks(second: Array, secant: Array | float) -> Array:
    """Second differences that are kinks: upwards, and more than smooth ones."""
    return np.where(second > SMOOTH * secant, second, 0.0)


def _axis_by_axis(p: Problem, alpha: Array, states: Array) -> tuple[Array, Array]:
    """Every rate by its own axis' bandwidth and states, but for the model error.

    Without it the rates are linear in the states, and their matrices affine in α.

    Returns:
        By the bandwidth, ``(count, m, S)``, and by the states,
        ``(count, m, S, S)``.
    """
    _, S, m = states.shape
    n, chains = p.law.order, p.law.chains
    nothing = IntegratorChain(orders=list(chains.orders), error_bound=0.0)
    unit = np.concatenate([np.zeros((1, S, m)), np.eye(S)[..., None].repeat(m, 2)])
    rates = filter_rates(
        dataclasses.replace(p.law, model=nothing),
        reference=np.zeros((2, S + 1, n, m)),
        bandwidth=np.stack([np.zeros((S + 1, m)), np.ones((S + 1, m))]),
        states=np.stack([unit, unit]),
    )
    # Without bandwidth and with one of 1 rad/s: (m, S rates, S states).
    still, moving = (rates[:, 1:] - rates[:, :1]).transpose(0, 3, 2, 1)
    by_bandwidth = moving - still
    by_tube = still + alpha[:, :, None, None] * by_bandwidth
    return np.einsum("mrs,csm->cmr", by_bandwidth, states), by_tube


def _all_axes(by_axis: Array) -> Array:
    """Matrices of axes side by side, ``(count, m, r, c)`` to ``(count, r m, c m)``."""
    count, m, rows, columns = by_axis.shape
    result = np.zeros((count, rows, m, columns, m))
    axes = np.arange(m)
    result[:, :, axes, :, axes] = by_axis.swapaxes(0, 1)
    return result.reshape(count, rows * m, columns * m)


def _by_model_error(
    tr: Transcription, reference: Array, states: Array, secant: float
) -> Differences:
    """The rates' part that is made of Δ and Δ̄: by x* and by R_0 ... R_(n-1).

    dΦ/dt has Δ(x*) in it, and dW/dt has 2 Δ̄ - Δ(x*).
    """
    model, (count, S, m) = tr.problem.model, states.shape
    n = tr.order
    flat = states.reshape(count, S * m)
    bounds = np.stack([flat @ bound.T for bound in tr.state_bounds], axis=1)

    def rates(x: Array, radius: Array) -> Array:
        own = model.model_error_bound(x)
        rows = [np.zeros((*own.shape[:-1], (n - 1) * m)), own]
        if tr.has_velocity_state:
            rows.append(2 * model.model_error_bound_over(x, radius) - own)
        return np.concatenate(rows, axis=-1)

    return differences(rates, reference, bounds, secant)
