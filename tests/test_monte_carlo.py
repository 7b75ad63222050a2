"""Many trials: each as it would fly alone, whoever flies it, and none unsafe."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    FirstOrderTaylorApproximation,
    LogVectorOutput,
    RandomSource,
)
from typer.testing import CliRunner

from dtmpc_drake.__main__ import app
from dtmpc_drake.diagrams import (
    FlyTrials,
    MakeSideBySide,
    Simulate,
    SimulateTrials,
    draw_trials,
)
from dtmpc_drake.diagrams.trials import SPREAD
from dtmpc_drake.disturbances import (
    DISTURBANCES,
    Constant,
    Disturbance,
    SeedTrials,
    TrialNoise,
    UniformHold,
    WorstCase,
)
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.experiments.monte_carlo import (
    OUTPUTS,
    Batch,
    choose_disturbances,
    fly,
    fly_all,
)
from dtmpc_drake.experiments.spread import batches, spread
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.method.tube import TubeStart
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import hold_plan, plan
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.flights import Flights
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import (
    Controller,
    Limits,
    Planner,
    Scenario,
    Waypoint,
    load_scenario,
    to_yaml,
    validate,
)
from dtmpc_drake.systems import Plant, SlidingModeTracker
from dtmpc_drake.visualization import plot_plan, plot_quantiles
from tests.models_for_tests import PlanarOnSlope, ThirdOrderPlanar

KINDS = {
    kind.short_name: kind.hard
    for kind in DISTURBANCES
    if kind.short_name and kind.__module__.startswith("dtmpc_drake.")
}


def short(model: Any = None, **fields: Any) -> Scenario:
    """Four seconds past one obstacle, with a drag that is not known."""
    model = model or DragDoubleIntegrator(0.1, 0.1)
    m = model.num_outputs
    settings: dict[str, Any] = {
        "disturbance": UniformHold(bound=[0.3] * m),
        "controller": Controller(slope=[2.0] * m, initial_boundary_layer=0.2),
        "start": Waypoint(position=[0.0] * m),
        "goal": Waypoint(position=[0.0, 3.0, 0.0][:m]),
        "duration": 4.0,
        "obstacles": [Cylinder([0.55, 1.5], 0.4)],
        "planner": Planner(intervals=16),
    }
    scenario = Scenario(name="short", model=model, **(settings | fields))
    validate(scenario)
    return scenario


def through(scenario: Scenario, name: str) -> Scenario:
    disturbance = choose_disturbances(scenario, name)[name]
    return dataclasses.replace(scenario, disturbance=disturbance)


def planned(scenario: Scenario) -> Plan:
    result = plan(scenario)
    assert result.certified, result
    assert result.plan is not None
    return result.plan


@pytest.fixture(scope="module")
def flown() -> tuple[Scenario, Plan]:
    scenario = short()
    return scenario, planned(scenario)


def assert_same_log(one: Flight, other: Flight) -> None:
    for field in dataclasses.fields(Flight):
        a, b = getattr(one, field.name), getattr(other, field.name)
        np.testing.assert_array_equal(a, b, err_msg=field.name, strict=True)


def assert_same_flights(one: Flights, other: Flights) -> None:
    left, right = one.arrays(), other.arrays()
    assert left.keys() == right.keys()
    for name, array in left.items():
        np.testing.assert_array_equal(array, right[name], err_msg=name, strict=True)


# Drawing.


def test_a_trial_is_named_by_its_number_and_the_seed() -> None:
    scenario = short()
    all_at_once = draw_trials(scenario, range(50))
    assert draw_trials(scenario, [17]) == [all_at_once[17]]
    assert draw_trials(scenario, range(40, 50)) == all_at_once[40:]
    assert len({trial.seed for trial in all_at_once}) == 50
    scenario.simulation.seed = 1
    assert draw_trials(scenario, [17])[0].seed != all_at_once[17].seed


def test_true_parameters_are_spread_over_all_that_the_model_allows() -> None:
    scenario = short(plant={"drag": 0.05})  # which does not matter
    low, high = scenario.model.parameter_interval("drag")
    drag = [trial.parameters["drag"] for trial in draw_trials(scenario, range(200))]
    assert (drag[0], drag[1]) == (low, high)
    assert min(drag) == low and max(drag) == high
    counts, _ = np.histogram(drag, bins=4, range=(low, high))
    assert counts.min() > 30
    for trial in draw_trials(scenario, range(3)):
        validate(trial.scenario(scenario))


def test_the_initial_error_is_anywhere_within_that_of_the_scenario() -> None:
    scenario = short(
        initial_error=Waypoint([0.05, 0.0, -0.02], [-0.2, 0.1, 0.1]),
    )
    declared = scenario.initial_error_state()
    trials = draw_trials(scenario, range(300))
    own = [trial.scenario(scenario) for trial in trials]
    for one in own:
        validate(one)
    errors = np.array([one.initial_error_state() for one in own])
    np.testing.assert_array_equal(errors[0], declared)
    np.testing.assert_array_equal(errors[1], -declared)
    assert (np.abs(errors) <= np.abs(declared)).all()
    # Also with other signs, to the layer's edge, but not out of the layer.
    s = np.abs(sliding_variable(errors, scenario.slope()))
    assert 0.199 < s[:, 0].max() <= scenario.controller.initial_boundary_layer
    assert (errors.max(axis=0) > 0.9 * np.abs(declared)).all(where=declared != 0)
    for trial in draw_trials(short(), range(3)):
        assert trial.initial_error is None


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_a_tube_opens_for_every_error_of_that_size(order: int) -> None:
    generator = np.random.default_rng(order)
    for _ in range(100):
        size = generator.exponential(size=(order, 2))
        slope = generator.exponential(size=2)
        layer = np.full(2, 0.3)
        opened = TubeStart.of_error(size, layer, slope)
        for _ in range(20):
            error = size * generator.choice([-1, 1, generator.uniform()], size.shape)
            own = TubeStart.of_error(error, layer, slope)
            assert (own.stages <= opened.stages * (1 + 1e-12)).all()
            assert (own.highest <= opened.highest).all()


def test_a_worst_case_that_reverses_does_so_at_another_pace_in_every_trial() -> None:
    scenario = short(disturbance=WorstCase(bound=[0.3] * 3, hold=2.0))
    trials = draw_trials(scenario, range(100))
    holds = [trial.scenario(scenario).disturbance.hold for trial in trials]
    assert min(holds[:2]) > 1e3 * scenario.duration  # the first two never reverse
    assert 2.0 / SPREAD < min(holds[2:]) < 0.6 and 7.0 < max(holds[2:]) < 2.0 * SPREAD
    follows = short(disturbance=WorstCase(bound=[0.3] * 3))
    assert trials[5].scenario(follows).disturbance == follows.disturbance


def test_the_hard_disturbances_have_the_bound_of_the_scenario() -> None:
    scenario = short(disturbance=UniformHold(bound=[0.1, 0.2, 0.3], hold=0.07))
    chosen = choose_disturbances(scenario, "all")
    assert list(chosen) == list(KINDS)
    assert all(d.bound == [0.1, 0.2, 0.3] for d in chosen.values())
    assert chosen["uniform"] == scenario.disturbance  # its own hold, too
    scenario.disturbance = WorstCase(bound=[0.1] * 3, hold=0.7)
    assert choose_disturbances(scenario, "worst_case")["worst_case"].hold == 0.7
    scenario.disturbance = WorstCase(bound=[0.1] * 3)
    reversing = choose_disturbances(scenario, "worst_case")["worst_case"]
    assert reversing == KINDS["worst_case"]([0.1] * 3) != scenario.disturbance
    own = dataclasses.replace(scenario, disturbance=Constant(bound=[0.1] * 3))
    assert choose_disturbances(own, "scenario") == {"scenario": own.disturbance}
    with pytest.raises(ScenarioError, match="got 'storm', but it must be one of"):
        choose_disturbances(scenario, "storm")


@pytest.mark.parametrize("name", ["kUniform", "kGaussian"])
def test_noise_of_many_trials_is_that_of_single_sources(name: str) -> None:
    distribution = getattr(RandomDistribution, name)
    seeds, hold = [0, 7, 2**32 - 1], 0.1

    def samples(system: Any, context: Any) -> list[Any]:
        simulator = Simulator(system, context)
        simulator.Initialize()
        seen = []
        for t in np.arange(0.05, 1.4, 0.1):
            simulator.AdvanceTo(t)
            seen.append(system.get_output_port().Eval(context).copy())
        return seen

    noise = TrialNoise(
        distribution=distribution, num_outputs=2, hold=hold, trials=3, duration=1.0
    )
    context = noise.CreateDefaultContext()
    noise.SetSeeds(context, seeds)
    many = np.reshape(samples(noise, context), (-1, 3, 2))
    for i, seed in enumerate(seeds):
        single = RandomSource(distribution, 2, hold)
        context = single.CreateDefaultContext()
        single.SetRandomContext(context, RandomGenerator(seed))
        expected = np.array(samples(single, context))
        np.testing.assert_array_equal(many[:11, i], expected[:11])
    np.testing.assert_array_equal(many[-1], many[-2])  # beyond the horizon


# Flying.

MODELS: dict[str, Callable[[], Scenario]] = {
    "drag": short,
    "third_order": lambda: short(ThirdOrderPlanar(), limits=Limits(input=15.0)),
    "coupled_inputs": lambda: short(PlanarOnSlope(), limits=Limits(input=8.0)),
}


OTHERS: dict[str, Callable[[list[float]], Disturbance]] = {
    "along_the_error": lambda bound: WorstCase(bound=bound),
    "model_error_too": lambda bound: WorstCase(bound=bound, model_error=True),
    "true_parameters": lambda bound: WorstCase(bound=bound, hold=0.5),
}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("disturbance", [*KINDS, *OTHERS])
def test_a_trial_flies_in_any_batch_as_it_flies_alone(
    model: str, disturbance: str
) -> None:
    scenario = MODELS[model]()
    make = (KINDS | OTHERS)[disturbance]
    scenario.disturbance = make(scenario.disturbance.bound)
    size = 0.02 * np.ones(scenario.model.num_outputs)
    scenario.initial_error = Waypoint(size.tolist(), (-3 * size).tolist())
    resting = hold_plan(scenario)
    scenario.duration = 1.5
    trials = draw_trials(scenario, range(37))
    batch = SimulateTrials(scenario, plan=resting, trials=trials)
    other = SimulateTrials(scenario, plan=resting, trials=trials[30:35])
    for i in (0, 1, 31):
        alone = Simulate(trials[i].scenario(scenario), plan=resting)
        assert_same_log(batch.trial(i), alone)
    assert_same_log(batch.trial(31), other.trial(1))
    # Each starts elsewhere, and has noise of its own.
    assert len(np.unique(batch.state[0], axis=0)) == 37
    assert np.ptp(batch.disturbance, axis=1).max() > 0.2


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("count", [1, 4])
def test_the_log_of_many_trials_has_the_extremes_of_each(
    order: int, count: int
) -> None:
    scenario = short(IntegratorChain(2, order, 0.1))
    trials = draw_trials(scenario, range(count))
    log = SimulateTrials(scenario, plan=hold_plan(scenario), trials=trials)
    each = [log.trial(i).extremes() for i in range(count)]
    for name, value in log.extremes().items():
        pick = min if name == "smallest_clearance" else max
        assert value == pick(seen[name] for seen in each), name


@pytest.mark.parametrize("disturbance", ["worst_case", "gust"])
@pytest.mark.parametrize("model", MODELS)
def test_the_model_error_follows_the_state_within_its_bound(
    model: str, disturbance: str
) -> None:
    scenario = through(MODELS[model](), disturbance)
    chosen = planned(scenario)
    trials = draw_trials(scenario, range(20))
    loop = MakeSideBySide(scenario, plan=chosen, trials=trials)
    builder = DiagramBuilder()
    builder.AddSystem(loop)
    sinks = {
        name: LogVectorOutput(loop.GetOutputPort(name), builder, 0.01)
        for name in ("state", "model_error")
    }
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeds = [trial.seed for trial in trials]
    SeedTrials(loop.GetSubsystemByName("disturbance"), context, seeds)
    simulator.AdvanceTo(scenario.duration)
    n, m = scenario.model.order, scenario.model.num_outputs
    state, error = (sinks[name].FindLog(context).data().T for name in sinks)
    bound = scenario.model.model_error_bound(state.reshape(-1, 20, n, m))
    share = error.reshape(-1, 20, m) / np.maximum(bound, 1e-300)
    assert np.abs(share).max() <= 1
    assert np.ptp(bound, axis=0).max() > 0.03  # the bound does follow the state
    if disturbance == "worst_case":
        assert set(np.unique(share)) == {-1.0, 1.0}


def test_trials_do_not_see_each_other() -> None:
    """Plant and tracker keep their scalar types, and their blocks apart."""
    scenario = short()
    size = 2 * 6
    plant = Plant(model=scenario.model, parameters={"drag": [0.0, 0.2]}, trials=2)
    context = plant.CreateDefaultContext()
    state = np.tile([0.0, 0.0, 0.0, 0.1, 1.0, 0.3], 2)
    context.SetContinuousState(state)
    for name in ("control", "disturbance"):
        plant.GetInputPort(name).FixValue(context, np.zeros(6))
    index = plant.GetInputPort("control").get_index()
    A = FirstOrderTaylorApproximation(
        plant, context, index, plant.GetOutputPort("state").get_index()
    ).A()
    assert not A[:6, 6:].any() and not A[6:, :6].any()
    assert A[4, 4] == 0.0 and A[10, 10] < -0.2  # each has its own drag

    tracker = SlidingModeTracker(scenario=scenario, trials=2).ToAutoDiffXd()
    context = tracker.CreateDefaultContext()
    inputs = {"state": InitializeAutoDiff(state).ravel()}
    inputs["plan"] = Value[object](hold_plan(scenario))
    for name, value in inputs.items():
        tracker.GetInputPort(name).FixValue(context, value)
    gradient = ExtractGradient(tracker.GetOutputPort("control").Eval(context))
    assert gradient.shape == (6, size)
    assert not gradient[:3, 6:].any() and not gradient[3:, :6].any()
    np.testing.assert_array_equal(gradient[:3, :6], gradient[3:, 6:])
    assert gradient[:3, :6].any()


def test_trials_fly_one_plan(flown: tuple[Scenario, Plan]) -> None:
    again = load_scenario("receding_horizon")
    with pytest.raises(ScenarioError, match="many trials fly one plan"):
        MakeSideBySide(again, plan=flown[1], trials=draw_trials(again, range(2)))


@pytest.mark.parametrize("disturbance", KINDS)
def test_no_trial_leaves_its_tube(
    flown: tuple[Scenario, Plan], disturbance: str
) -> None:
    scenario, chosen = flown
    flights = fly(Batch("", through(scenario, disturbance), chosen, range(150)))
    assert set(flights.violations.values()) == {0}
    assert flights.outside == 0
    assert flights.collisions == 0
    assert flights.safe
    drag = flights.parameters["drag"]
    assert (drag.min(), drag.max()) == scenario.model.parameter_interval("drag")
    assert flights.distinct > 140  # a corner may come again
    if disturbance not in ("uniform", "wind"):  # the tube is not merely large
        assert flights.worst_ratios[:, 1].max() > 0.7


@pytest.mark.parametrize("disturbance", KINDS)
@pytest.mark.parametrize("model", MODELS)
def test_no_trial_that_starts_with_an_error_leaves_its_tube(
    model: str, disturbance: str
) -> None:
    """Not even one whose signs are none of the scenario's."""
    scenario = MODELS[model]()
    size = np.array([0.02, 0.02, 0.01])[: scenario.model.num_outputs]
    scenario.initial_error = Waypoint(size.tolist(), (-3 * size).tolist())
    scenario = through(scenario, disturbance)
    flights = fly(Batch("", scenario, planned(scenario), range(60)))
    assert flights.safe, flights
    assert flights.distinct == 60


