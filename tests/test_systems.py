"""Each system on its own: ports, scalar types, randomness, and what it refuses."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff
from pydrake.common import RandomGenerator
from pydrake.common.value import Value
from pydrake.symbolic import Evaluate, Expression, MakeVectorContinuousVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, System
from pydrake.systems.primitives import (
    ConstantVectorSource,
    FirstOrderTaylorApproximation,
    Linearize,
)

from dtmpc_drake.disturbances import (
    BangBang,
    ColoredWind,
    Constant,
    Disturbance,
    Gust,
    MakeDisturbance,
    Relay,
    SlidingError,
    UniformHold,
    WorstCase,
)
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.method import sliding
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning import hold_plan
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Controller, Scenario, Waypoint
from dtmpc_drake.systems import (
    DtmpcPlanner,
    Plant,
    Plant_,
    SlidingModeTracker,
    SlidingModeTracker_,
    TubeMonitor,
    tube_ratios,
)


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    return Scenario(
        model=DragDoubleIntegrator(0.1, 0.05),
        start=Waypoint(position=[0.0, 1.0, 2.0], velocity=[0.1, 0.5, -0.2]),
        initial_error=Waypoint(position=[0.01, 0.02, -0.02]),
    )


@pytest.fixture(scope="session")
def resting(scenario: Scenario) -> Plan:
    return hold_plan(scenario)


def fixed(system: System, **values: Any) -> Context:
    """A Context with its input ports fixed by name."""
    context = system.CreateDefaultContext()
    for name, value in values.items():
        system.GetInputPort(name).FixValue(context, value)
    return context


# The plant.


def make_plant(drag: float = 0.3) -> Any:
    return Plant(
        model=DragDoubleIntegrator(0.2, 0.2),
        parameters={"drag": drag},
        initial_state=np.array([[1.0, 2.0, 3.0], [0.0, 3.0, 4.0]]),
    )


def test_a_plant_adds_itself_to_a_diagram_with_its_inputs_connected() -> None:
    builder = DiagramBuilder()
    push = {"control": [1.0, -2.0], "disturbance": [0.25, 0.5]}
    ports = {
        name: builder.AddSystem(ConstantVectorSource(value)).get_output_port()
        for name, value in push.items()
    }
    plant = Plant.AddToBuilder(
        builder=builder, model=IntegratorChain(2, 2), initial_state=np.eye(2), **ports
    )
    assert plant.get_name() == "plant"
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    rates = diagram.EvalTimeDerivatives(context).get_vector().CopyToVector()
    np.testing.assert_array_equal(rates, [0.0, 1.0, 1.25, -1.5])
    assert not plant.GetInputPort("model_error").HasValue(
        plant.GetMyContextFromRoot(context)
    )


def test_the_plant_is_its_equation() -> None:
    plant = make_plant()
    u, d = np.array([1.0, 2.0, 3.0]), np.array([0.1, -0.2, 0.3])
    context = fixed(plant, control=u, disturbance=d)
    np.testing.assert_allclose(
        plant.GetOutputPort("state").Eval(context), [1, 2, 3, 0, 3, 4]
    )
    rates = plant.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(rates[:3], [0, 3, 4])
    np.testing.assert_allclose(rates[3:], u + d - 0.3 * 5.0 * np.array([0.0, 3.0, 4.0]))


def test_true_parameters_live_in_the_context() -> None:
    plant = make_plant(drag=0.3)
    force = {"control": np.zeros(3), "disturbance": np.zeros(3)}
    default, changed = fixed(plant, **force), fixed(plant, **force)
    plant.SetParameters(changed, {"drag": 0.0})
    assert plant.EvalTimeDerivatives(changed).CopyToVector()[4] == 0.0
    assert plant.EvalTimeDerivatives(default).CopyToVector()[4] == pytest.approx(-4.5)
    with pytest.raises(KeyError, match="no parameter 'mass'; it has: drag"):
        plant.SetParameters(changed, {"mass": 1.0})
    with pytest.raises(KeyError, match="'mass'"):
        Plant(model=DragDoubleIntegrator(), parameters={"mass": 1.0})


def test_the_state_output_has_no_feedthrough() -> None:
    assert not make_plant().HasAnyDirectFeedthrough()


def test_a_model_error_from_outside_takes_the_place_of_the_true_parameters() -> None:
    u, d, f = np.array([1.0, 2.0, 3.0]), np.array([0.1, -0.2, 0.3]), np.ones(3)
    rates = [
        plant.EvalTimeDerivatives(
            fixed(plant, control=u, disturbance=d, model_error=f)
        ).CopyToVector()[3:]
        for plant in (make_plant(drag=0.3), make_plant(drag=0.0))
    ]
    estimate = 0.2  # the model's
    nominal = -estimate * 5.0 * np.array([0.0, 3.0, 4.0])
    np.testing.assert_allclose(rates[0], nominal + f + u + d)
    np.testing.assert_array_equal(rates[1], rates[0])


@pytest.mark.parametrize("ports", [2, 3])
@pytest.mark.parametrize("T", [AutoDiffXd, Expression])
def test_the_plant_converts_with_its_defaults(T: Any, ports: int) -> None:
    plant = make_plant(drag=0.3)
    other = plant.ToScalarType[T]()
    assert isinstance(other, Plant_[T])
    names = ("control", "disturbance", "model_error")[:ports]
    context = fixed(plant, **{name: np.zeros(3) for name in names})
    converted = fixed(other, **{name: np.array([T(0.0)] * 3) for name in names})
    rates = other.EvalTimeDerivatives(converted).CopyToVector()
    value = [r.value() if T is AutoDiffXd else r.Evaluate() for r in rates]
    np.testing.assert_allclose(value, plant.EvalTimeDerivatives(context).CopyToVector())


def test_the_plant_at_rest_linearises_to_integrators() -> None:
    model = IntegratorChain(2, 3)
    plant = Plant(model=model)
    context = fixed(plant, control=np.zeros(2), disturbance=np.zeros(2))
    linear = Linearize(
        plant,
        context,
        plant.GetInputPort("control").get_index(),
        plant.GetOutputPort("state").get_index(),
    )
    np.testing.assert_allclose(linear.A(), np.eye(6, k=2), atol=1e-12)
    np.testing.assert_allclose(linear.B(), np.eye(6)[:, 4:], atol=1e-12)
    np.testing.assert_allclose(linear.C(), np.eye(6))


def test_the_plant_in_flight_linearises_with_its_drag() -> None:
    plant = make_plant(drag=0.3)
    context = fixed(plant, control=np.zeros(3), disturbance=np.zeros(3))
    affine = FirstOrderTaylorApproximation(
        plant,
        context,
        plant.GetInputPort("control").get_index(),
        plant.GetOutputPort("state").get_index(),
    )
    v = np.array([0.0, 3.0, 4.0])
    expected = -0.3 * (5.0 * np.eye(3) + np.outer(v, v) / 5.0)
    np.testing.assert_allclose(affine.A()[3:, 3:], expected, atol=1e-9)


# The tracker.


def tracked_state(scenario: Scenario) -> Array:
    return scenario.start_state() + scenario.initial_error_state()


def test_the_tracker_is_the_control_law(scenario: Scenario, resting: Plan) -> None:
    tracker = SlidingModeTracker(scenario=scenario)
    state = tracked_state(scenario)
    context = fixed(tracker, state=state.ravel(), plan=Value[object](resting))
    context.SetTime(0.7)
    reference = tracker.GetOutputPort("reference").Eval(context)
    np.testing.assert_array_equal(reference, resting.reference(0.7).ravel())
    layer, layer_rate = resting.layer(0.7)
    expected = scenario.sliding_law().control(
        state=state,
        reference=resting.reference(0.7),
        layer=layer,
        layer_rate=layer_rate,
    )
    np.testing.assert_allclose(tracker.GetOutputPort("control").Eval(context), expected)


def test_the_reference_does_not_wait_for_the_state(scenario: Scenario) -> None:
    tracker = SlidingModeTracker(scenario=scenario)
    state = tracker.GetInputPort("state").get_index()
    reference = tracker.GetOutputPort("reference").get_index()
    assert not tracker.HasDirectFeedthrough(state, reference)


# NumPy takes flags that symbolic arithmetic leaves behind for errors.
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_the_tracker_is_differentiable(scenario: Scenario, resting: Plan) -> None:
    tracker = SlidingModeTracker(scenario=scenario)
    state = tracked_state(scenario).ravel()
    state[3:] /= 2  # inside the layer: its edge, where the plan starts, is a kink
    value = Value[object](resting)

    def control(x: Array) -> Array:
        context = fixed(tracker, state=x, plan=value)
        result: Array = tracker.GetOutputPort("control").Eval(context)
        return result

    other = tracker.ToAutoDiffXd()
    assert isinstance(other, SlidingModeTracker_[AutoDiffXd])
    context = fixed(other, state=InitializeAutoDiff(state).ravel(), plan=value)
    gradient = ExtractGradient(other.GetOutputPort("control").Eval(context))
    steps = 1e-6 * np.eye(6)
    expected = [(control(state + h) - control(state - h)) / 2e-6 for h in steps]
    np.testing.assert_allclose(gradient, np.transpose(expected), atol=1e-5)

    symbolic = tracker.ToSymbolic()
    x = MakeVectorContinuousVariable(6, "x")
    context = fixed(symbolic, state=[Expression(v) for v in x], plan=value)
    formula = symbolic.GetOutputPort("control").Eval(context)
    number = Evaluate(formula, dict(zip(x, state, strict=True)))
    np.testing.assert_allclose(number.ravel(), control(state))


def test_a_port_that_holds_no_plan_says_so(scenario: Scenario) -> None:
    zero = np.zeros(6)
    for system, port in (
        (SlidingModeTracker(scenario=scenario), "control"),
        (SlidingModeTracker(scenario=scenario), "reference"),
        (TubeMonitor(scenario=scenario), "tube_ratios"),
    ):
        context = fixed(system, state=zero, plan=Value[object]({"not": "a plan"}))
        with pytest.raises(TypeError, match=r"plan.* must hold a Plan.*holds a dict"):
            system.GetOutputPort(port).Eval(context)
        with pytest.raises(RuntimeError, match="must be connected to a plan"):
            system.GetOutputPort(port).Eval(fixed(system, state=zero))


# Disturbances.

D = np.array([0.5, 0.2, 0.0])
CHAIN = IntegratorChain(3, 2)


def drawn(config: Disturbance, seed: int, times: Array) -> Array:
    """Samples of a disturbance that needs no inputs, ``(K, m)``."""
    source = MakeDisturbance(config, model=CHAIN, slope=np.full(3, 2.0))
    context = source.CreateDefaultContext()
    source.SetRandomContext(context, RandomGenerator(seed))
    simulator = Simulator(source, context)
    simulator.Initialize()
    port = source.GetOutputPort("disturbance")
    samples = []
    for t in times:
        simulator.AdvanceTo(t)
        samples.append(port.Eval(context))
    return np.array(samples)


RANDOM: dict[str, Disturbance] = {
    "uniform": UniformHold(bound=D.tolist(), hold=0.1),
    "bang_bang": BangBang(bound=D.tolist(), hold=0.1),
    "wind": ColoredWind(bound=D.tolist(), correlation_time=0.2, intensity=3.0),
}


@pytest.mark.parametrize("name", RANDOM)
def test_random_disturbances_keep_their_bound_and_seed(name: str) -> None:
    times = np.arange(0.05, 20.0, 0.1)
    first = drawn(RANDOM[name], 1, times)
    assert (np.abs(first) <= D).all()
    assert (np.abs(first).max(axis=0) > 0.95 * D)[:2].all()
    np.testing.assert_array_equal(first, drawn(RANDOM[name], 1, times))
    assert np.abs(first - drawn(RANDOM[name], 2, times)).max() > 0.1
    # Nothing is left of the seed in the system: the Context holds it all.
    assert abs(np.corrcoef(first[:, 0], first[:, 1])[0, 1]) < 0.4


def test_uniform_and_bang_bang_hold_their_value() -> None:
    times = np.arange(0.005, 5.0, 0.01)
    for name in ("uniform", "bang_bang"):
        samples = drawn(RANDOM[name], 0, times).reshape(-1, 10, 3)
        assert (samples == samples[:, :1]).all()
        held = samples[:, 0, 0]
        if name == "uniform":
            assert len(np.unique(held)) == len(held)
        else:
            assert set(np.unique(held)) == {-0.5, 0.5}


def test_the_wind_has_the_deviation_and_memory_asked_for() -> None:
    wind = ColoredWind(bound=[1.0] * 3, correlation_time=0.2, intensity=0.2)
    samples = drawn(wind, 0, np.arange(1.0, 101.0, 0.1))
    assert samples.std() == pytest.approx(0.2, rel=0.1)
    assert abs(samples.mean()) < 0.02
    pairs = np.concatenate([samples[:-1], samples[1:]], axis=1)
    correlation = [np.corrcoef(pairs[:, i], pairs[:, i + 3])[0, 1] for i in range(3)]
    assert np.mean(correlation) == pytest.approx(np.exp(-0.1 / 0.2), abs=0.1)


def test_a_constant_disturbance_is_its_fraction() -> None:
    samples = drawn(Constant(bound=D.tolist(), fraction=-0.5), 0, np.array([0.1, 1.0]))
    np.testing.assert_array_equal(samples, [-D / 2, -D / 2])


def test_the_worst_case_pushes_along_the_sliding_variable() -> None:
    slope = np.full(3, 2.0)
    worst = WorstCase(bound=D.tolist())
    source = MakeDisturbance(worst, model=CHAIN, slope=slope)
    error = np.array([[0.1, -0.1, 0.1], [-0.3, 0.1, 0.0]])  # s = -0.1, -0.1, 0.2
    reference = np.arange(9.0)
    context = fixed(source, state=error.ravel() + reference[:6], reference=reference)
    push = source.GetOutputPort("disturbance").Eval(context)
    np.testing.assert_array_equal(push, [-0.5, -0.2, 0.0])
    # It does not wait for an error.
    context = fixed(source, state=reference[:6], reference=reference)
    sides = set()
    for seed in range(40):
        source.SetRandomContext(context, RandomGenerator(seed))
        push = source.GetOutputPort("disturbance").Eval(context)
        np.testing.assert_array_equal(np.abs(push), D)
        sides.add(tuple(np.sign(push[:2])))
    assert len(sides) == 4  # the seed decides to which side


def test_a_worst_case_may_have_the_model_error_on_its_side() -> None:
    model = DragDoubleIntegrator(0.1, 0.2)
    worst = WorstCase(bound=D.tolist(), model_error=True)
    source = MakeDisturbance(worst, model=model, slope=np.full(3, 2.0))
    reference = np.arange(9.0)
    error = np.array([0.1, -0.1, 0.1, -0.3, 0.1, 0.0])  # s = -0.1, -0.1, 0.2
    state = reference[:6] + error
    context = fixed(source, state=state, reference=reference)
    push = source.GetOutputPort("disturbance").Eval(context)
    np.testing.assert_array_equal(push, [-0.5, -0.2, 0.0])
    bound = model.model_error_bound(state.reshape(2, 3))
    model_error = source.GetOutputPort("model_error").Eval(context)
    np.testing.assert_array_equal(model_error, (bound * [-1, -1, 1]).ravel())


def both_drawn(config: Disturbance, seed: int, times: Array) -> tuple[Array, Array]:
    """Samples of d / D and f̃ / Δ of a plant that rests, ``(K, m)`` each."""
    model = IntegratorChain(2, 2, 0.25)
    source = MakeDisturbance(config, model=model, slope=np.full(2, 2.0))
    context = fixed(source, state=np.zeros(4))
    source.SetRandomContext(context, RandomGenerator(seed))
    simulator = Simulator(source, context)
    simulator.Initialize()
    samples: list[list[Array]] = []
    for t in times:
        simulator.AdvanceTo(t)
        names = ("disturbance", "model_error")
        samples.append([source.GetOutputPort(n).Eval(context) for n in names])
    d, f = np.moveaxis(np.array(samples), 1, 0)
    return d / config.bound, f / 0.25


def test_a_worst_case_with_a_hold_goes_from_end_to_end_at_random_times() -> None:
    times = np.arange(0.005, 400.0, 0.01)
    worst = WorstCase(bound=[0.5, 0.2], hold=1.0, model_error=True)
    d, f = both_drawn(worst, 1, times)
    for push in (d, f):
        assert set(np.unique(push)) == {-1.0, 1.0}
    reversed_ = np.diff(d, axis=0) != 0
    np.testing.assert_allclose(reversed_.sum(axis=0), 400, rtol=0.2)  # one a second
    assert (reversed_[:, 0] & reversed_[:, 1]).sum() < 40  # each on its own
    # The model error changes in the same instants, mostly to the same side.
    assert (f[0] == d[0]).all()
    assert not ((np.diff(f, axis=0) != 0) & ~reversed_ & (d == f)[:-1]).any()
    assert (f == d).mean() == pytest.approx(0.75, abs=0.08)
    # The seed decides it all, and a side is held long enough for an integrator.
    again, other = both_drawn(worst, 1, times[:500]), both_drawn(worst, 2, times[:500])
    np.testing.assert_array_equal(again[0], d[:500])
    assert (other[0] != d[:500]).any()
    switches = np.flatnonzero(reversed_[:, 0])
    assert np.diff(switches).min() >= 4  # 0.04 s


def test_without_a_reversal_both_push_to_one_side_for_ever() -> None:
    worst = WorstCase(bound=[0.5, 0.2], hold=1e6, model_error=True)
    sides = set()
    for seed in range(40):
        d, f = both_drawn(worst, seed, np.arange(0.005, 3.0, 0.1))
        assert (d == d[0]).all() and (f == d).all()
        sides.add(tuple(d[0]))
    assert len(sides) == 4


def test_a_gust_has_one_direction_for_long() -> None:
    gust = Gust(bound=[0.5, 0.2], hold=2.0, model_error=True)
    d, f = both_drawn(gust, 0, np.arange(0.01, 1000.0, 0.04))
    np.testing.assert_allclose(f, d, rtol=1e-12)
    changes = np.flatnonzero((np.diff(d, axis=0) != 0).any(axis=1))
    assert np.diff(changes).min() == 50  # 2 s
    assert not (np.diff(changes) % 50).any()  # or more, if the same corner comes again
    assert 0 < changes[0] < 50  # the first one has begun before
    np.testing.assert_allclose(np.abs(d).max(axis=1), 1.0, rtol=1e-12)
    held = d[changes]
    corner = (np.abs(np.abs(held) - 1.0) < 1e-12).all(axis=1)
    assert corner.mean() == pytest.approx(0.5, abs=0.1)
    assert len(np.unique(held[corner].round(), axis=0)) == 4
    angle = np.arctan2(held[~corner, 1], held[~corner, 0])
    counts, _ = np.histogram(angle, bins=8, range=(-np.pi, np.pi))
    assert counts.min() > 15  # of 250


def test_a_gust_along_one_output_has_two_sides() -> None:
    source = MakeDisturbance(
        Gust(bound=[0.3]), model=IntegratorChain(1, 2), slope=np.ones(1)
    )
    sides = set()
    for seed in range(20):
        context = source.CreateDefaultContext()
        source.SetRandomContext(context, RandomGenerator(seed))
        sides.add(float(source.GetOutputPort("disturbance").Eval(context)[0]))
    assert sides == {-0.3, 0.3}
    assert not source.HasOutputPort("model_error")


@dataclasses.dataclass
class Squall(WorstCase):
    """A disturbance of a user's own."""


