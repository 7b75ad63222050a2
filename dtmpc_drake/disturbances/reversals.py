"""A push to one end, and at random times to the other."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import EventStatus, LeafSystem

from dtmpc_drake.numerics.arrays import Array

_APART = 0.25
"""How often the model error is left on the other side by a reversal."""


class Reversals(LeafSystem):
    """Pushes every output to a side, and reverses at random times.

    .. pydrake_system::

        name: Reversals
        input_ports:
        - noise
        output_ports:
        - push
        - model_error_push

    Inside the boundary layer, and where Δ is a constant, the error obeys a linear
    differential equation driven by f̃ + d.  So of all pushes that are allowed, those
    that drive an error the furthest are always at one end or the other, whatever
    the state: for s and ỹ one that never reverses, for dỹ/dt one that does so once.

    `push`, -1 or 1 for every output, is for d, and `model_error_push` for f̃: a
    reversal of an output reverses the former, and takes the latter along or, one
    time in four, leaves the two on opposite sides.

    `noise` must be uniform on [0, 1), with as many elements, and redrawn at the
    multiples of `period`.  It is looked at in between, so that each number is seen
    once.  From one look to the next all is held: a push never changes within a
    step of the integrator.
    """

    def __init__(self, *, hold: Array, period: float) -> None:
        """Constructs the system.

        Args:
            hold: the mean time between two reversals of every element, in s.
            period: between two looks at the noise, in s.
        """
        LeafSystem.__init__(self)
        size = len(hold)
        self._chance = -np.expm1(-period / hold)
        self._noise = self.DeclareVectorInputPort("noise", size)
        # The sides of d, then of f̃; zero before the first look.
        self._state = self.DeclareDiscreteState(2 * size)
        self.DeclarePeriodicDiscreteUpdateEvent(period, period / 2, self._update)
        for row, name in enumerate(("push", "model_error_push")):
            self.DeclareVectorOutputPort(
                name,
                size,
                lambda context, output, row=row: output.SetFromVector(
                    self._sides(context)[row]
                ),
                prerequisites_of_calc={self._noise.ticket(), self.xd_ticket()},
            )

    def _sides(self, context: Any) -> Array:
        """-1 or 1 for d and for f̃, ``(2, size)``."""
        held = context.get_discrete_state_vector().value().reshape(2, -1)
        first = np.where(self._noise.Eval(context) < 0.5, -1.0, 1.0)
        return np.where(held == 0, first, held)

    def _update(self, context: Any, state: Any) -> EventStatus:
        sides = self._sides(context)
        if context.get_discrete_state_vector().value().any():
            noise = self._noise.Eval(context)
            push = np.where(noise < self._chance, -sides[0], sides[0])
            relation = np.where(noise < _APART * self._chance, -1.0, 1.0)
            model = np.where(noise < self._chance, relation * push, sides[1])
            sides = np.stack([push, model])
        state.set_value(sides.ravel())
        return EventStatus.Succeeded()
