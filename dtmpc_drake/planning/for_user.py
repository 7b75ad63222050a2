"""What a user gives and gets, when planning is done in a problem's own units."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.planning.canonical import plan_in_units
from dtmpc_drake.planning.starts import Guess
from dtmpc_drake.records.candidate import Candidate
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import Iteration, PlanningResult


@dataclasses.dataclass(frozen=True, eq=False)
class _TranslatedGuess:
    """What iterations may start from, in a problem's own units."""

    guess: Guess
    units: Units

    def reference(self, time: FloatArray | float) -> FloatArray:
        """See `Guess`."""
        rows = self.guess.reference(np.asarray(time) * self.units.time)
        return rows / self.units.of_rows(rows.shape[-2])

    def bandwidth(self, time: FloatArray | float) -> FloatArray:
        """See `Guess`."""
        time = np.asarray(time) * self.units.time
        return self.guess.bandwidth(time) * self.units.time


def guess_in_units(guess: Guess | None, units: Units) -> Guess | None:
    """What iterations start from, in a problem's own units."""
    if isinstance(guess, Plan):
        return plan_in_units(guess, units)
    return None if guess is None else _TranslatedGuess(guess, units)


def report_for_user(
    report: Callable[[Iteration], None], units: Units
) -> Callable[[Iteration], None]:
    """Reports iterations in the user's units."""
    return lambda iteration: report(_scaled(iteration, _ITERATION, units))


def result_for_user(result: PlanningResult, units: Units) -> PlanningResult:
    """A result in the user's units; its certificate and message are already."""
    back = units.inverse()
    plan, attempt = (
        None if each is None else plan_in_units(each, back)
        for each in (result.plan, result.attempt)
    )
    if result.plan is result.attempt:
        plan = attempt
    candidates = [
        dataclasses.replace(
            _scaled(candidate, _CANDIDATE, units), path=candidate.path * units.length
        )
        for candidate in result.candidates
    ]
    return dataclasses.replace(
        result,
        plan=plan,
        attempt=attempt,
        cost=result.cost * units.cost,
        history=tuple(_scaled(each, _ITERATION, units) for each in result.history),
        candidates=tuple(candidates),
    )


_LENGTHS, _COSTS = ("violation", "slack", "defect", "step"), ("cost", "predicted")
_ITERATION = _LENGTHS, _COSTS
_CANDIDATE = ("length", "violation"), ("cost", "coarse_cost")

Row = TypeVar("Row", Iteration, Candidate)


def _scaled(
    row: Row, fields: tuple[tuple[str, ...], tuple[str, ...]], units: Units
) -> Row:
    """Fields that are lengths, and those that are costs, in the user's units."""
    changed = {
        name: value * unit
        for names, unit in zip(fields, (units.length, units.cost), strict=True)
        for name in names
        if (value := getattr(row, name)) is not None
    }
    return dataclasses.replace(row, **changed)
