"""A problem's own units, in which all problems look alike.

What a search calls near, small or long is a matter of units: ten of a vehicle that is
given in millimetres are no distance.  So problems are planned and proven in units of
their own, in which the largest speed is about 2.5 and the faster of the rates by which
a tube forgets, the slope of the sliding surface and half of the largest bandwidth, is
about 2, whatever units a user has.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from dtmpc_drake.numerics.arrays import Array

SPEED, RATE = 2.5, 2.0
"""In a problem's own units."""
NEAR = np.sqrt(2.0)
"""A user's unit of length or time that is within this factor is taken."""


@dataclasses.dataclass(frozen=True)
class Units:
    """What own units are in those of the user.

    Attributes:
        length: of outputs.
        time: in s.
        cost: of the optimum.
    """

    length: float = 1.0
    time: float = 1.0
    cost: float = 1.0

    @classmethod
    def own(
        cls,
        *,
        speed: float,
        slope: Array,
        bandwidth: Array | float,
        orders: Sequence[int],
    ) -> Units:
        """Those of a problem.

        The cost goes with them, so that a weight of the input stays what it is.  Where
        outputs differ in their order the unit of time is the user's: in another one
        their inputs, of which there may be norms, would no longer be so large as each
        other.

        Args:
            speed: the largest that is allowed along an axis.
            slope: λ, ``(m,)``, in 1/s.
            bandwidth: the largest α, one for all outputs or ``(m,)``, in rad/s.
            orders: n_i of every output; without sliding surfaces (n = 1) the slope
                says nothing.
        """
        order, alike = max(orders), min(orders) == max(orders)
        rate = float(np.mean(bandwidth)) / 2
        if order > 1:
            rate = max(rate, float(np.mean(slope)))
        time = _unless_near(RATE / rate) if alike and rate > 0 else 1.0
        length = _unless_near(speed * time / SPEED)
        return cls(length, time, (length / time**order) ** 2 * time)

    @property
    def are_the_users(self) -> bool:
        """Whether nothing has to be converted."""
        return self == Units()

    def of(self, derivative: int) -> float:
        """The unit of a derivative of the output."""
        return self.length / self.time**derivative

    def of_rows(self, count: int) -> Array:
        """Those of the output and its first derivatives, ``(count, 1)``."""
        return np.array([[self.of(k)] for k in range(count)])

    def inverse(self) -> Units:
        """The user's units in those of the problem."""
        return Units(1 / self.length, 1 / self.time, 1 / self.cost)


def _unless_near(unit: float) -> float:
    """A unit, or the user's: where that is near, or where numbers are broken."""
    usable = 0 < unit < np.inf  # not so for NaN; who planned with it is told later
    return 1.0 if not usable or 1 / NEAR <= unit <= NEAR else unit
