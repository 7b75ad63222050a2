"""The closed loop: how planner, tracker, plant, disturbance and monitor are wired.

`MakeClosedLoop` is one flight, as it is planned and sensed; `MakeSideBySide` is many
flights of one plan.  Both close the same loop around what `MakeController` gives alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import PassThrough

from dtmpc_drake.diagrams.live_view import LiveView
from dtmpc_drake.diagrams.trials import Trial
from dtmpc_drake.disturbances import MakeDisturbance
from dtmpc_drake.errors import require
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario, require_one_plan
from dtmpc_drake.systems import (
    DtmpcPlanner,
    ObstacleSensor,
    Plant,
    SlidingModeTracker,
    TubeMonitor,
)
from dtmpc_drake.systems.wiring import RequirePorts


def MakeClosedLoop(
    scenario: Scenario,
    *,
    plan: Plan | None = None,
    plant: System | None = None,
    disturbance: System | None = None,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """The diagram of a scenario.

    Plant and disturbance may be systems of one's own.  What a plan promises holds for
    them as far as what the scenario says of them is true: its model with the bound Δ,
    the bound D, and a start within its initial error.

    Args:
        scenario: the whole experiment; the diagram's default Context is its
            start (apart from randomness, which `SetRandomContext` seeds).
        plan: to fly instead of planning at the start.
        plant: to fly instead of a `Plant` of the scenario's model and parameters.  It
            has the input ports `control` and `disturbance`, ``(m,)``, and the output
            port `state`, flattened as that of a `Plant`, which depends on its own state
            alone.  Its default Context is where it starts.
        disturbance: that pushes it, instead of the scenario's: a system with the output
            port `disturbance`, ``(m,)``.  It may have the input ports `state` and
            `reference`, as the plant and the tracker give them, and the output port
            `model_error`, ``(m,)``, if the plant has such an input.
        meshcat: to watch the simulation in, if given.

    Returns:
        A diagram named ``closed_loop`` that exports the output ports `state`,
        `control`, `reference`, `plan`, `status`, `disturbance`, `tube_ratios`,
        `clearance`, `quantities` and `record`; if there may be more plans than one,
        `known_since` and `replans`, too; if the disturbance chooses it,
        `model_error`.  See the systems for their meaning.

    Raises:
        ScenarioError: if plan, plant or disturbance do not fit the scenario's model.
    """
    _require_plan(scenario, plan)
    if plant is None:
        plant = Plant(
            model=scenario.model,
            parameters=scenario.plant_parameters(),
            initial_state=scenario.start_state() + scenario.initial_error_state(),
        )
    if disturbance is None:
        disturbance = MakeDisturbance(
            scenario.disturbance,
            model=scenario.model,
            slope=scenario.slope(),
            duration=scenario.duration,
        )
    _require_fit(scenario, plant, disturbance)
    builder = DiagramBuilder()
    builder.AddNamedSystem("plant", plant)
    state = plant.GetOutputPort("state")
    outputs = _add_controller(builder, scenario, state, plan=plan, meshcat=meshcat)
    _close(builder, plant, disturbance, outputs)
    return _built(builder, "closed_loop", outputs)


def MakeController(
    scenario: Scenario, *, plan: Plan | None = None, meshcat: Meshcat | None = None
) -> Diagram:
    """The closed loop without plant and disturbance, for a larger diagram.

    Args:
        scenario: as for `MakeClosedLoop`, and so the next two.
        plan: to fly instead of planning at the start.
        meshcat: to watch the simulation in, if given.

    Returns:
        A diagram named ``controller`` with the input port `state`, flattened as that
        of a `Plant`, and the output ports of `MakeClosedLoop` but those of plant and
        disturbance: `control`, ``(m,)``, is what the plant is to be given.

    Raises:
        ScenarioError: if the plan does not fit the scenario's model.
    """
    _require_plan(scenario, plan)
    builder = DiagramBuilder()
    size = Chains.of(scenario.model).size
    entry = builder.AddNamedSystem("state", PassThrough(size))
    builder.ExportInput(entry.get_input_port(), "state")
    state = entry.get_output_port()
    outputs = _add_controller(builder, scenario, state, plan=plan, meshcat=meshcat)
    return _built(builder, "controller", outputs)


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
        ScenarioError: if the scenario asks for plans on the way, or the plan does not
            fit its model.
    """
    require_one_plan(scenario)
    _require_plan(scenario, plan)
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
    disturbance = MakeDisturbance(
        scenario.disturbance,
        model=scenario.model,
        slope=scenario.slope(),
        trials=[one.disturbance for one in own],
        duration=scenario.duration,
    )
    state = plant.GetOutputPort("state")
    outputs = _add_controller(builder, scenario, state, plan=plan, trials=len(trials))
    _close(builder, plant, disturbance, outputs)
    return _built(builder, "closed_loop", outputs)


