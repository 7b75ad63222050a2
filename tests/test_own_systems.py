"""Systems of one's own in the closed loop, and its controller in a larger diagram."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Adder

from dtmpc_drake import systems
from dtmpc_drake.diagrams import MakeClosedLoop, MakeController, Simulate
from dtmpc_drake.disturbances import Constant, MakeDisturbance, WorstCase
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.planning import plan
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Limits, Scenario, load_scenario
from tests.test_diagrams import small


class Cart(LeafSystem):
    """A plant as somebody else would write it: y'' = u + d + push, in Drake's terms."""

    def __init__(self, start: Any, push: float = 0.0, *, direct: bool = False) -> None:
        LeafSystem.__init__(self)
        self._push, m = push, np.shape(start)[1]
        self._control = self.DeclareVectorInputPort("control", m)
        self._disturbance = self.DeclareVectorInputPort("disturbance", m)
        start = BasicVector(np.ravel(start))
        state = self.DeclareContinuousState(start, m, m, 0)
        if direct:  # the default of Drake's: it may depend on anything
            self.DeclareVectorOutputPort("state", 2 * m, self._calc_state)
        else:
            self.DeclareStateOutputPort("state", state)

    def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
        velocity = context.get_continuous_state().get_generalized_velocity()
        push = self._control.Eval(context) + self._disturbance.Eval(context)
        rates = [velocity.CopyToVector(), push + self._push]
        derivatives.SetFromVector(np.concatenate(rates))

    def _calc_state(self, context: Any, output: Any) -> None:
        output.SetFromVector(context.get_continuous_state_vector().CopyToVector())


class Bumps(LeafSystem):
    """A disturbance of somebody else: it follows the clock and the velocity."""

    def __init__(self, bound: float, m: int) -> None:
        LeafSystem.__init__(self)
        self._bound, self._m = bound, m
        self._state = self.DeclareVectorInputPort("state", 2 * m)
        self.DeclareVectorOutputPort("disturbance", m, self._calc)

    def _calc(self, context: Any, output: Any) -> None:
        velocity = self._state.Eval(context)[self._m :]
        side = np.sin(5 * context.get_time()) + velocity >= 0
        output.SetFromVector(self._bound * np.where(side, 1, -1))


Certified = tuple[Scenario, Plan]


@pytest.fixture(scope="module")
def chain() -> Certified:
    """Two carts whose model error is up to 0.2 m/s²."""
    return certified(small(IntegratorChain(2, 2, 0.2), plant={"model_error": 0.1}))


def certified(scenario: Scenario) -> Certified:
    result = plan(scenario)
    assert result.certified and result.plan is not None
    return scenario, result.plan


@pytest.mark.parametrize("push", [-0.2, 0.0, 0.2])
def test_a_plant_of_ones_own_stays_in_the_tube(chain: Certified, push: float) -> None:
    scenario, flown = chain
    flight = Simulate(scenario, plan=flown, plant=Cart(scenario.start_state(), push))
    assert flight.breaches(scenario) == ()
    # It is really this plant that flies: it feels its own push, and not the model's.
    others = Simulate(scenario, plan=flown)
    assert np.abs(flight.state - others.state).max() > 1e-3


def test_a_plant_that_is_the_models_flies_as_the_librarys_does(
    chain: Certified,
) -> None:
    scenario, flown = chain
    mine = Simulate(scenario, plan=flown, plant=Cart(scenario.start_state(), 0.1))
    librarys = Simulate(scenario, plan=flown)
    np.testing.assert_allclose(mine.state, librarys.state, atol=1e-12)


def test_a_plant_that_is_not_what_the_scenario_says_is_seen(chain: Certified) -> None:
    scenario, flown = chain
    worse = Simulate(scenario, plan=flown, plant=Cart(scenario.start_state(), 2.0))
    assert {breach.what for breach in worse.breaches(scenario)} >= {"layer", "position"}
    elsewhere = Simulate(scenario, plan=flown, plant=Cart(np.ones((2, 2))))
    assert elsewhere.breaches(scenario)[0].time == 0.0


