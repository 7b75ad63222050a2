"""The cost of being away from where the state should be, x̃ᵀQx̃.

It is a running cost, the paper's Q_x, and at the last instant its terminal cost h with
the weight R_f.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from dtmpc_drake.costs.base import Cost
from dtmpc_drake.costs.weights import Weight, is_nothing, matrix_of, root_of
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array


@dataclasses.dataclass(frozen=True, eq=False)
class StateCost(Cost):
    """``Σ_k e_k'Q_k e_k`` with e_k = y*^(k) - target_k, or its part across a line.

    Attributes:
        target: x, ``(n, m)``.
        roots: from ``x* - target``, flattened, to what is squared, ``(r, n m)``.
        of_goal: see base class.
    """

    target: Array
    roots: Array
    of_goal: bool = True

    title: ClassVar[str] = "state"

    @classmethod
    def of(
        cls,
        weights: Sequence[Weight],
        target: Array,
        direction: Array | None = None,
    ) -> StateCost:
        """From weights of each derivative.

        Args:
            weights: Q_k of the position, the velocity, ..., at most n of them.
            target: x, ``(n, m)``.
            direction: of a line through the target, of any length, ``(m,)``; what a
                state is away along it costs nothing.
        """
        n, m = target.shape
        across = np.eye(m)
        if direction is not None:
            along = direction / np.linalg.norm(direction)
            across = across - np.outer(along, along)
        rows = []
        for k, weight in enumerate(weights):
            if not is_nothing(weight):
                place = np.zeros((1, n))
                place[0, k] = 1.0
                rows.append(np.kron(place, root_of(matrix_of(weight, m)) @ across))
        roots = np.concatenate([np.zeros((0, n * m)), *rows])
        return cls(target, roots, of_goal=direction is None)

    def in_units(self, units: Units, worth: float) -> StateCost:
        """See base class."""
        rows = units.of_rows(len(self.target))
        each = np.broadcast_to(np.sqrt(worth) * rows, self.target.shape).ravel()
        return StateCost(self.target / rows, self.roots * each, self.of_goal)

    def residuals(self, law: SlidingLaw, state: Array, highest: Array) -> Array:
        """See base class."""
        away = state - self.target
        return away.reshape(*away.shape[:-2], -1) @ self.roots.T

    def slopes(
        self, law: SlidingLaw, state: Array, highest: Array, secant: float
    ) -> tuple[Array, Array]:
        """See base class; exact."""
        shape = len(state), *self.roots.shape
        none = np.zeros((*shape[:2], highest.shape[1]))
        return np.broadcast_to(self.roots, shape), none