def _require_plan(scenario: Scenario, plan: Plan | None) -> None:
    """Refuses to fly what is no plan of the scenario's model."""
    chains = Chains.of(scenario.model)
    fits = plan is None or (isinstance(plan, Plan) and plan.chains == chains)
    allowed = f"a Plan of {chains.words} with {chains.num_outputs} outputs"
    require("plan", plan, fits, allowed)


def _require_fit(scenario: Scenario, plant: System, disturbance: System) -> None:
    """Refuses systems that are not for the scenario's model, or not for each other."""
    chains = Chains.of(scenario.model)
    n, m = chains.order, chains.num_outputs
    looks = {"state": chains.size, "reference": (n + 1) * m}
    push, chosen = {"disturbance": m}, {"model_error": m}
    RequirePorts(
        "disturbance", disturbance, inputs={}, outputs=push, optional=looks | chosen
    )
    inputs, optional = {"control": m} | push, chosen
    if disturbance.HasOutputPort("model_error"):
        inputs, optional = inputs | chosen, {}
    state = {"state": chains.size}
    RequirePorts("plant", plant, inputs=inputs, outputs=state, optional=optional)
    output = plant.GetOutputPort("state").get_index()
    for name in inputs:
        direct = plant.HasDirectFeedthrough(
            plant.GetInputPort(name).get_index(), output
        )
        require(
            "plant",
            f"one whose output state depends directly on its input {name}",
            not direct,
            "a Drake System whose output state is its own state alone",
        )


def _add_controller(
    builder: DiagramBuilder,
    scenario: Scenario,
    state: OutputPort,
    *,
    plan: Plan | None,
    trials: int | None = None,
    meshcat: Meshcat | None = None,
) -> dict[str, OutputPort]:
    """Adds planner, tracker and monitor, and the sensor if there is to be one.

    Returns:
        The output ports to export, by name.
    """
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
        state=state if trials is None else None,
        measured_obstacles=measured,
    )
    flown = planner.GetOutputPort("plan")
    tracker = SlidingModeTracker.AddToBuilder(
        builder=builder, scenario=scenario, state=state, plan=flown, trials=trials
    )
    control = tracker.GetOutputPort("control")
    monitor = TubeMonitor.AddToBuilder(
        builder=builder,
        scenario=scenario,
        state=state,
        plan=flown,
        control=control,
        trials=trials,
    )
    outputs = {
        "control": control,
        "reference": tracker.GetOutputPort("reference"),
        "plan": flown,
        "status": planner.GetOutputPort("status"),
    }
    for name in ("tube_ratios", "clearance", "quantities", "record"):
        outputs[name] = monitor.GetOutputPort(name)
    if sensor is not None:
        outputs["known_since"] = sensor.GetOutputPort("known_since")
        outputs["replans"] = planner.GetOutputPort("replans")
    if meshcat is not None:
        LiveView.AddToBuilder(
            builder=builder,
            scenario=scenario,
            meshcat=meshcat,
            state=state,
            plan=flown,
        )
    return outputs


def _close(
    builder: DiagramBuilder,
    plant: System,
    disturbance: System,
    outputs: dict[str, OutputPort],
) -> None:
    """Adds the disturbance, and closes the loop over the plant.

    Args:
        builder: the DiagramBuilder.
        plant: that is in it.
        disturbance: to add.
        outputs: of the controller; those of plant and disturbance are added.
    """
    builder.AddNamedSystem("disturbance", disturbance)
    outputs["state"] = plant.GetOutputPort("state")
    for name in ("disturbance", "model_error"):
        if disturbance.HasOutputPort(name):
            outputs[name] = disturbance.GetOutputPort(name)
    for name in ("state", "reference"):  # only the hardest look at them
        if disturbance.HasInputPort(name):
            builder.Connect(outputs[name], disturbance.GetInputPort(name))
    for name in ("control", "disturbance", "model_error"):
        if name in outputs:
            builder.Connect(outputs[name], plant.GetInputPort(name))


def _built(
    builder: DiagramBuilder, name: str, outputs: dict[str, OutputPort]
) -> Diagram:
    """The diagram under its name, with these ports exported."""
    for port_name, port in outputs.items():
        builder.ExportOutput(port, port_name)
    diagram = builder.Build()
    diagram.set_name(name)
    return diagram
