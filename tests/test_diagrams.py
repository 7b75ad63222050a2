"""The closed loop does what the mathematics says, whatever pushes the plant."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

from dtmpc_drake.diagrams import MakeClosedLoop, Simulate
from dtmpc_drake.disturbances import (
    BangBang,
    ColoredWind,
    Constant,
    Disturbance,
    Gust,
    UniformHold,
    WorstCase,
)
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.obstacles import Cylinder, Sphere
from dtmpc_drake.planning import plan
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import (
    Controller,
    Limits,
    Planner,
    Scenario,
    Waypoint,
    load_scenario,
    validate,
)
from tests.models_for_tests import FirstOrderScalar, PlanarOnSlope, ThirdOrderPlanar


def small(model: Any, **fields: Any) -> Scenario:
    """Four seconds past one obstacle (none for a single output)."""
    m = model.num_outputs
    along = np.eye(m)[min(1, m - 1)]
    obstacles: list[Any] = [Cylinder([0.55, 1.5], 0.4)] if m > 1 else []
    if m > 2:
        obstacles.append(Sphere([-0.9, 2.2, 0.1], 0.3))
    settings: dict[str, Any] = {
        "disturbance": WorstCase(bound=[0.3] * m),
        "controller": Controller(slope=[2.0] * m, initial_boundary_layer=0.2),
        "start": Waypoint(position=[0.0] * m),
        "goal": Waypoint(position=(3.0 * along).tolist()),
        "duration": 4.0,
        "obstacles": obstacles,
        "planner": Planner(intervals=16),
    }
    scenario = Scenario(name="small", model=model, **(settings | fields))
    validate(scenario)
    return scenario


CASES: dict[str, Callable[[], Scenario]] = {
    "known_drag": lambda: small(DragDoubleIntegrator(0.1, 0.0)),
    "unknown_drag": lambda: small(DragDoubleIntegrator(0.1, 0.1), plant={"drag": 0.2}),
    "n1_m1": lambda: small(IntegratorChain(1, 1, 0.1), plant={"model_error": 0.1}),
    "n1_state_dependent": lambda: small(
        FirstOrderScalar(), plant={"error_fraction": 1.0}
    ),
    "n2_m1": lambda: small(IntegratorChain(1, 2, 0.2), plant={"model_error": 0.2}),
    "n3_m1": lambda: small(IntegratorChain(1, 3), limits=Limits(input=10.0)),
    "n3_m3": lambda: small(
        IntegratorChain(3, 3, 0.1),
        plant={"model_error": 0.1},
        limits=Limits(input=15.0),
    ),
    "n3_state_dependent": lambda: small(
        ThirdOrderPlanar(), plant={"error_fraction": 1.0}, limits=Limits(input=15.0)
    ),
    "coupled_inputs": lambda: small(
        PlanarOnSlope(), plant={"error_fraction": -1.0}, limits=Limits(input=8.0)
    ),
    "initial_error": lambda: small(
        DragDoubleIntegrator(0.1, 0.0),
        initial_error=Waypoint(position=[0.03, -0.04, 0.02], velocity=[0.1, 0.2, -0.1]),
    ),
}

DISTURBANCES: dict[str, Callable[[list[float]], Disturbance]] = {
    "uniform": lambda D: UniformHold(bound=D, hold=0.05),
    "constant": lambda D: Constant(bound=D, fraction=-1.0),
    "bang_bang": lambda D: BangBang(bound=D, hold=0.3),
    "worst_case": lambda D: WorstCase(bound=D),
    "worst_model": lambda D: WorstCase(bound=D, model_error=True),
    "reversing": lambda D: WorstCase(bound=D, hold=0.5, model_error=True),
    "gust": lambda D: Gust(bound=D, hold=1.5, model_error=True),
    "wind": lambda D: ColoredWind(bound=D, correlation_time=0.3, intensity=0.7),
}


@pytest.fixture(scope="session")
def planned() -> Callable[[str], tuple[Scenario, Plan]]:
    """A case's scenario with its certified plan; each is planned once."""
    known: dict[str, tuple[Scenario, Plan]] = {}

    def get(case: str) -> tuple[Scenario, Plan]:
        if case not in known:
            scenario = CASES[case]()
            result = plan(scenario)
            assert result.certified, result
            assert result.plan is not None
            known[case] = scenario, result.plan
        return known[case]

    return get


