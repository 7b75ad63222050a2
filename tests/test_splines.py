"""Splines: exact linear algebra, checked against scipy's B-splines."""

from __future__ import annotations

from fractions import Fraction
from math import comb, factorial

import numpy as np
import pytest
import scipy.interpolate
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from dtmpc_drake.numerics import splines
from dtmpc_drake.numerics.arrays import Array

degrees = st.integers(1, 5)
"""For which scipy's and the tests' own arithmetic is exact enough."""
all_degrees = st.integers(1, 11)
counts = st.integers(1, 12)
seeds = st.integers(0, 2**32 - 1)
steps = st.floats(0.1, 3)


def draw(degree: int, intervals: int, seed: int) -> Array:
    """Coefficients of a random spline with two outputs."""
    return np.random.default_rng(seed).normal(size=(intervals + degree, 2))


def exact_pieces(degree: int) -> list[list[Fraction]]:
    """The B-spline on the knots 0, 1, ..., degree + 1, piece by piece, exactly.

    By truncated powers: ``Σ_k (-1)^k C(d + 1, k) (x - k)_+^d / d!``.
    """
    pieces = []
    for piece in range(degree + 1):
        powers = [Fraction(0)] * (degree + 1)
        for k in range(piece + 1):
            sign = (-1) ** k * comb(degree + 1, k)
            for p in range(degree + 1):
                power = comb(degree, p) * (piece - k) ** (degree - p)
                powers[p] += Fraction(sign * power, factorial(degree))
        pieces.append(powers)
    return pieces


def reference(
    coefficients: Array, degree: int, step: float
) -> scipy.interpolate.BSpline:
    """The same spline in scipy; its knots begin `degree` steps before zero."""
    knots = step * (np.arange(len(coefficients) + degree + 1.0) - degree)
    return scipy.interpolate.BSpline(knots, coefficients, degree)


@given(degree=all_degrees, points=st.lists(st.floats(0, 1), min_size=1, max_size=5))
def test_the_basis_is_a_partition_of_unity(degree: int, points: list[float]) -> None:
    values = splines.basis(degree, 0, np.array(points), 0.7)
    assert values.sum(axis=1) == pytest.approx(np.ones(len(points)))
    assert (values >= -1e-12).all()


@pytest.mark.parametrize("degree", range(1, 15))
def test_every_piece_is_the_b_spline_rounded_once(degree: int) -> None:
    """The j-th coefficient acts through the piece that is j before the last."""
    exact = [[float(x) for x in powers] for powers in exact_pieces(degree)]
    assert splines.piece_powers(degree).T.tolist() == exact[::-1]


@pytest.mark.parametrize("degree", range(1, 12))
def test_pieces_join_in_all_derivatives_but_the_last(degree: int) -> None:
    for k in range(degree):
        start, end = splines.basis(degree, k, np.array([0.0, 1.0]), 1.0)
        scale = np.abs(splines.derivative_powers(splines.piece_powers(degree), k))
        # The next piece reads the same coefficients one place earlier.
        slack = 1e-15 * degree * scale.sum()
        assert end[1:] == pytest.approx(start[:-1], abs=slack)
        assert end[0] == pytest.approx(0, abs=slack)
        assert start[-1] == pytest.approx(0, abs=slack)


@given(degree=degrees, intervals=counts, step=steps, seed=seeds)
def test_every_piece_and_derivative_is_scipys(
    degree: int, intervals: int, step: float, seed: int
) -> None:
    coefficients = draw(degree, intervals, seed)
    expected = reference(coefficients, degree, step)
    local = np.array([0.0, 0.2, 0.55, 0.9])
    windows = splines.windows(coefficients, degree)
    times = step * (np.arange(intervals)[:, None] + local)
    for k in range(degree + 1):
        found = splines.basis(degree, k, local, step) @ windows
        exact = expected(times, nu=k)
        assert found == pytest.approx(exact, abs=1e-7 * (1 + np.abs(exact).max()))


@given(degree=degrees, intervals=counts, step=steps, seed=seeds)
def test_piece_coefficients_are_powers_of_the_time_since_the_piece_began(
    degree: int, intervals: int, step: float, seed: int
) -> None:
    coefficients = draw(degree, intervals, seed)
    powers = splines.piece_coefficients(coefficients, degree, step)
    assert powers.shape == (intervals, degree + 1, 2)
    t = np.linspace(0, step, 6)
    for piece in range(intervals):
        exact = reference(coefficients, degree, step)(piece * step + t[:-1])
        for axis in range(2):
            found = Polynomial(powers[piece, :, axis])(t[:-1])
            assert found == pytest.approx(exact[:, axis], abs=1e-9)


