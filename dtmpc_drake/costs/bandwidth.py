"""The cost of bandwidth and of its rate, α̃ᵀRα̃ + vᵀR_v v with v = dα/dt."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.costs.weights import Weight, is_nothing, matrix_of, square
from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass(frozen=True, eq=False)
class BandwidthCost:
    """``(α - floor)'R(α - floor) + v'R_v v``, for α that is linear between knots.

    It is a cost of the decisions themselves, which programs have exactly.

    Attributes:
        weight: R: a number, a list or a matrix; see `weights`.
        floor: α̲, in rad/s.
        rate_weight: R_v, of the same forms.
    """

    weight: Weight
    floor: float
    rate_weight: Weight = 0.0

    @property
    def charges_rate(self) -> bool:
        """Whether the rate costs anything."""
        return not is_nothing(self.rate_weight)

    def running(self, bandwidth: Array, step: float) -> Array:
        """At the knots, to be added up by the trapezoidal rule.

        The rate jumps there: it counts with the mean of both sides, with which that
        rule is exact.

        Args:
            bandwidth: α, ``(K, m)``.
            step: between two knots, in s.

        Returns:
            ``(K,)``.
        """
        of_bandwidth = square(self.weight, bandwidth - self.floor)
        if not self.charges_rate or len(bandwidth) < 2:
            return of_bandwidth
        each = square(self.rate_weight, np.diff(bandwidth, axis=0) / step)
        sides = np.concatenate([each[:1], each, each[-1:]])
        return of_bandwidth + (sides[1:] + sides[:-1]) / 2

    def hessian(self, outputs: int) -> Array:
        """Of ``running`` by α where the rate costs nothing, ``(m, m)``."""
        return 2 * matrix_of(self.weight, outputs)

    def rate_hessian(self, outputs: int, step: float) -> Array:
        """Of the rate's cost on one piece by α at both of its ends, ``(2 m, 2 m)``."""
        both = np.array([[1.0, -1.0], [-1.0, 1.0]])
        return np.kron(both, 2 / step * matrix_of(self.rate_weight, outputs))