Planned = Callable[[str], tuple[Scenario, Plan]]


def with_seed(scenario: Scenario, seed: int) -> Scenario:
    simulation = dataclasses.replace(scenario.simulation, seed=seed)
    return dataclasses.replace(scenario, simulation=simulation)


@pytest.mark.parametrize("disturbance", DISTURBANCES)
@pytest.mark.parametrize("case", CASES)
def test_the_tube_is_invariant(planned: Planned, case: str, disturbance: str) -> None:
    scenario, flown = planned(case)
    bound = scenario.disturbance.bound
    pushed = dataclasses.replace(scenario, disturbance=DISTURBANCES[disturbance](bound))
    log = Simulate(pushed, plan=flown)
    assert log.tube_ratios.max() <= 1 + 1e-6
    assert log.clearance.min() > 0
    assert (np.abs(log.disturbance) <= bound).all()
    seen = log.extremes()
    assert seen["largest_input"] <= scenario.limits.input
    assert seen["largest_speed"] <= scenario.limits.speed


def test_the_tube_is_tight_for_the_known_model() -> None:
    scenario = load_scenario("known_environment")
    scenario.disturbance = WorstCase(bound=scenario.disturbance.bound)
    log = Simulate(scenario)
    assert log.status == "certified"
    assert log.tube_ratios.max() <= 1 + 1e-6
    assert log.clearance.min() > 0
    assert log.extremes()["worst_position_ratio"] > 0.8
    # The velocity tube as well, once its start is forgotten.
    settled = log.time > 1.0
    assert log.tube_ratios[settled, 2].max() > 0.5


def test_a_plant_that_breaks_its_bounds_is_seen_outside(planned: Planned) -> None:
    """The invariance above is no property of the monitor."""
    scenario, flown = planned("n2_m1")
    loop = MakeClosedLoop(scenario, plan=flown)
    context = loop.CreateDefaultContext()
    plant = loop.GetSubsystemByName("plant")
    plant.SetParameters(plant.GetMyContextFromRoot(context), {"model_error": 1.0})
    simulator = Simulator(loop, context)
    simulator.AdvanceTo(2.0)
    assert loop.GetOutputPort("tube_ratios").Eval(context).max() > 1.0


def test_the_seed_decides_everything_random(planned: Planned) -> None:
    scenario, flown = planned("known_drag")
    scenario = dataclasses.replace(scenario, duration=1.0)
    for name in ("uniform", "bang_bang", "wind", "reversing", "gust"):
        source = DISTURBANCES[name]([0.3, 0.3, 0.3])
        scenario = dataclasses.replace(scenario, disturbance=source)
        first, again, other = (
            Simulate(with_seed(scenario, seed), plan=flown) for seed in (3, 3, 4)
        )
        for field in dataclasses.fields(Flight):
            np.testing.assert_array_equal(
                getattr(first, field.name), getattr(again, field.name)
            )
        assert np.abs(first.disturbance - other.disturbance).max() > 0.01
        assert np.abs(first.state - other.state).max() > 1e-6


