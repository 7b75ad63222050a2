"""The paper's first experiment, wired by hand: planner, tracker, plant, wind, monitor.

Run it with ``python diagrams/known_environment.py``.  `MakeClosedLoop` is this wiring
with more ports; ``receding_horizon.py`` adds a sensor to it.
"""

from pathlib import Path

from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

import dtmpc_drake as dtmpc
from dtmpc_drake import systems
from dtmpc_drake.disturbances import MakeDisturbance
from dtmpc_drake.visualization import ShownFlight

scenario = dtmpc.load_scenario("known_environment")
model, start, slope = scenario.model, scenario.start_state(), scenario.slope()

builder = DiagramBuilder()
add, connect = builder.AddNamedSystem, builder.Connect
planner = add("planner", systems.DtmpcPlanner(scenario=scenario))
tracker = add("tracker", systems.SlidingModeTracker(scenario=scenario))
plant = add("plant", systems.Plant(model=model, initial_state=start))
wind = MakeDisturbance(scenario.disturbance, model=model, slope=slope)
add("wind", wind)

plan, state = planner.GetOutputPort("plan"), plant.GetOutputPort("state")
control = tracker.GetOutputPort("control")
connect(plan, tracker.GetInputPort("plan"))
connect(state, tracker.GetInputPort("state"))
connect(control, plant.GetInputPort("control"))
connect(wind.GetOutputPort("disturbance"), plant.GetInputPort("disturbance"))
monitor = systems.TubeMonitor.AddToBuilder(
    builder=builder, scenario=scenario, state=state, plan=plan, control=control
)
used = LogVectorOutput(monitor.GetOutputPort("tube_ratios"), builder, 0.02)
flown = LogVectorOutput(state, builder, 0.02)

simulator = Simulator(builder.Build())
context = simulator.get_mutable_context()
simulator.get_system().SetRandomContext(context, RandomGenerator(0))
simulator.AdvanceTo(scenario.duration)

log = flown.FindLog(context)
path = Path("out/diagrams/known_environment.html")
path.parent.mkdir(parents=True, exist_ok=True)
dtmpc.write_replay(
    path,
    scenario=scenario,
    plan=plan.Eval(planner.GetMyContextFromRoot(context)),
    flight=ShownFlight(time=log.sample_times(), position=log.data()[:3].T),
)
share = used.FindLog(context).data().max()
print(f"used {share:.0%} of the tube at most; see {path}")
