"""Limits of a user's own in a problem's own units.

They are asked in the units that they know, and so their margins stay in them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.limits.base import ConvexLimit, Limit, SampledLimit
from dtmpc_drake.method.enclosure import Enclosure
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array, BoolArray


@dataclasses.dataclass(frozen=True, eq=False)
class _Translated(Limit):
    """A limit that is asked in the user's units.

    Attributes:
        limit: in the user's units.
        law: the controller, in the user's units.
        units: the problem's own in the user's.
    """

    limit: Limit
    law: SlidingLaw
    units: Units

    @property
    def name(self) -> str:  # type: ignore[override]
        """See base class."""
        return self.limit.name

    @property
    def title(self) -> str:
        """See base class."""
        return self.limit.title

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        return self.limit.unit(self.law, column)

    def where(self, law: SlidingLaw, column: int) -> str:
        """See base class."""
        return self.limit.where(self.law, column)

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """See base class; in the user's unit."""
        return self.limit.margins(self.law, _for_user(at, self.units))

    def proven(self, enclosure: Enclosure) -> Array:
        """See base class; in the user's unit."""
        return self.limit.proven(enclosure.for_user(self.law))


@dataclasses.dataclass(frozen=True, eq=False)
class _TranslatedSampled(_Translated, SampledLimit):
    """The same of a `SampledLimit`."""

    limit: SampledLimit

    @property
    def between_knots(self) -> bool:  # type: ignore[override]
        """See base class."""
        return self.limit.between_knots

    @property
    def scale(self) -> float:
        """See base class."""
        return self.limit.scale

    @property
    def size(self) -> Array | float:
        """See base class."""
        return self.limit.size


@dataclasses.dataclass(frozen=True, eq=False)
class _TranslatedConvex(_Translated, ConvexLimit):
    """The same of a `ConvexLimit`, whose margins are those of the derivative."""

    limit: ConvexLimit

    @property
    def _unit(self) -> float:
        return self.units.of(self.limit.derivative)

    @property
    def derivative(self) -> int:
        """See base class."""
        return self.limit.derivative

    def reads(self, num_outputs: int) -> BoolArray:
        """See base class."""
        return self.limit.reads(num_outputs)

    @property
    def size(self) -> float | None:
        """See base class."""
        size = self.limit.size
        return None if size is None else size / self._unit

    def left(self, value: Array, spread: Array) -> Array:
        """See base class."""
        return self.limit.left(value * self._unit, spread * self._unit) / self._unit

    def left_slopes(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """See base class."""
        return self.limit.left_slopes(value * self._unit, spread * self._unit)

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """See base class."""
        return super().margins(law, at) / self._unit

    def proven(self, enclosure: Enclosure) -> Array:
        """See base class."""
        return super().proven(enclosure) / self._unit


def _for_user(at: Instant, units: Units) -> Instant:
    n = at.state.shape[-2]
    rows, highest = units.of_rows(n), units.of(n)
    return Instant(
        state=at.state * rows,
        highest=at.highest * highest,
        gain=at.gain * highest,
        error_bound=at.error_bound * rows,
        state_radius=at.state_radius * rows,
        gain_radius=at.gain_radius * np.float64(highest),
    )


def in_units(limit: Limit, law: SlidingLaw, units: Units) -> Limit:
    """A limit in a problem's own units.

    Args:
        limit: in the user's units.
        law: the controller, in the user's units.
        units: the problem's own in the user's.
    """
    known = limit.in_units(units, law.order)
    if known is not None:
        return known
    if isinstance(limit, SampledLimit):
        return _TranslatedSampled(limit, law, units)
    if isinstance(limit, ConvexLimit):
        return _TranslatedConvex(limit, law, units)
    return _Translated(limit, law, units)
