"""How the arrays of many trials lie in memory while something is computed of them."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.numerics.arrays import Array


def unflattened(values: Array, shape: tuple[int, ...], *, trials: bool) -> Array:
    """A flattened array in its shape.

    Args:
        values: from a port or a state.
        shape: of the array.
        trials: whether its first axis is one of trials, which are neighbours in
            memory then: NumPy is slow along axes as short as those of a state, and
            what is computed of the array lies as it does.
    """
    array = values.reshape(shape)
    return np.asfortranarray(array) if trials else array
