"""A sensor that reveals obstacles on the way."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
)

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.numerics.arrays import BoolArray
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.systems.wiring import AddConnected


class ObstacleSensor(LeafSystem):
    """Knows an obstacle once it has been within range, or its time has come.

    .. pydrake_system::

        name: ObstacleSensor
        input_ports:
        - state
        output_ports:
        - measured_obstacles
        - known_since

    `state` is the flattened ``(n, m)`` state.  `measured_obstacles` is abstract: a
    boolean array, one entry for each of the scenario's obstacles, true once it is
    known.  `known_since` has the times in s, infinite where it is not known yet;
    without obstacles it is one infinity.

    The times are discrete state, which only ever goes from infinite to finite: once
    known, always known.  The sensor looks every `sensing.period` of the scenario,
    so it notices a surface that comes within `sensing.range` that much later at
    most.  What is known at the scenario's start is so in the default Context.

    How far it must see: a vehicle that may fly at v can stop before what it senses
    if the range is at least ``v (δ + T / 2) + 2 ‖Ω‖``, where T is the time to stop
    with the deceleration that the feedback's bound leaves of the input limit, Ω the
    tube, and the delay δ counts two looks, two computations and one interval of the
    plan for each order; see `scenario.sensing_range_needed`, against which
    `sensing.range` is checked when a scenario is loaded.  For obstacles that have a
    `known_from` instead nobody can tell before the flight.
    """

    def __init__(self, *, scenario: Scenario) -> None:
        """Constructs a sensor.

        Args:
            scenario: gives the obstacles, and how they become known.
        """
        LeafSystem.__init__(self)
        self._scenario = scenario
        self._count = len(scenario.obstacles)
        self._outputs = scenario.model.num_outputs
        size = Chains.of(scenario.model).size
        self._state = self.DeclareVectorInputPort("state", size)
        since = np.full(max(self._count, 1), np.inf)
        since[: self._count][scenario.known_at_start()] = 0.0
        known_since = self.DeclareDiscreteState(since)
        self.DeclareAbstractOutputPort(
            "measured_obstacles",
            lambda: Value[object](),
            self._calc_measured_obstacles,
            prerequisites_of_calc={self.discrete_state_ticket(known_since)},
        )
        self.DeclareStateOutputPort("known_since", known_since)
        self.DeclarePeriodicDiscreteUpdateEvent(
            scenario.sensing.period, 0.0, self._look
        )

    @staticmethod
    def AddToBuilder(
        *, builder: DiagramBuilder, scenario: Scenario, state: OutputPort
    ) -> ObstacleSensor:
        """Adds a sensor to a diagram and connects it.

        Args:
            builder: the DiagramBuilder.
            scenario: as in the constructor.
            state: output port that gives the plant's state.

        Returns:
            The sensor, named ``obstacle_sensor``.
        """
        sensor = ObstacleSensor(scenario=scenario)
        return AddConnected(builder, "obstacle_sensor", sensor, {"state": state})

    def _calc_measured_obstacles(self, context: Any, output: Any) -> None:
        since = context.get_discrete_state(0).value()
        output.set_value(np.isfinite(since[: self._count]))

    def _look(self, context: Any, discrete_state: Any) -> EventStatus:
        since = context.get_discrete_state(0).value().copy()
        time = context.get_time()
        position = self._state.Eval(context)[: self._outputs]
        visible = self._scenario.visible_obstacles(time, position)
        new = np.isinf(since[: self._count]) & visible
        if new.any():
            since[: self._count][new] = time
            discrete_state.set_value(0, since)
        return EventStatus.Succeeded()


def EvalMeasuredObstacles(port: Any, context: Any, scenario: Scenario) -> BoolArray:
    """What is known at an input port; what is at the start if nothing is connected.

    Raises:
        TypeError: if the port holds anything but one boolean for each obstacle.
    """
    if not port.HasValue(context):
        return scenario.known_at_start()
    value = np.asarray(port.Eval(context))
    if value.dtype != bool or value.shape != (len(scenario.obstacles),):
        raise TypeError(
            f"{port.GetFullDescription()} must hold {len(scenario.obstacles)} booleans,"
            f" one for each obstacle, but it holds {value!r}"
        )
    return value
