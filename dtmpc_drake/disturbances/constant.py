"""One push for ever."""

from __future__ import annotations

import dataclasses

from pydrake.systems.framework import OutputPort

from dtmpc_drake.checks import Setting
from dtmpc_drake.disturbances.base import Disturbance, Parts, register_disturbance
from dtmpc_drake.errors import require


@register_disturbance
@dataclasses.dataclass
class Constant(Disturbance):
    """A constant disturbance at a fraction of the bound.

    Attributes:
        bound: D on every output, in m/s².
        fraction: of the bound, in [-1, 1].
    """

    bound: list[float] = dataclasses.field(default_factory=lambda: [0.5] * 3)
    fraction: float = 1.0

    def build(self, parts: Parts) -> OutputPort:
        """See base class."""
        return parts.constant(self.fraction * parts.bound)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        super().check(path, setting)
        fraction = self.fraction
        require(f"{path}.fraction", fraction, abs(fraction) <= 1, "in [-1, 1]")
