"""The sliding variable of a tracking error, as a system."""

from __future__ import annotations

from typing import Any

from pydrake.systems.framework import LeafSystem

from dtmpc_drake.models import Array
from dtmpc_drake.sliding import sliding_variable


class SlidingError(LeafSystem):
    """Measures how far a plant is from the sliding surface of its reference.

    .. pydrake_system::

        name: SlidingError
        input_ports:
        - state
        - reference
        output_ports:
        - s

    `state` is the flattened ``(n, m)`` state and `reference` the flattened
    ``(n + 1, m)`` reference, as from the plant and the tracker; `s` is
    ``(m,)``.
    """

    def __init__(self, *, slope: Array, order: int) -> None:
        """Constructs the system.

        Args:
            slope: λ, ``(m,)``.
            order: n.
        """
        LeafSystem.__init__(self)
        self._slope, self._shape = slope, (order, len(slope))
        size = order * len(slope)
        self._state = self.DeclareVectorInputPort("state", size)
        self._reference = self.DeclareVectorInputPort("reference", size + len(slope))
        self.DeclareVectorOutputPort(
            "s",
            len(slope),
            self._calc_s,
            prerequisites_of_calc={self._state.ticket(), self._reference.ticket()},
        )

    def _calc_s(self, context: Any, output: Any) -> None:
        state = self._state.Eval(context)
        error = state - self._reference.Eval(context)[: len(state)]
        output.SetFromVector(sliding_variable(error.reshape(self._shape), self._slope))