def test_flights_that_are_the_same_to_the_last_bit_count_once() -> None:
    """With a known drag and no error, all that is left is the side of each output."""
    scenario = short(DragDoubleIntegrator(0.1, 0.0))
    chosen = planned(scenario)
    plain = dataclasses.replace(scenario, disturbance=WorstCase(bound=[0.3] * 3))
    same = fly(Batch("", plain, chosen, range(60)))
    assert same.distinct == same.summary()["distinct"] == 2**3
    assert "60 trials, 8 distinct" in repr(same)
    varied = fly(Batch("", through(scenario, "worst_case"), chosen, range(60)))
    assert varied.distinct == varied.summary()["distinct"] == 60
    # The worst that is known is among them.
    np.testing.assert_allclose(
        varied.worst_ratios.max(axis=0), same.worst_ratios.max(axis=0), atol=1e-3
    )
    # As in two batches.
    halves = [
        fly(Batch("", plain, chosen, numbers)) for numbers in (range(30), range(30, 60))
    ]
    assert Flights.concatenate(halves).distinct == 8


def test_a_model_error_that_follows_the_state_uses_more_of_the_layer() -> None:
    """It is as large as the bound allows wherever it pushes along the disturbance."""
    scenario = load_scenario("unknown_drag")
    chosen = planned(scenario)
    plain = dataclasses.replace(scenario, disturbance=WorstCase(bound=[0.5] * 3))
    flights = {
        name: fly(Batch(name, one, chosen, range(60)))
        for name, one in (
            ("true_parameters", plain),
            ("worst_case", through(scenario, "worst_case")),
            ("gust", through(scenario, "gust")),
        )
    }
    assert all(f.safe for f in flights.values()), flights
    layer = {name: f.worst_ratios[:, 0] for name, f in flights.items()}
    for name in ("worst_case", "gust"):
        assert layer[name].max() > 0.902 > layer["true_parameters"].max()
        assert np.median(layer[name]) > np.median(layer["true_parameters"]) + 0.02