@pytest.mark.parametrize("config", [Squall(), object()])
def test_a_disturbance_that_is_not_known_is_refused_by_name(config: Any) -> None:
    name = type(config).__name__
    with pytest.raises(ScenarioError, match=f"^disturbance: got '{name}'.* one of Uni"):
        MakeDisturbance(config, model=CHAIN, slope=np.full(3, 2.0))


def test_small_parts_have_their_ports() -> None:
    relay = Relay(force=np.array([1.0, 2.0]))
    context = fixed(relay, u=[-1e-9, 0.0])
    np.testing.assert_array_equal(relay.GetOutputPort("y").Eval(context), [-1.0, 2.0])
    surface = SlidingError(slope=np.array([3.0]), chains=Chains((3,)))
    context = fixed(surface, state=[1.0, 1.0, 1.0], reference=np.zeros(4))
    assert surface.GetOutputPort("s").Eval(context) == pytest.approx(9 + 6 + 1)


# The monitor.


def test_the_monitor_measures_shares_of_the_tube(
    scenario: Scenario, resting: Plan
) -> None:
    monitor = TubeMonitor(scenario=scenario)
    time = 1.3
    layer = resting.boundary_layer(time)
    bound = resting.error_bound(time)
    error = np.stack([0.5 * bound[0], -0.25 * bound[1]])
    state = resting.reference(time)[:2] + error
    context = fixed(monitor, state=state.ravel(), plan=Value[object](resting))
    context.SetTime(time)
    ratios = monitor.GetOutputPort("tube_ratios").Eval(context).reshape(3, 3)
    s = np.abs(error[1] + 2.0 * error[0])
    np.testing.assert_allclose(ratios[0], s / layer, rtol=1e-4)
    np.testing.assert_allclose(ratios[1], 0.5, rtol=1e-4)
    np.testing.assert_allclose(ratios[2], 0.25, rtol=1e-4)
    np.testing.assert_array_equal(
        ratios,
        tube_ratios(plan=resting, time=time, state=state, slope=scenario.slope()),
    )
    assert monitor.GetOutputPort("clearance").Eval(context) == [np.inf]


