"""A relay: the sign of its input, at full force."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import LeafSystem

from dtmpc_drake.numerics.arrays import Array


class Relay(LeafSystem):
    """Switches every element between a force and its negative.

    .. pydrake_system::

        name: Relay
        input_ports:
        - u
        output_ports:
        - y

    y = force where u >= 0, and -force elsewhere: never zero.
    """

    def __init__(self, *, force: Array) -> None:
        """Constructs a relay.

        Args:
            force: shape ``(m,)``.
        """
        LeafSystem.__init__(self)
        self._force = np.asarray(force, dtype=float)
        size = len(self._force)
        self._u = self.DeclareVectorInputPort("u", size)
        self.DeclareVectorOutputPort(
            "y", size, self._calc_y, prerequisites_of_calc={self._u.ticket()}
        )

    def _calc_y(self, context: Any, output: Any) -> None:
        u = self._u.Eval(context)
        output.SetFromVector(np.where(u >= 0, self._force, -self._force))
