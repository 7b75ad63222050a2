"""No flight is begun that the integrator would make diverge."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    GetIntegrationSchemes,
    Simulator,
    SimulatorConfig,
)
from pydrake.systems.primitives import LinearSystem
from typer.testing import CliRunner

from dtmpc_drake.__main__ import app
from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.disturbances import ColoredWind, UniformHold
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.method.stability import LIMITS, longest_stable_step
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.planning import plan
from dtmpc_drake.scenario import (
    Bandwidth,
    Controller,
    Scenario,
    Simulation,
    Waypoint,
    load_scenario,
    require_stable_simulation,
    shipped_scenarios,
    to_yaml,
)

FAST = Scenario(
    name="fast",
    model=IntegratorChain(1, 2, 0.0),
    disturbance=UniformHold(bound=[0.1], hold=0.05),
    controller=Controller(slope=[2.0], bandwidth=Bandwidth(fixed=4.0)),
    start=Waypoint([0.0]),
    goal=Waypoint([1.0]),
    duration=2.0,
)


def final(scheme: str, rate: float, step: float = 0.01) -> float:
    """What is left of 1 after 300 steps of dx/dt = -rate x."""
    none = np.zeros((1, 0))
    simulator = Simulator(LinearSystem(np.array([[-rate]]), none, np.eye(1), none))
    config = SimulatorConfig(
        integration_scheme=scheme, max_step_size=step, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    simulator.get_mutable_context().SetContinuousState([1.0])
    simulator.AdvanceTo(300 * step)
    return float(np.abs(simulator.get_context().get_continuous_state_vector()[0]))


@pytest.mark.parametrize("scheme", sorted(set(GetIntegrationSchemes()) - {"cenic"}))
def test_each_limit_is_the_one_that_the_integrator_has(scheme):
    if scheme in LIMITS:
        assert final(scheme, 0.999 * LIMITS[scheme] / 0.01) < 1
        assert not final(scheme, 1.001 * LIMITS[scheme] / 0.01) < 1
    else:
        assert final(scheme, 1e4 / 0.01) < 1
        assert longest_stable_step(scheme, {"λ": 1e9}) is None


@pytest.mark.parametrize("name", shipped_scenarios())
def test_what_is_shipped_is_stable(name):
    require_stable_simulation(load_scenario(name))


def with_step(step: float, scheme: str = "runge_kutta3", **controller) -> Scenario:
    return dataclasses.replace(
        FAST,
        controller=dataclasses.replace(FAST.controller, **controller),
        simulation=Simulation(integration_scheme=scheme, max_step_size=step),
    )


@pytest.mark.parametrize("slope", [400.0, 1000.0])
def test_a_steep_surface_needs_a_short_step(slope):
    scenario = with_step(0.01, slope=[slope])
    with pytest.raises(ScenarioError) as error:
        Simulate(scenario)
    line = str(error.value)
    assert "simulation.max_step_size: got 0.01" in line
    assert f"at most {0.98 * 2.5127 / slope:.4g} s" in line
    assert f"controller.slope[0] = {slope:g} 1/s" in line
    require_stable_simulation(with_step(0.01, "implicit_euler", slope=[slope]))


def test_so_does_a_fast_bandwidth_and_a_short_gust():
    fast = Bandwidth(min=0.5, max=500.0)
    with pytest.raises(ScenarioError, match=r"bandwidth\.max = 500 rad/s"):
        require_stable_simulation(with_step(0.01, bandwidth=fast))
    wind = ColoredWind(bound=[0.1], correlation_time=1e-3)
    with pytest.raises(ScenarioError, match=r"correlation_time = 0\.001 s"):
        require_stable_simulation(dataclasses.replace(FAST, disturbance=wind))


def test_a_step_that_is_just_short_enough_flies_well():
    found = plan(with_step(0.01))
    assert found.certified
    longest, _ = longest_stable_step("runge_kutta3", {"λ": 400.0})
    steep = with_step(longest, slope=[400.0])
    log = Simulate(steep, plan=plan(steep).plan)
    assert np.isfinite(log.state).all()


@pytest.mark.parametrize("command", ["simulate", "monte-carlo", "compare"])
def test_commands_refuse_it_before_any_work(command, tmp_path):
    file = tmp_path / "steep.yaml"
    file.write_text(to_yaml(with_step(0.01, slope=[400.0])), encoding="utf-8")
    out = tmp_path / "out"
    result = CliRunner().invoke(app, [command, str(file), "--out", str(out)])
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith("simulation.max_step_size: got 0.01")
    assert not out.exists()
