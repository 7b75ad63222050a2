"""The paper's third experiment: one plan, two vehicles with drag at either end.

Run it with ``python diagrams/state_dependent_uncertainty.py``.  The planner knows the
drag up to an interval, so it is slow in the gap, and its one plan holds for a vehicle
with the least drag and for one with the most.
"""

from pathlib import Path

from pydrake.common import RandomGenerator
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, LogVectorOutput

import dtmpc_drake as dtmpc
from dtmpc_drake import systems
from dtmpc_drake.disturbances import MakeDisturbance

scenario = dtmpc.load_scenario("state_dependent_uncertainty")
model, start, slope = scenario.model, scenario.start_state(), scenario.slope()
result = dtmpc.plan(scenario)
print(result)

builder = DiagramBuilder()
source = builder.AddNamedSystem("plan", ConstantValueSource(Value[object](result.plan)))
wind = MakeDisturbance(scenario.disturbance, model=model, slope=slope)
builder.AddNamedSystem("wind", wind)
plan, push = source.get_output_port(), wind.GetOutputPort("disturbance")
logs = {}
for drag in model.parameter_interval("drag"):
    plant = systems.Plant(model=model, parameters={"drag": drag}, initial_state=start)
    tracker = systems.SlidingModeTracker(scenario=scenario)
    builder.AddNamedSystem(f"plant with drag {drag:g}", plant)
    builder.AddNamedSystem(f"tracker of drag {drag:g}", tracker)
    state, control = plant.GetOutputPort("state"), tracker.GetOutputPort("control")
    builder.Connect(plan, tracker.GetInputPort("plan"))
    builder.Connect(state, tracker.GetInputPort("state"))
    builder.Connect(control, plant.GetInputPort("control"))
    builder.Connect(push, plant.GetInputPort("disturbance"))
    logs[drag] = LogVectorOutput(state, builder, 0.02)

simulator = Simulator(builder.Build())
context = simulator.get_mutable_context()
simulator.get_system().SetRandomContext(context, RandomGenerator(0))
simulator.AdvanceTo(scenario.duration)

flights = {}
for drag, logger in logs.items():
    log = logger.FindLog(context)
    flights[f"drag {drag:g} 1/m"] = log.data()[None, :3].swapaxes(1, 2)
    fastest = log.data()[3:].max()
    print(f"drag {drag:g} 1/m: never faster than {fastest:.2f} m/s")
path = Path("out/diagrams/state_dependent_uncertainty.png")
path.parent.mkdir(parents=True, exist_ok=True)
dtmpc.plot_plan(
    scenario=scenario, plan=result.plan, position=flights, color_by="speed"
).savefig(path)
print(f"see {path}")
