"""What a cost answers about itself."""

from __future__ import annotations

import abc
from typing import ClassVar

import numpy as np

from dtmpc_drake.checks import Part
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.differences import differences
from dtmpc_drake.registry import Registry

STEP = 1e-6
"""Half-width of the differences along y*^(n)."""


class Cost(Part, abc.ABC):
    """A running cost: a sum of squares of what the reference is at one instant."""

    title: ClassVar[str] = ""
    """Of what it charges, for tables; its class if it says nothing."""
    of_goal: bool = False
    """Whether a plan that gives up the goal, to rest anywhere, has no such cost."""

    def in_units(self, units: Units, worth: float) -> Cost | None:
        """The same cost in other units; None if it leaves that to `costs.in_units`.

        Args:
            units: the new ones in the user's.
            worth: by which its squares are multiplied then.
        """
        return None

    @abc.abstractmethod
    def residuals(self, law: SlidingLaw, state: Array, highest: Array) -> Array:
        """What is squared, added up, and integrated over time.

        Args:
            law: the controller, with its model.
            state: x*, ``(..., n, m)``.
            highest: y*^(n), ``(..., m)``.

        Returns:
            ``(..., r)``.
        """

    def slopes(
        self, law: SlidingLaw, state: Array, highest: Array, secant: float
    ) -> tuple[Array, Array]:
        """First derivatives of the residuals, by differences.

        Args:
            law: the controller, with its model.
            state: x*, ``(K, n, m)``.
            highest: y*^(n), ``(K, m)``.
            secant: half-width of the differences along the state.

        Returns:
            By the state, ``(K, r, n m)``, and by y*^(n), ``(K, r, m)``.
        """

        def of_state(x: Array, _: Array) -> Array:
            return self.residuals(law, x, highest)

        found = differences(of_state, state, np.zeros_like(state), secant)
        moves = STEP * np.eye(highest.shape[1])[:, None]
        ahead, behind = (
            self.residuals(law, state, highest + sign * moves) for sign in (1.0, -1.0)
        )
        slope = (ahead - behind) / (2 * STEP)  # may not depend on it at all
        slope = np.broadcast_to(slope, (len(moves), *found.value.shape))
        return found.slope[:, :, : state[0].size], np.moveaxis(slope, 0, -1)


COSTS: Registry[Cost] = Registry(Cost, "register_cost")
register_cost = COSTS.register