def test_a_gust_pushes_all_axes_together(flown: tuple[Scenario, Plan]) -> None:
    """One number for all axes, as an ellipsoidal tube would have it."""
    scenario, chosen = flown

    def used(disturbance: str) -> Any:
        pushed = through(scenario, disturbance)
        trials = draw_trials(pushed, range(100))
        ratios = SimulateTrials(pushed, plan=chosen, trials=trials).tube_ratios
        return np.median(np.sqrt((ratios[:, :, 1] ** 2).mean(axis=-1)).max(axis=0))

    others = {name: used(name) for name in KINDS if name != "gust"}
    assert used("gust") > max(others.values()) + 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["known_environment", "unknown_drag", "state_dependent_uncertainty"]
)
def test_no_trial_of_the_shipped_experiments_is_unsafe(name: str) -> None:
    scenario = load_scenario(name)
    chosen = planned(scenario)
    flights = fly_all(
        {d: (through(scenario, d), chosen) for d in KINDS}, trials=500, batch_size=250
    )
    assert all(f.safe for f in flights.values()), flights


def test_a_violation_is_counted(flown: tuple[Scenario, Plan]) -> None:
    """The last trial has more drag than the model allows for."""
    scenario, chosen = flown
    allowed = draw_trials(scenario, range(2))
    excess = dataclasses.replace(allowed[0], parameters={"drag": 20.0})
    trials = [*allowed, excess]
    flights = FlyTrials(scenario, plan=chosen, trials=trials)
    assert flights.violations["layer"] == flights.violations["position"] == 1
    assert flights.outside == 1
    assert not flights.safe
    assert flights.summary()["worst_position_trial"] == excess.index