def test_no_error_in_no_tube_counts_as_nothing() -> None:
    """At the start all bounds but the layer are zero."""
    chain = Scenario(
        model=IntegratorChain(1, 1),
        disturbance=WorstCase(bound=[0.1]),
        controller=Controller(slope=[2.0]),
        start=Waypoint(position=[1.0]),
        goal=Waypoint(position=[2.0]),
    )
    ratios = tube_ratios(
        plan=hold_plan(chain), time=0.0, state=np.ones((1, 1)), slope=chain.slope()
    )
    np.testing.assert_array_equal(ratios, np.zeros((3, 1)))


# The planner.


def test_the_plan_that_holds_is_a_true_tube(scenario: Scenario, resting: Plan) -> None:
    times = np.linspace(0.0, scenario.duration, 50)
    reference = resting.reference(times)
    np.testing.assert_array_equal(reference[:, 0], np.tile([0.0, 1.0, 2.0], (50, 1)))
    assert np.abs(reference[:, 1:]).max() == 0.0
    error = tracked_state(scenario) - reference[0, :2]
    s = np.abs(sliding.sliding_variable(error, scenario.slope()))
    assert (s <= resting.boundary_layer(0.0) + 1e-12).all()
    assert (np.abs(error) <= resting.error_bound(0.0) + 1e-12).all()


def test_the_planner_uses_the_plan_it_is_given(
    scenario: Scenario, resting: Plan
) -> None:
    planner = DtmpcPlanner(scenario=scenario, plan=resting)
    simulator = Simulator(planner)
    simulator.Initialize()
    context = simulator.get_context()
    held = planner.GetOutputPort("plan").Eval(context)
    np.testing.assert_array_equal(held.layer_coefficients, resting.layer_coefficients)
    assert planner.GetOutputPort("status").Eval(context) == "given"


def test_the_planner_plans_in_its_initialization_event(scenario: Scenario) -> None:
    planner = DtmpcPlanner(scenario=scenario)
    assert not planner.HasAnyDirectFeedthrough()
    simulator = Simulator(planner)
    context = simulator.get_context()
    assert planner.GetOutputPort("status").Eval(context) == "not planned yet"
    assert np.ptp(planner.GetOutputPort("plan").Eval(context).knots) == 10.0
    simulator.Initialize()
    assert planner.GetOutputPort("status").Eval(context) == "certified"
    certified = planner.GetOutputPort("plan").Eval(context)
    np.testing.assert_allclose(
        certified.reference(10.0)[0], scenario.goal.position, atol=1e-6
    )
