"""A body of Drake's multibody engine flies a plan: a plant of one's own in the loop.

Run it with ``python diagrams/multibody_plant.py``.  A mass of 1 kg slides along three
prismatic joints.  It feels gravity, which its actuators compensate, but no drag: the
plan knows drag up to an interval only, and none at all is within it.
"""

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, LogVectorOutput

import dtmpc_drake as dtmpc


def make_plant() -> tuple[Diagram, MultibodyPlant]:
    """The body with the ports that `MakeClosedLoop` asks for, and its engine."""
    builder = DiagramBuilder()
    body = builder.AddNamedSystem("body", MultibodyPlant(time_step=0.0))
    frame, ball = body.world_frame(), SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    for name, axis in zip("xyz", np.eye(3), strict=True):
        inertia = ball if name == "z" else SpatialInertia.Zero()
        slide = body.AddRigidBody(name, inertia).body_frame()
        joint = body.AddJoint(PrismaticJoint(name, frame, slide, axis))
        body.AddJointActuator(name, joint)
        frame = slide
    body.Finalize()
    lift = -body.gravity_field().gravity_vector()  # for 1 kg, in N
    hover = builder.AddSystem(ConstantVectorSource(lift))
    force = builder.AddSystem(Adder(num_inputs=3, size=3))
    builder.ExportInput(force.get_input_port(0), "control")
    builder.ExportInput(force.get_input_port(1), "disturbance")
    builder.Connect(hover.get_output_port(), force.get_input_port(2))
    builder.Connect(force.get_output_port(), body.get_actuation_input_port())
    builder.ExportOutput(body.get_state_output_port(), "state")
    return builder.Build(), body


scenario = dtmpc.load_scenario("unknown_drag")
result = dtmpc.plan(scenario)
plant, body = make_plant()
loop = dtmpc.MakeClosedLoop(scenario, plan=result.plan, plant=plant)
builder = DiagramBuilder()
builder.AddNamedSystem("loop", loop)
# Without a period, they log every step of the integrator.
used = LogVectorOutput(loop.GetOutputPort("tube_ratios"), builder)
clearance = LogVectorOutput(loop.GetOutputPort("clearance"), builder)

simulator = Simulator(builder.Build())
context = simulator.get_mutable_context()
simulator.get_system().SetRandomContext(context, RandomGenerator(0))
start = scenario.start_state().ravel()
body.SetPositionsAndVelocities(body.GetMyMutableContextFromRoot(context), start)
simulator.AdvanceTo(scenario.duration)

share, nearest = used.FindLog(context).data(), clearance.FindLog(context).data()
print(f"used {share.max():.0%} of the tube at most, {nearest.min():.3f} m clear")
if share.max() > 1 or nearest.min() <= 0:
    raise SystemExit("the body left its tube")
