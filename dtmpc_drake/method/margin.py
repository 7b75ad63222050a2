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
        worth: so large is an own unit of the problem in the unit of the value.
    """

    value: float
    unit: str
    time: float
    where: str
    worth: float = 1.0

    @property
    def rank(self) -> float:
        """By which margins of different units compare; what is not finite is first."""
        return self.value / self.worth if math.isfinite(self.value) else -math.inf

    @property
    def kept(self) -> bool:
        """Whether the limit is kept; what is not finite is not."""
        return math.isfinite(self.value) and self.value >= 0

    def summary(self) -> dict[str, float | str]:
        """As plain numbers and texts."""
        names = "value", "unit", "time", "where"
        return {name: getattr(self, name) for name in names}

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
    time: Array,
    values: Array,
    unit: str | Sequence[str],
    where: Sequence[str],
    worth: float = 1.0,
) -> Margin:
    """The smallest of ``(K, q)`` values; one that is not finite comes before all.

    Args:
        time: ``(K,)``, in s.
        values: ``(K, q)``, not empty, in own units of a problem.
        unit: of the user, for all columns or for each.
        where: names of the columns.
        worth: of an own unit in those of the user.
    """
    ranked = np.where(np.isfinite(values), values, -np.inf)
    row, column = np.unravel_index(int(np.argmin(ranked)), values.shape)
    if not isinstance(unit, str):
        unit = unit[int(column)]
    value = float(values[row, column] * worth)
    return Margin(value, unit, float(time[row]), where[int(column)], worth)


def worst(margins: Iterable[Margin]) -> Margin:
    """The smallest of several margins, each in own units."""
    return min(margins, key=lambda margin: margin.rank)
