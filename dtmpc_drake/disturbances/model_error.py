"""The model error that an adversary chooses: it follows the state."""

from __future__ import annotations

from typing import Any

from pydrake.systems.framework import LeafSystem

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.models import Model


class ModelError(LeafSystem):
    """Turns a share of the model-error bound into a model error.

    .. pydrake_system::

        name: ModelError
        input_ports:
        - state
        - push
        output_ports:
        - model_error

    ``model_error = push Δ(x)``, ``(m,)``: whatever is within -1 and 1 in `push`,
    ``(m,)``, is within the bound at the `state`, flattened as the
    plant gives it.  With `trials`, every port has one more axis in front.
    """

    def __init__(self, *, model: Model, trials: int | None = None) -> None:
        """Constructs the system.

        Args:
            model: gives Δ; the plant's own, not one that the planner makes of it.
            trials: how many plants; one, without the axis, if left out.
        """
        LeafSystem.__init__(self)
        self._model, self._chains = model, Chains.of(model)
        count = 1 if trials is None else trials
        size = model.num_outputs * count
        self._state = self.DeclareVectorInputPort("state", count * self._chains.size)
        self._push = self.DeclareVectorInputPort("push", size)
        self.DeclareVectorOutputPort(
            "model_error",
            size,
            self._calc_model_error,
            prerequisites_of_calc={self._state.ticket(), self._push.ticket()},
        )

    def _calc_model_error(self, context: Any, output: Any) -> None:
        state = self._state.Eval(context).reshape(-1, self._chains.size)
        bound = self._model.model_error_bound(self._chains.unpack(state))
        output.SetFromVector(self._push.Eval(context) * bound.ravel())
