"""Margins: how much is left of a limit, or that nothing can be said about it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence

import numpy as np

from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass(frozen=True)
class Margin:
    """The smallest distance from a limit over a whole plan.

    Attributes:
        value: negative where the limit is broken; not finite where it is unknown.
        unit: of the value.
        time: when it is smallest, in s.
        where: which obstacle, axis or bound.
    """

    value: float
    unit: str
    time: float
    where: str

    @property
    def kept(self) -> bool:
        """Whether the limit is kept; what is not finite is not."""
        return math.isfinite(self.value) and self.value >= 0

    def named(self, name: str) -> str:
        """One line that says of which limit this is the margin."""
        if math.isfinite(self.value):
            return f"{name} {self}"
        kind = "not a number" if math.isnan(self.value) else "infinite"
        return f"{kind} in {name} at t = {self.time:.2f} s" + self._place

    @property
    def _place(self) -> str:
        return f" ({self.where})" if self.where else ""

    def __str__(self) -> str:
        """For one line of a report."""
        value = f"{self.value:+.4f} {self.unit}".rstrip()
        if 0 < abs(self.value) < 5e-5:  # never a broken limit that reads +0.0000
            value = f"{self.value:+.1e} {self.unit}".rstrip()
        return f"{value} at t = {self.time:.2f} s{self._place}"


def smallest(
    time: Array, values: Array, unit: str, where: str | Sequence[str]
) -> Margin:
    """The smallest of ``(K, q)`` values; one that is not finite comes before all.

    Args:
        time: ``(K,)``, in s.
        values: ``(K, q)``, not empty.
        unit: of the values.
        where: names of the columns, or what they are called before their number.
    """
    ranked = np.where(np.isfinite(values), values, -np.inf)
    row, column = np.unravel_index(int(np.argmin(ranked)), values.shape)
    if isinstance(where, str):
        name = f"{where} {column}" if where else ""
    else:
        name = where[int(column)]
    return Margin(float(values[row, column]), unit, float(time[row]), name)


def worst(margins: Iterable[Margin]) -> Margin:
    """The smallest of several margins, as `smallest`."""
    return min(margins, key=lambda m: m.value if math.isfinite(m.value) else -math.inf)