def test_a_collision_is_counted(flown: tuple[Scenario, Plan]) -> None:
    """Every trial flies through what the plan did not know of."""
    scenario, chosen = flown
    wall = dataclasses.replace(scenario, obstacles=[Cylinder([0.0, 2.0], 0.4)])
    flights = fly(Batch("", wall, chosen, range(3)))
    assert not any(flights.violations.values())
    assert flights.collisions == 3
    assert not flights.safe


def test_what_is_kept_of_a_flight_is_what_the_log_says(
    flown: tuple[Scenario, Plan],
) -> None:
    scenario, chosen = flown
    scenario = through(scenario, "bang_bang")
    flights = fly(Batch("", scenario, chosen, range(5)))
    trial = draw_trials(scenario, [3])[0]
    log = Simulate(trial.scenario(scenario), plan=chosen)
    worst = log.tube_ratios.max(axis=(0, 2))
    np.testing.assert_array_equal(flights.worst_ratios[3], worst)
    assert flights.smallest_clearance[3] == log.clearance.min()
    squares = (log.control**2).sum(axis=1)
    assert flights.effort[3] == pytest.approx(np.trapezoid(squares, log.time))
    np.testing.assert_allclose(np.diff(flights.time), 0.05)
    assert flights.time[-1] == log.time[-1]
    np.testing.assert_array_equal(flights.position[3], log.position[::5])
    # Nothing between two samples is lost.
    assert flights.position_ratio[3].max() == worst[1]
    summary = flights.summary()
    assert (
        summary["largest_position_ratio"]["largest"]
        == summary["worst_ratios"]["position"]
    )
    assert flights.quantiles()[-1].max() == summary["worst_ratios"]["position"]


