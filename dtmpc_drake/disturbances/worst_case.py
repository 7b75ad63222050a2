"""Away from the plan, with all that is allowed."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import OutputPort

from dtmpc_drake.checks import Setting, require_positive
from dtmpc_drake.disturbances.base import (
    LOOK,
    Disturbance,
    Parts,
    register_disturbance,
)
from dtmpc_drake.disturbances.relay import Relay
from dtmpc_drake.disturbances.reversals import Reversals
from dtmpc_drake.disturbances.sliding_error import SlidingError
from dtmpc_drake.method.chains import Chains

_NUDGE = 1e-6
"""Far above what rounding makes of s, far below what a push does."""


@register_disturbance
@dataclasses.dataclass
class WorstCase(Disturbance):
    """A disturbance that pushes away from the plan with all that is allowed.

    It pushes along the sliding variable; where there is no error yet, the seed
    decides to which side of every output.  With `hold` it pushes every output to a
    side that the seed decides, and at random times to the opposite one.

    Attributes:
        bound: D on every output, in m/s².
        hold: the mean time between two reversals of the push on an output, in s;
            if left out, it follows the sliding variable.
        model_error: whether the model error is at a bound, too: ±Δ(x), on the side
            of the push, instead of what the plant's true parameters make of it.
            With `hold` the two are now and then apart.
    """

    bound: list[float] = dataclasses.field(default_factory=lambda: [0.5] * 3)
    hold: float | None = None
    model_error: bool = False

    short_name = "worst_case"

    def build(self, parts: Parts) -> OutputPort:
        """See base class."""
        if self.hold is None:
            push = model_error_push = _along_the_error(parts)
        else:
            holds = [one.hold for one in parts.each(self) if one.hold]
            push, model_error_push = _reversals(parts, holds)
        scaled = parts.scaled(push, parts.bound)
        if self.model_error:
            parts.choose_model_error(model_error_push)
        return scaled

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        super().check(path, setting)
        if self.hold is not None:
            require_positive(f"{path}.hold", self.hold, "s")

    def periods(self) -> dict[str, float]:
        """As many reversals as there are holds."""
        return {} if self.hold is None else {"hold": self.hold}

    @classmethod
    def hard(cls, bound: list[float]) -> WorstCase:
        """Reverses its push, and has the model error, too."""
        return cls(bound=bound, hold=1.5, model_error=True)

    @property
    def is_varied(self) -> bool:
        """One that follows the error has but one side of every output to choose."""
        return self.hold is not None

    def drawn(self, *, patience: float) -> WorstCase:
        """See base class."""
        if self.hold is None:
            return self
        return dataclasses.replace(self, hold=patience * self.hold)


def _along_the_error(parts: Parts) -> OutputPort:
    """The side of every output to which s goes.

    At s = 0 it pushes too: one that waited for an error would never see any.
    The seed decides to which side, not rounding.
    """
    error = parts.builder.AddSystem(
        SlidingError(
            slope=parts.slope, chains=Chains.of(parts.model), trials=parts.count
        )
    )
    for name in ("state", "reference"):
        parts.look_at(name, error)
    s = error.get_output_port()
    side = parts.noise(RandomDistribution.kGaussian)
    nudged = parts.sum(s, parts.scaled(side, np.full(s.size(), _NUDGE)))
    return parts.chain(nudged, Relay(force=np.ones(s.size())))


def _reversals(parts: Parts, holds: Sequence[float]) -> tuple[OutputPort, OutputPort]:
    """One side of every output, and at random times the other: for d and f̃."""
    noise = parts.noise(RandomDistribution.kUniform, LOOK)
    each = np.repeat(holds, parts.model.num_outputs)
    sides = parts.builder.AddSystem(Reversals(hold=each, period=LOOK))
    parts.builder.Connect(noise, sides.get_input_port())
    return sides.GetOutputPort("push"), sides.GetOutputPort("model_error_push")
