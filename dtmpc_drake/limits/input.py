"""The limit of the input's norm (Theorem 2 and corollary 2)."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.limits.base import Facets, SampledLimit, Slopes
from dtmpc_drake.limits.input_slopes import InputSlopes
from dtmpc_drake.method.enclosure import Enclosure
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant, input_bound
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array, euclidean_norm

APEX = 0.05
"""Below this part of the limit the norm of B⁻¹ y*^(n) is cut from all sides."""
SMALLEST_HIGHEST = 0.05
"""Norms of y*^(n) below this are taken for it: they bend without limit at zero."""


@dataclasses.dataclass(frozen=True)
class InputLimit(SampledLimit):
    """``‖u‖ <= bound``.

    Attributes:
        bound: u_m, in the unit of the input.
    """

    bound: float

    name: ClassVar[str] = "input"

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        return law.model.input_unit

    def in_units(self, units: Units, order: int) -> InputLimit:
        """See base class."""
        return InputLimit(self.bound / units.of(order))

    def worth(self, units: Units, order: int) -> float:
        """See base class."""
        return units.of(order)

    @property
    def size(self) -> float:
        """See base class."""
        return self.bound

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """See base class."""
        return np.asarray(self.bound - input_bound(law, at))[..., None]

    def proven(self, enclosure: Enclosure) -> Array:
        """See base class; the norm of y*^(n), which is linear, is largest at an end."""
        return self.margins(enclosure.law, enclosure.instant).min(axis=0)

    def facets(self, law: SlidingLaw, at: Instant) -> Facets:
        """Where the norm of B⁻¹ y*^(n) is near its apex.

        A norm is the largest of u'v over all unit vectors u.  Its slope at v is one of
        them; near zero v turns within a step, and more are needed.
        """
        nominal = law.model.input_for(at.state, at.highest)
        small = np.flatnonzero(np.linalg.norm(nominal, axis=1) < APEX * self.bound)
        m = law.num_outputs
        directions = np.concatenate([np.eye(m), -np.eye(m)])
        return Facets(small.repeat(2 * m), np.tile(directions, (len(small), 1)))

    def facet_margins(
        self, law: SlidingLaw, at: Instant, margins: Array, facets: Facets
    ) -> Array:
        """With u'v for the norm of v = B⁻¹ y*^(n)."""
        nominal = law.model.input_for(at.state, at.highest)[facets.place]
        along = (facets.direction * nominal).sum(axis=1)
        return margins[facets.place, 0] + euclidean_norm(nominal) - along

    def slopes(
        self, law: SlidingLaw, at: Instant, secant: float, facets: Facets
    ) -> Slopes:
        """See base class."""
        inputs = InputSlopes(law, at, secant)
        nominal, spread = inputs.nominal, inputs.spread
        against = (spread / euclidean_norm(spread)[:, None])[:, None]
        by_model, by_highest, by_gain = inputs.through_spread(-against)
        # ‖B⁻¹ y*^(n)‖ along its own direction, and along the facets' ones.
        each = np.concatenate([np.arange(len(nominal)), facets.place])
        steepest = nominal / euclidean_norm(nominal)[:, None]
        along = np.concatenate([steepest, facets.direction])
        own_model, own_highest = inputs.through_nominal(each, -along)
        return Slopes(
            by_model=by_model[each, 0] + own_model,
            by_highest=by_highest[each, 0] + own_highest,
            by_gain=by_gain[each, 0],
        )

    def curvature(self, at: Instant) -> Array:
        """Of ‖y*^(n)‖, which stands for ‖B⁻¹ y*^(n)‖."""
        size = np.maximum(np.linalg.norm(at.highest, axis=1), SMALLEST_HIGHEST)
        unit = at.highest / size[:, None]
        outer = unit[:, :, None] * unit[:, None, :]
        return (np.eye(unit.shape[1]) - outer) / size[:, None, None]
