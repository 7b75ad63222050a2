"""The paper's second experiment: pillars become known on the way, plans follow.

Run it with ``python diagrams/receding_horizon.py``.  It is the wiring of
``known_environment.py`` with a sensor, and a planner that listens to it and to the
state.
"""

from pathlib import Path

from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

import dtmpc_drake as dtmpc
from dtmpc_drake import systems
from dtmpc_drake.disturbances import MakeDisturbance
from dtmpc_drake.records.replan import flown_plan, table
from dtmpc_drake.visualization import ShownFlight

scenario = dtmpc.load_scenario("receding_horizon")
model, start, slope = scenario.model, scenario.start_state(), scenario.slope()

builder = DiagramBuilder()
add, connect = builder.AddNamedSystem, builder.Connect
sensor = add("sensor", systems.ObstacleSensor(scenario=scenario))
planner = add("planner", systems.DtmpcPlanner(scenario=scenario))
tracker = add("tracker", systems.SlidingModeTracker(scenario=scenario))
plant = add("plant", systems.Plant(model=model, initial_state=start))
wind = MakeDisturbance(scenario.disturbance, model=model, slope=slope)
add("wind", wind)

known, state = sensor.GetOutputPort("measured_obstacles"), plant.GetOutputPort("state")
connect(state, sensor.GetInputPort("state"))
connect(state, planner.GetInputPort("state"))
connect(known, planner.GetInputPort("measured_obstacles"))
connect(state, tracker.GetInputPort("state"))
connect(planner.GetOutputPort("plan"), tracker.GetInputPort("plan"))
connect(tracker.GetOutputPort("control"), plant.GetInputPort("control"))
connect(wind.GetOutputPort("disturbance"), plant.GetInputPort("disturbance"))
flown = LogVectorOutput(state, builder, 0.02)

simulator = Simulator(builder.Build())
context = simulator.get_mutable_context()
simulator.get_system().SetRandomContext(context, RandomGenerator(0))
simulator.AdvanceTo(scenario.duration)

replans = planner.GetOutputPort("replans").Eval(planner.GetMyContextFromRoot(context))
since = sensor.GetOutputPort("known_since").Eval(sensor.GetMyContextFromRoot(context))
log = flown.FindLog(context)
path = Path("out/diagrams/receding_horizon.html")
path.parent.mkdir(parents=True, exist_ok=True)
flight = ShownFlight(
    time=log.sample_times(),
    position=log.data()[:3].T,
    replans=replans,
    known_since=since,
)
plan = flown_plan(replans)
dtmpc.write_replay(path, scenario=scenario, plan=plan, flight=flight)
print(table(replans))
print(f"see {path}")
