"""How large things are drawn, and how fast a replay plays.

Sizes in pictures are given for fields of some ten units of length, tubes of some tenths
of one and flights of some ten seconds.  Where a problem is of another size, or in other
units, they are multiplied by one, two or five times a power of ten.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.records.plan import Plan
from dtmpc_drake.visualization.geometry import embedding, tube_box

_FIELD, _FIELDS = 20.0, (2.5, 100.0)  # usual length, and what is near enough
_TIME, _TIMES = 30.0, (1.0, 100.0)  # the same of durations, in s
_TUBE = 0.3  # usual half-width


@dataclasses.dataclass(frozen=True)
class Scale:
    """What drawn sizes are multiples of, in a problem's units.

    Attributes:
        field: of grid, discs, poles and margins; the unit of the whole scene.
        tube: of vehicle, lines and the camera that follows: as that of the field, but
            less where the tube is much thinner.
        time: how many times faster than the flight a replay plays.
    """

    field: float = 1.0
    tube: float = 1.0
    time: float = 1.0

    @classmethod
    def of(cls, plan: Plan) -> Scale:
        """The scale of a plan's picture."""
        E = embedding(plan.num_outputs)
        low, high = (E @ corner for corner in tube_box(plan))
        field = _nice(float((high - low).max()), _FIELD, _FIELDS)
        half = plan.position_tube(plan.sample_times())[:, : np.count_nonzero(E)]
        thin = float(np.median(half)) / (_TUBE * field)
        tube = field * float(10.0 ** np.ceil(np.log10(thin))) if 0 < thin < 1 else field
        duration = plan.end_time - plan.start_time
        return cls(field, tube, _nice(duration, _TIME, _TIMES))

    @property
    def tube_is_thin(self) -> bool:
        """Whether a tube can hardly be seen from afar."""
        return self.tube < self.field

    @property
    def from_afar(self) -> Scale:
        """The same for what is only seen from afar, all of it as large as the field."""
        return dataclasses.replace(self, tube=self.field)


def decimals(size: float) -> int:
    """How many show a hundredth of a number of this size, or of the digit before it."""
    return int(np.clip(2 - np.trunc(np.log10(max(size, 1e-9))), 0, 9))


def _nice(size: float, usual: float, near: tuple[float, float]) -> float:
    """A round number by which a size is not far from the usual one."""
    if size <= 0.0 or near[0] <= size <= near[1]:
        return 1.0
    rough = size / usual
    power = float(10.0 ** np.floor(np.log10(rough)))
    return power * min(
        (1.0, 2.0, 5.0, 10.0), key=lambda n: abs(np.log(rough / power / n))
    )
