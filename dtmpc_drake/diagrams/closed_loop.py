"""TODO."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder

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
    scenario: Scenario,
    *,
    plan: Plan | None = None,
    trials: Sequence[Trial] | None = None,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """The diagram of a scenario.

    Args:
        scenario: the whole experiment; the diagram's default Context is its
            start (apart from randomness, which `SetRandomContext` seeds).
        plan: to fly instead of planning at the start.
        trials: to fly a plan many times side by side, each with its own true
            parameters; `state`, `control`, `disturbance`, `tube_ratios` and
            `clearance` then have one more axis in front.
        meshcat: to watch the simulation of a single flight in, if given.

    Returns:
        A diagram named ``closed_loop`` that exports the output ports `state`,
        `control`, `reference`, `plan`, `status`, `disturbance`, `tube_ratios`,
        `clearance`, `quantities` and `record`; if there may be more plans than one,
        `known_since` and `replans`, too; if the disturbance chooses it,
        `model_error`.  See the systems for their meaning.

    Raises:
        ValueError: if trials come without a plan or with a Meshcat, or with a
            scenario that asks for plans on the way.
    """
    model = scenario.model
    parameters: dict[str, Any] = dict(scenario.plant_parameters())
    initial_error = scenario.initial_error_state()
    count = disturbances = None
    if trials is not None:
        if plan is None or meshcat is not None:
            raise ValueError("trials: they fly a given plan, and are not shown")
        require_one_plan(scenario)
        count = len(trials)
        for name in parameters:
            parameters[name] = [trial.parameters[name] for trial in trials]
        own = [trial.scenario(scenario) for trial in trials]
        initial_error = np.stack([one.initial_error_state() for one in own])
        disturbances = [one.disturbance for one in own]
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem(
        "plant",
        Plant(
            model=model,
            parameters=parameters,
            initial_state=scenario.start_state() + initial_error,
            trials=count,
        ),
    )
    planner = builder.AddNamedSystem(
        "planner", DtmpcPlanner(scenario=scenario, plan=plan)
    )
    tracker = builder.AddNamedSystem(
        "tracker", SlidingModeTracker(scenario=scenario, trials=count)
    )
    disturbance = builder.AddNamedSystem(
        "disturbance",
        MakeDisturbance(
            scenario.disturbance,
            model=model,
            slope=scenario.slope(),
            trials=disturbances,
            duration=scenario.duration,
        ),
    )
    outputs = {
        "state": plant.GetOutputPort("state"),
        "control": tracker.GetOutputPort("control"),
        "reference": tracker.GetOutputPort("reference"),
        "plan": planner.GetOutputPort("plan"),
        "status": planner.GetOutputPort("status"),
        "disturbance": disturbance.GetOutputPort("disturbance"),
    }
    monitor = TubeMonitor.AddToBuilder(
        builder=builder,
        scenario=scenario,
        state=outputs["state"],
        plan=outputs["plan"],
        control=outputs["control"],
        trials=count,
    )
    for name in ("tube_ratios", "clearance", "quantities", "record"):
        outputs[name] = monitor.GetOutputPort(name)

    if trials is None:
        builder.Connect(outputs["state"], planner.GetInputPort("state"))
        if scenario.is_receding:
            sensor = builder.AddNamedSystem(
                "obstacle_sensor", ObstacleSensor(scenario=scenario)
            )
            builder.Connect(outputs["state"], sensor.GetInputPort("state"))
            measured = sensor.GetOutputPort("measured_obstacles")
            builder.Connect(measured, planner.GetInputPort("measured_obstacles"))
            outputs["known_since"] = sensor.GetOutputPort("known_since")
            outputs["replans"] = planner.GetOutputPort("replans")
    builder.Connect(outputs["state"], tracker.GetInputPort("state"))
    builder.Connect(outputs["plan"], tracker.GetInputPort("plan"))
    builder.Connect(outputs["control"], plant.GetInputPort("control"))
    builder.Connect(outputs["disturbance"], plant.GetInputPort("disturbance"))
    if disturbance.HasOutputPort("model_error"):
        outputs["model_error"] = disturbance.GetOutputPort("model_error")
        builder.Connect(outputs["model_error"], plant.GetInputPort("model_error"))
    for name in ("state", "reference"):  # only the hardest look at them
        if disturbance.HasInputPort(name):
            builder.Connect(outputs[name], disturbance.GetInputPort(name))
    if meshcat is not None:
        view = LiveView(scenario=scenario, meshcat=meshcat)
        builder.AddNamedSystem("live_view", view)
        for name in ("state", "plan"):
            builder.Connect(outputs[name], view.GetInputPort(name))
    for name, port in outputs.items():
        builder.ExportOutput(port, name)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return diagram
