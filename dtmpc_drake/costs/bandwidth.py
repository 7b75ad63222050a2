"""The cost of bandwidth, α̃ᵀRα̃ with R a multiple of the identity."""

from __future__ import annotations

import dataclasses

from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass(frozen=True)
class BandwidthCost:
    """``weight ‖α - floor‖²``.

    It is a cost of the decisions themselves, which programs have exactly.

    Attributes:
        weight: R, times the identity.
        floor: α̲, in rad/s.
    """

    weight: float
    floor: float

    def running(self, bandwidth: Array) -> Array:
        """At instants, of α ``(..., m)``, shape ``(...)``."""
        return self.weight * ((bandwidth - self.floor) ** 2).sum(axis=-1)
