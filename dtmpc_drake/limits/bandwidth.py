"""The range of the bandwidth and the limit of its rate.

The bandwidth that a layer implies is α = (Δ(x*) + D + η - dΦ*/dt)/Φ*  (eq. phidot).
It is what the certificate looks at; planners decide the bandwidth itself, whose limits
are exact for them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.enclosure import THINNEST, Enclosure
from dtmpc_drake.method.margin import Margin, smallest
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.polynomials import Polynomial

FIXED_TOLERANCE = 5e-3
"""Allowed deviation from a fixed bandwidth, relative."""
KNOTS_TOLERANCE = 5e-3
"""Allowed deviation of the implied bandwidth from the plan's own, relative."""


@dataclasses.dataclass(frozen=True, eq=False)
class BandwidthLimit:
    """``low <= α <= high`` and ``|dα/dt| <= rate`` on every output.

    Attributes:
        low, high: ``(m,)``, in rad/s; equal if the bandwidth is given.
        rate: in rad/s².
    """

    low: Array
    high: Array
    rate: float

    @property
    def is_fixed(self) -> bool:
        """Whether α is given rather than decided."""
        return bool((self.low == self.high).all())

    def at(self, bandwidth: Array | float) -> BandwidthLimit:
        """The same with a given bandwidth, in rad/s."""
        alpha = np.broadcast_to(bandwidth, self.low.shape).copy()
        return dataclasses.replace(self, low=alpha, high=alpha)

    def in_units(self, time: float) -> BandwidthLimit:
        """The same in a unit of time that is so long."""
        return BandwidthLimit(self.low * time, self.high * time, self.rate * time**2)

    def certify(self, enclosure: Enclosure) -> dict[str, Margin]:
        """Margins of the implied α: of its bounds, its rate, and from the plan's own α.

        * ``bandwidth_min``, ``bandwidth_max``: α keeps its bounds.
        * ``bandwidth_knots``: the plan's own α, piecewise linear, is the implied one.
        * ``bandwidth_rate``: α keeps its rate limit, where Δ is constant.
        * ``bandwidth_knots_rate``: the plan's own α does, where Δ varies: Δ(x*) may
          have kinks then (drag has one wherever a velocity changes its sign), in which
          the implied α has no rate, whatever the layer.

        Args:
            enclosure: of the plan.
        """
        law, layer, units = enclosure.law, enclosure.layer, enclosure.corridor.units
        time = enclosure.time * units.time
        model, axes = law.model, law.model.axes
        middle = enclosure.reference.derivatives[:, : law.order]
        least_error = model.model_error_bound_under(middle, enclosure.reference_radius)
        most_error = model.model_error_bound_over(middle, enclosure.reference_radius)
        thin = layer.derivatives[:, 0] - layer.radius(0)
        thick = layer.derivatives[:, 0] + layer.radius(0)

        def room(needed: Polynomial) -> tuple[Array, Array]:
            """(α - b) Φ and (b - α) Φ, bounded from below on every interval."""
            value, radius = needed.derivatives[:, 0], needed.radius(0)
            return least_error - value - radius, value - radius - most_error

        least, most = self.low, self.high
        if self.is_fixed:
            least, most = least * (1 - FIXED_TOLERANCE), most * (1 + FIXED_TOLERANCE)
        own = enclosure.bandwidth
        needed = _needed_model_error(law, layer, own)
        above = room(_needed_model_error(law, layer, _constant(least, layer)))[0]
        below = room(_needed_model_error(law, layer, _constant(most, layer)))[1]
        allowed = np.abs(own.derivatives[:, 0]) - own.radius(0)
        near = KNOTS_TOLERANCE * allowed * thin + np.minimum(*room(needed))
        margins = {
            name: smallest(time, left / thick, "rad/s", axes, 1 / units.time)
            for name, left in (
                ("bandwidth_min", above),
                ("bandwidth_max", below),
                ("bandwidth_knots", near),
            )
        }
        if not self.is_fixed:
            slack = self.rate - np.abs(own.derivatives[:, 1])
            name = "bandwidth_knots_rate"
            if not model.error_bound_varies:
                name = "bandwidth_rate"
                # α is b - (E - Δ)/Φ with E what b needs, so its rate is that of b, but
                # for ((E - Δ) dΦ/dt - Φ dE/dt)/Φ².
                off = np.abs(needed.derivatives[:, 0] - least_error) + needed.radius(0)
                thinnest = np.maximum(thin, THINNEST)
                off = off * layer.largest(1) / thinnest + needed.largest(1)
                slack = slack - off / thinnest
            margins[name] = smallest(time, slack, "rad/s²", axes, units.time**-2)
        return margins


def _constant(bandwidth: Array, layer: Polynomial) -> Polynomial:
    rows = np.zeros((len(layer.derivatives), 2, len(bandwidth)))
    rows[:, 0] = bandwidth
    return Polynomial(rows, layer.half)


def _needed_model_error(
    law: SlidingLaw, layer: Polynomial, bandwidth: Polynomial
) -> Polynomial:
    """E = dΦ/dt + bΦ - D - η, which is Δ(x*) where α = b, linear in time."""
    rows = layer.derivatives.swapaxes(0, 1)
    count = len(rows)
    needed = np.zeros((count + 1, *rows.shape[1:]))
    needed[: count - 1] = rows[1:]
    needed[0] -= law.forcing_of(0.0)
    value, slope = bandwidth.derivatives.swapaxes(0, 1)
    needed[:count] += value * rows
    # Leibniz: (bΦ)^(k) = b Φ^(k) + k b' Φ^(k-1).
    needed[1:] += np.arange(1, count + 1)[:, None, None] * slope * rows
    return Polynomial(needed.swapaxes(0, 1), layer.half)
