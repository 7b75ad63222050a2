"""Monte Carlo as a diagram: a hundred vehicles fly one plan side by side.

Run it with ``python diagrams/side_by_side.py``.  Plant, tracker and disturbance take as
many trials as they are told, so a diagram of four systems flies all of them; ``dtmpc
monte-carlo`` spreads such diagrams over processes.
"""

from pathlib import Path

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, LogVectorOutput

import dtmpc_drake as dtmpc
from dtmpc_drake import systems
from dtmpc_drake.disturbances import MakeDisturbance, SeedTrials

TRIALS = 100
scenario = dtmpc.load_scenario("known_environment")
model, start, slope = scenario.model, scenario.start_state(), scenario.slope()
result = dtmpc.plan(scenario)

builder = DiagramBuilder()
add, connect = builder.AddNamedSystem, builder.Connect
source = add("plan", ConstantValueSource(Value[object](result.plan)))
tracker = systems.SlidingModeTracker(scenario=scenario, trials=TRIALS)
add("tracker", tracker)
plant = add("plant", systems.Plant(model=model, initial_state=start, trials=TRIALS))
wind = MakeDisturbance(
    scenario.disturbance,
    model=model,
    slope=slope,
    trials=[scenario.disturbance] * TRIALS,
    duration=scenario.duration,
)
add("wind", wind)
plan, state = source.get_output_port(), plant.GetOutputPort("state")
connect(plan, tracker.GetInputPort("plan"))
connect(state, tracker.GetInputPort("state"))
connect(tracker.GetOutputPort("control"), plant.GetInputPort("control"))
connect(wind.GetOutputPort("disturbance"), plant.GetInputPort("disturbance"))
flown = LogVectorOutput(state, builder, 0.02)

simulator = Simulator(builder.Build())
# Fixed steps: those that depend on the error would tie each vehicle to all others.
fixed = SimulatorConfig(max_step_size=0.01, use_error_control=False)
ApplySimulatorConfig(fixed, simulator)
context = simulator.get_mutable_context()
SeedTrials(wind, context, range(TRIALS))
simulator.AdvanceTo(scenario.duration)

log = flown.FindLog(context)
# (vehicles, times, order, outputs)
states = np.moveaxis(log.data().reshape(TRIALS, *start.shape, -1), -1, 1)
used = systems.tube_ratios(
    plan=result.plan, time=log.sample_times(), state=states, slope=slope
)
shares = used.reshape(TRIALS, -1).max(axis=1)
print(f"{TRIALS} flights used {shares.min():.0%} to {shares.max():.0%} of the tube")
path = Path("out/diagrams/side_by_side.png")
path.parent.mkdir(parents=True, exist_ok=True)
positions = states[:, :, 0]
dtmpc.plot_plan(scenario=scenario, plan=result.plan, position=positions).savefig(path)
print(f"see {path}")
