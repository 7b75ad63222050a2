"""Sparse linear constraints, collected block by block.

Equations are kept apart from inequalities: Drake makes two inequalities of an
equation that stands among inequalities, which leaves a solver of interior points
no interior.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.sparse as sp

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.splines import Sparse

ZERO = 1e-9
"""Entries that are smaller are none."""


@dataclasses.dataclass(frozen=True, eq=False)
class Assembled:
    """``low <= matrix z <= high``, or equations, where both bounds are the same."""

    matrix: Sparse
    low: Array
    high: Array

    @property
    def finite(self) -> bool:
        """Whether all numbers are, except for bounds that are none."""
        bounds = np.concatenate([self.low, self.high])
        return bool(np.isfinite(self.matrix.data).all() and not np.isnan(bounds).any())


class Rows:
    """Rows of a constraint on a vector of a given width."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._values: list[Array] = []
        self._indices: list[tuple[Array, Array]] = []
        self._bounds: list[tuple[Array, Array]] = []
        self.count = 0

    def add(
        self,
        values: Array,
        columns: Array,
        low: Array | float,
        high: Array | float = np.inf,
    ) -> None:
        """Adds rows with equally many entries each, ``(R, E)``."""
        size = len(values)
        row, entry = np.nonzero(np.abs(values) > ZERO)
        self._values.append(values[row, entry])
        self._indices.append((row + self.count, columns[row, entry]))
        self._bounds.append((np.broadcast_to(low, size), np.broadcast_to(high, size)))
        self.count += size

    def equate(self, values: Array, columns: Array, to: Array | float) -> None:
        """Adds equations with equally many entries each, ``(R, E)``."""
        self.add(values, columns, to, to)

    def reads(self) -> Array:
        """Which entries of the vector some row has, ``(width,)``."""
        found = np.zeros(self._width, dtype=bool)
        for _, columns in self._indices:
            found[columns] = True
        return found

    def assemble(self) -> Assembled:
        """The matrix and its bounds."""
        row, column = (
            np.concatenate(part) for part in zip(*self._indices, strict=True)
        )
        matrix = sp.csc_matrix(
            (np.concatenate(self._values), (row, column)),
            shape=(self.count, self._width),
        )
        low, high = (np.concatenate(part) for part in zip(*self._bounds, strict=True))
        return Assembled(matrix, low, high)
