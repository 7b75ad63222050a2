"""The planner as a system: it plans when the simulation starts."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import EventStatus, LeafSystem

from dtmpc_drake import tube
from dtmpc_drake.plan import Plan
from dtmpc_drake.planning import plan as make_plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.sliding import sliding_variable

_HOLD_STEPS = 400


def hold_plan(scenario: Scenario) -> Plan:
    """A reference that rests at the start, with the tube that is true for it.

    It is what is flown where no certified plan exists.  The bandwidth is the
    highest allowed, and the tube starts from the plant's actual error, its
    velocity included, so the plant does stay inside it.  Nobody has checked
    that tube against obstacles or the input limit: it is not certified.
    """
    model = scenario.planning_model()
    n, m = model.order, model.num_outputs
    start = scenario.start_state()
    rest = np.zeros((n + 1, m))
    rest[0] = start[0]
    error = start + scenario.initial_error_state() - rest[:n]
    slope, bandwidth = scenario.slope(), scenario.controller.bandwidth
    highest = np.full(m, bandwidth.fixed or bandwidth.max)
    layer = np.maximum(
        scenario.initial_boundary_layer(), np.abs(sliding_variable(error, slope))
    )
    half_grid = 2 * _HOLD_STEPS + 1
    bounds = tube.propagate(
        model=model,
        reference=np.broadcast_to(rest[:n], (half_grid, n, m)),
        bandwidth=np.broadcast_to(highest, (half_grid, m)),
        slope=slope,
        disturbance_bound=scenario.disturbance_bound(),
        reaching_rate=scenario.controller.reaching_rate,
        initial_boundary_layer=layer,
        initial_error=error,
        velocity_bound="comparison",
        step=scenario.duration / _HOLD_STEPS,
    )
    coefficients = np.zeros((1, n + 2, m))
    coefficients[0, 0] = rest[0]
    return Plan(
        knots=np.array([0.0, scenario.duration]),
        coefficients=coefficients,
        bandwidth_knots=np.stack([highest, highest]),
        tube_times=np.linspace(0.0, scenario.duration, _HOLD_STEPS + 1),
        layer_samples=np.stack(
            [bounds.boundary_layer, bounds.boundary_layer_rate], axis=1
        ),
        bound_samples=bounds.error_bound,
        bound_rate_samples=bounds.error_bound_rate,
    )


class DtmpcPlanner(LeafSystem):
    """Plans trajectory and tube of a scenario in an initialization event.

    .. pydrake_system::

        name: DtmpcPlanner
        input_ports:
        - state
        - measured_obstacles (optional)
        output_ports:
        - plan
        - status

    `plan` is abstract and always holds a `Plan`; `status` is an abstract text:
    ``certified``, ``given`` for a plan from the constructor, or why there is
    none (such as ``infeasible: ...``).  Without a certified plan, and before
    the initialization event, `plan` is `hold_plan`, and no exception is raised.

    Both outputs are abstract state, so there is no feedthrough from the inputs
    and a plan only changes in events.  One plan is made from the scenario, at
    the start; the inputs (the plant's state, and what a sensor knows of the
    obstacles) are where plans on the way take their beginning from.
    """

    def __init__(self, *, scenario: Scenario, plan: Plan | None = None) -> None:
        """Constructs a planner.

        Args:
            scenario: to plan.
            plan: to use as it is instead of planning.
        """
        LeafSystem.__init__(self)
        self._scenario = scenario
        size = scenario.model.order * scenario.model.num_outputs
        self._state = self.DeclareVectorInputPort("state", size)
        self._measured_obstacles = self.DeclareAbstractInputPort(
            "measured_obstacles", Value[object]()
        )
        first = hold_plan(scenario) if plan is None else plan
        status = "not planned yet" if plan is None else "given"
        self._plan_state = self.DeclareAbstractState(Value[object](first))
        self._status_state = self.DeclareAbstractState(AbstractValue.Make(status))
        self.DeclareStateOutputPort("plan", self._plan_state)
        self.DeclareStateOutputPort("status", self._status_state)
        if plan is None:
            # An event, so that loggers see the plan from the first instant on.
            self.DeclareInitializationUnrestrictedUpdateEvent(self._plan_once)

    def _plan_once(self, context: Any, state: Any) -> EventStatus:
        result = make_plan(self._scenario)
        status: str = result.status
        if result.certified:
            state.get_mutable_abstract_state(int(self._plan_state)).set_value(
                result.plan
            )
        else:
            status = f"{status}: {result.message}"
        state.get_mutable_abstract_state(int(self._status_state)).set_value(status)
        return EventStatus.Succeeded()
