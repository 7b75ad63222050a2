"""What a solver must do to be a backend: one class, in one file.

A backend is chosen by its name, `scenario.Planner.backend`.  Everything before and
after it (transcription, starts, certificate, verdict) is the same for all.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import ClassVar, TypeVar

from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.iterate import Decisions, Iterate
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.starts import Guess, first_decisions
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.result import Iteration
from dtmpc_drake.scenario import Planner
from dtmpc_drake.scenario.schema import BACKENDS

Report = Callable[[Iteration], None]
"""Is called with every iteration as it ends."""


@dataclasses.dataclass(frozen=True)
class Effort:
    """How far to go.

    Attributes:
        max_iterations: at most so many programs.
        max_penalty: largest weight of a slack that is tried; that of the options if
            left out.
        tolerance: to stop at; that of the options if left out.
        coarse: less accurately, for a first solution on a coarse grid.
        thorough: also where there is next to nothing to gain.
    """

    max_iterations: int
    max_penalty: float | None = None
    tolerance: float | None = None
    coarse: bool = False
    thorough: bool = True


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """What a backend ended with.

    Attributes:
        transcription: of the problem, on the grid of the iterate.
        iterate: the best found.
        violation: of the iterate, see `Transcription.violation`.
        converged: whether nothing more than the tolerance is to be gained.
        failure: the solver's status, if it is what ended the iterations.
        out_of_time: whether it was the deadline.
    """

    transcription: Transcription
    iterate: Iterate
    violation: float
    converged: bool = False
    failure: str | None = None
    out_of_time: bool = False

    @property
    def feasible(self) -> bool:
        """Whether the iterate keeps all limits of the programs."""
        return self.violation <= self.transcription.options.backoff


class Backend(abc.ABC):
    """A solver of problems; see `register_backend`."""

    name: ClassVar[str]
    """In `scenario.Planner.backend`."""
    price: ClassVar[float] = 1.0
    """What a solve costs, in times of `clarabel`'s; searches buy candidates by it."""

    @abc.abstractmethod
    def refine(
        self,
        transcription: Transcription,
        decisions: Decisions,
        *,
        effort: Effort,
        report: Report,
        deadline: Deadline = NEVER,
    ) -> Solution:
        """Solves one problem on one grid, from a start.

        Args:
            transcription: of the problem.
            decisions: to start from.
            effort: how far to go.
            report: is given every iteration.
            deadline: after which no program is begun.
        """

    def solve(
        self,
        problem: Problem,
        settings: Planner,
        *,
        warm_start: Guess | None,
        report: Report,
        deadline: Deadline,
    ) -> Solution:
        """Solves a problem; on one grid, unless a backend knows better.

        Args:
            problem: to solve.
            settings: how.
            warm_start: to start from; the straight line if left out.
            report: is given every iteration.
            deadline: after which no program is begun.
        """
        tr = Transcription(problem, settings.intervals, settings.options)
        return self.refine(
            tr,
            first_decisions(tr, warm_start),
            effort=Effort(settings.max_iterations),
            report=report,
            deadline=deadline,
        )


_BACKENDS: dict[str, Backend] = {}

Class = TypeVar("Class", bound=type[Backend])


def register_backend(cls: Class) -> Class:
    """Makes a backend known by its name; a decorator.

    Raises:
        ValueError: if there is another one of its name.
    """
    other = _BACKENDS.get(cls.name)
    if other is not None and type(other).__qualname__ != cls.__qualname__:
        raise ValueError(f"@register_backend: there is another {cls.name!r}")
    _BACKENDS[cls.name] = cls()
    if cls.name not in BACKENDS:
        BACKENDS.append(cls.name)
    return cls


def backend_of(name: str) -> Backend:
    """The backend of a name that a valid scenario has."""
    return _BACKENDS[name]
