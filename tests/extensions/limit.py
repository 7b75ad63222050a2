"""A limit that the library does not have: the power that the input brings in."""

import dataclasses

import numpy as np

from dtmpc_drake.checks import require_positive
from dtmpc_drake.limits import SampledLimit, register_limit
from dtmpc_drake.method.tightening import input_bound
from dtmpc_drake.numerics.arrays import euclidean_norm, magnitude


@register_limit
@dataclasses.dataclass(frozen=True)
class PowerLimit(SampledLimit):
    """``|u'dy/dt| <= bound``, by ``‖u‖ ‖dy/dt‖``; for models of order two or more.

    Attributes:
        bound: in W/kg.
    """

    bound: float

    name = "power"

    @property
    def size(self):
        return self.bound

    def unit(self, law):
        return "W/kg"

    def margins(self, law, at):
        fastest = euclidean_norm(magnitude(at.derivative(1)) + at.box[..., 1, :])
        return np.asarray(self.bound - input_bound(law, at) * fastest)[..., None]

    def proven(self, enclosure):
        # All of this grows with the box, and is convex in y*^(n).
        return self.margins(enclosure.law, enclosure.instant).min(axis=0)

    def check(self, path, setting):
        require_positive(f"{path}.bound", self.bound, "")

    def flown(self, state, control):
        power = np.abs((control * state[..., 1, :]).sum(axis=-1))
        return self.bound - power[..., None]
