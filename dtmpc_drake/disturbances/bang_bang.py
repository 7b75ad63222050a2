"""From one end to the other, at random."""

from __future__ import annotations

import dataclasses

from pydrake.common import RandomDistribution
from pydrake.systems.framework import OutputPort

from dtmpc_drake.checks import Setting, require_positive
from dtmpc_drake.disturbances.base import Disturbance, Parts, register_disturbance
from dtmpc_drake.disturbances.relay import Relay


@register_disturbance
@dataclasses.dataclass
class BangBang(Disturbance):
    """A disturbance that jumps between -D and D at random.

    Attributes:
        bound: D on every output, in m/s².
        hold: how long a sign is kept, in s.
    """

    bound: list[float] = dataclasses.field(default_factory=lambda: [0.5] * 3)
    hold: float = 0.5

    short_name = "bang_bang"

    def build(self, parts: Parts) -> OutputPort:
        """The sign of noise, at full force."""
        gaussian = parts.noise(RandomDistribution.kGaussian, self.hold)
        return parts.chain(gaussian, Relay(force=parts.bound))

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        super().check(path, setting)
        require_positive(f"{path}.hold", self.hold, "s")

    def periods(self) -> dict[str, float]:
        """A new sign after every hold."""
        return {"hold": self.hold}
