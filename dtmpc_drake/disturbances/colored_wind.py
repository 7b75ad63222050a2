"""Wind: filtered noise."""

from __future__ import annotations

import dataclasses

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import OutputPort
from pydrake.systems.primitives import FirstOrderLowPassFilter, Gain, Saturation

from dtmpc_drake.checks import Setting, require_not_negative, require_positive
from dtmpc_drake.disturbances.base import Disturbance, Parts, register_disturbance

_SAMPLES_PER_CORRELATION_TIME = 10
_SHORTEST_SAMPLE = 0.005  # of the wind's white noise, in s


@register_disturbance
@dataclasses.dataclass
class ColoredWind(Disturbance):
    """Filtered white noise, clipped to the bound.

    Attributes:
        bound: D on every output, in m/s².
        correlation_time: of the first-order filter, in s.
        intensity: standard deviation before clipping, as a fraction of D.
    """

    bound: list[float] = dataclasses.field(default_factory=lambda: [0.5] * 3)
    correlation_time: float = 0.5
    intensity: float = 0.5

    short_name = "wind"

    def build(self, parts: Parts) -> OutputPort:
        """See base class."""
        tau, bound = self.correlation_time, parts.bound
        sample = max(tau / _SAMPLES_PER_CORRELATION_TIME, _SHORTEST_SAMPLE)
        # Held noise w passes the filter as x+ = a x + (1 - a) w: this much of
        # it gives x the deviation that is asked for.
        a = np.exp(-sample / tau)
        deviation = self.intensity * bound * np.sqrt((1 + a) / (1 - a))
        return parts.chain(
            parts.noise(RandomDistribution.kGaussian, sample),
            Gain(k=deviation),
            FirstOrderLowPassFilter(time_constant=tau, size=len(bound)),
            Saturation(min_value=-bound, max_value=bound),
        )

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        super().check(path, setting)
        require_positive(f"{path}.correlation_time", self.correlation_time, "s")
        require_not_negative(f"{path}.intensity", self.intensity, "")

    def rates(self) -> dict[str, float]:
        """That of the filter."""
        tau = self.correlation_time
        return {f"correlation_time = {tau:g} s": 1 / tau}

    @classmethod
    def hard(cls, bound: list[float]) -> ColoredWind:
        """Clipped as often as not."""
        return cls(bound=bound, intensity=1.0)
