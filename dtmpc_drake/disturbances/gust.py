"""All outputs in one direction, for long."""

from __future__ import annotations

import dataclasses

from pydrake.common import RandomDistribution
from pydrake.systems.framework import OutputPort

from dtmpc_drake.checks import Setting, require_positive
from dtmpc_drake.disturbances.base import (
    LOOK,
    Disturbance,
    Parts,
    register_disturbance,
)
from dtmpc_drake.disturbances.gusts import Gusts


@register_disturbance
@dataclasses.dataclass
class Gust(Disturbance):
    """A disturbance that pushes all outputs in one direction, for long.

    Each is as strong as the bounds allow: one half of the time at a corner of the
    box abs(d) <= D, and else anywhere on its surface.

    Attributes:
        bound: D on every output, in m/s².
        hold: how long a direction is kept, in s; long compared with 1/λ and 1/α.
        model_error: whether the model error is Δ(x) in the same direction, instead
            of what the plant's true parameters make of it.
    """

    bound: list[float] = dataclasses.field(default_factory=lambda: [0.5] * 3)
    hold: float = 4.0
    model_error: bool = False

    short_name = "gust"

    def build(self, parts: Parts) -> OutputPort:
        """See base class."""
        m = parts.model.num_outputs
        noise = parts.noise(RandomDistribution.kUniform, LOOK, m + 1)
        gusts = Gusts(num_outputs=m, hold=self.hold, period=LOOK, trials=parts.count)
        push = parts.chain(noise, gusts)
        scaled = parts.scaled(push, parts.bound)
        if self.model_error:
            parts.choose_model_error(push)
        return scaled

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        super().check(path, setting)
        require_positive(f"{path}.hold", self.hold, "s")

    def periods(self) -> dict[str, float]:
        """A new direction after every hold."""
        return {"hold": self.hold}

    @classmethod
    def hard(cls, bound: list[float]) -> Gust:
        """With the model error, too."""
        return cls(bound=bound, model_error=True)
