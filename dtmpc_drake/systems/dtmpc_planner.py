"""The planner as a system: it plans at the start of a simulation and on the way."""

from __future__ import annotations

import dataclasses
from time import perf_counter
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
)

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.numerics.arrays import BoolArray
from dtmpc_drake.planning import Problem, plan_problem, replan, shortest_duration
from dtmpc_drake.planning.hold import hold_plan
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import Replan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.systems.obstacle_sensor import EvalMeasuredObstacles
from dtmpc_drake.systems.wiring import AddConnected


@dataclasses.dataclass(frozen=True, eq=False)
class _Memory:
    """What a planner remembers beside its plan; never changed, only replaced.

    Attributes:
        replans: all that took effect, in order.
        pending: one that will, at its hand-over.
        known: the obstacles that the latest of them has looked at, ``(o,)``.
    """

    replans: tuple[Replan, ...]
    pending: Replan | None
    known: BoolArray

    def __deepcopy__(self, memo: dict[int, Any]) -> _Memory:
        return self


class DtmpcPlanner(LeafSystem):
    """Plans trajectory and tube of a scenario at the start and on the way.

    .. pydrake_system::

        name: DtmpcPlanner
        input_ports:
        - state
        - measured_obstacles (optional)
        output_ports:
        - plan
        - status
        - replans

    `plan` is abstract and always holds a `Plan`; `status` is an abstract text:
    ``certified``, ``given`` for a plan from the constructor, or why there is
    none (such as ``infeasible: ...``).  Without a certified plan, and before
    the initialization event, `plan` is `hold_plan`, and no exception is raised.
    `replans` holds a tuple of `Replan`, one for every time that was planned.

    All outputs are abstract state, so there is no feedthrough from the inputs
    and a plan only changes in events.  The first one, from the obstacles that
    `measured_obstacles` knows then (those that the scenario says, if it is not
    connected), is made in the initialization event.

    If the scenario asks for it (`Scenario.is_receding`), the planner looks at its
    inputs every `sensing.period`.  It plans again every `planner.replan_period`,
    and at once when there is a new obstacle, or after ``braking`` or ``unsafe``; see
    `planning.replanning.replan` for what it decides.  The outcome takes effect
    `planner.compute_delay` later, at the next look: until then the old plan is
    flown, and nothing else is begun.  Where too little time is left for a plan to
    the goal (`shortest_duration`), only new obstacles count.  Once the outcome is
    in effect `status` is ``certified``, ``kept: ...``, ``braking: ...`` or
    ``unsafe: ...``; see `Replan`.

    The delay is what the scenario says, so a simulation is the same on any machine.
    What this machine took is in the records (`Replan.solve_time`); where it is more
    than the delay, the vehicle would need a faster one.

    With `ObstacleSensor` and a range of `scenario.sensing_range_needed` there is a
    way to rest before every obstacle when it becomes known; the planner finds it by
    optimisation, from a few starts, and says ``unsafe`` if it does not.
    """

    def __init__(self, *, scenario: Scenario, plan: Plan | None = None) -> None:
        """Constructs a planner.

        Args:
            scenario: to plan.
            plan: to use as it is instead of planning at the start.
        """
        LeafSystem.__init__(self)
        self._scenario = scenario
        self._chains = Chains.of(scenario.model)
        self._state = self.DeclareVectorInputPort("state", self._chains.size)
        self._measured_obstacles = self.DeclareAbstractInputPort(
            "measured_obstacles", Value[object]()
        )
        first = hold_plan(scenario) if plan is None else plan
        status = "not planned yet" if plan is None else "given"
        memory = _Memory((), None, scenario.known_at_start())
        if plan is not None:
            memory = dataclasses.replace(memory, replans=(Replan.given(plan),))
        self._plan_state = self.DeclareAbstractState(Value[object](first))
        self._status_state = self.DeclareAbstractState(AbstractValue.Make(status))
        self._memory_state = self.DeclareAbstractState(Value[object](memory))
        self.DeclareStateOutputPort("plan", self._plan_state)
        self.DeclareStateOutputPort("status", self._status_state)
        self.DeclareAbstractOutputPort(
            "replans",
            lambda: Value[object](),
            self._calc_replans,
            prerequisites_of_calc={self.abstract_state_ticket(self._memory_state)},
        )
        if plan is None:
            # An event, so that loggers see the plan from the first instant on.
            self.DeclareInitializationUnrestrictedUpdateEvent(self._plan_first)
        if scenario.is_receding:
            # Half a period after the sensor, whose news it would miss otherwise.
            period = scenario.sensing.period
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, period / 2, self._look)

    @staticmethod
    def AddToBuilder(
        *,
        builder: DiagramBuilder,
        scenario: Scenario,
        plan: Plan | None = None,
        state: OutputPort | None = None,
        measured_obstacles: OutputPort | None = None,
    ) -> DtmpcPlanner:
        """Adds a planner to a diagram and connects it.

        Args:
            builder: the DiagramBuilder.
            scenario: as in the constructor.
            plan: as in the constructor.
            state: output port that gives the plant's state; only plans on the way
                look at it.
            measured_obstacles: output port that gives what is known.

        Returns:
            The planner, named ``planner``.
        """
        planner = DtmpcPlanner(scenario=scenario, plan=plan)
        inputs = {"state": state, "measured_obstacles": measured_obstacles}
        return AddConnected(builder, "planner", planner, inputs)

    def _calc_replans(self, context: Any, output: Any) -> None:
        output.set_value(self._memory(context).replans)

    def _memory(self, context: Any) -> _Memory:
        memory: _Memory = context.get_abstract_state(
            int(self._memory_state)
        ).get_value()
        return memory

    def _set(self, state: Any, index: Any, value: Any) -> None:
        state.get_mutable_abstract_state(int(index)).set_value(value)

    def _known(self, context: Any) -> BoolArray:
        return EvalMeasuredObstacles(self._measured_obstacles, context, self._scenario)

    def _plan_first(self, context: Any, state: Any) -> EventStatus:
        known = self._known(context)
        begin = perf_counter()
        result = plan_problem(
            Problem.from_scenario(self._scenario, known), self._scenario.planner
        )
        status: str = result.status
        plan = result.plan
        if not result.certified or plan is None:
            status = f"{status}: {result.message}"
            plan = self._plan_in_force(context)
        first = Replan(
            time=0.0,
            hand_over=0.0,
            cause="start",
            revealed=(),
            status=result.status,
            message=result.message,
            iterations=len(result.history),
            cost=result.cost,
            plan=plan,
            solve_time=perf_counter() - begin,
        )
        self._set(state, self._plan_state, plan)
        self._set(state, self._status_state, status)
        self._set(state, self._memory_state, _Memory((first,), None, known))
        return EventStatus.Succeeded()

    def _plan_in_force(self, context: Any) -> Plan:
        plan: Plan = context.get_abstract_state(int(self._plan_state)).get_value()
        return plan

    def _look(self, context: Any, state: Any) -> EventStatus:
        """Takes a pending plan over, or begins with a new one."""
        period, time = self._scenario.sensing.period, context.get_time()
        before = memory = self._memory(context)
        plan = self._plan_in_force(context)
        pending, stopping = memory.pending, False
        if pending is not None and time >= pending.hand_over - period / 2:
            if pending.plan is not None:
                plan = pending.plan
                self._set(state, self._plan_state, plan)
            stopping = pending.status in ("braking", "unsafe")
            status: str = pending.status
            if status != "certified":
                status = f"{status}: {pending.message}"
            self._set(state, self._status_state, status)
            replans = (*memory.replans, pending)
            memory = dataclasses.replace(memory, replans=replans, pending=None)
        ends = self._hand_over(time) >= self._scenario.duration
        if memory.pending is None and not ends:  # what is begun now comes into effect
            known = self._known(context)
            revealed = np.flatnonzero(known & ~memory.known)
            cause = "revealed" if len(revealed) else self._due(time)
            if cause is None and stopping:
                cause = "retry"
            if cause is not None:
                outcome = self._replan(context, plan, known, revealed, cause)
                memory = dataclasses.replace(memory, pending=outcome, known=known)
        if memory is before:
            return EventStatus.DidNothing()
        self._set(state, self._memory_state, memory)
        return EventStatus.Succeeded()

    def _due(self, time: float) -> str | None:
        """Whether a periodic plan is due, and makes sense."""
        again = self._scenario.planner.replan_period
        period = self._scenario.sensing.period
        if again is None:
            return None
        left = self._scenario.duration - self._hand_over(time)
        if left < shortest_duration(self._scenario):
            return None
        look, every = int(time / period), max(1, round(again / period))
        return "period" if look > 0 and look % every == 0 else None

    def _hand_over(self, time: float) -> float:
        """The first look when a plan that is begun now is ready."""
        return time + self._scenario.planning_delay()

    def _replan(
        self, context: Any, plan: Plan, known: BoolArray, revealed: Any, cause: str
    ) -> Replan:
        begin, time = perf_counter(), context.get_time()
        hand_over = self._hand_over(time)
        decision = replan(
            self._scenario,
            plan,
            known=known,
            measured_at=time,
            state=self._chains.unpack(self._state.Eval(context)),
            start=hand_over,
            news=cause != "period",
        )
        return Replan(
            time=time,
            hand_over=hand_over,
            cause=cause,
            revealed=tuple(int(i) for i in revealed),
            status=decision.status,
            message=decision.message,
            iterations=decision.iterations,
            cost=decision.cost,
            plan=decision.plan,
            solve_time=perf_counter() - begin,
        )
