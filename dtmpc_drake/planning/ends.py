"""That a reference meets its ends, and how its spline answers to them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from dtmpc_drake.numerics import splines
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.problem import Problem

BLEND = 0.125
"""Part of the way, at each end, in which a start is bent to meet the ends."""


class Ends:
    """What both ends ask of a reference on a uniform grid.

    Args:
        problem: whose ends are meant.
        intervals: of the grid.
    """

    def __init__(self, problem: Problem, intervals: int) -> None:
        chains, m = problem.law.chains, problem.law.num_outputs
        self._shape = intervals + chains.order + 1, m
        self._groups = [
            (_Group(problem, intervals, order, some), some)
            for order, some in splines.grouped(chains.orders)
        ]

    def met_by(self, coefficients: Array) -> Array:
        """The nearest spline that meets both end states.

        Nearest in the highest derivative, with only the first and last part of
        the way changed, so that a shifted end leaves the rest where it was.
        """
        result = np.zeros(self._shape)
        for group, some in self._groups:
            result[: group.count, some] = group.met_by(
                coefficients[: group.count, some]
            )
        return result

    def nearest_to(self, wanted: Array) -> Array:
        """The spline nearest to values at all knots and midpoints, with its ends.

        Args:
            wanted: ``(2 N + 1, m)``.
        """
        result = np.zeros(self._shape)
        for group, some in self._groups:
            result[: group.count, some] = group.nearest_to(wanted[:, some])
        return result


class _Group:
    """The ends of the outputs of one order.

    Args:
        problem: whose ends are meant.
        intervals: of the grid.
        order: n_i.
        some: index of the outputs that have it.

    Attributes:
        count: of their coefficients.
    """

    def __init__(
        self, problem: Problem, intervals: int, order: int, some: Array | slice
    ) -> None:
        degree, step = order + 1, problem.duration / intervals
        self._intervals, self._degree = intervals, degree
        self.count = count = intervals + degree
        goal = [k for k in problem.goal_rows if k < order]
        start = [*problem.start[:order, some]]
        if problem.start_highest is not None:
            start.append(problem.start_highest[some])
        self._conditions = np.concatenate(
            [
                _conditions(intervals, degree, 0, step)[: len(start)],
                _conditions(intervals, degree, intervals, step)[goal],
            ]
        )
        self._wanted = np.concatenate([start, problem.goal[goal][:, some]])
        part = min(int(BLEND * intervals) + 2 * order, count // 2)
        self._free = np.r_[:part, count - part : count]
        # In units of the step, so that problems on as many intervals share them.
        rows = tuple(range(len(start))), tuple(goal)
        answers = _answers(intervals, degree, part, rows)
        self._answers = answers * step ** np.concatenate([*map(np.array, rows)])

    def met_by(self, coefficients: Array) -> Array:
        """See `Ends`."""
        result = coefficients.copy()
        missing = self._wanted - self._conditions @ coefficients
        result[self._free] += self._answers @ missing
        return result

    def nearest_to(self, wanted: Array) -> Array:
        """See `Ends`."""
        operator, normal = _least_squares(self._intervals, self._degree)
        return self.met_by(normal.solve(operator.T @ wanted))


def _conditions(intervals: int, degree: int, knot: int, step: float) -> Array:
    """Every derivative up to the n-th at the first or last knot."""
    rows = np.zeros((degree, intervals + degree))
    for k in range(degree):
        start = splines.basis(degree, k, np.zeros(1), step)[0]
        rows[k, knot : knot + degree] = start[:degree]
    return rows


@lru_cache
def _least_squares(intervals: int, degree: int) -> tuple[splines.Sparse, Any]:
    """A spline's values at knots and midpoints, and the factors of A'A."""
    operator = splines.midpoint_operator(intervals, degree)
    return operator, scipy.sparse.linalg.splu((operator.T @ operator).tocsc())


@lru_cache
def _answers(
    intervals: int, degree: int, part: int, rows: tuple[tuple[int, ...], ...]
) -> Array:
    """How the outer coefficients answer to conditions at both ends, in unit steps.

    So that y*^(n) changes least.

    Args:
        intervals: of the grid.
        degree: of the spline.
        part: so many coefficients may change at each end.
        rows: the derivatives that are prescribed at the start and at the end.

    Returns:
        ``(2 part, conditions)``.
    """
    count = intervals + degree
    free = np.r_[:part, count - part : count]
    changed = np.concatenate(
        [
            _conditions(intervals, degree, knot, 1.0)[list(some)]
            for knot, some in zip((0, intervals), rows, strict=True)
        ]
    )[:, free]
    highest = splines.knot_operator(intervals, degree, degree - 1, 1.0)[:, free]
    few = sp.csr_array(changed)
    system = sp.block_array([[highest.T @ highest, few.T], [few, None]]).tocsc()
    wanted = np.eye(len(free) + len(changed))[:, len(free) :]
    return scipy.sparse.linalg.splu(system).solve(wanted)[: len(free)]
