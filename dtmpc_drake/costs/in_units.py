"""Costs in a problem's own units."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.costs.bandwidth import BandwidthCost
from dtmpc_drake.costs.base import Cost
from dtmpc_drake.costs.weights import Weight
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass(frozen=True, eq=False)
class _Translated(Cost):
    """A cost that is asked in the user's units.

    Attributes:
        cost: in the user's units.
        law: the controller, in the user's units.
        units: the problem's own in the user's.
        root: what its residuals are multiplied by.
        of_goal: see base class.
    """

    cost: Cost
    law: SlidingLaw
    units: Units
    root: float
    of_goal: bool

    def _shown(self, state: Array, highest: Array) -> tuple[Array, Array]:
        n = self.law.order
        return state * self.units.of_rows(n), highest * self.units.of(n)

    def residuals(self, law: SlidingLaw, state: Array, highest: Array) -> Array:
        """See base class."""
        return self.root * self.cost.residuals(self.law, *self._shown(state, highest))


def in_units(cost: Cost, law: SlidingLaw, units: Units, *, running: bool) -> Cost:
    """A cost in a problem's own units.

    Args:
        cost: in the user's units.
        law: the controller, in the user's units.
        units: the problem's own in the user's.
        running: whether it counts all the time, or at the end alone.
    """
    worth = (units.time if running else 1.0) / units.cost
    known = cost.in_units(units, worth)
    if known is not None:
        return known
    return _Translated(cost, law, units, float(np.sqrt(worth)), cost.of_goal)


def bandwidth_in_units(cost: BandwidthCost, units: Units) -> BandwidthCost:
    """The cost of the bandwidth in a problem's own units."""
    return BandwidthCost(
        weight=_times(cost.weight, 1 / (units.time * units.cost)),
        floor=cost.floor * units.time,
        rate_weight=_times(cost.rate_weight, 1 / (units.time**3 * units.cost)),
    )


def _times(weight: Weight, factor: float) -> Weight:
    return (np.array(weight) * factor).tolist()
