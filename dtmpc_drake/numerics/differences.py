"""Central differences of functions of a state and a box, along what they see."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from dtmpc_drake.numerics.arrays import Array

TINY = 1e-6
"""Half-width of the differences along bounds."""


@dataclasses.dataclass(frozen=True, eq=False)
class Differences:
    """A function of a state and a box around it, and its slopes, at K instants.

    Attributes:
        value: ``(K, r)``.
        slope: by the state and then by the box's radius, ``(K, r, 2 n m)``.
        second: second differences over twice the width, by the state, ``(K, r, n m)``:
            ``slope dx + second |dx|`` agrees with the function at both ends.
    """

    value: Array
    slope: Array
    second: Array


def differences(
    function: Callable[[Array, Array], Array],
    state: Array,
    radius: Array,
    secant: float,
) -> Differences:
    """Central differences, only along the derivatives that the function looks at.

    Args:
        function: of ``(..., n, m)`` and ``(..., n, m)`` to ``(..., r)``, each batch
            entry alone.
        state: ``(K, n, m)``.
        radius: ``(K, n, m)``.
        secant: half-width of the differences along the state, in its units.
    """
    K, n, m = state.shape
    flat = np.concatenate([state, radius], axis=1)
    size = np.repeat([secant, TINY], n)

    def at(rows: Array) -> Array:
        return function(rows[..., :n, :], rows[..., n:, :])

    # All axes of a row at once show whether anything depends on it; not by the same,
    # which what depends on a difference of two of them would not see.
    each = 1 + np.sin(1 + np.arange(m)) / 4
    moves = (np.eye(2 * n) * size)[:, None, :, None] * each
    moved = at(np.concatenate([flat[None], flat + moves]))
    value = moved[0]
    seen = np.flatnonzero((moved[1:] != value).any(axis=(1, 2)))
    slope = np.zeros((K, value.shape[1], 2 * n, m))
    second = np.zeros_like(slope)
    if len(seen):
        moves = np.zeros((len(seen), m, 1, 2 * n, m))
        for i, row in enumerate(seen):
            moves[i, :, 0, row] = size[row] * np.eye(m)
        ahead, behind = at(np.stack([flat + moves, flat - moves]))
        width = 2 * size[seen, None, None, None]
        # (rows seen, m, K, r) to (K, r, rows seen, m)
        slope[:, :, seen] = ((ahead - behind) / width).transpose(2, 3, 0, 1)
        second[:, :, seen] = ((ahead + behind - 2 * value) / width).transpose(
            2, 3, 0, 1
        )
    shape = (K, value.shape[1], -1)
    return Differences(value, slope.reshape(shape), second[:, :, :n].reshape(shape))


class Parts:
    """Several functions of K boxes around states, each with its slope.

    They are evaluated together, at the same places.

    Args:
        functions: by name, each as for `differences` but with any shape of values.
        state: ``(K, n, m)``.
        radius: ``(K, n, m)``.
        secant: half-width of the differences along the state, in its units.
    """

    def __init__(
        self,
        functions: dict[str, Callable[[Array, Array], Array]],
        state: Array,
        radius: Array,
        secant: float,
    ) -> None:
        one = {
            name: function(state[:1], radius[:1])[0]
            for name, function in functions.items()
        }
        self._shape = {name: value.shape for name, value in one.items()}
        ends = np.cumsum([value.size for value in one.values()])
        self._where = {
            name: slice(end - value.size, end)
            for (name, value), end in zip(one.items(), ends, strict=True)
        }

        def flat(state: Array, radius: Array) -> Array:
            lead = state.shape[:-2]
            values = [function(state, radius) for function in functions.values()]
            return np.concatenate([v.reshape(*lead, -1) for v in values], axis=-1)

        self._found = differences(flat, state, radius, secant)

    def __getitem__(self, name: str) -> tuple[Array, Array]:
        """Value ``(K, ...)`` and slope ``(K, ..., 2 n m)``."""
        where, shape = self._where[name], self._shape[name]
        value, slope = self._found.value[:, where], self._found.slope[:, where]
        K = len(value)
        return value.reshape(K, *shape), slope.reshape(K, *shape, slope.shape[-1])