# Spreading.


def test_batches_cover_all_trials_once() -> None:
    assert batches(7, 3) == [range(0, 3), range(3, 6), range(6, 7)]
    for count, size in ((0, 3), (-1, 3), (3, 0)):
        with pytest.raises(ScenarioError, match="at least 1"):
            batches(count, size)


def test_local_workers_give_the_same_to_the_last_bit(
    flown: tuple[Scenario, Plan],
) -> None:
    scenario, chosen = flown
    work = {d: (through(scenario, d), chosen) for d in ("uniform", "bang_bang")}
    ended = []
    spread_out = fly_all(work, trials=9, batch_size=4, done=ended.append)
    assert sum(len(batch.numbers) for batch in ended) == 18
    for name, (its_scenario, its_plan) in work.items():
        here = fly(Batch(name, its_scenario, its_plan, range(9)))
        assert_same_flights(spread_out[name], here)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, dict[str, subprocess.Popen[bytes]]]]:
    """A real scheduler and two workers, each a process of its own."""
    root = str(Path(__file__).parents[1])
    path = os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])
    env = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    file = tmp_path / "scheduler.json"
    shared = ("--scheduler-file", str(file), "--no-dashboard")

    def start(module: str, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", *arguments, *shared],
            env=env,
            cwd=tmp_path,
            stderr=subprocess.DEVNULL,
        )

    processes = {
        "scheduler": start("dask_scheduler", "--host", "127.0.0.1", "--port", "0")
    }
    try:
        deadline = time.monotonic() + 60
        while not file.exists():
            assert time.monotonic() < deadline and processes["scheduler"].poll() is None
            time.sleep(0.05)
        for name in ("first", "second"):
            processes[name] = start(
                "dask_worker", "--nthreads", "1", "--no-nanny", "--name", name
            )
        yield json.loads(file.read_text())["address"], processes
    finally:
        for process in processes.values():
            process.kill()
            process.wait()


