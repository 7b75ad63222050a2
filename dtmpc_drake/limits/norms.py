"""Limits of a norm ``‖P z + q‖ <= c`` (assumption 5, corollaries 1 and 2).

z is the output, one of its derivatives, or the input: anywhere in a box.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from dtmpc_drake.checks import (
    Part,
    Setting,
    require_length,
    require_magnitude,
    require_positive,
)
from dtmpc_drake.errors import require
from dtmpc_drake.limits.base import ConvexLimit
from dtmpc_drake.limits.input_box import InputBoxLimit
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import joined
from dtmpc_drake.numerics.arrays import Array, BoolArray, euclidean_norm

MOST_READ = 4
"""Of so many numbers in z all corners of the box are looked at."""
DERIVATIVES = "position", "velocity", "acceleration", "jerk"
"""What a derivative of the output is called."""


@dataclasses.dataclass(frozen=True, eq=False)
class Norm:
    """``‖P z + q‖ <= c`` for a z that is known up to some distance.

    Attributes:
        matrix: P, ``(r, m)``; the identity if None.
        offset: q, ``(r,)``; zero if None.
        bound: c.
    """

    matrix: Array | None
    offset: Array | None
    bound: float

    def reads(self, m: int) -> BoolArray:
        """Which numbers of z count, ``(m,)``."""
        if self.matrix is None:
            return np.ones(m, dtype=bool)
        return np.asarray(self.matrix.any(axis=0))

    def unit(self, units: Sequence[str]) -> str:
        """That of the numbers that count, of z whose units are these."""
        return joined(np.array(units)[self.reads(len(units))].tolist())

    def in_unit(self, unit: float) -> Norm:
        """The same of a z in another unit."""
        offset = None if self.offset is None else self.offset / unit
        return Norm(self.matrix, offset, self.bound / unit)

    def _parts(self, m: int) -> tuple[Array, Array, Array | None]:
        """P, q, and the signs of the corners of a box that P reads, ``(2^k, m)``."""
        matrix = np.eye(m) if self.matrix is None else self.matrix
        offset = np.zeros(len(matrix)) if self.offset is None else self.offset
        read = np.flatnonzero(matrix.any(axis=0))
        if len(read) > MOST_READ:
            return matrix, offset, None
        signs = np.zeros((2 ** len(read), m))
        signs[:, read] = [*itertools.product((-1.0, 1.0), repeat=len(read))]
        return matrix, offset, signs

    def left(self, value: Array, spread: Array) -> Array:
        """What is left at each corner of the box ``value ± spread``, ``(..., q)``.

        A norm is largest at one of them.  Of boxes with many corners there is one
        column, ``c - ‖P value + q‖ - ‖|P| spread‖``.
        """
        matrix, offset, signs = self._parts(value.shape[-1])
        if signs is None:
            seen, wide = value @ matrix.T + offset, spread @ np.abs(matrix).T
            return (self.bound - euclidean_norm(seen) - euclidean_norm(wide))[..., None]
        corners = value[..., None, :] + signs * spread[..., None, :]
        return self.bound - euclidean_norm(corners @ matrix.T + offset)

    def left_slopes(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """Derivatives of `left` by value and by spread, ``(..., q, m)`` each."""
        matrix, offset, signs = self._parts(value.shape[-1])
        if signs is None:
            seen, wide = value @ matrix.T + offset, spread @ np.abs(matrix).T
            return (
                -(_unit(seen) @ matrix)[..., None, :],
                -(_unit(wide) @ np.abs(matrix))[..., None, :],
            )
        corners = value[..., None, :] + signs * spread[..., None, :]
        by_value = -_unit(corners @ matrix.T + offset) @ matrix
        return by_value, by_value * signs


def _unit(vectors: Array) -> Array:
    return vectors / euclidean_norm(vectors)[..., None]


@dataclasses.dataclass(frozen=True, eq=False)
class DerivativeNorm(ConvexLimit):
    """``‖P y^(k) + q‖ <= c``.

    Attributes:
        of: k.
        norm: P, q and c.
    """

    of: int
    norm: Norm

    @property
    def derivative(self) -> int:
        """See base class."""
        return self.of

    @property
    def name(self) -> str:  # type: ignore[override]
        """See base class."""
        return f"{DERIVATIVES[self.of]}_norm"

    def reads(self, num_outputs: int) -> BoolArray:
        """See base class."""
        return self.norm.reads(num_outputs)

    @property
    def size(self) -> float | None:
        """See base class."""
        return self.norm.bound if self.of else None

    def in_units(self, units: Units, order: int) -> DerivativeNorm:
        """See base class."""
        return DerivativeNorm(self.of, self.norm.in_unit(units.of(self.of)))

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        return self.norm.unit(law.model.units_of(self.of))

    def left(self, value: Array, spread: Array) -> Array:
        """See base class."""
        return self.norm.left(value, spread)

    def left_slopes(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """See base class."""
        return self.norm.left_slopes(value, spread)


@dataclasses.dataclass(frozen=True, eq=False)
class InputNorm(InputBoxLimit):
    """``‖P u + q‖ <= c``.

    Attributes:
        norm: P, q and c.
    """

    norm: Norm

    name: ClassVar[str] = "input_norm"

    @property
    def size(self) -> float:
        """See base class."""
        return self.norm.bound

    def in_units(self, units: Units, order: int) -> InputNorm:
        """See base class."""
        return InputNorm(self.norm.in_unit(units.of(order)))

    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """See base class."""
        return self.norm.unit(law.model.input_units)

    def left(self, value: Array, spread: Array) -> Array:
        """See base class."""
        return self.norm.left(value, spread)

    def left_slopes(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """See base class."""
        return self.norm.left_slopes(value, spread)


@dataclasses.dataclass
class NormLimit(Part):
    """``‖matrix z + offset‖ <= bound``, as a scenario has it.

    Attributes:
        of: z: ``position``, ``velocity``, ``acceleration``, ``jerk`` (up to the
            model's order) or ``input``.
        bound: c, in the unit of the norm.
        matrix: P, a list of rows; the identity if left out.
        offset: q; zero if left out.
    """

    of: str
    bound: float
    matrix: list[list[float]] | None = None
    offset: list[float] | None = None

    def limit(self) -> DerivativeNorm | InputNorm:
        """What a planner keeps."""
        matrix, offset = (
            None if given is None else np.array(given, dtype=float)
            for given in (self.matrix, self.offset)
        )
        norm = Norm(matrix, offset, self.bound)
        if self.of == "input":
            return InputNorm(norm)
        return DerivativeNorm(DERIVATIVES.index(self.of), norm)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        words = [*DERIVATIVES[: setting.order + 1], "input"]
        ok = self.of in words
        require(f"{path}.of", self.of, ok, "one of " + ", ".join(words))
        require_positive(f"{path}.bound", self.bound, "")
        rows = setting.num_outputs
        if self.matrix is not None:
            rows = len(self.matrix)
            require(f"{path}.matrix", self.matrix, rows > 0, "of one row at least")
            for i, row in enumerate(self.matrix):
                require_length(f"{path}.matrix[{i}]", row, setting.num_outputs)
                for j, value in enumerate(row):
                    require_magnitude(f"{path}.matrix[{i}][{j}]", value, "")
        if self.offset is not None:
            allowed = f"{rows} numbers, one for each row of the matrix"
            require(f"{path}.offset", self.offset, len(self.offset) == rows, allowed)
            for i, value in enumerate(self.offset):
                require_magnitude(f"{path}.offset[{i}]", value, "")
