"""How much of the tube the plant uses, and how far it stays from obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort

from dtmpc_drake.models import Array
from dtmpc_drake.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.sliding import sliding_variable
from dtmpc_drake.systems.plan_port import DeclarePlanInputPort, EvalPlan

_WIDENING = 1e-6
"""Added to every bound (in m or m/s), so that 0/0 at the start counts as 0."""


def tube_ratios(
    *, plan: Plan, time: Array | float, state: Array, slope: Array
) -> Array:
    """|s|/Φ, |ỹ|/Ω and |dỹ/dt|/W: at most one inside the tube.

    Without a velocity tube (n = 1: the velocity is no state) the last row
    repeats the second.

    Args:
        plan: gives the reference and the bounds.
        time: shape ``(...)``, in s.
        state: x, shape ``(..., n, m)``.
        slope: λ, shape ``(m,)``.

    Returns:
        Shape ``(..., 3, m)``.
    """
    error = state - plan.reference(time)[..., :-1, :]
    bound = plan.error_bound(time)
    velocity = min(1, plan.order - 1)
    used = [sliding_variable(error, slope), error[..., 0, :], error[..., velocity, :]]
    allowed = [plan.boundary_layer(time), bound[..., 0, :], bound[..., velocity, :]]
    return np.asarray(
        np.abs(np.stack(used, axis=-2)) / (np.stack(allowed, axis=-2) + _WIDENING)
    )


class TubeMonitor(LeafSystem):
    """Watches a plant that should stay inside the tube of a plan.

    .. pydrake_system::

        name: TubeMonitor
        input_ports:
        - state
        - plan
        output_ports:
        - tube_ratios
        - clearance

    `tube_ratios` is the flattened ``(3, m)`` array |s|/Φ, |ỹ|/Ω, |dỹ/dt|/W (see
    the function of that name).  `clearance` has the distance of the plant's
    true position from the surface of each obstacle, in m and negative inside;
    without obstacles it is one infinity.  With `trials`, `state` and both
    outputs have one more axis in front.
    """

    def __init__(self, *, scenario: Scenario, trials: int | None = None) -> None:
        """Constructs a monitor.

        Args:
            scenario: gives the obstacles and λ.
            trials: how many plants; one, without the axis, if left out.
        """
        LeafSystem.__init__(self)
        n, m = scenario.model.order, scenario.model.num_outputs
        count = 1 if trials is None else trials
        self._shape = (count, n, m)
        self._slope = scenario.slope()
        self._obstacles = scenario.obstacle_set()
        self._state = self.DeclareVectorInputPort("state", count * n * m)
        self._plan = DeclarePlanInputPort(self)
        self.DeclareVectorOutputPort(
            "tube_ratios", count * 3 * m, self._calc_tube_ratios
        )
        self.DeclareVectorOutputPort(
            "clearance",
            count * max(len(self._obstacles), 1),
            self._calc_clearance,
            prerequisites_of_calc={self._state.ticket()},
        )

    @staticmethod
    def AddToBuilder(
        *,
        builder: DiagramBuilder,
        scenario: Scenario,
        state: OutputPort,
        plan: OutputPort,
        trials: int | None = None,
    ) -> TubeMonitor:
        """Adds a monitor to a diagram and connects it.

        Args:
            builder: the DiagramBuilder.
            scenario: as in the constructor.
            state: output port that gives the plant's state.
            plan: output port that gives the plan.
            trials: as in the constructor.

        Returns:
            The monitor, named ``tube_monitor``.
        """
        monitor: TubeMonitor = builder.AddNamedSystem(
            "tube_monitor", TubeMonitor(scenario=scenario, trials=trials)
        )
        builder.Connect(state, monitor.GetInputPort("state"))
        builder.Connect(plan, monitor.GetInputPort("plan"))
        return monitor

    def _calc_tube_ratios(self, context: Any, output: Any) -> None:
        ratios = tube_ratios(
            plan=EvalPlan(self._plan, context),
            time=context.get_time(),
            state=self._state.Eval(context).reshape(self._shape),
            slope=self._slope,
        )
        output.SetFromVector(ratios.ravel())

    def _calc_clearance(self, context: Any, output: Any) -> None:
        position = self._state.Eval(context).reshape(self._shape)[:, 0]
        clearance = self._obstacles.clearance(position)
        if not len(self._obstacles):
            clearance = np.full((len(position), 1), np.inf)
        output.SetFromVector(clearance.ravel())
