"""One direction for all outputs after the other, from noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import EventStatus, LeafSystem

from dtmpc_drake.numerics.arrays import Array


class Gusts(LeafSystem):
    """Pushes all outputs together, for long, and then in another direction.

    .. pydrake_system::

        name: Gusts
        input_ports:
        - noise
        output_ports:
        - push

    `push`, ``(m,)``, is on the surface of the cube from -1 to 1: one half of the
    time at a corner, and else anywhere.  The first one is kept for a random part of
    `hold`, all others for `hold`.  `noise`, ``(m + 1,)``, is looked at as by
    `Reversals`.  With `trials`, both have one more axis in front.
    """

    def __init__(
        self, *, num_outputs: int, hold: float, period: float, trials: int | None = None
    ) -> None:
        """Constructs the system.

        Args:
            num_outputs: m.
            hold: how long a direction is kept, in s; rounded to the period.
            period: between two looks at the noise, in s.
            trials: how many plants; one, without the axis, if left out.
        """
        LeafSystem.__init__(self)
        count = 1 if trials is None else trials
        self._shape = (count, num_outputs + 1)
        self._looks = max(1, round(hold / period))
        self._noise = self.DeclareVectorInputPort("noise", count * (num_outputs + 1))
        # The push, then for how many more looks; all zero before the first look.
        self._state = self.DeclareDiscreteState(count * (num_outputs + 1))
        self.DeclarePeriodicDiscreteUpdateEvent(period, period / 2, self._update)
        self.DeclareVectorOutputPort(
            "push",
            count * num_outputs,
            self._calc_push,
            prerequisites_of_calc={self._noise.ticket(), self.xd_ticket()},
        )

    def _drawn(self, context: Any) -> tuple[Array, Array]:
        """A push, ``(trials, m)``, and a share of its time, ``(trials, 1)``."""
        noise = self._noise.Eval(context).reshape(self._shape)
        way, choice = 2 * noise[:, :-1] - 1, 2 * noise[:, -1:]
        corner = np.where(way < 0, -1.0, 1.0)
        largest = np.abs(way).max(axis=1, keepdims=True)
        anywhere = way / np.maximum(largest, np.finfo(float).tiny)
        return np.where(choice < 1, corner, anywhere), choice % 1

    def _held(self, context: Any) -> Array:
        """What is held, ``(trials, m + 1)``; before the first look, what will be."""
        held = context.get_discrete_state_vector().value().reshape(self._shape)
        if held.any():
            return np.asarray(held)
        push, share = self._drawn(context)
        return np.concatenate([push, 1 + np.floor(share * self._looks)], axis=1)

    def _update(self, context: Any, state: Any) -> EventStatus:
        push, looks = np.split(self._held(context), [-1], axis=1)
        other, _ = self._drawn(context)
        over = looks == 0
        push = np.where(over, other, push)
        looks = np.where(over, self._looks, looks) - 1
        state.set_value(np.concatenate([push, looks], axis=1).ravel())
        return EventStatus.Succeeded()

    def _calc_push(self, context: Any, output: Any) -> None:
        output.SetFromVector(self._held(context)[:, :-1].ravel())
