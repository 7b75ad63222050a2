"""Outputs of different relative degree n_i (the paper's assumption 4), in dense arrays.

A state has the shape ``(..., n, m)`` with n the largest n_i; row k holds the k-th
derivatives.  Output i has rows 0 to n_i - 1, and zeros in those that do not exist.  A
*reference*, ``(..., n + 1, m)``, is such a state and, in its last row, y_i*^(n_i) of
every output: what the inputs reach.  Stages of the tube's cascade are aligned at Φ,
which is in the last row for every output.

Where all orders are the same nothing has to be moved, and nothing is: all functions
give views then.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property, lru_cache
from math import comb
from typing import TYPE_CHECKING

import numpy as np

from dtmpc_drake.numerics.arrays import Array, BoolArray

if TYPE_CHECKING:  # plans are read where Drake, which models need, is not
    from dtmpc_drake.models import Model


def surface_coefficients(slope: Array, order: int) -> Array:
    """c_k = C(n-1, k) λ^(n-1-k), so that s = Σ_k c_k ỹ^(k)  (eq. s).

    Args:
        slope: λ, shape ``(..., m)``, in 1/s.
        order: n, of all outputs.

    Returns:
        Shape ``(..., n, m)``; the last row is one.  Read-only if ``(n, m)``.
    """
    if slope.ndim == 1 and slope.dtype != object:
        return _kept_coefficients(tuple(slope.tolist()), order)
    return np.stack(
        [comb(order - 1, k) * slope ** (order - 1 - k) for k in range(order)], axis=-2
    )


@lru_cache
def _kept_coefficients(slope: tuple[float, ...], order: int) -> Array:
    """A flight asks for the same ones at every stage of every step."""
    (coefficients,) = surface_coefficients(np.array(slope)[None], order)
    coefficients.flags.writeable = False
    return np.asarray(coefficients)


@dataclasses.dataclass(frozen=True)
class Chains:
    """The orders of a plant's outputs, and how its numbers lie in arrays.

    Attributes:
        orders: n_i, each at least 1.
    """

    orders: tuple[int, ...]

    @classmethod
    def of(cls, model: Model) -> Chains:
        """Those of a model."""
        if not model.orders:
            return cls((model.order,) * model.num_outputs)
        return cls(tuple(model.orders))

    @cached_property
    def order(self) -> int:
        """n, the largest."""
        return max(self.orders)

    @property
    def num_outputs(self) -> int:
        """M, the number of outputs."""
        return len(self.orders)

    @cached_property
    def are_alike(self) -> bool:
        """Whether all outputs have the same order."""
        return min(self.orders) == self.order

    @property
    def words(self) -> str:
        """For messages, ``order 2`` or ``orders 3, 3, 2, 1``."""
        if self.are_alike:
            return f"order {self.order}"
        return "orders " + ", ".join(map(str, self.orders))

    @cached_property
    def size(self) -> int:
        """Numbers in a state, the sum of all orders."""
        return sum(self.orders)

    @cached_property
    def each(self) -> Array:
        """n_i, ``(m,)``."""
        return np.array(self.orders)

    @cached_property
    def exists(self) -> BoolArray:
        """Which rows of a state there are, ``(n, m)``."""
        return np.arange(self.order)[:, None] < self.each

    @cached_property
    def below_top(self) -> BoolArray:
        """Which rows are below the highest one of a state, ``(n, m)``."""
        return np.arange(self.order)[:, None] < self.each - 1

    def coefficients(self, slope: Array) -> Array:
        """c_k of every output's sliding surface, ``(n, m)``; zero from n_i on.

        Args:
            slope: λ, ``(m,)``.
        """
        if self.are_alike:
            return surface_coefficients(slope, self.order)
        return _mixed_coefficients(self, tuple(slope.tolist()))

    # Rows of states.

    def existing(self, rows: Array) -> Array:
        """States with zeros in all rows that do not exist, ``(..., n, m)``."""
        return rows if self.are_alike else np.where(self.exists, rows, 0.0)

    def top(self, rows: Array) -> Array:
        """The rows n_i - 1 of states, ``(..., m)``."""
        return self._row(rows, self.order - 1, self.each - 1)

    def set_row(self, rows: Array, values: Array) -> None:
        """Writes the rows n_i - 1 of states, in place."""
        if self.are_alike:
            rows[..., -1, :] = values
        else:
            rows[..., self.each - 1, np.arange(self.num_outputs)] = values

    def set_top(self, rows: Array, values: Array | float) -> None:
        """Writes the rows n_i - 1 of states where they are not the first, in place."""
        if self.are_alike:
            rows[..., -1, :] = values
            return
        (several,) = np.nonzero(self.each > 1)
        values = np.broadcast_to(values, (*rows.shape[:-2], self.num_outputs))
        rows[..., self.each[several] - 1, several] = values[..., several]

    def with_top(self, lower: Array, top: Array) -> Array:
        """States from their rows below n - 1, with other rows n_i - 1 > 0.

        Args:
            lower: ``(..., n - 1, m)``, n > 1.
            top: ``(..., m)``.

        Returns:
            ``(..., n, m)``.
        """
        rows = np.concatenate([lower, top[..., None, :]], axis=-2)
        if not self.are_alike:
            rows = self.existing(rows)
            self.set_top(rows, top)
        return rows

    # From derivatives of a function, row k the k-th, to what there is of them.

    def state_of(self, derivatives: Array) -> Array:
        """The state, ``(..., n, m)``, of at least n rows."""
        return self.existing(derivatives[..., : self.order, :])

    def highest_of(self, derivatives: Array, further: int = 0) -> Array:
        """The derivatives of order n_i, or so many further, ``(..., m)``."""
        row = self.order + further
        return self._row(derivatives, row, self.each + further)

    def reference_of(self, derivatives: Array) -> Array:
        """The reference, ``(..., n + 1, m)``, of at least n + 1 rows."""
        if self.are_alike:
            return derivatives[..., : self.order + 1, :]
        highest = self.highest_of(derivatives)[..., None, :]
        return np.concatenate([self.state_of(derivatives), highest], axis=-2)

    def derivative_of(self, state: Array, highest: Array, k: int) -> Array:
        """Row k of derivatives, from a state and its highest; zero beyond these.

        Args:
            state: ``(..., n, m)``.
            highest: the derivatives of order n_i, ``(..., m)``.
            k: up to n.

        Returns:
            ``(..., m)``.
        """
        if k == self.order:
            return highest if self.are_alike else np.where(self.each == k, highest, 0.0)
        row = state[..., k, :]
        return row if self.are_alike else np.where(self.each == k, highest, row)

    # The cascade's stages.

    def from_first(self, stages: Array) -> Array:
        """Stages that are aligned at Φ, aligned at Y_0 instead, ``(..., n, m)``."""
        return self._rolled(stages, -1)

    def at_layer(self, stages: Array) -> Array:
        """The inverse of `from_first`; zero in rows before the first stage."""
        return self._rolled(self.existing(stages), 1)

    # A plant's state, of whose numbers there are no more than exist.

    def pack(self, state: Array) -> Array:
        """From ``(..., n, m)`` to ``(..., size)``: row by row, all that exists."""
        flat = state.reshape(*state.shape[:-2], -1)
        return flat if self.are_alike else flat[..., self._index]

    def unpack(self, flat: Array) -> Array:
        """The inverse of `pack`; generic in the scalar."""
        lead, shape = flat.shape[:-1], (self.order, self.num_outputs)
        if self.are_alike:
            return flat.reshape(*lead, *shape)
        # Zeros of the same kind, of which functions may be taken.
        zero = 0.0 if flat.dtype != object else type(flat.flat[0])(0.0)
        state = np.empty((*lead, self.order * self.num_outputs), dtype=flat.dtype)
        state[...] = zero
        state[..., self._index] = flat
        return state.reshape(*lead, *shape)

    @cached_property
    def _index(self) -> Array:
        return np.flatnonzero(self.exists)

    def _row(self, rows: Array, alike: int, each: Array) -> Array:
        if self.are_alike:
            return rows[..., alike, :]
        return rows[..., each, np.arange(self.num_outputs)]

    def _rolled(self, stages: Array, sign: int) -> Array:
        """Moves output i by n - n_i rows; zeros move in."""
        if self.are_alike:
            return stages
        row = np.arange(self.order)[:, None] - sign * (self.order - self.each)
        inside = (row >= 0) & (row < self.order)
        moved = stages[..., np.where(inside, row, 0), np.arange(self.num_outputs)]
        return np.where(inside, moved, 0.0)


@lru_cache
def _mixed_coefficients(chains: Chains, slope: tuple[float, ...]) -> Array:
    coefficients = np.zeros(chains.exists.shape)
    for i, (order, own) in enumerate(zip(chains.orders, slope, strict=True)):
        coefficients[:order, i] = surface_coefficients(np.array([own]), order)[:, 0]
    coefficients.flags.writeable = False
    return coefficients
