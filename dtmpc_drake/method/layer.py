"""The boundary layer Φ: dΦ/dt = -α Φ + Δ(x*) + D + η  (eq. phidot).

It is solved to rounding for a bandwidth and a forcing that are parabolas on every
step, and stands between the nodes as polynomials.  Cubics through Φ and dΦ/dt would
not do: their second derivative jumps at every node by about α⁴Φ times the square of
a step, and the rate of the bandwidth that a layer implies is read off it.
"""

from __future__ import annotations

from functools import lru_cache
from math import factorial

import numpy as np

from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.filters import linear_recurrence

_ROUNDING = 1e-15
"""What the quadrature may leave out, relative to what it adds up."""
_MOST_POINTS = 12
"""Of the quadrature: enough for steps of up to eight time constants."""


def integrate_layer(
    bandwidth: Array, forcing: Array, initial: Array, step: float
) -> tuple[Array, Array]:
    """Φ and dΦ/dt at the nodes.

    Args:
        bandwidth: α on the half grid, ``(2 M + 1, m)``.
        forcing: Δ(x*) + D + η on the half grid, same shape.
        initial: Φ at the first node, ``(m,)``.
        step: between two nodes, in s.

    Returns:
        Both ``(M + 1, m)``.
    """
    alpha, force = _by_step(step * bandwidth), _by_step(step * forcing)
    point, weight = _gauss(float(np.abs(step * bandwidth).max(initial=0.0)))
    u = ((1 + point) / 2)[:, None]
    # From values at start, middle and end to the powers of a parabola.
    powers = np.array([[1, 0, 0], [-3, 4, -1], [2, -4, 2]])
    value = u ** np.arange(3) @ powers
    ahead = (1 - u ** np.arange(1, 4)) / np.arange(1, 4) @ powers
    pushed = np.exp(-(ahead @ alpha)) * (value @ force)
    gained = weight / 2 @ pushed
    whole = np.exp(-(np.array([1, 4, 1]) / 6 @ alpha))
    shape = (-1, *bandwidth.shape[1:])
    layer = linear_recurrence(
        whole.reshape(shape), gained.reshape(shape), np.asarray(initial)
    )
    return layer, forcing[::2] - bandwidth[::2] * layer


def _by_step(values: Array) -> Array:
    """At start, middle and end of every step, one row each, ``(3, M m)``."""
    return np.stack([values[:-2:2], values[1::2], values[2::2]]).reshape(3, -1)


def layer_pieces(
    law: SlidingLaw,
    *,
    reference: Array,
    bandwidth: Array,
    initial: Array,
    step: float,
) -> Array:
    """Φ as polynomials whose implied bandwidth is the given one.

    Each has Φ and its first three derivatives at both ends of its step.  So not only
    Φ and dΦ/dt but also the rate of the bandwidth that they imply is right between
    the nodes, and kinks of α at the nodes are met.

    Args:
        law: gives Δ(x*) + D + η.
        reference: x* on the half grid, ``(2 M + 1, n, m)``.
        bandwidth: α on the half grid, ``(2 M + 1, m)``.
        initial: Φ(t0), ``(m,)``.
        step: between two nodes, in s.

    Returns:
        Coefficients in powers of the time since a step began, ``(M, 8, m)``.
    """
    forcing = law.forcing(reference)
    layer, _ = integrate_layer(bandwidth, forcing, initial, step)
    # All in parts of a step, in which α and f are of it, too.
    alpha, force = _parabolas(step * bandwidth), _parabolas(step * forcing)

    def derivatives(u: float, value: Array) -> list[Array]:
        """Φ and its derivatives at one end of the steps."""
        a = alpha[0] + u * (alpha[1] + u * alpha[2])
        da, dda = alpha[1] + 2 * u * alpha[2], 2 * alpha[2]
        one = force[0] + u * (force[1] + u * force[2]) - a * value
        two = force[1] + 2 * u * force[2] - a * one - da * value
        three = 2 * force[2] - a * two - 2 * da * one - dda * value
        return [value, one, two, three]

    ends = np.stack(derivatives(0.0, layer[:-1]) + derivatives(1.0, layer[1:]))
    powers = np.einsum("pd,dkm->kpm", _two_point_hermite(), ends)
    return powers / step ** np.arange(8)[:, None]


def _parabolas(values: Array) -> Array:
    """Through start, middle and end of every step, in powers, ``(3, M, m)``."""
    start, middle, end = values[:-2:2], values[1::2], values[2::2]
    return np.stack(
        [start, 4 * middle - 3 * start - end, 2 * (start + end) - 4 * middle]
    )


def _gauss(constants: float) -> tuple[Array, Array]:
    """Points and weights on [-1, 1], enough for steps of so many time constants.

    With G of them the quadrature of exp(-a u) over [0, 1] is wrong by at most
    ``a^(2G) (G!)^4 / ((2G + 1) ((2G)!)^3)``.
    """
    for count in range(2, _MOST_POINTS):
        least = factorial(count) ** 4 / ((2 * count + 1) * factorial(2 * count) ** 3)
        if constants ** (2 * count) * least <= _ROUNDING:
            return _legendre(count)
    return _legendre(_MOST_POINTS)


_legendre = lru_cache(np.polynomial.legendre.leggauss)


@lru_cache
def _two_point_hermite() -> Array:
    """From value and three derivatives at 0 and at 1 to powers, ``(8, 8)``."""
    at = np.zeros((8, 8))
    for k in range(4):
        at[k, k] = factorial(k)
        for p in range(k, 8):
            at[4 + k, p] = factorial(p) / factorial(p - k)
    return np.round(6 * np.linalg.inv(at)) / 6  # whole sixths
