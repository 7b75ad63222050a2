"""Unit normals: which part best, how they turn, and the nearest point of a box."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.numerics.arrays import Array, FloatArray

_SWEEPS = 20
"""At most, of the search for the nearest point of a box."""


def separating_normals(hull: Array, size: Array) -> Array:
    """The half-planes that best part the origin from a hull of balls.

    Maximises over unit vectors ν the least of ``ν'z_i - ρ_i``.  At the optimum
    one ball is nearest, or a pair is touched together; all such candidates are
    tried.  That is exact in the plane; elsewhere any unit vector is valid.

    Args:
        hull: centres z_i, ``(P, c, rows)``.
        size: radii ρ_i, ``(P, c)``.

    Returns:
        ``(P, rows)``.
    """
    first, second = np.triu_indices(hull.shape[1], 1)
    edge = hull[:, second] - hull[:, first]
    length = np.maximum(np.linalg.norm(edge, axis=-1, keepdims=True), 1e-12)
    edge /= length
    sine = (size[:, second] - size[:, first])[..., None] / length
    middle = (hull[:, first] + hull[:, second]) / 2
    square = middle - (middle * edge).sum(-1, keepdims=True) * edge
    distance = np.linalg.norm(square, axis=-1, keepdims=True)
    # Through the very centre: step aside, always to the same side.
    aside = np.zeros_like(edge)
    if hull.shape[2] > 1:
        aside[..., 0], aside[..., 1] = edge[..., 1], -edge[..., 0]
    square = np.where(distance > 1e-6, square / np.maximum(distance, 1e-12), aside)
    sine = np.clip(sine, -1.0, 1.0)
    pairs = sine * edge + np.sqrt(1 - sine**2) * square
    radial = hull / np.maximum(np.linalg.norm(hull, axis=-1, keepdims=True), 1e-12)
    candidates = np.concatenate([pairs, radial], axis=1)
    margins = candidates @ hull.swapaxes(1, 2) - size[:, None]
    best = margins.min(axis=2).argmax(axis=1)
    return candidates[np.arange(len(hull)), best]


def tangent_space(normal: Array) -> Array:
    """An orthonormal basis of what is square to each unit vector.

    Args:
        normal: ``(P, rows)``.

    Returns:
        ``(P, rows - 1, rows)``.
    """
    rows = normal.shape[1]
    if rows == 2:
        return np.stack([-normal[:, 1], normal[:, 0]], axis=1)[:, None]
    # A reflection that maps the first axis to the normal.
    sign = np.where(normal[:, 0] >= 0, 1.0, -1.0)
    mirror = normal.copy()
    mirror[:, 0] += sign
    outer = mirror[:, :, None] * mirror[:, None, :]
    size = (mirror**2).sum(1)[:, None, None]
    return (np.eye(rows) - 2 * outer / size)[:, 1:]


def turned(normal: Array, rotation: Array) -> Array:
    """Unit normals ``(ν + Σ t_j τ_j) / sqrt(1 + t't)`` with tangents τ.

    Args:
        normal: ν, ``(P, rows)``.
        rotation: t, ``(P, rows - 1)``.
    """
    moved = normal + np.einsum("pt,pti->pi", rotation, tangent_space(normal))
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def nearest_of_box(offset: FloatArray, matrix: FloatArray, box: FloatArray) -> Array:
    """The shortest of ``offset + H r̃`` over ``|r̃| <= Ω``.

    One coordinate of r̃ after the other is minimised over.  One sweep is exact where
    H has orthogonal columns.

    Args:
        offset: ``(..., rows)``.
        matrix: H, ``(..., rows, m)``, to be broadcast.
        box: Ω, ``(..., m)``, to be broadcast.

    Returns:
        The same shape as `offset`.
    """
    square = np.maximum((matrix**2).sum(axis=-2), 1e-300)
    error = np.zeros((*offset.shape[:-1], matrix.shape[-1]))
    nearest = np.array(offset)
    for _ in range(_SWEEPS):
        change = 0.0
        for j in range(error.shape[-1]):
            column, limit = matrix[..., j], box[..., j]
            along = np.einsum("...i,...i->...", nearest, column) / square[..., j]
            step = np.clip(error[..., j] - along, -limit, limit) - error[..., j]
            nearest += step[..., None] * column
            error[..., j] += step
            change = max(change, np.abs(step).max(initial=0.0))
        if change < 1e-6:
            break
    return nearest
