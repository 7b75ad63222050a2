"""A quadratic program of a fixed layout on Clarabel, with numbers that change.

Building one takes as long as solving it, so that a program that is no longer used
waits for the next one of its layout (`borrowed`).
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import scipy.sparse as sp
from pydrake.solvers import (
    Binding,
    ClarabelSolver,
    EvaluatorBase,
    MathematicalProgram,
    MathematicalProgramResult,
    QuadraticCost,
    SolveInParallel,
    SolverOptions,
)

from dtmpc_drake.logs import muted
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.scp.rows import Assembled

GROUP = 16
"""So many windows share one of Drake's costs, whose matrices are dense."""
WAITING = 16
"""Layouts of which programs are kept."""


@dataclasses.dataclass(frozen=True)
class Window:
    """A cost of a narrow band: a sum over windows that move along the variables.

    Attributes:
        start: the first variable of the first window.
        width: variables in each window.
        stride: from one window to the next.
        count: of windows.
    """

    start: int
    width: int
    stride: int
    count: int


@dataclasses.dataclass(frozen=True)
class Layout:
    """What programs that may stand in for each other have in common.

    Attributes:
        size: number of variables.
        costs: the quadratic ones, by name.
    """

    size: int
    costs: tuple[tuple[str, Window], ...]


class Solution:
    """What the solver found.

    Attributes:
        z: the variables; None if there is no solution.
        status: the solver's word.
    """

    def __init__(
        self, status: str, result: MathematicalProgramResult, rows: Binding, good: bool
    ) -> None:
        self.status = status
        self.z = np.asarray(result.get_x_val()) if good else None
        self._result, self._rows = result, rows

    @property
    def multipliers(self) -> Array:
        """Of the inequalities' lower bounds, none negative."""
        return np.asarray(np.maximum(self._result.GetDualSolution(self._rows), 0.0))


