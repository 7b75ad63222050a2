"""How the arrays of many trials lie in memory while something is computed of them."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.method.chains import Chains
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


def unpacked(
    values: Array, chains: Chains, lead: tuple[int, ...], *, trials: bool
) -> Array:
    """A state port's numbers as states, ``(*lead, n, m)``; see `unflattened`.

    Args:
        values: from a port or a state, as `Chains.pack` makes them.
        chains: the orders of the outputs.
        lead: the shape of what is side by side.
        trials: as for `unflattened`.
    """
    state = chains.unpack(values.reshape(*lead, chains.size))
    return np.asfortranarray(state) if trials else state
