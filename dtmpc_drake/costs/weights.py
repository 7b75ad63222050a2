"""Weights of squares: a number, a list or a matrix.

A number weighs all entries of a vector alike, a list each by its own, and a matrix Q
makes it x'Qx.  They are kept as they are given: what is weighed by a number needs no
product with a matrix.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dtmpc_drake.checks import require_magnitude, require_not_negative
from dtmpc_drake.errors import ScenarioError, require
from dtmpc_drake.numerics.arrays import Array

Weight = float | list[float] | list[list[float]]
"""In a scenario: a number (times the identity), the diagonal, or the whole matrix."""

TOLERANCE = 1e-9
"""Of symmetry and of negative eigenvalues, relative to the largest entry."""


def require_weight(field: str, weight: Weight, size: int) -> None:
    """Requires a symmetric positive semi-definite weight of a vector.

    Args:
        field: for errors.
        weight: a number, a list or a matrix.
        size: of the vector.

    Raises:
        ScenarioError: that names the field, or an entry of it.
    """
    given: Any = weight.tolist() if isinstance(weight, np.ndarray) else weight
    if not isinstance(given, (list, tuple)):
        require_not_negative(field, given, "")
        return
    rows = [row for row in given if isinstance(row, (list, tuple))]
    whole = len(given) == size and all(len(row) == size for row in rows)
    allowed = f"{size} numbers, or {size} rows of a matrix with {size} numbers each"
    require(field, given, whole, f"one number, {allowed}")
    if not rows:
        for i, value in enumerate(given):
            require_not_negative(f"{field}[{i}]", float(value), "")
        return
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            require_magnitude(f"{field}[{i}][{j}]", value, "")
    matrix = np.array(rows, dtype=float)
    rounding = TOLERANCE * float(np.abs(matrix).max())
    for i, j in np.argwhere(np.abs(matrix - matrix.T) > rounding)[:1]:
        why = f"{matrix[j, i]:g} as in {field}[{j}][{i}]: the matrix is symmetric"
        raise ScenarioError(f"{field}[{i}][{j}]", float(matrix[i, j]), why)
    least = float(np.linalg.eigvalsh(matrix)[0])
    why = f"positive semi-definite: its smallest eigenvalue is {least:.4g}"
    require(field, given, least >= -rounding, why)


def is_nothing(weight: Weight | Array) -> bool:
    """Whether it weighs nothing."""
    return not np.any(weight)


def matrix_of(weight: Weight | Array, size: int) -> Array:
    """The whole matrix Q, ``(size, size)``."""
    given = np.asarray(weight, dtype=float)
    return given if given.ndim == 2 else given * np.eye(size)


def root_of(weight: Weight | Array) -> Array:
    """The symmetric root of Q, as a number, a diagonal or a matrix."""
    given = np.asarray(weight, dtype=float)
    if given.ndim < 2:
        return np.asarray(np.sqrt(given))
    values, vectors = np.linalg.eigh(given)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def rooted(root: Array, vector: Array) -> Array:
    """Q^½ x, whose square is x'Qx; both ``(..., m)``."""
    return vector @ root if root.ndim == 2 else root * vector


def rooted_rows(root: Array, rows: Array) -> Array:
    """The same of the derivatives of x, ``(..., m, c)``."""
    if root.ndim == 2:
        return np.asarray(root @ rows)
    return rows * (root[:, None] if root.ndim else root)


def square(weight: Weight | Array, vector: Array) -> Array:
    """x'Qx, of ``(..., m)``."""
    given = np.asarray(weight, dtype=float)
    if given.ndim == 0:
        return np.asarray(given * (vector**2).sum(axis=-1))
    if given.ndim == 1:
        return np.asarray(vector**2 @ given)
    return np.asarray(((vector @ given) * vector).sum(axis=-1))
