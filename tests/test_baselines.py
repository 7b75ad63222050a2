"""What each part of the method is good for, against plans that lack it."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from diagrams.__main__ import app
from diagrams.compare import OUTPUTS, Row, to_text
from diagrams.monte_carlo import Batch, fly
from dtmpc_drake.models import ConstantUncertainty, DragDoubleIntegrator
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import Problem
from dtmpc_drake.planning.baselines import (
    TITLES,
    Outcome,
    bandwidth_cost,
    make_baselines,
    solve,
)
from dtmpc_drake.scenario import (
    Bandwidth,
    Controller,
    Planner,
    Scenario,
    UniformHold,
    Waypoint,
    WorstCase,
    load_scenario,
)


def short(**fields: Any) -> Scenario:
    """Four seconds past one obstacle that is in the way."""
    settings: dict[str, Any] = {
        "model": DragDoubleIntegrator(0.1, 0.1),
        "disturbance": UniformHold(bound=[0.3] * 3),
        "controller": Controller(initial_boundary_layer=0.2),
        "start": Waypoint(position=[0.0] * 3),
        "goal": Waypoint(position=[0.0, 3.0, 0.0]),
        "duration": 4.0,
        "obstacles": [Cylinder([0.25, 1.5], 0.4)],
        "planner": Planner(intervals=16),
    }
    scenario = Scenario(name="short", **(settings | fields))
    scenario.validate()
    return scenario


def solved(scenario: Scenario) -> dict[str, Outcome]:
    return {b.name: solve(b) for b in make_baselines(scenario)}


@pytest.fixture(scope="module")
def outcomes() -> dict[str, Outcome]:
    return solved(short())


def test_each_baseline_lacks_one_thing() -> None:
    baselines = {b.name: b for b in make_baselines(short())}
    assert list(baselines) == list(TITLES)
    whole = Problem.from_scenario(short())
    same = baselines["both"].problem
    np.testing.assert_array_equal(same.bandwidth_min, whole.bandwidth_min)
    np.testing.assert_array_equal(same.bandwidth_max, whole.bandwidth_max)
    assert same.model == whole.model
    for name, fixed, constant in (
        ("rigid_tube", True, True),
        ("state_dependent", True, False),
        ("bandwidth", False, True),
        ("both", False, False),
        ("both_paper", False, False),
    ):
        problem = baselines[name].problem
        assert problem.bandwidth_is_fixed == fixed
        assert isinstance(problem.model, ConstantUncertainty) == constant
        np.testing.assert_array_equal(problem.disturbance_bound, 0.3)
        assert problem.velocity_bound == (
            "paper" if name == "both_paper" else "comparison"
        )
    nominal = baselines["nominal"].problem
    assert not nominal.disturbance_bound.any()
    assert not nominal.model.model_error_bound(np.ones((2, 3))).any()


def test_a_fixed_bandwidth_is_the_one_of_the_scenario_or_the_highest() -> None:
    rigid = make_baselines(short())[1]
    assert rigid.scenario.controller.bandwidth.fixed == 4.0
    fixed = Controller(bandwidth=Bandwidth(fixed=3.0))
    baselines = {b.name: b for b in make_baselines(short(controller=fixed))}
    np.testing.assert_array_equal(baselines["rigid_tube"].problem.bandwidth_max, 3.0)
    np.testing.assert_array_equal(baselines["both"].problem.bandwidth_max, 4.0)


def test_a_nominal_plan_collides_and_dtmpc_does_not() -> None:
    """Both are flown by the same controller, pushed as hard as the wind may."""
    scenario = load_scenario("known_environment")
    scenario.disturbance = WorstCase(bound=scenario.disturbance.bound)
    baselines = {b.name: b for b in make_baselines(scenario)}
    flights, tubes = {}, {}
    for name in ("nominal", "both"):
        outcome = solve(baselines[name])
        assert outcome.plan is not None
        own = outcome.baseline.scenario
        flights[name] = fly(Batch(name, own, outcome.plan, range(20)))
        tubes[name] = outcome.plan.position_tube(outcome.plan.sample_times())
        # The nominal tracker is fair: it keeps the plant in its tube.
        assert not any(flights[name].violations.values())
    assert flights["nominal"].collisions > 15  # whatever side it is pushed to
    assert flights["both"].collisions == 0
    assert tubes["nominal"].mean() < 0.5 * tubes["both"].mean()


def test_only_what_keeps_every_limit_is_certified(outcomes: dict[str, Outcome]) -> None:
    nominal = outcomes["nominal"]
    assert nominal.plan is not None and not nominal.certified
    assert nominal.certificate is not None
    assert nominal.certificate.margins["obstacles"].value < 0
    assert "smallest margin" in nominal.message
    for name in ("state_dependent", "both", "both_paper"):
        assert outcomes[name].certified, outcomes[name].message


def test_all_have_the_same_cost_function(outcomes: dict[str, Outcome]) -> None:
    # Three axes at 4 rad/s, 3.5 above the floor, for 4 s; the weight is 0.1.
    fixed = outcomes["state_dependent"].result
    assert bandwidth_cost(fixed) == pytest.approx(0.1 * 3 * 3.5**2 * 4.0, rel=1e-3)
    assert bandwidth_cost(outcomes["nominal"].result) == 0.0
    free = outcomes["both"].result
    assert 0.0 < bandwidth_cost(free) < bandwidth_cost(fixed)
    assert outcomes["nominal"].result.cost < free.cost < fixed.cost


def test_the_paper_s_velocity_bound_costs_more(outcomes: dict[str, Outcome]) -> None:
    ours, theirs = outcomes["both"], outcomes["both_paper"]
    assert ours.plan is not None and theirs.plan is not None
    t = ours.plan.sample_times()
    assert (
        ours.plan.error_bound(t)[:, 1] < ours.plan.boundary_layer(t) + 1e-9
    ).mean() > 0.9
    assert ours.result.cost <= theirs.result.cost * 1.01


@pytest.fixture(scope="module")
def tight_drag() -> dict[str, Outcome]:
    """The third experiment with the drag error that C_d in [0, 0.2] needs."""
    scenario = load_scenario("state_dependent_uncertainty")
    assert isinstance(scenario.model, DragDoubleIntegrator)
    scenario.model.drag_error_bound = 0.1
    return solved(scenario)


def test_the_whole_method_beats_each_of_its_parts(
    tight_drag: dict[str, Outcome],
) -> None:
    """A constant uncertainty is infeasible, a fixed bandwidth dear."""
    assert {name: o.certified for name, o in tight_drag.items()} == {
        "nominal": False,
        "rigid_tube": False,
        "state_dependent": True,
        "bandwidth": False,
        "both": True,
        "both_paper": True,
    }
    for name in ("rigid_tube", "bandwidth"):
        assert tight_drag[name].result.status == "infeasible"
        assert "cannot keep" in tight_drag[name].message
    cost = {name: o.result.cost for name, o in tight_drag.items()}
    assert cost["both"] < 0.5 * cost["state_dependent"]
    assert cost["both"] < 0.9 * cost["both_paper"]


def test_the_table_names_what_cannot_be_kept(tight_drag: dict[str, Outcome]) -> None:
    text = to_text({name: Row(o, None) for name, o in tight_drag.items()})
    lines = text.splitlines()
    assert len({len(line.split("  ")) for line in lines[:1]}) == 1
    rigid = next(line for line in lines if line.startswith("rigid tube  "))
    assert rigid.split()[2:5] == ["no", "no", "-"]
    assert "rigid tube: infeasible, cannot keep" in text


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


def test_the_command_compares(tmp_path: Path) -> None:
    file, out = tmp_path / "short.yaml", tmp_path / "out"
    file.write_text(short().to_yaml(), encoding="utf-8")
    result = invoke(file, "--trials", 10, "--out", out)
    assert result.exit_code == 0, result.output
    assert {path.name for path in out.iterdir()} == set(OUTPUTS)
    data = json.loads((out / "compare.json").read_text(encoding="utf-8"))
    rows = {row["name"]: row for row in data["baselines"]}
    assert list(rows) == list(TITLES)
    assert rows["both"]["certified"] and rows["both"]["flights"] == 12
    assert rows["both"]["collisions"] == rows["both"]["violations"] == 0
    assert rows["nominal"]["collisions"] > 0 and rows["nominal"]["violations"] == 0
    total = rows["both"]["input_cost"] + rows["both"]["bandwidth_cost"]
    assert rows["both"]["cost"] == pytest.approx(total)
    with open(out / "compare.csv", encoding="utf-8", newline="") as table:
        assert [row["name"] for row in csv.DictReader(table)] == list(TITLES)
    text = (out / "compare.txt").read_text(encoding="utf-8")
    assert text.strip() in result.output


def test_bad_options_get_one_line() -> None:
    result = invoke("known_environment", "--trials", "0")
    assert result.exit_code == 2
    assert result.stderr == "--trials: got 0, but it must be at least 1\n"


def test_the_exit_status_tells_an_impossible_task(tmp_path: Path) -> None:
    file = tmp_path / "storm.yaml"
    storm = short(
        disturbance=UniformHold(bound=[4.0] * 3),
        obstacles=[],
        planner=Planner(intervals=8, max_iterations=2),
    )
    file.write_text(storm.to_yaml(), encoding="utf-8")
    result = invoke(file, "--trials", 1, "--out", tmp_path / "out")
    assert result.exit_code == 3, result.output
    assert "infeasible" in result.output
