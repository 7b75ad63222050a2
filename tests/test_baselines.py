"""What each part of the method is good for, against plans that lack it."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text
from typer.testing import CliRunner

from dtmpc_drake.__main__ import app
from dtmpc_drake.disturbances import UniformHold, WorstCase
from dtmpc_drake.experiments.compare import OUTPUTS, Row, to_figure, to_text
from dtmpc_drake.experiments.monte_carlo import Batch, fly
from dtmpc_drake.models import ConstantUncertainty, DragDoubleIntegrator
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import Problem, plan_problem
from dtmpc_drake.planning.baselines import (
    RESOLUTION,
    TITLES,
    Baseline,
    Outcome,
    bandwidth_cost,
    crossover,
    make_baselines,
    solve,
)
from dtmpc_drake.scenario import (
    Bandwidth,
    Controller,
    Planner,
    Scenario,
    Waypoint,
    load_scenario,
    to_yaml,
    validate,
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
    validate(scenario)
    return scenario


def solved(scenario: Scenario) -> dict[str, Outcome]:
    return {b.name: solve(b) for b in make_baselines(scenario)}


@pytest.fixture(scope="module")
def outcomes() -> dict[str, Outcome]:
    return solved(short())


@pytest.fixture(scope="module")
def gate() -> dict[str, Outcome]:
    """A gate beside the straight line, where the speed decides what fits."""
    posts = [Cylinder([-0.42, 1.5], 0.4), Cylinder([0.62, 1.5], 0.4)]
    quick = Planner(intervals=16, max_iterations=20)
    return solved(short(obstacles=posts, planner=quick))


def test_each_baseline_lacks_one_thing() -> None:
    baselines = {b.name: b for b in make_baselines(short())}
    assert list(baselines) == list(TITLES)
    whole = Problem.from_scenario(short())
    same = baselines["both"].problem
    np.testing.assert_array_equal(same.bandwidth.low, whole.bandwidth.low)
    np.testing.assert_array_equal(same.bandwidth.high, whole.bandwidth.high)
    assert same.model == whole.model
    for name, fixed, constant in (
        ("rigid_tube", True, True),
        ("state_dependent", True, False),
        ("bandwidth", False, True),
        ("both", False, False),
        ("both_paper", False, False),
    ):
        problem = baselines[name].problem
        assert problem.bandwidth.is_fixed == fixed
        assert isinstance(problem.model, ConstantUncertainty) == constant
        np.testing.assert_array_equal(problem.law.disturbance_bound, 0.3)
        assert problem.velocity_bound == (
            "paper" if name == "both_paper" else "comparison"
        )
    nominal = baselines["nominal"].problem
    assert not nominal.law.disturbance_bound.any()
    assert not nominal.model.model_error_bound(np.ones((2, 3))).any()


def test_a_scenario_s_own_fixed_bandwidth_bounds_no_baseline() -> None:
    """It belongs to its own experiment; the opponent may have any from min to max."""
    fixed = Controller(bandwidth=Bandwidth(fixed=3.0))
    baselines = {b.name: b for b in make_baselines(short(controller=fixed))}
    for name in ("nominal", "rigid_tube", "state_dependent"):
        assert baselines[name].fixed_bandwidth == 4.0  # where a sweep begins
    both = baselines["both"]
    assert both.fixed_bandwidth is None
    np.testing.assert_array_equal(both.problem.bandwidth.low, 0.5)
    np.testing.assert_array_equal(both.problem.bandwidth.high, 4.0)


def best_of(baseline: Baseline, bandwidths: Iterable[float]) -> float:
    """The lowest cost of a certified plan, each planned on its own from nothing."""
    costs = [math.inf]
    for bandwidth in bandwidths:
        one = baseline.at(bandwidth)
        result = plan_problem(one.problem, one.scenario.planner)
        if result.certified:
            costs.append(result.cost)
    return min(costs)


def whole_grid(scenario: Scenario) -> np.ndarray:
    bounds = scenario.controller.bandwidth
    return np.linspace(bounds.max, bounds.min, round(1 / RESOLUTION) + 1)


def test_a_sweep_finds_what_all_bandwidths_find(outcomes: dict[str, Outcome]) -> None:
    found = outcomes["state_dependent"]
    cheapest = best_of(found.baseline, whole_grid(short()))
    assert found.certified
    assert found.result.cost == pytest.approx(cheapest, rel=5e-3)
    # Neither end of the range: dear at the top, a wide way round at the bottom.
    assert 0.5 < found.baseline.fixed_bandwidth < 2.0
    assert found.result.cost < 0.5 * found.sweep[0].cost


@pytest.mark.parametrize("name", ["rigid_tube", "state_dependent"])
def test_a_fixed_row_is_the_best_of_its_sweep(
    outcomes: dict[str, Outcome], gate: dict[str, Outcome], name: str
) -> None:
    for found in (outcomes[name], gate[name]):
        tried = [point.bandwidth for point in found.sweep]
        assert tried == sorted(tried, reverse=True) and tried[0] == 4.0
        assert len(set(tried)) == len(tried) >= 5
        assert found.baseline.fixed_bandwidth in tried
        certified = [p.cost for p in found.sweep if p.status == "certified"]
        assert found.certified == bool(certified)
        if certified:
            assert found.result.cost == min(certified)
            assert found.plan is not None
            won = found.baseline.fixed_bandwidth
            np.testing.assert_allclose(found.plan.bandwidth_knots, won, rtol=1e-9)
        for point in found.sweep:
            assert (point.cost is None) == (point.status in ("infeasible", "failed"))


def test_a_sweep_is_the_same_every_time(outcomes: dict[str, Outcome]) -> None:
    again = solve(make_baselines(short())[1])
    assert again.sweep == outcomes["rigid_tube"].sweep


def test_a_range_of_one_bandwidth_is_planned_once() -> None:
    one = short(controller=Controller(bandwidth=Bandwidth(min=3.0, max=3.0)))
    found = solve(make_baselines(one)[1])
    assert [point.bandwidth for point in found.sweep] == [3.0]


def test_the_highest_bandwidth_may_be_too_high() -> None:
    """αΦ(t0) of its first layer alone is beyond the input limit."""
    high = short(
        controller=Controller(
            initial_boundary_layer=0.4, bandwidth=Bandwidth(max=14.5, rate_max=20.0)
        ),
        obstacles=[],
        planner=Planner(intervals=8),
    )
    found = solve(make_baselines(high)[1])
    assert [point.status for point in found.sweep[:3]] == ["infeasible"] * 3
    assert found.certified and found.baseline.fixed_bandwidth < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rigid_tube", "state_dependent"])
@pytest.mark.parametrize(
    ("layer", "highest"), [(0.2, 8.0), (0.4, 16.0)], ids=["wide", "too high"]
)
def test_a_sweep_finds_the_feasible_part_of_a_range(
    name: str, layer: float, highest: float
) -> None:
    """Lower ones do not fit the gate, higher ones ask for too much input."""
    bandwidth = Bandwidth(max=highest, rate_max=20.0)
    scenario = short(
        controller=Controller(initial_boundary_layer=layer, bandwidth=bandwidth),
        obstacles=[Cylinder([-0.62, 1.5], 0.4), Cylinder([0.62, 1.5], 0.4)],
    )
    baseline = next(b for b in make_baselines(scenario) if b.name == name)
    found = solve(baseline)
    cheapest = best_of(baseline, whole_grid(scenario))
    assert found.certified
    assert found.result.cost == pytest.approx(cheapest, rel=5e-3)


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
    # Three axes above the floor for 4 s; the weight is 0.1.
    problem = outcomes["both"].baseline.problem
    fixed = outcomes["state_dependent"].result
    excess = outcomes["state_dependent"].baseline.fixed_bandwidth - 0.5
    assert bandwidth_cost(fixed, problem) == pytest.approx(
        0.1 * 3 * excess**2 * 4.0, rel=1e-3
    )
    assert bandwidth_cost(outcomes["nominal"].result, problem) == 0.0
    free = outcomes["both"].result
    assert bandwidth_cost(free, problem) > 0.0
    assert outcomes["nominal"].result.cost < free.cost < fixed.cost


def test_the_paper_s_velocity_bound_costs_more(outcomes: dict[str, Outcome]) -> None:
    ours, theirs = outcomes["both"], outcomes["both_paper"]
    assert ours.plan is not None and theirs.plan is not None
    t = ours.plan.sample_times()
    assert (
        ours.plan.error_bound(t)[:, 1] < ours.plan.boundary_layer(t) + 1e-9
    ).mean() > 0.9
    assert ours.result.cost <= theirs.result.cost * 1.01


def test_the_whole_method_beats_each_of_its_parts(gate: dict[str, Outcome]) -> None:
    """A constant uncertainty is infeasible, the best fixed bandwidth dear."""
    assert {name: o.certified for name, o in gate.items()} == {
        "nominal": False,
        "rigid_tube": False,
        "state_dependent": True,
        "bandwidth": False,
        "both": True,
        "both_paper": True,
    }
    for name in ("rigid_tube", "bandwidth"):
        assert gate[name].result.status == "infeasible"
        assert "cannot keep" in gate[name].message
    cost = {name: o.result.cost for name, o in gate.items()}
    assert cost["both"] < 0.7 * cost["state_dependent"]
    assert cost["both"] < cost["both_paper"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("known_environment", 2.0),
        ("unknown_drag", 2.1),
        ("state_dependent_uncertainty", 1.3),
    ],
)
def test_no_constant_bandwidth_comes_near_on_the_shipped_fields(
    name: str, factor: float
) -> None:
    """Far below what a sweep looked at, too: its way down ends early."""
    baselines = {b.name: b for b in make_baselines(load_scenario(name))}
    found, whole = solve(baselines["state_dependent"]), solve(baselines["both"])
    assert found.certified and whole.certified
    assert found.result.cost > factor * whole.result.cost
    # Programs stop when the next one promises less than 2.5 % of the cost.
    others = best_of(baselines["state_dependent"], np.arange(4.0, 0.4, -0.5))
    assert others > 0.975 * found.result.cost
    rigid = solve(baselines["rigid_tube"])
    constant = best_of(baselines["rigid_tube"], np.arange(4.0, 0.4, -0.5))
    assert rigid.certified == math.isfinite(constant)
    if rigid.certified:
        assert constant > 0.975 * rigid.result.cost


def test_the_slope_is_not_charged_but_seen() -> None:
    """A steeper surface looks cheap; its loop is the faster one."""
    outcomes = []
    for slope in (2.0, 4.0):
        scenario = load_scenario("known_environment")
        scenario.controller.slope = [slope] * 3
        outcomes.append(solve(make_baselines(scenario)[4]))
    two, four = outcomes
    assert two.baseline.name == "both" and two.certified and four.certified
    assert two.result.cost == pytest.approx(16.54, rel=0.01)
    assert four.result.cost == pytest.approx(11.26, rel=0.01)
    loops = [crossover(o.plan, o.baseline.scenario) for o in outcomes if o.plan]
    means = [o.plan.bandwidth_knots.mean() for o in outcomes if o.plan]
    assert means[1] < 0.8 * means[0]
    assert loops[1] > 1.4 * loops[0]


def test_the_table_names_what_cannot_be_kept(gate: dict[str, Outcome]) -> None:
    rows = {name: Row(outcome, None) for name, outcome in gate.items()}
    text = to_text(short(), rows)
    rigid = next(x for x in text.splitlines() if x.startswith("rigid tube  "))
    assert rigid.split()[2:5] == ["no", "no", "-"]
    factor = gate["state_dependent"].result.cost / gate["both"].result.cost
    assert f"the best fixed α costs {factor:.2f} times as much as DTMPC" in text
    tried = gate["rigid_tube"].sweep
    assert (
        f"rigid tube: infeasible, no plan at {len(tried)} fixed bandwidths from "
        f"{tried[-1].bandwidth:.4g} to 4 rad/s; the nearest, "
    ) in text
    assert ": cannot keep " in text


def test_the_table_says_which_bandwidth_won_and_what_costs_are_counted_in(
    outcomes: dict[str, Outcome],
) -> None:
    scenario = short(
        controller=Controller(initial_boundary_layer=0.2, slope=[2.0, 2.0, 3.0])
    )
    text = to_text(scenario, {n: Row(o, None) for n, o in outcomes.items()})
    header, _, *lines = text.splitlines()
    assert "fixed α" in header and "ω_c" in header
    for line, outcome in zip(lines, outcomes.values(), strict=False):
        alpha = outcome.baseline.fixed_bandwidth
        assert ("-" if alpha is None else f"{alpha:.4g}") == line.split()[-10]
    assert "cost: ∫ 2‖u*‖² + 0.1‖α − 0.5‖² dt, with α from 0.5 to 4 rad/s" in text
    assert "does not charge λ = (2, 2, 3) 1/s" in text


def test_the_figure_says_which_bandwidth_won_in_titles_that_fit(
    gate: dict[str, Outcome],
) -> None:
    rows = {}
    for name, o in gate.items():
        flown = o.plan and fly(Batch(name, o.baseline.scenario, o.plan, range(2)))
        rows[name] = Row(o, flown)
    figure = to_figure(short(), rows)
    titles = [axes.get_title(loc="left") for axes in figure.axes[: len(rows)]]
    for title, outcome in zip(titles, gate.values(), strict=True):
        alpha = outcome.baseline.fixed_bandwidth
        won = "" if alpha is None else f", α = {alpha:.4g} rad/s"
        assert title.startswith(f"{outcome.baseline.title}{won}: ")
    assert "λ = 2 1/s" in figure.get_supxlabel()
    figure.draw_without_rendering()
    texts = [axes.yaxis.label for axes in figure.axes]
    texts += figure.findobj(lambda x: isinstance(x, Text) and x.get_text() in titles)
    for text in [*texts, *figure.texts]:
        extent = text.get_window_extent()
        assert extent.x0 >= 0 and extent.x1 <= figure.bbox.width, text


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


@pytest.mark.slow
def test_the_command_compares(tmp_path: Path) -> None:
    file, out = tmp_path / "short.yaml", tmp_path / "out"
    file.write_text(to_yaml(short()), encoding="utf-8")
    result = invoke(file, "--trials", 10, "--out", out)
    assert result.exit_code == 0, result.output
    assert {path.name for path in out.iterdir()} == set(OUTPUTS)
    data = json.loads((out / "compare.json").read_text(encoding="utf-8"))
    rows = {row["name"]: row for row in data["baselines"]}
    assert list(rows) == list(TITLES)
    assert rows["both"]["certified"] and rows["both"]["flights"] == 12
    assert rows["both"]["collisions"] == rows["both"]["violations"] == 0
    assert rows["nominal"]["collisions"] > 0 and rows["nominal"]["violations"] == 0
    for name in ("rigid_tube", "state_dependent"):
        row = rows[name]
        costs = {p["bandwidth"]: p["cost"] for p in row["sweep"]}
        assert row["certified"] and row["cost"] == costs[row["fixed_bandwidth"]]
        assert row["cost"] == min(cost for cost in costs.values() if cost is not None)
    assert rows["both"]["sweep"] == [] and rows["both"]["fixed_bandwidth"] is None
    assert 2.0 < rows["both"]["crossover"] < rows["nominal"]["crossover"]
    assert data["currency"] == {
        "input_weight": 2.0,
        "bandwidth_weight": 0.1,
        "bandwidth_min": 0.5,
        "bandwidth_max": 4.0,
        "slope": [2.0, 2.0, 2.0],
    }
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


@pytest.mark.slow
def test_the_exit_status_tells_an_impossible_task(tmp_path: Path) -> None:
    file = tmp_path / "storm.yaml"
    storm = short(
        disturbance=UniformHold(bound=[4.0] * 3),
        obstacles=[],
        planner=Planner(intervals=8, max_iterations=2),
    )
    file.write_text(to_yaml(storm), encoding="utf-8")
    result = invoke(file, "--trials", 1, "--out", tmp_path / "out")
    assert result.exit_code == 3, result.output
    assert "infeasible" in result.output
