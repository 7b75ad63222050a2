"""What a plan does on short intervals of time: bounds that hold all along them.

Reference and boundary layer are polynomials, so Taylor's formula about the
middle of an interval gives their range exactly enough.  The tube follows from
them by comparison: on every interval the filters are replaced by ones with
coefficients that are at least as bad.  Nothing is sampled; left out of account are
the rounding of floating-point numbers and the error of a fourth-order quadrature of
linear filters, which the length of the intervals makes negligible.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.enclosure import THINNEST, Corridor, Enclosure
from dtmpc_drake.method.tube import (
    cascade_bounds,
    comparison_forcing,
    propagate_cascade,
)
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.filters import half_grid, integrate_filter
from dtmpc_drake.numerics.polynomials import Polynomial, hermite_powers
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.records.plan import Plan

_MOST, _LONGEST = 2**19, 16e-3
"""About so many intervals are enough, unless they are longer than this, in s: a flight
of half an hour is not enclosed on millions of them, which takes gigabytes."""


def enclose(
    plan: Plan, problem: Problem, *, longest: float, velocity_slack: float
) -> Enclosure:
    """Encloses a plan.

    The velocity tube must be known to bound itself, since Δ̄ looks at it.  So the
    plan's own W, plus some slack, is taken for granted in Δ̄; if the bound that
    follows is smaller for all times (`claim_excess`), no error can ever have
    been the first to leave it, and what was granted is proven.

    Args:
        plan: whose polynomials are enclosed.
        problem: gives the model and the controller's constants.
        longest: interval, in s.
        velocity_slack: what is added to the plan's own W, in its unit.

    Raises:
        ValueError: if the plan's grids are not uniform, one within the other.
    """
    chains, slope = problem.law.chains, problem.law.slope
    n = chains.order
    pieces = _Pieces.of(plan, longest)
    h, reference, hermite = pieces.step, pieces.reference(), pieces.hermite
    layer = pieces.layer()

    # The cascade.  Its rates are filtered too, so they are bounded in turn.
    stages, rates = propagate_cascade(
        layer=layer.at_ends(),
        layer_rate=layer.at_ends(1),
        slope=slope,
        start=problem.tube_start,
        step=h,
    )
    fastest, second_rates = layer.largest(1), [layer.largest(2)]
    for j in range(n - 2, -1, -1):
        above = fastest
        fastest = np.abs(rates[:-1, j]) + h * above
        second_rates.insert(0, slope * fastest + above)
    curvature = np.stack(second_rates, axis=1)
    at_ends = cascade_bounds(chains, stages, slope)
    curvature = cascade_bounds(chains, curvature, slope)
    proven = _Arc(at_ends[:-1].copy(), at_ends[1:].copy(), curvature.copy())
    claimed = [
        hermite(plan.bound_samples[:, k], plan.bound_rate_samples[:, k])
        for k in range(n)
    ]
    if n > 1 and problem.velocity_bound == "comparison":
        top = chains.top(
            np.stack([c.derivatives[:, 0] + c.radius(0) for c in claimed], axis=1)
        )
        bounds = proven.highest(h)
        chains.set_top(bounds, np.minimum(chains.top(bounds), top + velocity_slack))
        middles = half_grid(stages, rates, h)
        proven.set_top(
            chains,
            _velocity_tube(
                problem=problem,
                reference=reference,
                layer=layer,
                lower_bounds=cascade_bounds(chains, middles, slope, n - 1),
                error_bound=bounds,
            ),
        )
    excess = [
        np.minimum(c.at_ends()[:-1] - start, c.at_ends()[1:] - end)
        - h**2 / 8 * (curved + c.largest(2))
        for c, start, end, curved in zip(
            claimed, *(each.swapaxes(0, 1) for each in proven.parts), strict=True
        )
    ]
    return Enclosure(
        law=problem.law,
        corridor=Corridor(
            time=pieces.times(),
            parts=pieces.parts,
            reference=reference,
            position_tube=at_ends[:, 0],
            position_curvature=curvature[:, 0],
            units=problem.units,
        ),
        reference_radius=_state_radius(problem, reference),
        layer=layer,
        bandwidth=pieces.bandwidth(),
        error_bound=proven.highest(h),
        claim_excess=chains.existing(np.stack(excess, axis=1)),
    )


def claimed_corridor(
    plan: Plan, *, longest: float, slack: float, units: Units
) -> Corridor:
    """The tube that a certified plan carries, made wider by what it may lack.

    Args:
        plan: whose own tube is taken for granted.
        longest: interval, in s.
        slack: what is added to Ω.
        units: of all this, in those of the user.

    Raises:
        ValueError: if the plan's grids are not uniform, one within the other.
    """
    pieces = _Pieces.of(plan, longest)
    tube = pieces.hermite(plan.bound_samples[:, 0], plan.bound_rate_samples[:, 0])
    return Corridor(
        time=pieces.times(),
        parts=pieces.parts,
        reference=pieces.reference(),
        position_tube=tube.at_ends() + slack,
        position_curvature=tube.largest(2),
        units=units,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Pieces:
    """How a plan's pieces are cut into intervals.

    Attributes:
        plan: that is cut.
        parts: of each step of its own tube, a power of two.
    """

    plan: Plan
    parts: int

    @classmethod
    def of(cls, plan: Plan, longest: float) -> _Pieces:
        if not plan.is_uniform:
            raise ValueError("a plan's knots must be equally spaced, and so its tube")
        steps, span = len(plan.tube_times) - 1, plan.end_time - plan.start_time
        longest = max(longest, min(_LONGEST, span / _MOST))
        parts = 1
        while span / steps / parts > longest:
            parts *= 2
        return cls(plan, parts)

    @property
    def tube_step(self) -> float:
        span = self.plan.end_time - self.plan.start_time
        return span / (len(self.plan.tube_times) - 1)

    @property
    def step(self) -> float:
        return self.tube_step / self.parts

    def times(self) -> Array:
        count = (len(self.plan.tube_times) - 1) * self.parts
        return self.plan.start_time + self.step * np.arange(count + 1)

    def reference(self) -> Polynomial:
        tube_steps = (len(self.plan.tube_times) - 1) // (len(self.plan.knots) - 1)
        return Polynomial.on_intervals(
            self.plan.coefficients,
            self.tube_step * tube_steps,
            tube_steps * self.parts,
        )

    def layer(self) -> Polynomial:
        return Polynomial.on_intervals(
            self.plan.layer_coefficients, self.tube_step, self.parts
        )

    def bandwidth(self) -> Polynomial:
        """The plan's own α, linear on every interval."""
        plan, count = self.plan, len(self.plan.knots) - 1
        step = (plan.end_time - plan.start_time) / count
        rise = np.diff(plan.bandwidth_knots, axis=0) / step
        powers = np.stack([plan.bandwidth_knots[:-1], rise], axis=1)
        parts = (len(plan.tube_times) - 1) // count * self.parts
        return Polynomial.on_intervals(powers, step, parts)

    def hermite(self, value: Array, rate: Array) -> Polynomial:
        """What the samples of the plan's own tube stand for."""
        powers = hermite_powers(value, rate, self.tube_step)
        return Polynomial.on_intervals(powers, self.tube_step, self.parts)


