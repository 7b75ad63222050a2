"""The boundary-layer sliding controller that keeps the plant inside the tube."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.symbolic import Expression
from pydrake.systems.framework import DiagramBuilder, LeafSystem_, OutputPort
from pydrake.systems.scalar_conversion import TemplateSystem

from dtmpc_drake.scenario import Scenario
from dtmpc_drake.systems.plan_port import DeclarePlanInputPort, EvalPlan
from dtmpc_drake.systems.side_by_side import unpacked
from dtmpc_drake.systems.wiring import AddConnected


def _plain(time: Any) -> float:
    """The time as a number; a plan is not differentiated along it."""
    if isinstance(time, AutoDiffXd):
        return float(time.value())
    if isinstance(time, Expression):
        return float(time.Evaluate())
    return float(time)


def _tracker_of(T: Any) -> Any:
    """`SlidingModeTracker` for the scalar type T."""

    class Impl(LeafSystem_[T]):
        """Tracks a plan with the control law of the paper's section IV.

        .. pydrake_system::

            name: SlidingModeTracker
            input_ports:
            - state
            - plan
            output_ports:
            - control
            - reference

        `state` is the flattened ``(n, m)`` state as the plant gives it, `plan` an
        abstract port that holds a `Plan`.  `control` is u, ``(m,)``; `reference` is
        the flattened ``(n + 1, m)`` array of y* and its derivatives at the Context's
        time, the last row y_i*^(n_i) (see `Plan.reference`).
        With `trials`, as many plants track the same plan: `state` is
        ``(trials, n, m)`` and `control` is ``(trials, m)``, both flattened.

        The tracker supports double, AutoDiffXd and Expression in the state;
        the Context's time must be a number in each of them.
        """

        def _construct(
            self,
            *,
            scenario: Scenario,
            trials: int | None = None,
            converter: Any = None,
        ) -> None:
            """Constructs a tracker.

            Args:
                scenario: gives the model as the planner sees it, λ, D and η.
                trials: how many plants; one, without the axis, if left out.
                converter: for scalar conversion, set by Drake.
            """
            LeafSystem_[T].__init__(self, converter=converter)
            self._scenario = scenario
            self._law = scenario.sliding_law()
            n, m = self._law.order, self._law.num_outputs
            self._trials = trials
            self._lead = () if trials is None else (trials,)
            count = math.prod(self._lead)
            size = count * self._law.chains.size
            self._state = self.DeclareVectorInputPort("state", size)
            self._plan = DeclarePlanInputPort(self)
            self.DeclareVectorOutputPort("control", count * m, self._calc_control)
            self.DeclareVectorOutputPort(
                "reference",
                (n + 1) * m,
                self._calc_reference,
                # Not the state: else every loop over the reference is algebraic.
                prerequisites_of_calc={self._plan.ticket(), self.time_ticket()},
            )

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(
                self,
                scenario=other._scenario,
                trials=other._trials,
                converter=converter,
            )

        @staticmethod
        def AddToBuilder(
            *,
            builder: DiagramBuilder,
            scenario: Scenario,
            state: OutputPort,
            plan: OutputPort,
            trials: int | None = None,
        ) -> Impl:
            """Adds a tracker to a diagram and connects it.

            Args:
                builder: the DiagramBuilder.
                scenario: as in the constructor.
                state: output port that gives the plant's state.
                plan: output port that gives the plan.
                trials: as in the constructor.

            Returns:
                The tracker, named ``tracker``.
            """
            tracker = Impl(scenario=scenario, trials=trials)
            inputs = {"state": state, "plan": plan}
            return AddConnected(builder, "tracker", tracker, inputs)

        def _calc_reference(self, context: Any, output: Any) -> None:
            plan = EvalPlan(self._plan, context)
            reference = plan.reference(_plain(context.get_time()))
            output.SetFromVector(np.array([T(v) for v in reference.ravel()]))

        def _calc_control(self, context: Any, output: Any) -> None:
            plan, time = EvalPlan(self._plan, context), _plain(context.get_time())
            layer, layer_rate = plan.layer(time)
            state = unpacked(
                self._state.Eval(context),
                self._law.chains,
                self._lead,
                trials=bool(self._lead),
            )
            control = self._law.control(
                state=state,
                reference=plan.reference(time),
                layer=layer,
                layer_rate=layer_rate,
            )
            output.SetFromVector(control.ravel())

    return Impl


SlidingModeTracker_ = TemplateSystem.define("SlidingModeTracker_")(_tracker_of)
SlidingModeTracker = SlidingModeTracker_[None]
