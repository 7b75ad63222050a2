"""The same field, seen by a sensor with a range: a closed loop in a larger diagram.

Run it with ``python diagrams/sensed_environment.py``.  What `MakeClosedLoop` gives is a
system like any other: here loggers of Drake's own listen to two of its ports.
"""

from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

import dtmpc_drake as dtmpc

scenario = dtmpc.load_scenario("sensed_environment")
builder = DiagramBuilder()
loop = builder.AddNamedSystem("loop", dtmpc.MakeClosedLoop(scenario))
clearance = LogVectorOutput(loop.GetOutputPort("clearance"), builder, 0.02)
control = LogVectorOutput(loop.GetOutputPort("control"), builder, 0.02)

simulator = Simulator(builder.Build())
context = simulator.get_mutable_context()
simulator.get_system().SetRandomContext(context, RandomGenerator(0))
simulator.Initialize()
told, mine = 0, loop.GetMyContextFromRoot(context)
for step in range(1, 1 + int(2 * scenario.duration)):
    simulator.AdvanceTo(0.5 * step)
    replans = loop.GetOutputPort("replans").Eval(mine)
    for replan in replans[told:]:
        print(replan.headline())
    told = len(replans)

since = loop.GetOutputPort("known_since").Eval(mine)
nearest = clearance.FindLog(context).data().min(axis=1)
for i, (when, distance) in enumerate(zip(since, nearest, strict=True)):
    print(f"obstacle {i}: seen at {when:5.2f} s, passed at {distance:.3f} m")
largest = (control.FindLog(context).data() ** 2).sum(axis=0).max() ** 0.5
print(f"largest input {largest:.2f} of {scenario.limits.input:g} m/s²")
