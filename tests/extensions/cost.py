"""A cost that the library does not have: of being away from a lane."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.checks import Setting, require_length
from dtmpc_drake.costs import Cost, register_cost
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.numerics.arrays import Array


@register_cost
@dataclasses.dataclass(frozen=True)
class Lane(Cost):
    """``weight (normal'y - offset)²``, so that plans keep to a line or a plane.

    Attributes:
        normal: one number for each output.
        offset: in m.
        weight: in 1/m².
    """

    normal: list[float]
    offset: float = 0.0
    weight: float = 1.0

    def residuals(self, law: SlidingLaw, state: Array, highest: Array) -> Array:
        away = state[..., 0, :] @ np.array(self.normal) - self.offset
        return np.asarray(np.sqrt(self.weight) * away)[..., None]

    def check(self, path: str, setting: Setting) -> None:
        require_length(f"{path}.normal", self.normal, setting.num_outputs)