def test_the_diagram_exports_its_ports_by_name(planned: Planned) -> None:
    scenario, flown = planned("known_drag")
    loop = MakeClosedLoop(scenario, plan=flown)
    assert loop.get_name() == "closed_loop"
    context = loop.CreateDefaultContext()
    sizes = {
        "state": 6,
        "control": 3,
        "reference": 9,
        "disturbance": 3,
        "tube_ratios": 9,
        "clearance": 2,
        "quantities": 8,
        "record": 6 * 8,
    }
    for name, size in sizes.items():
        assert loop.GetOutputPort(name).Eval(context).shape == (size,)
    assert isinstance(loop.GetOutputPort("plan").Eval(context), Plan)
    assert loop.GetOutputPort("status").Eval(context) == "given"
    assert loop.num_output_ports() == len(sizes) + 2
    assert loop.num_input_ports() == 0


def test_loggers_see_the_plan_from_the_first_instant(planned: Planned) -> None:
    scenario, flown = planned("initial_error")
    log = Simulate(scenario)
    assert log.status == "certified"
    np.testing.assert_allclose(log.reference[0], flown.reference(0.0), atol=1e-9)
    np.testing.assert_allclose(
        log.state[0], scenario.start_state() + scenario.initial_error_state()
    )
    # Φ(t0) is what the scenario says; the plan that holds has another one.
    s = np.abs([0.16, 0.12, -0.06])
    np.testing.assert_allclose(log.tube_ratios[0, 0], s / 0.2, rtol=1e-4)


def test_planning_in_the_diagram_is_planning_before_it(planned: Planned) -> None:
    scenario, flown = planned("known_drag")
    np.testing.assert_array_equal(
        Simulate(scenario).state, Simulate(scenario, plan=flown).state
    )


def test_the_log_is_sampled_evenly_and_to_the_end(planned: Planned) -> None:
    scenario, flown = planned("n2_m1")
    odd = dataclasses.replace(scenario, duration=1.2345)
    log = Simulate(odd, plan=flown)
    np.testing.assert_allclose(np.diff(log.time)[:-1], 0.01)
    assert log.time[0] == 0.0
    assert log.time[-1] == 1.2345
    shapes = {"state": (2, 1), "control": (1,), "reference": (3, 1)}
    shapes |= {"disturbance": (1,), "tube_ratios": (3, 1), "clearance": (1,)}
    for name, shape in shapes.items():
        assert getattr(log, name).shape == (len(log.time), *shape)
    assert np.isinf(log.clearance).all()  # there are no obstacles


def test_a_log_survives_its_file(planned: Planned, tmp_path: Path) -> None:
    scenario, flown = planned("n1_m1")
    log = Simulate(scenario, plan=flown)
    log.save(tmp_path / "log.npz")
    loaded = Flight.load(tmp_path / "log.npz")
    for field in dataclasses.fields(Flight):
        np.testing.assert_array_equal(
            getattr(loaded, field.name), getattr(log, field.name)
        )
    assert "401 samples over 4 s" in repr(loaded)
    flown.save(tmp_path / "plan.npz")
    with pytest.raises(ValueError, match="not a saved log"):
        Flight.load(tmp_path / "plan.npz")


def test_without_a_certified_plan_the_vehicle_stays() -> None:
    """An honest status, no exception, and a tube that is still true."""
    weak = small(
        DragDoubleIntegrator(0.1, 0.0),
        limits=Limits(input=0.2),
        start=Waypoint(position=[0.0] * 3, velocity=[0.1, 0.2, 0.0]),
        planner=Planner(intervals=16, max_iterations=4),
    )
    log = Simulate(weak)
    assert log.status.startswith("infeasible: cannot keep input limit")
    assert np.ptp(log.reference[:, 0], axis=0).max() == 0.0
    assert log.tube_ratios.max() <= 1 + 1e-6


def test_a_simulation_can_be_watched(planned: Planned) -> None:
    scenario, flown = planned("known_drag")
    meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    loop = MakeClosedLoop(scenario, plan=flown, meshcat=meshcat)
    simulator = Simulator(loop)
    simulator.AdvanceTo(0.1)
    assert meshcat.HasPath("/dtmpc/vehicle")
    assert loop.HasSubsystemNamed("live_view")
