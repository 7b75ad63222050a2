"""What a planner did on the way: one record for every time that it planned."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from dtmpc_drake.records.plan import Plan, join

ReplanStatus = Literal["certified", "kept", "braking", "unsafe", "given"]


@dataclasses.dataclass(frozen=True, repr=False)
class Replan:
    """One time that a planner planned, and what came of it.

    Attributes:
        time: of the measurement that it planned from, in s.
        hand_over: when the outcome took effect, in s.
        cause: ``start``, ``period``, ``revealed`` or ``retry``, which follows at once
            on ``braking`` and ``unsafe``.
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

    @classmethod
    def given(cls, plan: Plan) -> Replan:
        """The record of a plan that was given at the start, not made."""
        return cls(
            time=0.0,
            hand_over=0.0,
            cause="start",
            revealed=(),
            status="given",
            message="",
            iterations=0,
            cost=None,
            plan=plan,
            solve_time=0.0,
        )

    def summary(self) -> dict[str, Any]:
        """Everything but the plan, as plain numbers and texts."""
        names = [f.name for f in dataclasses.fields(self) if f.name != "plan"]
        return {name: getattr(self, name) for name in names}

    def headline(self) -> str:
        """What a spectator wants to know."""
        why = "first plan" if self.cause == "start" else "new plan"
        if self.revealed:
            plural = "s" if len(self.revealed) > 1 else ""
            why = f"obstacle{plural} " + ", ".join(map(str, self.revealed)) + " found"
        return f"t = {self.hand_over:.1f} s, {why}: {self.status}"

    def __repr__(self) -> str:
        """One line."""
        cause = self.cause + "".join(f" {i}" for i in self.revealed)
        return (
            f"Replan(t = {self.time:.2f} s, {cause}: {self.status},"
            f" {self.iterations} iterations, {self.solve_time:.3f} s)"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class PlanInForce:
    """A plan while it is in force.

    Attributes:
        plan: the plan.
        start: when it takes over, in s.
        end: when the next one does, in s.
        replan: that it comes from.
    """

    plan: Plan
    start: float
    end: float
    replan: Replan


def plans_in_force(replans: Sequence[Replan]) -> list[PlanInForce]:
    """Every plan that took over, in order."""
    taken = [r for r in replans if r.plan is not None]
    ends = [*(r.hand_over for r in taken[1:]), np.inf][: len(taken)]
    return [
        PlanInForce(r.plan, r.hand_over, min(end, r.plan.end_time), r)
        for r, end in zip(taken, ends, strict=True)
        if r.plan is not None
    ]


def flown_plan(replans: Sequence[Replan]) -> Plan:
    """The plan that was in force at each time; see `dtmpc_drake.records.plan.join`."""
    shown = plans_in_force(replans)
    return join([s.plan for s in shown], [s.start for s in shown])


def counted(replans: Sequence[Replan]) -> str:
    """How many plans took over, by status."""
    counts = Counter(r.status for r in replans if r.plan is not None)
    parts = [f"{number} {status}" for status, number in counts.items()]
    return ", ".join(parts) + (" plans" if len(replans) > 1 else " plan")


def table(replans: Sequence[Replan]) -> str:
    """One line for each, under a header."""
    header = f"{'t (s)':>6} {'from':>6}  {'cause':<12} {'status':<10}"
    lines = [f"{header} {'iterations':>10} {'cost':>9} {'solve (s)':>9}"]
    for r in replans:
        cause = " ".join([r.cause, *map(str, r.revealed)])
        cost = "" if r.cost is None else f"{r.cost:.3f}"
        lines.append(
            f"{r.time:6.2f} {r.hand_over:6.2f}  {cause:<12} {r.status:<10}"
            f" {r.iterations:10d} {cost:>9} {r.solve_time:9.3f}"
        )
    return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class Decision:
    """What is to be flown next.

    Attributes:
        status: ``certified``, ``kept``, ``braking`` or ``unsafe``; see `Replan`.
        message: one line.
        plan: to take over, or None to keep the old one.
        cost: of the plan.
        iterations: convex programs that were solved, whatever came of them.
    """

    status: ReplanStatus
    message: str
    plan: Plan | None
    cost: float | None
    iterations: int
