"""A running simulation in Meshcat, as it happens."""

from __future__ import annotations

from typing import Any

from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
)

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.systems.plan_port import DeclarePlanInputPort, EvalPlan
from dtmpc_drake.systems.wiring import AddConnected
from dtmpc_drake.visualization.geometry import embedding
from dtmpc_drake.visualization.scale import Scale
from dtmpc_drake.visualization.scene import ROOT, add_scene, add_tube


class LiveView(LeafSystem):
    """Draws the scene when the simulation starts, then moves the vehicle.

    A new plan replaces the old one as soon as it is in force.

    .. pydrake_system::

        name: LiveView
        input_ports:
        - state
        - plan

    Set the simulator's target realtime rate to one to watch it.
    """

    def __init__(
        self, *, scenario: Scenario, meshcat: Meshcat, publish_period: float = 1 / 32
    ) -> None:
        """Constructs a view.

        Args:
            scenario: gives the obstacles.
            meshcat: to draw into.
            publish_period: between two pictures, in s.
        """
        LeafSystem.__init__(self)
        self._scenario, self._meshcat = scenario, meshcat
        chains = Chains.of(scenario.model)
        self._embedding = embedding(chains.num_outputs)
        self._state = self.DeclareVectorInputPort("state", chains.size)
        self._plan = DeclarePlanInputPort(self)
        self.DeclareInitializationPublishEvent(self._draw)
        self.DeclarePeriodicPublishEvent(publish_period, 0.0, self._move)

    @staticmethod
    def AddToBuilder(
        *,
        builder: DiagramBuilder,
        scenario: Scenario,
        meshcat: Meshcat,
        state: OutputPort,
        plan: OutputPort,
        publish_period: float = 1 / 32,
    ) -> LiveView:
        """Adds a view to a diagram and connects it.

        Args:
            builder: the DiagramBuilder.
            scenario: as in the constructor.
            meshcat: as in the constructor.
            state: output port that gives the plant's state.
            plan: output port that gives the plan.
            publish_period: as in the constructor.

        Returns:
            The view, named ``live_view``.
        """
        view = LiveView(
            scenario=scenario, meshcat=meshcat, publish_period=publish_period
        )
        return AddConnected(builder, "live_view", view, {"state": state, "plan": plan})

    def _draw(self, context: Any) -> EventStatus:
        self._drawn = EvalPlan(self._plan, context)
        self._scale = Scale.of(self._drawn)
        add_scene(self._meshcat, scenario=self._scenario, plan=self._drawn)
        return EventStatus.Succeeded()

    def _move(self, context: Any) -> EventStatus:
        position = self._state.Eval(context)[: self._embedding.shape[1]]
        where = RigidTransform(self._embedding @ position)
        self._meshcat.SetTransform(f"{ROOT}/vehicle", where)
        plan = EvalPlan(self._plan, context)
        if plan is not self._drawn:  # what Meshcat shows is no part of the Context
            self._drawn = plan
            add_tube(self._meshcat, plan=plan, scale=self._scale)
        return EventStatus.Succeeded()