@given(degree=all_degrees, intervals=counts, step=steps, seed=seeds)
def test_a_refined_spline_is_the_same_function(
    degree: int, intervals: int, step: float, seed: int
) -> None:
    coefficients = draw(degree, intervals, seed)
    fine = splines.refine(coefficients, degree)
    assert fine.shape == (2 * intervals + degree, 2)
    local = np.array([0.0, 0.3, 0.5, 0.8])
    coarse = splines.basis(degree, 0, local / 2, step)
    coarse = np.concatenate([coarse, splines.basis(degree, 0, (1 + local) / 2, step)])
    before = coarse @ splines.windows(coefficients, degree)
    after = splines.basis(degree, 0, local, step / 2) @ splines.windows(fine, degree)
    assert after.reshape(before.shape) == pytest.approx(before, abs=1e-12)


@given(degree=degrees, intervals=counts, step=steps, seed=seeds)
def test_control_points_enclose_their_piece(
    degree: int, intervals: int, step: float, seed: int
) -> None:
    """In any direction no point of a piece is beyond its control points."""
    coefficients = draw(degree, intervals, seed)
    windows = splines.windows(coefficients, degree)
    local = np.linspace(0, 1, 30)
    angle = np.linspace(0, np.pi, 7)
    directions = np.stack([np.cos(angle), np.sin(angle)])
    for k in range(degree):
        controls = splines.control_basis(degree, k, step) @ windows @ directions
        points = splines.basis(degree, k, local, step) @ windows @ directions
        slack = 1e-9 * (1 + np.abs(controls).max())
        assert (points.max(axis=1) <= controls.max(axis=1) + slack).all()
        assert (points.min(axis=1) >= controls.min(axis=1) - slack).all()
        # The first and the last lie on the curve.
        assert controls[:, 0] == pytest.approx(points[:, 0], abs=slack)
        assert controls[:, -1] == pytest.approx(points[:, -1], abs=slack)


@given(degree=degrees, more=st.integers(0, 3), seed=seeds)
def test_elevation_keeps_the_curve_and_its_hull(
    degree: int, more: int, seed: int
) -> None:
    controls = np.random.default_rng(seed).normal(size=degree + 1)
    raised = splines.elevation(degree, degree + more) @ controls
    assert len(raised) == degree + more + 1
    t = np.linspace(0, 1, 11)

    def curve(points: Array) -> Array:
        d = len(points) - 1
        return np.sum(
            [
                scipy.special.comb(d, i) * t**i * (1 - t) ** (d - i) * p
                for i, p in enumerate(points)
            ],
            axis=0,
        )

    assert curve(raised) == pytest.approx(curve(controls), abs=1e-12)
    assert raised.max() <= controls.max() + 1e-12
    assert raised.min() >= controls.min() - 1e-12


@given(degree=st.integers(2, 5), derivative=st.integers(0, 4), step=steps, seed=seeds)
def test_the_knot_operator_differentiates_at_the_knots(
    degree: int, derivative: int, step: float, seed: int
) -> None:
    # A spline is this often differentiable at its knots.
    derivative = min(derivative, degree - 1)
    coefficients = draw(degree, 6, seed)
    operator = splines.knot_operator(6, degree, derivative, step)
    assert operator.shape == (7, 6 + degree)
    # One output more than scipy's domain: it has no right limit at its end.
    longer = np.vstack([coefficients, coefficients[-1:]])
    exact = reference(longer, degree, step)(step * np.arange(7), nu=derivative)
    found = operator @ coefficients
    assert found == pytest.approx(exact, abs=1e-7 * (1 + np.abs(exact).max()))


def test_powers_are_differentiated_column_by_column() -> None:
    powers = np.array([[5.0, 1.0], [3.0, 0.0], [2.0, -1.0]])
    once = splines.derivative_powers(powers, 1)
    assert once == pytest.approx(np.array([[3.0, 0.0], [4.0, -2.0]]))
    twice = splines.derivative_powers(powers, 2)
    assert twice == pytest.approx(np.array([[4.0, -2.0]]))


@given(degree=degrees)
def test_bezier_points_of_a_straight_line_are_equally_spaced(degree: int) -> None:
    line = np.zeros(degree + 1)
    line[:2] = 1.0, 2.0
    points = splines.powers_to_bezier(degree) @ line
    assert points == pytest.approx(np.linspace(1, 3, degree + 1))
