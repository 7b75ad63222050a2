"""What is known of a plan all along short intervals of time.

It is made by `planning.proof`, which proves it; limits ask it for what is left of them.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np

from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.polynomials import Polynomial

THINNEST = 1e-12
"""Boundary layer that is divided by, in m/s; one so thin is no layer at all."""


@dataclasses.dataclass(frozen=True, eq=False)
class Corridor:
    """Where a plan may be on K equal intervals.

    Attributes:
        time: where intervals meet, ``(K + 1,)``, in s.
        parts: intervals in each step of the plan's own tube, a power of two.
        reference: y*.
        position_tube: Ω where intervals meet, ``(K + 1, m)``.
        position_curvature: a bound of ``|d²Ω/dt²|``, ``(K, m)``.
        units: of all this, in those of the user.
    """

    time: Array
    parts: int
    reference: Polynomial
    position_tube: Array
    position_curvature: Array
    units: Units = Units()

    @property
    def step(self) -> float:
        """Length of an interval, in s."""
        return 2 * self.reference.half


@dataclasses.dataclass(frozen=True, eq=False)
class Enclosure:
    """Bounds along a plan on K equal intervals.

    Attributes:
        law: the controller that flies the plan.
        corridor: the intervals, y* and Ω.
        reference_radius: how far x* leaves its value at the middle, ``(K, n, m)``.
        layer: Φ*.
        bandwidth: the plan's own α, linear on every interval.
        error_bound: bounds of ``|ỹ^(k)|`` all along, ``(K, n, m)``.
        claim_excess: how far the plan's own bounds lie above those proven here,
            at least, ``(K, n, m)``; negative where below.
    """

    law: SlidingLaw
    corridor: Corridor
    reference_radius: Array
    layer: Polynomial
    bandwidth: Polynomial
    error_bound: Array
    claim_excess: Array

    @property
    def time(self) -> Array:
        """Where intervals begin, ``(K,)``, in s."""
        return self.corridor.time[:-1]

    @property
    def reference(self) -> Polynomial:
        """y*."""
        return self.corridor.reference

    def ends(self, k: int) -> Array:
        """y*^(k) at both ends of every interval, ``(2, K, m)``.

        Args:
            k: at most n_i; zero for outputs of a smaller order.
        """
        chains, highest = self.law.chains, self.instant.highest
        if k == self.law.order:
            return chains.derivative_of(self.instant.state, highest, k)
        meeting = self.reference.at_ends(k)
        ends = np.stack([meeting[:-1], meeting[1:]])
        if chains.are_alike:
            return ends
        return np.select([chains.each > k, chains.each == k], [ends, highest], 0.0)

    def sag(self, k: int) -> Array | float:
        """How far y*^(k) may be from the chord between its ends, ``(K, m)``.

        Not at all for k = n_i: y_i*^(n_i) is linear, and its second derivative zero.
        """
        if k == self.law.order:
            return 0.0
        return self.reference.half**2 / 2 * self.reference.largest(k + 2)

    def for_user(self, law: SlidingLaw) -> Enclosure:
        """The same in the user's units, the controller given in them."""
        n, units, own = law.order, self.corridor.units, self.corridor
        rows = units.of_rows(n)
        corridor = Corridor(
            time=own.time * units.time,
            parts=own.parts,
            reference=own.reference.in_units(units.length, units.time),
            position_tube=own.position_tube * units.length,
            position_curvature=own.position_curvature * units.of(2),
        )
        return Enclosure(
            law=law,
            corridor=corridor,
            reference_radius=self.reference_radius * rows,
            layer=self.layer.in_units(units.of(n - 1), units.time),
            bandwidth=self.bandwidth.in_units(1 / units.time, units.time),
            error_bound=self.error_bound * rows,
            claim_excess=self.claim_excess * rows,
        )

    @cached_property
    def instant(self) -> Instant:
        """What is known all along each interval.

        The reference has its value at the middle with a box around it, but y_i*^(n_i)
        has its values at both ends, ``(2, K, m)``: it is linear, and a convex function
        of it is largest at one of them.
        """
        chains, middle = self.law.chains, self.reference.derivatives
        state, highest = chains.state_of(middle), chains.highest_of(middle)
        rise = self.reference.half * chains.highest_of(middle, further=1)
        return Instant(
            state=state,
            highest=np.stack([highest - rise, highest + rise]),
            # κ - Δ(x*), which is also K(x) - Δ(x), is a polynomial.
            gain=self.law.gain(state, self.layer.derivatives[:, 1]),
            error_bound=self.error_bound,
            state_radius=self.reference_radius,
            gain_radius=self.layer.radius(1),
        )