def test_a_worker_killed_in_the_middle_loses_nothing(
    flown: tuple[Scenario, Plan],
    cluster: tuple[str, dict[str, subprocess.Popen[bytes]]],
) -> None:
    from distributed import Client

    scenario, chosen = flown
    address, processes = cluster
    work = {"bang_bang": (through(scenario, "bang_bang"), chosen)}
    killed = []

    def kill_one_at_work(batch: Batch) -> None:
        if killed:
            return
        with Client(address) as client:
            workers = client.scheduler_info()["workers"]
            for worker, tasks in client.processing().items():
                if tasks:
                    killed.append(workers[worker]["id"])
                    processes[killed[0]].send_signal(signal.SIGKILL)
                    return

    far = fly_all(
        work, trials=30, batch_size=3, scheduler=address, done=kill_one_at_work
    )
    assert killed and processes[killed[0]].wait(10) == -signal.SIGKILL
    here = fly(Batch("bang_bang", *work["bang_bang"], range(30)))
    assert_same_flights(far["bang_bang"], here)


@pytest.mark.parametrize("address", ["nonsense", "foo://127.0.0.1:1"])
def test_a_bad_address_is_named(address: str) -> None:
    with pytest.raises(ScenarioError, match="a Dask scheduler that answers"):
        spread(abs, [1, 2], scheduler=address)


def test_a_scheduler_without_workers_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr("dtmpc_drake.experiments.spread.PATIENCE", 0.5)
    with (
        LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0") as empty,
        pytest.raises(ScenarioError, match="a scheduler with workers: none came"),
    ):
        spread(abs, [1, 2], scheduler=empty.scheduler_address)


def what_is_heard(item: int) -> int:
    """The least level that a worker writes to its terminal."""
    return min(each.level for each in logging.getLogger("distributed").handlers)