@dataclasses.dataclass(frozen=True, eq=False)
class _Arc:
    """Functions on every interval: their ends, and bounds of second derivatives.

    Of all derivatives of the error, ``(K, n, m)`` each, or of one, ``(K, m)``.
    """

    start: Array
    end: Array
    curvature: Array

    @property
    def parts(self) -> tuple[Array, Array, Array]:
        """Start, end and curvature."""
        return self.start, self.end, self.curvature

    def set_top(self, chains: Chains, top: _Arc) -> None:
        """Puts another bound in the place of that of each ``|ỹ^(n_i - 1)|``."""
        for rows, values in zip(self.parts, top.parts, strict=True):
            chains.set_top(rows, values)

    def highest(self, step: float) -> Array:
        """A bound all along the interval."""
        return np.maximum(self.start, self.end) + step**2 / 8 * self.curvature


def _velocity_tube(
    *,
    problem: Problem,
    reference: Polynomial,
    layer: Polynomial,
    lower_bounds: Array,
    error_bound: Array,
) -> _Arc:
    """W on every interval.

    With α̂ = (Δ_0 + D + η - dΦ*/dt)/Φ* for *any* Δ_0(t), here the chords of Δ(x*), the
    comparison system holds with α̂ for α and Δ_0 for Δ(x*): what the switching gain
    has beyond it, |Δ(x) - Δ_0|, is in E.  E is replaced by chords above it, and all
    else is smooth and integrated as it is.
    """
    law, model, slope = problem.law, problem.model, problem.law.slope
    chains, step = law.chains, 2 * layer.half
    ends = [reference.at_ends(k) for k in range(chains.order)]
    nominal = model.model_error_bound(chains.existing(np.stack(ends, axis=1)))
    nominal = _chords(nominal)
    thickness = _interleave(layer.at_ends(), layer.derivatives[:, 0])
    thickness = np.maximum(thickness, THINNEST)
    rate = _interleave(layer.at_ends(1), layer.derivatives[:, 1])
    bandwidth = np.maximum(law.forcing_of(nominal) - rate, 0.0) / thickness

    largest = model.model_error_bound_over(
        chains.state_of(reference.derivatives),
        error_bound + _state_radius(problem, reference),
    )
    both = np.maximum(largest[:-1], largest[1:])
    largest = _chords(np.concatenate([largest[:1], both, largest[-1:]]))

    def forcing(bandwidth: Array, lower_bounds: Array, model_error: Array) -> Array:
        return comparison_forcing(
            law,
            bandwidth=bandwidth,
            lower_bounds=lower_bounds,
            model_error=model_error,
        )

    W, _ = integrate_filter(
        bandwidth + (chains.each - 1) * slope,
        forcing(bandwidth, lower_bounds, 2 * largest - nominal),
        problem.tube_start.highest,
        step,
    )
    # Within an interval: the worst constant coefficients there.
    change = layer.radius(1) + np.abs(nominal[2::2] - nominal[:-2:2]) / 2
    gain = law.forcing_of(nominal[1::2]) - layer.derivatives[:, 1]
    low = np.maximum(gain - change, 0.0) / (layer.derivatives[:, 0] + layer.radius(0))
    low = low + (chains.each - 1) * slope
    thin = np.maximum(layer.derivatives[:, 0] - layer.radius(0), THINNEST)
    worst = forcing(
        np.maximum(gain + change, 0.0) / thin,
        error_bound[:, :-1],
        2 * np.maximum(largest[:-2:2], largest[2::2])
        - np.minimum(nominal[:-2:2], nominal[2::2]),
    )
    decay = np.exp(-low * step)
    after = decay * W[:-1] + (1 - decay) / low * worst
    return _Arc(W[:-1], np.maximum(after, W[1:]), low * np.abs(worst - low * W[:-1]))


def _state_radius(problem: Problem, reference: Polynomial) -> Array:
    """How far x* leaves its value at the middle, ``(K, n, m)``."""
    chains = problem.law.chains
    rows = [reference.radius(k) for k in range(chains.order)]
    return chains.existing(np.stack(rows, axis=1))


def _interleave(ends: Array, middles: Array) -> Array:
    """Values at ends and middles to the half grid."""
    result = np.empty((2 * len(ends) - 1, *ends.shape[1:]))
    result[::2], result[1::2] = ends, middles
    return result


def _chords(ends: Array) -> Array:
    """Straight lines between ends, on the half grid."""
    return _interleave(ends, (ends[:-1] + ends[1:]) / 2)
