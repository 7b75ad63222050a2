"""What a planner did on the way: one record for every time that it planned."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

from dtmpc_drake.plan import Plan, join

Outcome = Literal["certified", "kept", "braking", "unsafe", "given"]


@dataclasses.dataclass(frozen=True, repr=False)
class Replan:
    """One time that a planner planned, and what came of it.

    Attributes:
        time: of the measurement that it planned from, in s.
        hand_over: when the outcome took effect, in s.
        cause: ``start``, ``period`` or ``revealed``.
        revealed: the obstacles that had become known, by their index.
        status: ``certified``; ``kept`` (no certified plan, but the old one is
            clear of all that is known); ``braking`` (a certified plan to rest);
            ``unsafe`` (none of them); ``given`` (not planned at all).  A first
            plan that fails says why, as the planner's result does.
        message: one line.
        iterations: convex programs that were solved.
        cost: of the plan from the hand-over on; None if the old one was kept.
        plan: that took effect, or None if the old one was kept.
        solve_time: what the computer took, in s.  It says nothing about the
            simulation, and does not count when records are compared.
    """

    time: float
    hand_over: float
    cause: str
    revealed: tuple[int, ...]
    status: str
    message: str
    iterations: int
    cost: float | None
    plan: Plan | None = dataclasses.field(compare=False)
    solve_time: float = dataclasses.field(compare=False)

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def summary(self) -> dict[str, Any]:
        """Everything but the plan, as plain numbers and texts."""
        names = [f.name for f in dataclasses.fields(self) if f.name != "plan"]
        return {name: getattr(self, name) for name in names}

    def __repr__(self) -> str:
        """One line."""
        cause = self.cause + "".join(f" {i}" for i in self.revealed)
        return (
            f"Replan(t = {self.time:.2f} s, {cause}: {self.status},"
            f" {self.iterations} iterations, {self.solve_time:.3f} s)"
        )


def flown_plan(replans: Sequence[Replan]) -> Plan:
    """The plan that was in force at each time; see `dtmpc_drake.plan.join`."""
    taken = [r for r in replans if r.plan is not None]
    plans = [r.plan for r in taken if r.plan is not None]
    return join(plans, [r.hand_over for r in taken])