def test_a_disturbance_of_ones_own_pushes(chain: Certified) -> None:
    scenario, flown = chain
    flight = Simulate(scenario, plan=flown, disturbance=Bumps(0.3, 2))
    assert (np.abs(flight.disturbance) == 0.3).all()
    assert set(np.sign(flight.disturbance).ravel()) == {-1.0, 1.0}
    assert flight.breaches(scenario) == ()


def test_the_librarys_own_disturbances_may_be_brought(chain: Certified) -> None:
    scenario, flown = chain
    worst = WorstCase(bound=[0.3, 0.3], model_error=True)
    brought = MakeDisturbance(worst, model=scenario.model, slope=scenario.slope())
    mine = Simulate(scenario, plan=flown, disturbance=brought)
    asked = Simulate(dataclasses.replace(scenario, disturbance=worst), plan=flown)
    np.testing.assert_array_equal(mine.state, asked.state)


REFUSED: dict[str, tuple[Callable[[Scenario], dict[str, Any]], str]] = {
    "ports of other names": (
        lambda _: {"plant": Adder(2, 2)},
        r"plant: got 'one with input ports u0 \(2\), u1 \(2\) and output ports"
        r" sum \(2\)', but it must be a Drake System with input ports control \(2\),"
        r" disturbance \(2\) and output ports state \(4\)",
    ),
    "ports of other sizes": (
        lambda _: {"plant": Cart(np.zeros((2, 3)))},
        r"plant: got .*control \(3\).*, but .* control \(2\)",
    ),
    "many plants": (
        lambda s: {"plant": systems.Plant(model=s.model, trials=3)},
        r"plant: got .*control \(6\).*, but .* control \(2\)",
    ),
    "no system": (lambda s: {"plant": s.model}, r"plant: got IntegratorChain\(.*Drake"),
    "a class": (lambda _: {"plant": Cart}, r"plant: got <class .*a Drake System"),
    "a state that follows the input at once": (
        lambda s: {"plant": Cart(s.start_state(), direct=True)},
        r"plant: got 'one whose output state depends directly on its input control'",
    ),
    "no port for the model error": (
        lambda s: {
            "plant": Cart(s.start_state()),
            "disturbance": MakeDisturbance(
                WorstCase(bound=[0.3, 0.3], model_error=True),
                model=s.model,
                slope=s.slope(),
            ),
        },
        r"plant: got .* must be .* disturbance \(2\), model_error \(2\) and output",
    ),
    "a push of another size": (
        lambda _: {"disturbance": Bumps(0.3, 3)},
        r"disturbance: got .*disturbance \(3\)', but it must be .* disturbance \(2\)",
    ),
    "no push": (
        lambda s: {"disturbance": s.disturbance},
        r"disturbance: got WorstCase\(.* must be a Drake System with output ports",
    ),
    "a look at another state": (
        lambda s: {
            "disturbance": MakeDisturbance(
                WorstCase(bound=[0.3, 0.3]),
                model=IntegratorChain(2, 3),
                slope=s.slope(),
            )
        },
        r"disturbance: got .*state \(6\), reference \(8\).* state \(4\)",
    ),
    "no plan": (
        lambda s: {"plan": plan(s)},
        r"plan: got PlanningResult.* must be a Plan of order 2 with 2 outputs",
    ),
    "a plan of another model": (
        lambda _: {"plan": certified(small(IntegratorChain(1, 2)))[1]},
        r"plan: got Plan\(.*, but it must be a Plan of order 2 with 2 outputs",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused_at_once_in_one_line(
    chain: Certified, case: str
) -> None:
    scenario, flown = chain
    brought, words = REFUSED[case]
    with pytest.raises(ScenarioError, match=words) as error:
        MakeClosedLoop(scenario, **({"plan": flown} | brought(scenario)))
    assert "\n" not in str(error.value)


# The controller in a larger diagram.


def larger(scenario: Scenario, flown: Plan | None) -> Simulator:
    """The closed loop, put together by somebody who has a plant and a push."""
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem(
        "plant",
        systems.Plant(
            model=scenario.model,
            parameters=scenario.plant_parameters(),
            initial_state=scenario.start_state() + scenario.initial_error_state(),
        ),
    )
    controller = builder.AddSystem(MakeController(scenario, plan=flown))
    push = builder.AddSystem(
        MakeDisturbance(
            scenario.disturbance, model=scenario.model, slope=scenario.slope()
        )
    )
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("state"))
    builder.Connect(controller.GetOutputPort("control"), plant.GetInputPort("control"))
    builder.Connect(
        push.GetOutputPort("disturbance"), plant.GetInputPort("disturbance")
    )
    for name in ("state", "reference"):
        if push.HasInputPort(name):
            source = plant if name == "state" else controller
            builder.Connect(source.GetOutputPort(name), push.GetInputPort(name))
    for name in ("control", "record", "status"):
        builder.ExportOutput(controller.GetOutputPort(name), name)
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    return Simulator(builder.Build())


@pytest.mark.parametrize("disturbance", [Constant, WorstCase])
def test_in_a_larger_diagram_it_flies_as_in_the_closed_loop(disturbance: Any) -> None:
    pushed = disturbance(bound=[0.3, 0.3, 0.3])
    scenario, flown = certified(
        small(DragDoubleIntegrator(0.1, 0.1), disturbance=pushed, duration=4.0)
    )
    for given in (flown, None):  # planned before it, and in it
        mine = larger(scenario, given)
        loop = Simulator(MakeClosedLoop(scenario, plan=given))
        for simulator in (mine, loop):
            system, context = simulator.get_system(), simulator.get_mutable_context()
            system.SetRandomContext(context, RandomGenerator(3))
            simulator.AdvanceTo(scenario.duration)
        for name in ("state", "control", "record"):
            np.testing.assert_array_equal(
                at_the_end(mine, name), at_the_end(loop, name)
            )
        assert at_the_end(mine, "status") == at_the_end(loop, "status")


def at_the_end(simulator: Simulator, name: str) -> Any:
    return simulator.get_system().GetOutputPort(name).Eval(simulator.get_context())


def test_the_controller_exports_the_ports_of_the_loop_but_the_plants() -> None:
    for name in ("known_environment", "receding_horizon"):
        scenario = load_scenario(name)
        controller, loop = MakeController(scenario), MakeClosedLoop(scenario)
        assert controller.get_name() == "controller"
        assert controller.num_input_ports() == 1
        assert controller.GetInputPort("state").size() == 6
        assert output_names(loop) - output_names(controller) == {"state", "disturbance"}
        assert output_names(controller) < output_names(loop)
        assert controller.HasOutputPort("replans") is scenario.is_receding


def output_names(system: Any) -> frozenset[str]:
    count = system.num_output_ports()
    return frozenset(system.get_output_port(i).get_name() for i in range(count))


def test_the_controller_looks_at_the_state_that_it_is_given() -> None:
    """Obstacles are found where the larger diagram says that the vehicle is."""
    scenario = load_scenario("sensed_environment")
    controller = MakeController(scenario)
    context = controller.CreateDefaultContext()
    far = scenario.start_state()
    far[0] += [0.0, 0.0, 300.0]
    controller.GetInputPort("state").FixValue(context, far.ravel())
    assert controller.GetOutputPort("clearance").Eval(context).shape == (5,)
    control = controller.GetOutputPort("control").Eval(context)
    assert np.abs(control).max() > 0
    assert control[2] < 0  # back down


def test_a_plan_of_another_model_is_no_plan_for_the_controller() -> None:
    scenario = small(IntegratorChain(2, 2), limits=Limits(input=6.0))
    with pytest.raises(ScenarioError, match="plan: got 3, but it must be a Plan"):
        MakeController(scenario, plan=3)  # type: ignore[arg-type]
