"""Uniform B-splines: the reference with its dynamics eliminated.

A first-order hold on y^(n) makes y a spline of degree n + 1 on the knot grid.
Its B-spline coefficients are a basis of exactly these functions, so the planner
decides them, and no dynamics constraint is left; every value and every Bézier
control point depends on n + 2 neighbouring coefficients.

Outputs of different order have splines of different degree (`Splines`).  What turns
their coefficients into something, a *basis*, is ``(..., degree + 1, m)`` with the
largest degree, and zero for coefficients that an output does not have; or
``(..., degree + 1, 1)`` if all are alike.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache
from math import comb, factorial
from typing import Any

import numpy as np
import scipy.sparse as sp

from dtmpc_drake.numerics.arrays import Array

Sparse = Any
"""A scipy sparse array; scipy is untyped here."""


@lru_cache
def piece_powers(degree: int) -> Array:
    """One piece in powers of the local time t in [0, 1].

    The Cox-de Boor recursion on equally spaced knots: of the degree d, the j-th of
    the coefficients that act on a piece has the weight
    ``b_j^d = ((t + d - j) b_(j-1)^(d-1) + (j + 1 - t) b_j^(d-1)) / d``.
    Times d! all of them have whole coefficients, so that only the last division
    rounds.

    Returns:
        ``(degree + 1 powers, degree + 1 coefficients)``: column j belongs to the
        j-th of the coefficients that act on the piece.
    """
    weights = np.ones((1, 1))
    for d in range(1, degree + 1):
        j = np.arange(d + 1.0)
        # Rows 1 to d are the powers; columns j and j + 1 are b_(j-1) and b_j.
        below = np.pad(weights, 1)
        earlier, later = below[:, :-1], below[:, 1:]
        weights = (d - j) * earlier[1:] + (j + 1) * later[1:] + (earlier - later)[:-1]
    return weights / factorial(degree)


def derivative_powers(powers: Array, derivative: int) -> Array:
    """Powers of a polynomial's derivative, with respect to local time."""
    for _ in range(derivative):
        powers = powers[1:] * np.arange(1, len(powers))[:, None]
    return powers


@lru_cache
def powers_to_bezier(degree: int) -> Array:
    """From powers to Bézier control points on [0, 1], square."""
    return np.array(
        [
            [comb(i, j) / comb(degree, j) if j <= i else 0.0 for j in range(degree + 1)]
            for i in range(degree + 1)
        ]
    )


@lru_cache
def elevation(degree: int, to: int) -> Array:
    """Control points of a higher degree for the same curve, ``(to+1, degree+1)``."""
    matrix = np.eye(degree + 1)
    for p in range(degree, to):
        step = np.zeros((p + 2, p + 1))
        for i in range(p + 2):
            if i > 0:
                step[i, i - 1] = i / (p + 1)
            if i <= p:
                step[i, i] = 1 - i / (p + 1)
        matrix = step @ matrix
    return matrix


def basis(degree: int, derivative: int, points: Array, step: float) -> Array:
    """Values at local times of one piece, ``(len(points), degree + 1)``."""
    powers = derivative_powers(piece_powers(degree), derivative)
    values = points[:, None] ** np.arange(len(powers)) @ powers
    return values / step**derivative


def control_basis(degree: int, derivative: int, step: float) -> Array:
    """Control points of a derivative on one piece."""
    powers = derivative_powers(piece_powers(degree), derivative)
    return powers_to_bezier(degree - derivative) @ powers / step**derivative


def windows(coefficients: Array, degree: int) -> Array:
    """The coefficients that act on each piece, ``(N, degree + 1, m)``."""
    view = np.lib.stride_tricks.sliding_window_view(coefficients, degree + 1, axis=0)
    return view.swapaxes(1, 2)


def knot_operator(intervals: int, degree: int, derivative: int, step: float) -> Sparse:
    """The derivative at all knots, sparse ``(N + 1, N + degree)``."""
    start = basis(degree, derivative, np.array([0.0]), step)[0, :degree]
    return sp.diags_array(
        [np.full(intervals + 1, v) for v in start],
        offsets=list(range(degree)),
        shape=(intervals + 1, intervals + degree),
    ).tocsr()


def midpoint_operator(intervals: int, degree: int) -> Sparse:
    """Values at all knots and midpoints, sparse ``(2 N + 1, N + degree)``."""
    points = basis(degree, 0, np.array([0.0, 0.5, 1.0]), 1.0)
    piece, half = np.divmod(np.arange(2 * intervals + 1), 2)
    piece[-1], half[-1] = intervals - 1, 2
    columns = piece[:, None] + np.arange(degree + 1)
    return sp.csr_array(
        (
            points[half].ravel(),
            columns.ravel(),
            np.arange(len(piece) + 1) * (degree + 1),
        ),
        shape=(len(piece), intervals + degree),
    )


def piece_coefficients(coefficients: Array, degree: int, step: float) -> Array:
    """Every piece in powers of the time since it began, ``(N, degree + 1, m)``."""
    powers = piece_powers(degree) / step ** np.arange(degree + 1)[:, None]
    return powers @ windows(coefficients, degree)


