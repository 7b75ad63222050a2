"""Piecewise polynomials: their pieces, derivatives and ranges on short intervals."""

from __future__ import annotations

import dataclasses
from functools import cached_property, lru_cache
from math import comb, factorial

import numpy as np
import numpy.typing as npt

from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass(frozen=True, eq=False)
class Polynomial:
    """A polynomial on each of K intervals, by its derivatives at their middles.

    Attributes:
        derivatives: value and all derivatives, ``(K, degree + 1, m)``, fastest if
            in memory each lies by itself (as `np.swapaxes` leaves them).
        half: of the length of an interval, in s.
    """

    derivatives: Array
    half: float

    @classmethod
    def on_intervals(cls, coefficients: Array, step: float, parts: int) -> Polynomial:
        """Cuts every piece of a piecewise polynomial into equal intervals.

        Args:
            coefficients: in powers of the time since a piece began,
                ``(pieces, degree + 1, m)``.
            step: length of a piece, in s.
            parts: intervals in each piece.
        """
        powers, m = coefficients.shape[1:]
        middle = (np.arange(parts) + 0.5) * step / parts
        basis = np.zeros((parts, powers, powers))
        for k in range(powers):
            for p in range(k, powers):
                scale = factorial(p) / factorial(p - k)
                basis[:, k, p] = scale * middle ** (p - k)
        # One product for all: (derivative and part, power) by (power, piece and axis).
        by_power = coefficients.swapaxes(0, 1).reshape(powers, -1)
        values = basis.swapaxes(0, 1).reshape(-1, powers) @ by_power
        values = values.reshape(powers, parts, -1, m).swapaxes(1, 2)
        rows = values.reshape(powers, -1, m)
        return cls(rows.swapaxes(0, 1), step / parts / 2)

    def in_units(self, value: float, time: float) -> Polynomial:
        """The same where units of value and time are so small in these ones."""
        powers = time ** np.arange(self.derivatives.shape[1])
        rows = self.derivatives.swapaxes(0, 1) * (value / powers)[:, None, None]
        return Polynomial(rows.swapaxes(0, 1), self.half * time)

    def radius(self, order: int) -> Array:
        """How far a derivative leaves its value at the middle, ``(K, m)``."""
        return self._radii[order]

    @cached_property
    def _radii(self) -> Array:
        rows = np.abs(self.derivatives.swapaxes(0, 1))
        rest = _taylor(len(rows), self.half) - np.eye(len(rows))
        return (rest @ rows.reshape(len(rows), -1)).reshape(rows.shape)

    def largest(self, order: int) -> Array:
        """A bound of a derivative's magnitude all along, ``(K, m)``."""
        return np.abs(self.derivatives[:, order]) + self.radius(order)

    def at_ends(self, order: int = 0) -> Array:
        """A continuous derivative where intervals meet, ``(K + 1, m)``."""
        return self._ends[order]

    @cached_property
    def _ends(self) -> Array:
        rows = self.derivatives.swapaxes(0, 1)
        count, K, m = rows.shape
        starts = _taylor(count, -self.half) @ rows.reshape(count, -1)
        last = _taylor(count, self.half) @ rows[:, -1]
        return np.concatenate([starts.reshape(count, K, m), last[:, None]], axis=1)


def _taylor(count: int, offset: float) -> Array:
    """From derivatives at one place to those at another, ``(count, count)``."""
    rows = range(count)
    return np.array(
        [
            [offset ** (j - i) / factorial(j - i) if j >= i else 0.0 for j in rows]
            for i in rows
        ]
    )


def hermite_powers(value: Array, rate: Array, step: float) -> Array:
    """Cubic Hermite pieces in powers of the time since they began, ``(M, 4, m)``."""
    rise = np.diff(value, axis=0) / step
    start, end = rate[:-1], rate[1:]
    return np.stack(
        [
            value[:-1],
            start,
            (3 * rise - 2 * start - end) / step,
            (start + end - 2 * rise) / step**2,
        ],
        axis=1,
    )


def cut(grid: Array, start: float, end: float) -> tuple[Array, npt.NDArray[np.intp]]:
    """The part of a grid between two times, and the piece that each of its is of.

    Pieces of less than a nanosecond are left out.
    """
    inner = (grid > start + 1e-9) & (grid < end - 1e-9)
    times = np.concatenate([[start], grid[inner], [end]])
    piece = np.searchsorted(grid, (times[:-1] + times[1:]) / 2, side="right") - 1
    return times, np.clip(piece, 0, len(grid) - 2)


def shifted(coefficients: Array, shift: float) -> Array:
    """The same polynomial in powers of ``t - shift``, ``(powers, m)``."""
    powers = len(coefficients)
    return np.stack(
        [
            sum(
                comb(p, k) * shift ** (p - k) * coefficients[p]
                for p in range(k, powers)
            )
            for k in range(powers)
        ]
    )


@lru_cache
def power_derivatives(count: int, powers: int) -> tuple[Array, Array]:
    """Factors and exponents of the derivatives of ``t^p``, ``(count, powers)`` each."""
    factor, exponent = np.zeros((2, count, powers))
    for k in range(count):
        for p in range(k, powers):
            factor[k, p] = factorial(p) / factorial(p - k)
            exponent[k, p] = p - k
    return factor, exponent


def locate(grid: Array, time: Array | float) -> tuple[Array, npt.NDArray[np.intp]]:
    """Time since the start of the piece, and the piece's index; clamped."""
    if isinstance(time, float):  # a flight's look-ups, for which arrays are slow
        t = min(max(time, grid[0]), grid[-1])
        one = min(max(grid.searchsorted(t, side="right") - 1, 0), len(grid) - 2)
        return np.asarray(t - grid[one]), np.asarray(one)
    time = np.clip(np.asarray(time, dtype=float), grid[0], grid[-1])
    piece = np.clip(np.searchsorted(grid, time, side="right") - 1, 0, len(grid) - 2)
    return time - grid[piece], piece
