"""First-order linear filters, integrated with no loop over time.

A trajectory is sampled on a *half grid*: M equal steps give the nodes 0, 2, ..., 2M
and the midpoints between them.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtbtrs

from dtmpc_drake.numerics.arrays import Array


def linear_recurrence(gain: Array, offset: Array, initial: Array) -> Array:
    """Solves x[i + 1] = gain[i] x[i] + offset[i].

    Args:
        gain: shape ``(M, ...)``.
        offset: shape ``(M, ...)``.
        initial: x[0], shape ``(...)``.

    Returns:
        Shape ``(M + 1, ...)``.
    """
    # All columns side by side are one triangular system with two diagonals.
    columns = int(np.prod(gain.shape[1:]))
    right = np.empty((len(gain) + 1, columns))
    right[0], right[1:] = np.ravel(initial), offset.reshape(len(gain), columns)
    band = np.zeros((columns + 1, right.size), order="F")
    band[-1, : right.size - columns] = -gain.ravel()
    x, _ = dtbtrs(band, right.reshape(-1, 1), uplo="L", diag="U", overwrite_b=1)
    return x.reshape(len(gain) + 1, *gain.shape[1:])


def integrate_filter(
    rate: Array, forcing: Array, initial: Array, step: float
) -> tuple[Array, Array]:
    """Integrates dx/dt = -rate(t) x + forcing(t), fourth order in the step.

    Args:
        rate: on the half grid, ``(2 M + 1, ...)``, in 1/s.
        forcing: on the half grid, same shape.
        initial: x at the first node, shape ``(...)``.
        step: between two nodes, in s.

    Returns:
        x and dx/dt at the nodes, both ``(M + 1, ...)``.
    """
    start, middle, end = rate[:-2:2], rate[1::2], rate[2::2]
    to_end = np.exp(-step / 6 * (start + 4 * middle + end))
    from_middle = np.exp(-step / 24 * (8 * middle + 5 * end - start))
    increment = (
        step
        / 6
        * (to_end * forcing[:-2:2] + 4 * from_middle * forcing[1::2] + forcing[2::2])
    )
    x = linear_recurrence(to_end, increment, initial)
    return x, forcing[::2] - rate[::2] * x


def half_grid(value: Array, rate: Array, step: float) -> Array:
    """Node values and rates to the half grid, by cubic Hermite midpoints."""
    result = np.empty((2 * len(value) - 1, *value.shape[1:]))
    result[::2] = value
    result[1::2] = (value[:-1] + value[1:]) / 2 + step / 8 * (rate[:-1] - rate[1:])
    return result
