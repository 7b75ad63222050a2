"""The bandwidth at the knots: its range and rate there, and the projection on them."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.scenario import SolverOptions


class BandwidthKnots:
    """What α may be at the knots of a uniform grid, a little inside its limits.

    So interpolation cannot break them.

    Args:
        problem: whose limits are meant.
        step: between two knots, in s.
        options: gives the reserve.

    Attributes:
        low, high: ``(m,)``, in rad/s.
        change: from one knot to the next at most, in rad/s.
    """

    def __init__(self, problem: Problem, step: float, options: SolverOptions) -> None:
        limit, reserve = problem.bandwidth, options.bandwidth_reserve
        middle = (limit.low + limit.high) / 2
        self.low = np.minimum(limit.low * (1 + reserve), middle)
        self.high = np.maximum(limit.high * (1 - reserve), middle)
        # A limit beyond the whole range is none, and only spoils the scale.
        self.change = (1 - reserve) * min(limit.rate * step, float(limit.high.max()))
        self._first = problem.start_bandwidth

    def feasible(self, bandwidth: Array) -> Array:
        """The smallest α above the given one that obeys range and rate.

        More bandwidth means a smaller tube, so nothing that was clear of an
        obstacle is lost.

        Args:
            bandwidth: ``(N + 1, m)``.
        """
        alpha = np.clip(bandwidth, self.low, self.high)
        index = np.arange(len(alpha))[:, None] * self.change
        forward = np.maximum.accumulate(alpha + index) - index
        backward = np.maximum.accumulate((alpha - index)[::-1])[::-1] + index
        alpha = np.maximum(forward, backward)
        if self._first is not None:
            alpha = np.clip(alpha, self._first - index, self._first + index)
        return np.asarray(alpha)
