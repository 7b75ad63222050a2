"""What the numbers of a scenario may be, for whoever answers for own fields.

The ranges are wide, for a scenario may be written in millimetres or kilometres, and
in milliseconds or hours.  They keep sums, squares and products of all that is in a
scenario far from the ends of a floating-point number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

from dtmpc_drake.errors import require

RANGES = {
    "s": (1e-6, 1e9),
    "m": (1e-9, 1e9),
    "m/s": (1e-9, 1e9),
    "m/s²": (1e-12, 1e12),  # and higher derivatives
    "1/s": (1e-6, 1e6),
    "rad/s": (1e-6, 1e6),
    "1/m": (1e-9, 1e9),
    "": (1e-9, 1e9),
}
"""By unit, the smallest number that is not zero and the largest magnitude.  The
smallest is only asked of what must not be zero.  Any other unit of a length stands in
the place of the metre."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a model, an obstacle or a disturbance is part of.

    Attributes:
        num_outputs: m, of the model.
        order: n, of the model.
        duration: of the scenario, in s.
        length_unit: of positions and obstacles.
        output_units: of every output.
        highest_units: of the derivative of order n_i of every output.
        input_units: of every input.
        num_positions: of the outputs that say where it is; all if left out.
    """

    num_outputs: int
    order: int
    duration: float
    length_unit: str
    output_units: tuple[str, ...]
    highest_units: tuple[str, ...]
    input_units: tuple[str, ...]
    num_positions: int | None = None

    @property
    def place(self) -> Setting:
        """The same for what lives in the space of these outputs alone."""
        if self.num_positions is None:
            return self
        return dataclasses.replace(self, num_outputs=self.num_positions)


class Part:
    """What a scenario is made of: it answers for its own fields."""

    required: ClassVar[tuple[str, ...]] = ()
    """Fields that a file must give, though they have a default."""

    def check(self, path: str, setting: Setting) -> None:
        """Refuses fields that make no sense; extended by whoever has some.

        All fields of a dataclass are of the types that it says by then, and finite.

        Args:
            path: of this section, for errors.
            setting: what it must fit.

        Raises:
            ScenarioError: that names the field.
        """
        return


def derivative_unit(unit: str, order: int) -> str:
    """The unit of a derivative, such as ``m/s²``."""
    power = "".join("⁰¹²³⁴⁵⁶⁷⁸⁹"[int(digit)] for digit in str(order))
    seconds = {0: "", 1: "/s"}.get(order, f"/s{power}")
    return f"{unit}{seconds}"


def range_of(unit: str) -> tuple[float, float]:
    """The smallest number and the largest magnitude; see `RANGES`."""
    if unit in RANGES:
        return RANGES[unit]
    above, slash, below = unit.partition("/")
    if above == "1":
        return RANGES["1/m"]
    return RANGES["m/s²" if below not in ("", "s") else f"m{slash}{below}"]


def require_positive(field: str, value: float, unit: str) -> None:
    """Requires a number that is greater than zero and in the range of its unit."""
    low, high = range_of(unit)
    allowed = f"greater than 0 {unit}".rstrip() + f", in [{low:g}, {high:g}]"
    require(field, value, low <= value <= high, allowed)


def require_magnitude(field: str, value: float, unit: str) -> None:
    """Requires a number of either sign that is not too large for its unit."""
    high = range_of(unit)[1]
    allowed = f"in [{-high:g}, {high:g}] {unit}".rstrip()
    require(field, value, abs(value) <= high, allowed)


def require_not_negative(field: str, value: float, unit: str) -> None:
    """Requires a number that is at least zero and not too large for its unit."""
    require_magnitude(field, value, unit)
    require(field, value, value >= 0, "at least 0")


def require_length(field: str, values: Sequence[float], num_outputs: int) -> None:
    """Requires one number for each output."""
    allowed = f"{num_outputs} numbers, one for each output"
    require(field, values, len(values) == num_outputs, allowed)