def refine(coefficients: Array, degree: int) -> Array:
    """The same spline on a grid with twice as many intervals."""
    weights = np.array([comb(degree + 1, k) for k in range(degree + 2)]) / 2**degree
    count = len(coefficients)
    up = np.zeros((2 * count - 1, coefficients.shape[1]))
    up[::2] = coefficients
    full = np.stack([np.convolve(column, weights) for column in up.T], axis=1)
    # Keep the coefficients whose support touches the interval.
    first = degree
    return full[first : first + 2 * (count - degree) + degree]


def grouped(orders: Sequence[int]) -> list[tuple[int, Any]]:
    """Each order that outputs have, the largest first, and the index of those."""
    found = sorted(set(orders), reverse=True)
    if len(found) == 1:
        return [(found[0], slice(None))]
    return [(order, np.flatnonzero(np.array(orders) == order)) for order in found]


@dataclasses.dataclass(frozen=True)
class Splines:
    """Splines of several outputs on one uniform grid, each of its own degree.

    They are stored as if all were of the largest degree, the coefficients of others
    zero at the end.

    Attributes:
        orders: n_i of each output, whose degree is n_i + 1.
        step: between two knots, in s.
    """

    orders: tuple[int, ...]
    step: float

    @property
    def degree(self) -> int:
        """The largest."""
        return max(self.orders) + 1

    def unused(self, intervals: int) -> Array:
        """Which coefficients no output has, flattened, out of ``(N + degree, m)``."""
        row = np.arange(intervals + self.degree)[:, None]
        return np.flatnonzero(row > intervals + np.array(self.orders))

    def values(self, points: Array) -> Array:
        """The state and, in one more row, the derivatives of order n_i.

        Args:
            points: local times in one piece, ``(P,)``.

        Returns:
            A basis ``(P, n + 1, degree + 1, ...)``.
        """
        n = self.degree - 1

        def rows(order: int) -> Array:
            some = [basis(order + 1, k, points, self.step) for k in range(order + 1)]
            none = [np.zeros_like(some[0])] * (n - order)
            return np.stack([*some[:-1], *none, some[-1]], axis=1)

        return self._each(rows)

    def controls(self, derivative: int, to: int) -> Array:
        """Bézier points of a derivative, as of a polynomial of a certain degree.

        Args:
            derivative: k; the points of outputs of an order below k are zero.
            to: the degree, at least that of every output's derivative.

        Returns:
            A basis ``(to + 1, degree + 1, ...)``.
        """

        def rows(order: int) -> Array:
            if derivative > order:
                return np.zeros((to + 1, order + 2))
            points = control_basis(order + 1, derivative, self.step)
            degree = order + 1 - derivative
            return points if degree == to else elevation(degree, to) @ points

        return self._each(rows)

    def pieces(self, coefficients: Array) -> Array:
        """Every piece in powers of the time since it began, ``(N, degree + 1, m)``."""
        pieces = len(coefficients) - self.degree
        result = np.zeros((pieces, self.degree + 1, len(self.orders)))
        for order, some in grouped(self.orders):
            own = coefficients[: pieces + order + 1, some]
            own = piece_coefficients(own, order + 1, self.step)
            result[:, : order + 2, some] = own
        return result

    def refined(self, coefficients: Array) -> Array:
        """The same splines on a grid with twice as many intervals."""
        pieces = len(coefficients) - self.degree
        result = np.zeros((2 * pieces + self.degree, len(self.orders)))
        for order, some in grouped(self.orders):
            finer = refine(coefficients[: pieces + order + 1, some], order + 1)
            result[: len(finer), some] = finer
        return result

    def _each(self, rows: Callable[[int], Array]) -> Array:
        """A basis of all outputs from that of an order, ``(..., order + 2)``."""
        groups = grouped(self.orders)
        if len(groups) == 1:
            return rows(groups[0][0])[..., None]
        result: Array = np.zeros(0)
        for order, some in groups:  # the first has the most coefficients
            own = rows(order)
            if not result.size:
                result = np.zeros((*own.shape, len(self.orders)))
            result[..., : order + 2, some] = own[..., None]
        return result


def applied(of: Array, coefficients: Array) -> Array:
    """What a basis makes of coefficients.

    Args:
        of: a basis ``(r, c, m or 1)``.
        coefficients: ``(..., c, m)``.

    Returns:
        ``(..., r, m)``.
    """
    if of.shape[-1] == 1:
        return np.asarray(of[..., 0] @ coefficients)
    return np.einsum("rcm,...cm->...rm", of, coefficients)


def over_axes(of: Array, num_outputs: int) -> Array:
    """A basis as a matrix of coefficients with the axes fastest, ``(r m, c m)``.

    Args:
        of: a basis ``(r, c, m or 1)``.
        num_outputs: m.
    """
    rows, columns, _ = of.shape
    each = of.swapaxes(1, 2)[..., None] * np.eye(num_outputs)[:, None]
    return each.reshape(rows * num_outputs, columns * num_outputs)
