"""Held and redrawn, uniformly."""

from __future__ import annotations

import dataclasses

from pydrake.common import RandomDistribution
from pydrake.systems.framework import OutputPort

from dtmpc_drake.checks import Setting, require_positive
from dtmpc_drake.disturbances.base import Disturbance, Parts, register_disturbance


@register_disturbance
@dataclasses.dataclass
class UniformHold(Disturbance):
    """A disturbance drawn uniformly from its bounds, held, and redrawn.

    Attributes:
        bound: D on every output, in m/s².
        hold: how long a value is kept, in s.
    """

    bound: list[float] = dataclasses.field(default_factory=lambda: [0.5] * 3)
    hold: float = 0.05

    short_name = "uniform"

    def build(self, parts: Parts) -> OutputPort:
        """Uniform on [0, 1), stretched to [-D, D)."""
        uniform = parts.noise(RandomDistribution.kUniform, self.hold)
        stretched = parts.scaled(uniform, 2 * parts.bound)
        return parts.sum(stretched, parts.constant(-parts.bound))

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        super().check(path, setting)
        require_positive(f"{path}.hold", self.hold, "s")

    def periods(self) -> dict[str, float]:
        """A new value after every hold."""
        return {"hold": self.hold}
