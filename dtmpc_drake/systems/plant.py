"""The true plant: y_i^(n_i) = F_i(x) + Σ_j B_ij(x) u_j + d_i."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    BasicVector_,
    ContinuousStateIndex,
    DiagramBuilder,
    LeafSystem_,
    OutputPort,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.systems.side_by_side import unflattened, unpacked
from dtmpc_drake.systems.wiring import AddConnected


def _plant_of(T: Any) -> Any:
    """`Plant` for the scalar type T."""

    class Impl(LeafSystem_[T]):
        """A model with its true parameters, as a continuous-time plant.

        .. pydrake_system::

            name: Plant
            input_ports:
            - control
            - disturbance
            - model_error (optional)
            output_ports:
            - state

        The state is the flattened ``(n, m)`` array of the models: all outputs
        first, then their first derivatives, and so on; where outputs differ in their
        order, without what does not exist (`Chains.pack`).  `control` is u and
        `disturbance` is d, both ``(m,)``.  With `trials`, as many plants fly
        side by side: every port is the flattened array with one more axis in
        front, such as ``(trials, n, m)`` for the state.

        The parameters that only the true plant knows (such as its drag) are
        one numeric parameter vector of the Context; see `SetParameters`.  They
        make F(x), unless `model_error` is connected: then F = F̂(x) + f̃ with that
        f̃, ``(m,)``, whatever the parameters are.  The plant supports double,
        AutoDiffXd and Expression.
        """

        def _construct(
            self,
            *,
            model: Model,
            parameters: Mapping[str, Any] | None = None,
            initial_state: Array | None = None,
            trials: int | None = None,
            converter: Any = None,
        ) -> None:
            """Constructs a plant.

            Args:
                model: gives F, B and the names of the parameters.
                parameters: defaults by name, a number or one for each trial;
                    those left out are at the middle of what the model allows.
                initial_state: default x(t0), ``(n, m)``, or one for each trial,
                    ``(trials, n, m)``; zero if left out.
                trials: how many plants; one, without the axis, if left out.
                converter: for scalar conversion, set by Drake.

            Raises:
                KeyError: if the model has no such parameter.
            """
            LeafSystem_[T].__init__(self, converter=converter)
            self._model = model
            self._trials = trials
            self._lead = () if trials is None else (trials,)
            self._chains = Chains.of(model)
            n, m = model.order, model.num_outputs
            self._shape = (*self._lead, n, m)
            middle = {
                name: sum(model.parameter_interval(name)) / 2
                for name in model.parameter_names
            }
            self._defaults = middle | self._checked(parameters or {})
            if initial_state is None:
                initial_state = np.zeros((n, m))
            self._initial_state = np.broadcast_to(initial_state, self._shape)
            count = math.prod(self._lead)
            self._control = self.DeclareVectorInputPort("control", count * m)
            self._disturbance = self.DeclareVectorInputPort("disturbance", count * m)
            self._model_error = self.DeclareVectorInputPort("model_error", count * m)
            flat = self._chains.pack(self._initial_state).ravel()
            state = self.DeclareContinuousState(_vector(flat))
            if self._defaults:
                self.DeclareNumericParameter(_vector(self._flat(self._defaults)))
            # A state output has no feedthrough, so that loops may close over it.
            self.DeclareStateOutputPort("state", ContinuousStateIndex(state))

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(
                self,
                model=other._model,
                parameters=other._defaults,
                initial_state=other._initial_state,
                trials=other._trials,
                converter=converter,
            )

        @staticmethod
        def AddToBuilder(
            *,
            builder: DiagramBuilder,
            model: Model,
            parameters: Mapping[str, Any] | None = None,
            initial_state: Array | None = None,
            trials: int | None = None,
            control: OutputPort | None = None,
            disturbance: OutputPort | None = None,
            model_error: OutputPort | None = None,
        ) -> Impl:
            """Adds a plant to a diagram and connects it.

            Args:
                builder: the DiagramBuilder.
                model: as in the constructor, and so the next three.
                parameters: defaults by name.
                initial_state: default x(t0).
                trials: how many plants.
                control: output port that gives the input.  This and the next two may
                    be connected later: in a closed loop they come from the state.
                disturbance: output port that gives the disturbance.
                model_error: output port that gives the model error.

            Returns:
                The plant, named ``plant``.
            """
            plant = Impl(
                model=model,
                parameters=parameters,
                initial_state=initial_state,
                trials=trials,
            )
            inputs = {
                "control": control,
                "disturbance": disturbance,
                "model_error": model_error,
            }
            return AddConnected(builder, "plant", plant, inputs)

        def SetParameters(self, context: Any, parameters: Mapping[str, Any]) -> None:
            """Sets true parameters by name in this plant's Context.

            Args:
                context: of this plant.
                parameters: a number, or one for each trial.

            Raises:
                KeyError: if the model has no such parameter.
            """
            values = self._parameters(context) | self._checked(parameters)
            context.get_mutable_numeric_parameter(0).SetFromVector(
                np.array([T(v) for v in self._flat(values)])
            )

        def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            """Each row's derivative is the next row, the last one's y^(n)."""
            state = context.get_continuous_state_vector().CopyToVector()
            chains, trials = self._chains, bool(self._lead)
            x = unpacked(state, chains, self._lead, trials=trials)
            u = self._unflattened(self._control.Eval(context))
            if not self._model.input_is_identity:
                B = self._model.input_matrix(x)
                u = np.einsum("...ij,...j->...i", B, u)
            highest = (
                self._drift(context, x)
                + u
                + self._unflattened(self._disturbance.Eval(context))
            )
            rates = np.empty(self._shape, dtype=x.dtype)
            rates[..., :-1, :] = x[..., 1:, :]
            chains.set_row(rates, highest)
            flat = chains.pack(rates).ravel()
            derivatives.get_mutable_vector().SetFromVector(flat)

        def _drift(self, context: Any, x: Array) -> Array:
            """F(x)."""
            if not self._model_error.HasValue(context):
                return self._model.true_drift(x, self._parameters(context))
            error = self._unflattened(self._model_error.Eval(context))
            return self._model.drift(x) + error

        def _unflattened(self, values: Array) -> Array:
            return unflattened(values, (*self._lead, -1), trials=bool(self._lead))

        def _parameters(self, context: Any) -> dict[str, Any]:
            if not self._defaults:
                return {}
            values = context.get_numeric_parameter(0).CopyToVector()
            values = values.reshape(len(self._defaults), *self._lead)
            return dict(zip(self._defaults, values, strict=True))

        def _flat(self, parameters: Mapping[str, Any]) -> Array:
            """All parameters one after the other, each for every trial."""
            rows = [np.broadcast_to(v, self._lead) for v in parameters.values()]
            return np.array(rows).ravel()

        def _checked(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
            for name in parameters:
                if name not in self._model.parameter_names:
                    allowed = ", ".join(self._model.parameter_names) or "none"
                    raise KeyError(
                        f"{type(self._model).__name__} has no parameter {name!r};"
                        f" it has: {allowed}"
                    )
            return dict(parameters)

    def _vector(values: Any) -> Any:
        return BasicVector_[T](np.array([T(v) for v in values]))

    return Impl


Plant_ = TemplateSystem.define("Plant_")(_plant_of)
Plant = Plant_[None]