class QuadraticProgram:
    """min ½ z'Pz + q'z under equations and inequalities; see `Layout`."""

    def __init__(self, layout: Layout) -> None:
        self._program = MathematicalProgram()
        self._z = self._program.NewContinuousVariables(layout.size, "z")
        last = sp.csc_matrix(([1.0], ([0], [layout.size - 1])), (1, layout.size))
        self._equations = self._program.AddLinearEqualityConstraint(
            last, np.zeros(1), self._z
        )
        self._inequalities = self._program.AddLinearConstraint(
            last, np.zeros(1), np.full(1, np.inf), self._z
        )
        # As a result wants it: pybind11 converts arguments in one thread at a time, and
        # refuses those of any other thread meanwhile.
        self._rows = Binding[EvaluatorBase](
            self._inequalities.evaluator(), self._inequalities.variables()
        )
        self._slack = self._program.AddLinearCost(np.ones(1), self._z[-1:])
        self._windows = dict(layout.costs)
        self._costs = {name: self._add_costs(w) for name, w in layout.costs}

    def _add_costs(self, window: Window) -> list[tuple[slice, QuadraticCost]]:
        """Which windows each of Drake's costs covers."""
        costs = []
        for first in range(0, window.count, GROUP):
            count = min(GROUP, window.count - first)
            start = window.start + first * window.stride
            size = (count - 1) * window.stride + window.width
            cost = self._program.AddQuadraticCost(
                np.eye(size),
                np.zeros(size),
                self._z[start : start + size],
                is_convex=True,
            )
            costs.append((slice(first, first + count), cost.evaluator()))
        return costs

    def set_rows(self, equations: Assembled, inequalities: Assembled) -> None:
        """``matrix z = low``, and ``low <= matrix z <= high``; none of it NaN."""
        self._equations.evaluator().UpdateCoefficients(equations.matrix, equations.low)
        self._inequalities.evaluator().UpdateCoefficients(
            inequalities.matrix, inequalities.low, inequalities.high
        )

    def set_lower_bounds(self, low: Array) -> None:
        """Of the inequalities."""
        self._inequalities.evaluator().UpdateLowerBound(low)

    def set_slack_cost(self, penalty: float) -> None:
        """Of the last variable."""
        self._slack.evaluator().UpdateCoefficients(np.full(1, penalty))

    def set_cost(
        self,
        name: str,
        *,
        quadratic: Array | float,
        linear: Array | float = 0.0,
        diagonal: float = 0.0,
    ) -> None:
        """One of the layout's costs.

        Args:
            name: of the cost in the layout.
            quadratic: Hessian of every window, broadcast to ``(count, width, width)``.
            linear: gradient of every window, broadcast to ``(count, width)``.
            diagonal: is added to the Hessian of every variable once.
        """
        window = self._windows[name]
        width, stride = window.width, window.stride
        quadratic = np.broadcast_to(quadratic, (window.count, width, width))
        linear = np.broadcast_to(linear, (window.count, width))
        # So many windows must pass until one has nothing in common with the first.
        apart = -(-width // stride)
        for part, cost in self._costs[name]:
            count = part.stop - part.start
            size = (count - 1) * stride + width
            # What the next part also covers has its diagonal from there.
            own = size if part.stop == window.count else count * stride
            hessian, gradient = np.zeros((size, size)), np.zeros(size)
            np.fill_diagonal(hessian[:own, :own], diagonal)
            blocks = np.lib.stride_tricks.as_strided(
                hessian,
                (count, width, width),
                (stride * sum(hessian.strides), *hessian.strides),
            )
            pieces = np.lib.stride_tricks.as_strided(
                gradient,
                (count, width),
                (stride * gradient.itemsize, gradient.itemsize),
            )
            for i in range(min(apart, count)):
                blocks[i::apart] += quadratic[part][i::apart]
                pieces[i::apart] += linear[part][i::apart]
            cost.UpdateCoefficients(hessian, gradient, 0.0, is_convex=True)

    def solve(
        self, *, accuracy: float, deadline: Deadline = NEVER, doubtful: bool = False
    ) -> Solution:
        """Solves with fast options, and with Clarabel's own where they do not do.

        Args:
            accuracy: tolerance of the duality gap; a fiftieth of it for feasibility.
            deadline: that the solver keeps, too.
            doubtful: whether the program may well be infeasible, so that it is not
                tried again if the solver says so.
        """
        fast = {
            "iterative_refinement_enable": 0,
            "equilibrate_enable": 0,
            "tol_gap_abs": accuracy,
            "tol_gap_rel": accuracy,
            "tol_feas": accuracy / 50,
        }
        for settings in (fast, {}):
            options = SolverOptions()
            for name, value in settings.items():
                options.SetOption(ClarabelSolver.id(), name, value)
            if np.isfinite(deadline.left):
                options.SetOption(ClarabelSolver.id(), "time_limit", deadline.left)
            # Drake tells the world how a program ended; here that is in the history.
            with muted("drake", "Clarabel returns"):
                # As a batch of one it lets other threads run, unlike `Solve`.
                (result,) = SolveInParallel(
                    progs=[self._program],
                    solver_options=options,
                    solver_id=ClarabelSolver.id(),
                )
            status = str(result.get_solver_details().status)
            # A step of almost solved programs is still checked by the merit.
            good = status in ("Solved", "AlmostSolved")
            if good or (doubtful and "PrimalInfeasible" in status):
                break
        return Solution(status, result, self._rows, good)


_waiting: OrderedDict[Layout, list[QuadraticProgram]] = OrderedDict()


@contextmanager
def borrowed(layout: Layout) -> Iterator[QuadraticProgram]:
    """A program of a layout, which nobody else has meanwhile.

    All its numbers are still those of its last user.
    """
    try:
        program = _waiting[layout].pop()
    except (KeyError, IndexError):
        program = QuadraticProgram(layout)
    try:
        yield program
    finally:
        _waiting.setdefault(layout, []).append(program)
        _waiting.move_to_end(layout)
        if len(_waiting) > WAITING:
            _waiting.popitem(last=False)
