"""Waves: a sinusoid on every output, whose phase the seed decides."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import LeafSystem, OutputPort

from dtmpc_drake.checks import Setting, require_positive
from dtmpc_drake.disturbances import Disturbance, Parts, register_disturbance


@register_disturbance
@dataclasses.dataclass
class Waves(Disturbance):
    """``d = D sin(2π (t / period + phase))``."""

    bound: list[float] = dataclasses.field(default_factory=lambda: [0.3, 0.3])
    period: float = 3.0

    short_name = "waves"

    def check(self, path: str, setting: Setting) -> None:
        super().check(path, setting)
        require_positive(f"{path}.period", self.period, "s")

    def build(self, parts: Parts) -> OutputPort:
        phase = parts.noise(RandomDistribution.kUniform)
        waves = parts.chain(phase, Sine(len(parts.bound), self.period))
        return parts.scaled(waves, parts.bound)


class Sine(LeafSystem):
    """The sine of time, at the phases of its input."""

    def __init__(self, size: int, period: float) -> None:
        LeafSystem.__init__(self)
        self._phase = self.DeclareVectorInputPort("phase", size)
        self._period = period
        self.DeclareVectorOutputPort("sine", size, self._calc)

    def _calc(self, context: Any, output: Any) -> None:
        turns = context.get_time() / self._period + self._phase.Eval(context)
        output.SetFromVector(np.sin(2 * np.pi * turns))
