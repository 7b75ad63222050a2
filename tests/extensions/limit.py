"""A limit that the library does not have: the power that the input brings in."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.checks import Setting, require_positive
from dtmpc_drake.limits import SampledLimit, register_limit
from dtmpc_drake.method.enclosure import Enclosure
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant, input_bound
from dtmpc_drake.numerics.arrays import Array, euclidean_norm, magnitude


@register_limit
@dataclasses.dataclass(frozen=True)
class PowerLimit(SampledLimit):
    """``|u'dy/dt| <= bound`` in W/kg, by ``‖u‖ ‖dy/dt‖``; for n of two or more."""

    bound: float

    name = "power"

    @property
    def size(self) -> float:
        return self.bound

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        return "W/kg"

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        fastest = euclidean_norm(magnitude(at.derivative(1)) + at.box[..., 1, :])
        return np.asarray(self.bound - input_bound(law, at) * fastest)[..., None]

    def proven(self, enclosure: Enclosure) -> Array:
        # All of this grows with the box, and is convex in y*^(n).
        return np.min(self.margins(enclosure.law, enclosure.instant), axis=0)

    def flown(self, state: Array, control: Array) -> Array:
        power = np.abs((control * state[..., 1, :]).sum(axis=-1))
        return np.asarray(self.bound - power)[..., None]

    def check(self, path: str, setting: Setting) -> None:
        require_positive(f"{path}.bound", self.bound, "")
