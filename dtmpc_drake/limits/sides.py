"""A least and a largest value of each of several numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from dtmpc_drake.checks import require_magnitude
from dtmpc_drake.errors import require
from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass
class Sides:
    """``min <= z <= max`` as rows ``a'z <= b``.

    Attributes:
        min: one for each number; null where there is none.
        max: the same.
    """

    min: list[float | None] | None = None
    max: list[float | None] | None = None

    def both(self) -> Array:
        """The least and the largest value, infinite where there is none, ``(m, 2)``."""
        count = len(self.min or self.max or ())
        both = np.full((count, 2), [-np.inf, np.inf])
        for column, side in enumerate((self.min, self.max)):
            for i, bound in enumerate(side or ()):
                if bound is not None:
                    both[i, column] = bound
        return both

    def normals(self, count: int) -> Array:
        """The rows a, one for every bound that there is, ``(q, count)``."""
        eye = np.eye(count)
        return np.stack([-eye, eye], axis=1)[np.isfinite(self.both())]

    @property
    def bounds(self) -> Array:
        """The bounds b, ``(q,)``."""
        both = self.both() * [-1.0, 1.0]
        return both[np.isfinite(both)]

    def of_row(self, row: int) -> int:
        """Which of the numbers a row is about."""
        return int(np.argwhere(np.isfinite(self.both()))[row, 0])

    def side(self, row: int, names: Sequence[str]) -> str:
        """What a row is about, ``min of axis z``."""
        i, column = np.argwhere(np.isfinite(self.both()))[row]
        return f"{'min' if column == 0 else 'max'} of {names[i]}"

    def sides_in(self, unit: float) -> tuple[Any, Any]:
        """Both sides in another unit."""
        both = self.min, self.max
        low, high = (
            side and [None if bound is None else bound / unit for bound in side]
            for side in both
        )
        return low, high

    def check_sides(self, path: str, units: Sequence[str]) -> None:
        """Refuses bounds that make no sense.

        Args:
            path: of this section, for errors.
            units: of what is bounded.
        """
        for name in ("min", "max"):
            side = getattr(self, name)
            if side is None:
                continue
            field = f"{path}.{name}"
            allowed = f"{len(units)} numbers, one each, null where there is no bound"
            require(field, side, len(side) == len(units), allowed)
            for i, bound in enumerate(side):
                if bound is not None:
                    require_magnitude(f"{field}[{i}]", bound, units[i])
        both = self.both()
        given = bool(np.isfinite(both).any())
        require(path, None, given, "left out, or given a min or a max that is no null")
        for i, (low, high) in enumerate(both):
            allowed = f"greater than {path}.min[{i}] = {low:g} {units[i]}"
            require(f"{path}.max[{i}]", high, low < high, allowed)
