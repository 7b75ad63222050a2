"""The sliding variable of a tracking error, as a system."""

from __future__ import annotations

from typing import Any

from pydrake.systems.framework import LeafSystem

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.numerics.arrays import Array


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
    ``(m,)``.  With `trials`, `state` and `s` have one more axis in front.
    """

    def __init__(
        self, *, slope: Array, chains: Chains, trials: int | None = None
    ) -> None:
        """Constructs the system.

        Args:
            slope: λ, ``(m,)``.
            chains: the orders of the outputs.
            trials: how many plants; one, without the axis, if left out.
        """
        LeafSystem.__init__(self)
        m, count = len(slope), 1 if trials is None else trials
        self._slope, self._chains = slope, chains
        self._state = self.DeclareVectorInputPort("state", count * chains.size)
        size = (chains.order + 1) * m
        self._reference = self.DeclareVectorInputPort("reference", size)
        self.DeclareVectorOutputPort(
            "s",
            count * m,
            self._calc_s,
            prerequisites_of_calc={self._state.ticket(), self._reference.ticket()},
        )

    def _calc_s(self, context: Any, output: Any) -> None:
        chains = self._chains
        state = self._state.Eval(context).reshape(-1, chains.size)
        reference = self._reference.Eval(context).reshape(-1, len(self._slope))
        error = chains.unpack(state) - reference[: chains.order]
        output.SetFromVector(sliding_variable(error, self._slope, chains).ravel())
