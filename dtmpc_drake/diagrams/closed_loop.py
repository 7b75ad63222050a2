"""The closed loop: how planner, tracker, plant, disturbance and monitor are wired.

`MakeClosedLoop` is one flight, as it is planned and sensed; `MakeSideBySide` is many
flights of one plan.  Both close the same loop.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System

from dtmpc_drake.diagrams.live_view import LiveView
from dtmpc_drake.diagrams.trials import Trial
from dtmpc_drake.disturbances import MakeDisturbance
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario, require_one_plan
from dtmpc_drake.systems import (
    DtmpcPlanner,
    ObstacleSensor,
    Plant,
    SlidingModeTracker,
    TubeMonitor,
)


def MakeClosedLoop(
    scenario: Scenario, *, plan: Plan | None = None, meshcat: Meshcat | None = None
) -> Diagram:
    """The diagram of a scenario.

    Args:
        scenario: the whole experiment; the diagram's default Context is its
            start (apart from randomness, which `SetRandomContext` seeds).
        plan: to fly instead of planning at the start.
        meshcat: to watch the simulation in, if given.

    Returns:
        A diagram named ``closed_loop`` that exports the output ports `state`,
        `control`, `reference`, `plan`, `status`, `disturbance`, `tube_ratios`,
        `clearance`, `quantities` and `record`; if there may be more plans than one,
        `known_since` and `replans`, too; if the disturbance chooses it,
        `model_error`.  See the systems for their meaning.
    """
    builder = DiagramBuilder()
    plant = Plant.AddToBuilder(
        builder=builder,
        model=scenario.model,
        parameters=scenario.plant_parameters(),
        initial_state=scenario.start_state() + scenario.initial_error_state(),
    )
    state = plant.GetOutputPort("state")
    sensor = measured = None
    if scenario.is_receding:
        sensor = ObstacleSensor.AddToBuilder(
            builder=builder, scenario=scenario, state=state
        )
        measured = sensor.GetOutputPort("measured_obstacles")
    planner = DtmpcPlanner.AddToBuilder(
        builder=builder,
        scenario=scenario,
        plan=plan,
        state=state,
        measured_obstacles=measured,
    )
    disturbance = MakeDisturbance(
        scenario.disturbance,
        model=scenario.model,
        slope=scenario.slope(),
        duration=scenario.duration,
    )
    outputs = _close(builder, scenario, plant, planner, disturbance)
    if sensor is not None:
        outputs["known_since"] = sensor.GetOutputPort("known_since")
        outputs["replans"] = planner.GetOutputPort("replans")
    if meshcat is not None:
        LiveView.AddToBuilder(
            builder=builder,
            scenario=scenario,
            meshcat=meshcat,
            state=state,
            plan=outputs["plan"],
        )
    return _built(builder, outputs)


def MakeSideBySide(
    scenario: Scenario, *, plan: Plan, trials: Sequence[Trial]
) -> Diagram:
    """The diagram of many trials that fly one plan side by side.

    Args:
        scenario: the whole experiment, with one plan.
        plan: to fly.
        trials: at least one; each has its own true parameters, initial error and
            disturbance.

    Returns:
        A diagram as from `MakeClosedLoop`, where `state`, `control`, `disturbance`,
        `model_error`, `tube_ratios`, `clearance`, `quantities` and `record` have one
        more axis in front.

    Raises:
        ScenarioError: if the scenario asks for plans on the way.
    """
    require_one_plan(scenario)
    own = [trial.scenario(scenario) for trial in trials]
    initial_error = np.stack([one.initial_error_state() for one in own])
    builder = DiagramBuilder()
    plant = Plant.AddToBuilder(
        builder=builder,
        model=scenario.model,
        parameters={
            name: [trial.parameters[name] for trial in trials]
            for name in scenario.plant_parameters()
        },
        initial_state=scenario.start_state() + initial_error,
        trials=len(trials),
    )
    planner = DtmpcPlanner.AddToBuilder(builder=builder, scenario=scenario, plan=plan)
    disturbance = MakeDisturbance(
        scenario.disturbance,
        model=scenario.model,
        slope=scenario.slope(),
        trials=[one.disturbance for one in own],
        duration=scenario.duration,
    )
    outputs = _close(builder, scenario, plant, planner, disturbance, trials=len(trials))
    return _built(builder, outputs)


def _close(
    builder: DiagramBuilder,
    scenario: Scenario,
    plant: System,
    planner: System,
    disturbance: System,
    *,
    trials: int | None = None,
) -> dict[str, OutputPort]:
    """Adds tracker, disturbance and monitor, and closes the loop over the plant.

    Returns:
        The output ports to export, by name.
    """
    state, plan = plant.GetOutputPort("state"), planner.GetOutputPort("plan")
    tracker = SlidingModeTracker.AddToBuilder(
        builder=builder, scenario=scenario, state=state, plan=plan, trials=trials
    )
    builder.AddNamedSystem("disturbance", disturbance)
    outputs = {
        "state": state,
        "control": tracker.GetOutputPort("control"),
        "reference": tracker.GetOutputPort("reference"),
        "plan": plan,
        "status": planner.GetOutputPort("status"),
        "disturbance": disturbance.GetOutputPort("disturbance"),
    }
    if disturbance.HasOutputPort("model_error"):
        outputs["model_error"] = disturbance.GetOutputPort("model_error")
    for name in ("state", "reference"):  # only the hardest look at them
        if disturbance.HasInputPort(name):
            builder.Connect(outputs[name], disturbance.GetInputPort(name))
    monitor = TubeMonitor.AddToBuilder(
        builder=builder,
        scenario=scenario,
        state=state,
        plan=plan,
        control=outputs["control"],
        trials=trials,
    )
    for name in ("tube_ratios", "clearance", "quantities", "record"):
        outputs[name] = monitor.GetOutputPort(name)
    for name in ("control", "disturbance", "model_error"):
        if name in outputs:
            builder.Connect(outputs[name], plant.GetInputPort(name))
    return outputs


def _built(builder: DiagramBuilder, outputs: dict[str, OutputPort]) -> Diagram:
    """The diagram, with these ports exported."""
    for name, port in outputs.items():
        builder.ExportOutput(port, name)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return diagram