def test_workers_of_this_machine_do_not_talk_while_they_close() -> None:
    assert spread(what_is_heard, [1, 2]) == [logging.CRITICAL] * 2


# The command line.


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["monte-carlo", *map(str, arguments)])


@pytest.fixture
def file(tmp_path: Path, flown: tuple[Scenario, Plan]) -> Path:
    path = tmp_path / "short.yaml"
    path.write_text(to_yaml(flown[0]), encoding="utf-8")
    return path


def test_the_command_writes_all_its_files(
    tmp_path: Path, file: Path, flown: tuple[Scenario, Plan]
) -> None:
    out = tmp_path / "here"
    options = ["--trials", 5, "--disturbance", "bang_bang", "--seed", 3, "--out", out]
    result = invoke(file, *options)
    assert result.exit_code == 0, result.output
    assert {path.name for path in out.iterdir()} == set(OUTPUTS)
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["certified"] and summary["seed"] == 3
    seen = summary["flights"]["bang_bang"]
    assert seen["trials"] == 5 and seen["collisions"] == 0
    assert set(seen["violations"].values()) == {0}
    with np.load(out / "monte_carlo.npz") as data:
        assert data["bang_bang_position"].shape == (5, 81, 3)
        index, seed, drag = (
            data[f"bang_bang_{name}"] for name in ("index", "seed", "parameter_drag")
        )
        effort = data["bang_bang_effort"]
    # The file names each trial well enough to repeat it alone.
    scenario = through(flown[0], "bang_bang")
    scenario.plant = {"drag": float(drag[4])}
    scenario.simulation = dataclasses.replace(scenario.simulation, seed=int(seed[4]))
    assert index[4] == 4
    log = Simulate(scenario, plan=flown[1])
    squares = (log.control**2).sum(axis=1)
    assert effort[4] == pytest.approx(np.trapezoid(squares, log.time))
    assert "bang_bang" in result.output and "0.0" in result.output


def test_without_a_certified_plan_nothing_flies(tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = invoke("constant_uncertainty", "--trials", 2, "--out", out)
    assert result.exit_code == 3
    assert {path.name for path in out.iterdir()} == {"summary.json"}
    assert "infeasible" in result.output


@pytest.mark.parametrize(
    ("option", "value", "complaint"),
    [
        ("--trials", "0", "--trials: got 0, but it must be at least 1"),
        ("--trials", "many", "--trials: got 'many', but it must be a whole number"),
        ("--batch-size", "0", "--batch-size: got 0, but it must be at least 1"),
        ("--disturbance", "storm", "--disturbance: got 'storm', but it must be one of"),
        ("--scheduler", "nonsense", "--scheduler: got 'nonsense', but it must be"),
        ("--seed", "-1", "simulation.seed: got -1, but it must be in"),
    ],
)
def test_bad_options_get_one_line(
    tmp_path: Path, file: Path, option: str, value: str, complaint: str
) -> None:
    result = invoke(file, "--out", tmp_path / "out", option, value)
    assert result.exit_code == 2
    assert result.stderr.startswith(complaint)
    assert result.stderr.count("\n") == 1


# Pictures.


def test_the_figures_show_every_cloud(flown: tuple[Scenario, Plan]) -> None:
    scenario, chosen = flown
    flights = {
        name: fly(Batch(name, through(scenario, name), chosen, range(3)))
        for name in ("worst_case", "uniform")
    }
    names = [f"1000 × {name.replace('_', ' ')}" for name in KINDS]
    figure = plot_plan(
        scenario=scenario,
        plan=chosen,
        position={name: flights["worst_case"].position for name in names},
    )
    legend = figure.legends[0]
    handles = zip(legend.get_texts(), legend.legend_handles, strict=True)
    colors = {text.get_text(): handle for text, handle in handles}
    assert set(names) <= set(colors)
    assert len({colors[name].get_color() for name in names}) == len(KINDS)
    figure.canvas.draw()
    box = legend.get_window_extent()
    assert box.x0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1
    ratios = {name: f.position_ratio for name, f in flights.items()}
    figure = plot_quantiles(time=flights["uniform"].time, ratios=ratios)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert {"worst_case: 3 flights", "uniform: 3 flights"} <= set(titles)
    figure.canvas.draw()
