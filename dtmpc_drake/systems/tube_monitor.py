"""How much of the tube the plant uses, and how far it stays from obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import (
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
)

from dtmpc_drake.limits import flown
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.records import verdict
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.systems.plan_port import DeclarePlanInputPort, EvalPlan
from dtmpc_drake.systems.side_by_side import unflattened, unpacked
from dtmpc_drake.systems.wiring import AddConnected

_WIDENING = 1e-6
"""Added to every bound, in own units, so that 0/0 at the start counts as 0."""
_SHORTEST = 1e-6
"""Time over which a speed may be taken from two positions, in s: less is rounding."""
_TUBES = slice(verdict.LAYER, verdict.VELOCITY + 1)


def tube_ratios(
    *,
    plan: Plan,
    time: Array | float,
    state: Array,
    slope: Array,
    units: Units | None = None,
) -> Array:
    """|s|/Φ, |ỹ|/Ω and |dỹ/dt|/W: at most one inside the tube.

    Without a velocity tube (outputs of order 1, whose velocity is no state) the last
    row repeats the second.

    Args:
        plan: gives the reference and the bounds.
        time: shape ``(...)``, in s.
        state: x, shape ``(..., n, m)``.
        slope: λ, shape ``(m,)``.
        units: in which a bound of a millionth is as good as none; the user's if left
            out.

    Returns:
        Shape ``(..., 3, m)``.
    """
    error = state - plan.reference(time)[..., :-1, :]
    bound = plan.error_bound(time)
    velocity, units = min(1, plan.order - 1), units or Units()
    s = sliding_variable(error, slope, plan.chains)
    ratios = np.empty((*error.shape[:-2], 3, error.shape[-1]))
    for k, (used, allowed, derivative) in enumerate(
        (
            (s, plan.boundary_layer(time), plan.order - 1),
            (error[..., 0, :], bound[..., 0, :], 0),
            (error[..., velocity, :], bound[..., velocity, :], velocity),
        )
    ):
        widening = _WIDENING * units.of(derivative)
        ratios[..., k, :] = np.abs(used) / (allowed + widening)
    if not plan.chains.are_alike:
        still = plan.chains.each == 1
        ratios[..., 2, still] = ratios[..., 1, still]
    return ratios


def _last_axis_max(values: Array) -> Array:
    """The largest along the last axis; NumPy itself is slow along a short one."""
    return np.asfortranarray(values).max(axis=-1)


class TubeMonitor(LeafSystem):
    """Watches a plant that should stay inside the tube of a plan, and its limits.

    .. pydrake_system::

        name: TubeMonitor
        input_ports:
        - state
        - plan
        - control
        output_ports:
        - tube_ratios
        - clearance
        - quantities
        - record

    `tube_ratios` is the flattened ``(3, m)`` array |s|/Φ, |ỹ|/Ω, |dỹ/dt|/W (see
    the function of that name).  `clearance` has the distance of the plant's
    true position from the surface of each obstacle, in m and negative inside;
    without obstacles it is one infinity.  `quantities`, ``(8,)``, is what the
    `QUANTITIES` of `records.verdict` are now, and `record` its flattened ``(6, 8)``
    record: the worst so far of each, and when a limit was broken first.  With
    `trials`, `state`, `control` and all outputs have one more axis in front.

    The record is state, which every step of the simulator begins by updating,
    after a new plan has come into force.  Its output has the present instant in
    it, too, and so the last one of a simulation.  What happens between two steps,
    or within the stages of one, is not seen.  Where the velocity is no state (outputs
    of order 1), the speed is that from one step to the next.
    """

    def __init__(self, *, scenario: Scenario, trials: int | None = None) -> None:
        """Constructs a monitor.

        Args:
            scenario: gives the obstacles, the limits and λ.
            trials: how many plants; one, without the axis, if left out.
        """
        LeafSystem.__init__(self)
        self._chains = Chains.of(scenario.model)
        n, m = self._chains.order, self._chains.num_outputs
        count = 1 if trials is None else trials
        self._shape = (count, n, m)
        self._still = self._chains.each == 1
        self._slope, self._units = scenario.slope(), scenario.own_units()
        self._obstacles = scenario.obstacle_set()
        self._largest = verdict.largest_kept(scenario.limits)
        limits = scenario.limits
        self._other_limits = limits.others
        # So that one largest speed will do for all axes.
        self._slower = limits.fastest - limits.speeds(m)
        self._state = self.DeclareVectorInputPort("state", count * self._chains.size)
        self._plan = DeclarePlanInputPort(self)
        self._control = self.DeclareVectorInputPort("control", count * m)
        seen = {self._state.ticket(), self._plan.ticket(), self.time_ticket()}
        self._tube_ratios = self.DeclareVectorOutputPort(
            "tube_ratios",
            count * 3 * m,
            self._calc_tube_ratios,
            prerequisites_of_calc=seen,
        )
        self._clearance = self.DeclareVectorOutputPort(
            "clearance",
            count * max(len(self._obstacles), 1),
            self._calc_clearance,
            prerequisites_of_calc={self._state.ticket()},
        )
        seen |= {self._control.ticket(), self.xd_ticket()}
        self._quantities = self.DeclareVectorOutputPort(
            "quantities",
            count * len(verdict.QUANTITIES),
            self._calc_quantities,
            prerequisites_of_calc=seen,
        )
        empty = verdict.empty_record((count,))
        self._record_state = self.DeclareDiscreteState(empty.ravel())
        if self._still.any():  # where each plant was, and when
            self._last_state = self.DeclareDiscreteState(np.full(count * m + 1, np.nan))
        self._record = self.DeclareVectorOutputPort(
            "record",
            empty.size,
            self._calc_record,
            prerequisites_of_calc=seen,
        )
        self.DeclarePerStepDiscreteUpdateEvent(self._update)

    @staticmethod
    def AddToBuilder(
        *,
        builder: DiagramBuilder,
        scenario: Scenario,
        state: OutputPort,
        plan: OutputPort,
        control: OutputPort,
        trials: int | None = None,
    ) -> TubeMonitor:
        """Adds a monitor to a diagram and connects it.

        Args:
            builder: the DiagramBuilder.
            scenario: as in the constructor.
            state: output port that gives the plant's state.
            plan: output port that gives the plan.
            control: output port that gives the plant's input.
            trials: as in the constructor.

        Returns:
            The monitor, named ``tube_monitor``.
        """
        monitor = TubeMonitor(scenario=scenario, trials=trials)
        inputs = {"state": state, "plan": plan, "control": control}
        return AddConnected(builder, "tube_monitor", monitor, inputs)

    def _calc_tube_ratios(self, context: Any, output: Any) -> None:
        ratios = tube_ratios(
            plan=EvalPlan(self._plan, context),
            time=context.get_time(),
            state=self._states(context),
            slope=self._slope,
            units=self._units,
        )
        output.SetFromVector(ratios.ravel())

    def _calc_clearance(self, context: Any, output: Any) -> None:
        position = self._chains.unpack(self._flat_states(context))[:, 0]
        clearance = self._obstacles.clearance(position)
        if not len(self._obstacles):
            clearance = np.full((len(position), 1), np.inf)
        output.SetFromVector(clearance.ravel())

    def _calc_quantities(self, context: Any, output: Any) -> None:
        ratios, depth, speed, missing = self._by_place(context)
        control = self._controls(context)
        value = np.empty((len(ratios), len(verdict.QUANTITIES)))
        value[:, _TUBES] = _last_axis_max(ratios)
        value[:, verdict.OBSTACLES] = _last_axis_max(depth)
        value[:, verdict.INPUT] = np.sqrt((control * control).sum(axis=-1))
        value[:, verdict.SPEED] = _last_axis_max(speed)
        value[:, verdict.OTHERS] = _last_axis_max(missing)
        # |s| has every part of the state in it.
        all_of_it = value[:, verdict.LAYER] + value[:, verdict.INPUT]
        value[:, verdict.FINITE] = ~np.isfinite(all_of_it)
        output.SetFromVector(value.ravel())

    def _calc_record(self, context: Any, output: Any) -> None:
        output.SetFromVector(self._look(context)[1].ravel())

    def _update(self, context: Any, discrete: Any) -> EventStatus:
        before, after = self._look(context)
        news = after is not before
        if news:
            record = discrete.get_mutable_vector(self._record_state)
            record.SetFromVector(after.ravel())
        if self._still.any() and not self._elapsed(context) < _SHORTEST:
            position = self._chains.unpack(self._flat_states(context))[:, 0]
            now = np.append(position, context.get_time())
            discrete.get_mutable_vector(self._last_state).SetFromVector(now)
            news = True
        return EventStatus.Succeeded() if news else EventStatus.DidNothing()

    def _look(self, context: Any) -> tuple[Array, Array]:
        """The record before the present instant and with it, ``(6, count, 8)``."""
        value = self._quantities.Eval(context)
        value = value.reshape(self._shape[0], len(verdict.QUANTITIES))

        def where() -> Array:
            ratios, depth, speed, missing = self._by_place(context)
            place = np.zeros(value.shape)
            place[:, _TUBES] = ratios.argmax(axis=-1)
            place[:, verdict.OBSTACLES] = depth.argmax(axis=-1)
            place[:, verdict.SPEED] = speed.argmax(axis=-1)
            place[:, verdict.OTHERS] = missing.argmax(axis=-1)
            return place

        before = context.get_discrete_state(self._record_state).value()
        before = before.reshape(-1, *value.shape)
        after = verdict.look(
            before,
            time=context.get_time(),
            value=value,
            where=where,
            largest=self._largest,
        )
        return before, after

    def _by_place(self, context: Any) -> tuple[Array, Array, Array, Array]:
        """Tube ratios, depths in obstacles, speeds, and what other limits miss.

        Each has its places along the last axis.
        """
        count, _, m = self._shape
        state = self._chains.unpack(self._flat_states(context))
        ratios = self._tube_ratios.Eval(context).reshape(count, 3, m)
        depth = -self._clearance.Eval(context).reshape(count, -1)
        missing = self._missing(state, context)
        return ratios, depth, self._speed(context, state), missing

    def _flat_states(self, context: Any) -> Array:
        """The state port's numbers, ``(count, size)``."""
        return self._state.Eval(context).reshape(self._shape[0], -1)

    def _states(self, context: Any) -> Array:
        """X of every plant, ``(count, n, m)``, as many trials lie in memory."""
        values, lead = self._state.Eval(context), self._shape[:1]
        return unpacked(values, self._chains, lead, trials=True)

    def _controls(self, context: Any) -> Array:
        """U of every plant, ``(count, m)``."""
        control = self._control.Eval(context)
        return unflattened(control, (self._shape[0], -1), trials=True)

    def _missing(self, state: Array, context: Any) -> Array:
        """What is missing of each of the other limits, ``(count, at least 1)``."""
        missing = np.full((len(state), max(len(self._other_limits), 1)), -np.inf)
        for i, limit in enumerate(self._other_limits):
            left = flown(limit, self._chains, state, self._controls(context))
            if left is not None:
                missing[:, i] = -left.min(axis=-1)
        return missing

    def _speed(self, context: Any, state: Array) -> Array:
        """|dy/dt| as the verdict wants it; minus infinity where it is not known yet."""
        if not self._still.any():
            return np.abs(state[:, 1]) + self._slower
        elapsed = self._elapsed(context)
        moving = np.full_like(state[:, 0], -np.inf)
        if elapsed >= _SHORTEST:
            before = context.get_discrete_state(self._last_state).value()[:-1]
            moved = np.abs(state[:, 0] - before.reshape(state[:, 0].shape))
            moving = moved / elapsed + self._slower
        if self._shape[1] == 1:
            return moving
        return np.where(self._still, moving, np.abs(state[:, 1]) + self._slower)

    def _elapsed(self, context: Any) -> float:
        """Since the position that was kept, in s; NaN if there is none."""
        kept = context.get_discrete_state(self._last_state).value()[-1]
        return float(context.get_time() - kept)
