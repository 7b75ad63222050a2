"""The benchmarks' peer, where CasADi is installed: ``pip install .[benchmark]``."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dtmpc_drake.disturbances import UniformHold
from dtmpc_drake.models import DragDoubleIntegrator
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import Problem, certify
from dtmpc_drake.scenario import Controller, Planner, Scenario, Waypoint, validate

pytest.importorskip("casadi")

from tests.benchmarks import bench_safe_plan, bench_tube_price
from tests.benchmarks.bench_safe_plan import STEP_MM, smallest_inflation
from tests.benchmarks.casadi_peer import Peer, Solution

INTERVALS = 7
"""Odd: no knot is where the obstacle is nearest."""


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Four seconds past one obstacle that is in the way."""
    scenario = Scenario(
        name="short",
        model=DragDoubleIntegrator(0.1, 0.0),
        disturbance=UniformHold(bound=[0.3] * 3),
        controller=Controller(initial_boundary_layer=0.2),
        start=Waypoint(position=[0.0] * 3),
        goal=Waypoint(position=[0.0, 3.0, 0.0]),
        duration=4.0,
        obstacles=[Cylinder([0.25, 1.5], 0.4)],
        planner=Planner(intervals=INTERVALS),
    )
    validate(scenario)
    return Problem.from_scenario(scenario)


def obstacle_margin(peer: Peer, solution: Solution) -> float:
    """A bound for all times, from the certificate rather than from samples."""
    return certify(peer.plan(solution), peer.problem).margins["obstacles"].value


def test_inflation_is_the_smallest_that_clears_the_plan(problem: Problem) -> None:
    peer = Peer(problem, INTERVALS)
    inflation = smallest_inflation(peer)
    assert inflation is not None and inflation > 0
    clear = peer.solve(inflation=inflation)
    assert clear.success
    assert peer.depth(clear)[1] == 0
    assert obstacle_margin(peer, clear) > -1e-4
    less = peer.solve(inflation=inflation - STEP_MM / 1000)
    assert less.success
    assert peer.depth(less)[1] > 0
    assert obstacle_margin(peer, less) < 0


def test_inflation_is_that_of_the_radii(problem: Problem) -> None:
    peer = Peer(problem, INTERVALS)
    obstacles = problem.obstacles
    larger = dataclasses.replace(obstacles, radius=obstacles.radius + 0.05)
    other = Peer(dataclasses.replace(problem, obstacles=larger), INTERVALS)
    inflated, plain = peer.solve(inflation=0.05), other.solve()
    np.testing.assert_allclose(inflated.coefficients, plain.coefficients, atol=1e-6)
    assert inflated.cost == pytest.approx(plain.cost)
    assert inflated.cost > peer.solve().cost


def test_no_inflation_is_said(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_safe_plan, "LARGEST_MM", 0)
    assert smallest_inflation(Peer(problem, INTERVALS)) is None


def test_table_of_safe_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_safe_plan, "LARGEST_MM", 40)
    section = bench_safe_plan.run("known_environment", 1, grids=(7, 56))
    assert [row[0] for row in section.rows] == ["7", "56"]
    assert section.rows[0][5] == "none"
    assert all(len(row) == len(section.columns) for row in section.rows)
    assert 0.03 < section.data["inflations"][56] < 0.05
    text = str(section)
    assert "Peer, coarsest and fastest clear: N = 56" in text
    # Its speed exceeds the limit between knots.
    assert section.rows[1][10].startswith("speed -0.00")
    assert "No clear plan of the peer is certified." in text


def test_a_plan_is_dearer_with_its_tube() -> None:
    data = bench_tube_price.run("known_environment", 1).data
    assert data["with tube"]["cost"] > 1.5 * data["no tube, bandwidth decided"]["cost"]
