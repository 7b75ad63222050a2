"""Arrays, norms with derivatives, and differences of batched functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
"""Floats in the planner, and AutoDiffXd or Expression in the systems."""
FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int_]

_SMOOTHING = 1e-9
"""Below this speed a norm is rounded off, so that it has a derivative at rest."""


def magnitude(v: Array) -> Array:
    """A differentiable upper bound of abs(v), at most 1e-9 too large."""
    return np.sqrt(v * v + _SMOOTHING**2)


def euclidean_norm(v: Array) -> Array:
    """A differentiable upper bound of the 2-norm over the last axis.

    Args:
        v: shape ``(..., m)``.

    Returns:
        Shape ``(...)``; at most 1e-9 too large.
    """
    if v.strides[-1] != v.itemsize:  # the same order of additions in any memory order
        v = np.ascontiguousarray(v)
    squared = np.einsum("...i,...i", v, v) + _SMOOTHING**2
    return np.asarray(np.sqrt(squared))  # of one vector of Drake's scalars, too


def jacobian(
    function: Callable[[Array], Array], point: Array, step: Array | float = 1e-6
) -> Array:
    """The derivative of a batched function by central differences.

    All perturbed points are evaluated in one batched call.

    Args:
        function: maps ``(..., p)`` to ``(..., r)``, each batch entry alone.
        point: shape ``(K, p)``.
        step: of the differences, broadcast to ``(K, p)``.  A large one is a
            secant: it sees a kink (such as that of a speed's magnitude) before
            it is reached.

    Returns:
        Shape ``(K, r, p)``.
    """
    step = np.broadcast_to(step, point.shape)
    ahead, behind = _perturbed(function, point, step, np.arange(point.shape[1]))
    return np.moveaxis((ahead - behind) / (2 * step.T[:, :, None]), 0, -1)


def second_differences(
    function: Callable[[Array], Array],
    point: Array,
    step: Array | float,
    coordinates: Array,
) -> Array:
    """How much steeper a batched function is ahead of a point than behind, halved.

    With the slope of `jacobian`, ``slope dx + second |dx|`` agrees with the function at
    both ends of the step; at a kink it is the function.

    Args:
        function: as for `jacobian`.
        point: shape ``(K, p)``.
        step: broadcast to ``(K, p)``.
        coordinates: indices of the q coordinates that are moved.

    Returns:
        Shape ``(K, r, q)``.
    """
    middle = function(point)
    if not len(coordinates):
        return np.zeros((*middle.shape, 0))
    step = np.broadcast_to(step, point.shape)
    ahead, behind = _perturbed(function, point, step, coordinates)
    change = ahead + behind - 2 * middle
    width = step.T[coordinates][:, :, None]
    return np.moveaxis(change / (2 * width), 0, -1)


def _perturbed(
    function: Callable[[Array], Array], point: Array, step: Array, coordinates: Array
) -> tuple[Array, Array]:
    """The function a step ahead and behind along each coordinate, ``(q, K, r)``."""
    offsets = np.eye(point.shape[1])[coordinates, None, :] * step
    values = function(np.concatenate([point + offsets, point - offsets]))
    return values[: len(coordinates)], values[len(coordinates) :]
