"""Claims about the sides of obstacles: what is proposed, and what is chosen."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.experiments.random_fields import SEEDS, plan_fields, random_field
from dtmpc_drake.experiments.simulate import CANDIDATES, run
from dtmpc_drake.method.tube import TubeStart
from dtmpc_drake.models import IntegratorChain, register_model
from dtmpc_drake.obstacles import Cylinder, Ellipsoid, Obstacle, Sphere
from dtmpc_drake.planning import Problem, plan, plan_problem
from dtmpc_drake.planning.search.best_side import SWITCH, affordable, plan_best_side
from dtmpc_drake.planning.search.sides import Way, propose, sides_of
from dtmpc_drake.scenario import Scenario, Waypoint, load_scenario, validate
from dtmpc_drake.visualization import plot_candidates
from tests.test_random_scenarios import random_scenario

KNOWN = "known_environment"


def flight(obstacles: list[Obstacle], outputs: int = 3, **changes) -> Scenario:
    """8 m along the second output (or the only one), from rest to rest."""
    start, goal = [0.0] * outputs, [0.0] * outputs
    goal[min(1, outputs - 1)] = 8.0
    scenario = Scenario(
        model=IntegratorChain(num_outputs=outputs, order=2),
        start=Waypoint(position=start),
        goal=Waypoint(position=goal),
        duration=8.0,
        obstacles=obstacles,
    )
    scenario.disturbance.bound = [0.3] * outputs
    scenario.controller.slope = [2.0] * outputs
    scenario.planner.intervals = 24
    scenario.planner.initial_guess = "best_side"
    scenario.planner.time_budget = 0.5
    for name, value in changes.items():
        setattr(scenario, name, value)
    validate(scenario)
    return scenario


def ways(scenario: Scenario, count: int = 50) -> list[Way]:
    return propose(Problem.from_scenario(scenario), count)


# What is proposed.


def test_all_ways_through_the_papers_field_are_found():
    """Three ways past the first pair, and two past each of the others."""
    found = ways(load_scenario(KNOWN))
    pairs, rest = ("RL", "RR", "LL"), ("LR",) * 3
    expected = {
        pair + a + b + c
        for pair in pairs
        for a in rest[0]
        for b in rest[1]
        for c in "LR"
    }
    assert {way.sides for way in found} == expected
    assert len(found) == len(expected) == 24


@pytest.mark.parametrize(
    "scenario",
    [
        load_scenario(KNOWN),
        random_field(3),
        flight([Sphere([0.1, 4.0, 0.2], 1.0), Cylinder([-0.8, 6.0], 0.7)]),
        flight([Ellipsoid([0.2, 4.0, 0.0], [[1, 0.4, 0], [0, 1, 0.2]], 0.9)]),
        flight([Cylinder([0.1, 3.0], 0.8), Sphere([-0.4, 5.5], 0.6)], outputs=2),
    ],
    ids=["known", "random", "sphere", "ellipsoid", "planar"],
)
def test_ways_are_clear_distinct_shortest_first_and_true(scenario):
    problem = Problem.from_scenario(scenario)
    found = propose(problem, 20)
    assert len(found) > 1
    assert len({way.sides for way in found}) == len(found)
    lengths = [way.length for way in found]
    assert lengths == sorted(lengths)
    for way in found:
        np.testing.assert_allclose(way.points[0], problem.start[0], atol=1e-9)
        np.testing.assert_allclose(way.points[-1], problem.goal[0], atol=1e-9)
        assert problem.obstacles.clearance(way.points).min() >= 0
        steps = np.linalg.norm(np.diff(way.points, axis=0), axis=1)
        assert way.length == pytest.approx(steps.sum(), rel=1e-2)
        # The letters say what a look from above sees.
        for letter, obstacle in zip(way.sides, scenario.obstacles, strict=True):
            beside = np.abs(way.points[:, 1] - obstacle.center[1]).argmin()
            x = way.points[beside, 0]
            if letter in "LR":
                assert (x < obstacle.center[0]) == (letter == "L")


def test_the_near_side_of_a_pillar_comes_first():
    assert [w.sides for w in ways(flight([Cylinder([0.3, 4.0], 1.0)]))] == ["L", "R"]
    assert [w.sides for w in ways(flight([Cylinder([-0.3, 4.0], 1.0)]))] == ["R", "L"]


def test_a_slalom_is_flown_as_a_slalom_before_anything_else():
    slalom = [Cylinder([0.6 * sign, y], 0.8) for sign, y in ((1, 2), (-1, 4), (1, 6))]
    assert ways(flight(slalom))[0].sides == "LRL"


def test_a_gap_too_narrow_for_the_smallest_tube_is_closed():
    """Half the steady tube, 0.4 / (4 * 2) = 0.05 m, on both sides of a way."""

    def through(width: float) -> bool:
        x = 1.0 + width / 2
        pair = [Cylinder([-x, 4.0], 1.0), Cylinder([x, 4.0], 1.0)]
        return "RL" in [way.sides for way in ways(flight(pair))]

    assert through(0.06)
    assert not through(0.04)


def test_a_wall_of_many_pillars_has_two_ends():
    """Not 2^9 ways: what has no gap between is passed on one side."""
    wall = [
        Cylinder([x, 4.0 + 0.1 * (-1) ** k], 0.3)
        for k, x in enumerate(np.linspace(-1.9, 2.1, 9).tolist())
    ]
    assert [way.sides for way in ways(flight(wall))] == ["R" * 9, "L" * 9][::-1]


def test_a_ball_may_be_passed_above_and_below_a_pillar_may_not():
    ball = ways(flight([Sphere([0.0, 4.0, 0.1], 1.0)]))
    assert {way.sides for way in ball} == set("LRAB")
    below = next(way for way in ball if way.sides == "B")
    assert below.points[:, 2].min() < -0.9
    assert {w.sides for w in ways(flight([Cylinder([0.0, 4.0], 1.0)]))} == set("LR")


def test_where_there_is_nothing_to_choose_the_straight_line_remains():
    line = ways(flight([]))
    assert [way.sides for way in line] == [""]
    np.testing.assert_allclose(line[0].points[:, [0, 2]], 0.0, atol=1e-12)
    behind = flight([Cylinder([0.0, -3.0], 1.0), Cylinder([0.0, 12.0], 1.0)])
    assert [way.sides for way in ways(behind)] == ["--"]
    (single,) = ways(flight([Sphere([20.0], 1.0)], outputs=1))
    assert single.sides == "-" and single.points.shape[1] == 1


def test_sides_do_not_depend_on_the_direction_of_flight():
    """Turned by any angle, left remains left."""
    angle = 2.1
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centers = [[0.3, 3.0], [-0.5, 5.0]]
    scenario = flight([Cylinder(c, 0.8) for c in centers])
    turned = flight([Cylinder((turn @ c).tolist(), 0.8) for c in centers])
    turned.goal.position = [*(turn @ [0.0, 8.0]).tolist(), 0.0]
    assert [w.sides for w in ways(turned)] == [w.sides for w in ways(scenario)]


def test_the_sides_of_a_plan_are_told_from_its_positions(known_result, known_problem):
    path = known_result.plan.reference(known_result.plan.sample_times())[:, 0]
    way = Way.along("-----", path)
    assert sides_of(known_problem, way) == "RLRLR"


# What is chosen.


@pytest.fixture(scope="module")
def best():
    return plan(load_scenario("best_side"))


@pytest.fixture(scope="module")
def best_problem():
    return Problem.from_scenario(load_scenario("best_side"))


def test_the_best_side_costs_less_than_half_of_the_straight_line(best, known_result):
    assert best.certified and known_result.certified
    assert best.cost <= 0.5 * known_result.cost


def test_the_scenario_differs_from_the_papers_in_the_initial_guess_only():
    shipped, paper = load_scenario("best_side"), load_scenario(KNOWN)
    shipped.name = paper.name
    shipped.planner.initial_guess = "straight_line"
    assert shipped == paper
    assert paper.planner.initial_guess == "straight_line"


def test_the_table_tells_every_candidate(best):
    assert len(best.candidates) == 25  # 24 ways and the straight line
    (chosen,) = [c for c in best.candidates if c.chosen]
    assert chosen is best.candidates[0]
    assert chosen.cost == best.cost and chosen.status == "certified"
    certified = [c.cost for c in best.candidates if c.status == "certified"]
    assert best.cost == min(certified)
    rows = best.candidates_table().splitlines()
    assert len(rows) == 26
    assert (
        rows[1].startswith("*") and "RRRRR" in rows[1] and f"{best.cost:.3f}" in rows[1]
    )
    assert sum("straight line" in row for row in rows) == 1


def test_no_search_no_candidates(known_result):
    assert known_result.candidates == ()


def test_the_result_does_not_depend_on_the_number_of_threads(best, best_problem):
    settings = load_scenario("best_side").planner
    alone = plan_best_side(best_problem, settings, plan_problem, threads=1)
    np.testing.assert_array_equal(alone.plan.coefficients, best.plan.coefficients)
    np.testing.assert_array_equal(alone.plan.bandwidth_knots, best.plan.bandwidth_knots)
    assert alone.candidates_table() == best.candidates_table()


def test_the_budget_buys_candidates_at_fixed_prices():
    scenario = load_scenario("best_side")
    problem = Problem.from_scenario(scenario)
    counts = []
    for budget in (0.01, 0.5, 1.0, 2.0, 4.0):
        scenario.planner.time_budget = budget
        counts.append(affordable(problem, scenario.planner))
    solves, plans = zip(*counts, strict=True)
    assert list(solves) == sorted(solves) and list(plans) == sorted(plans)
    assert solves[0] == 2 and plans[0] >= 1  # the straight line and one way
    scenario.planner.time_budget = 0.3
    result = plan(scenario)
    assert len(result.candidates) == affordable(problem, scenario.planner)[0]


def test_an_uncertain_model_makes_candidates_dearer():
    problem = Problem.from_scenario(load_scenario("state_dependent_uncertainty"))
    settings = load_scenario("best_side").planner
    known = Problem.from_scenario(load_scenario("best_side"))
    assert affordable(problem, settings)[0] < affordable(known, settings)[0]


@pytest.mark.parametrize(
    ("field", "value"),
    [("initial_guess", "left"), ("time_budget", 0.0), ("time_budget", -1.0)],
)
def test_bad_settings_are_named(field, value):
    scenario = load_scenario("best_side")
    setattr(scenario.planner, field, value)
    with pytest.raises(ScenarioError, match=rf"planner\.{field}"):
        validate(scenario)


@pytest.mark.parametrize(
    "scenario",
    [
        flight([]),
        flight([Sphere([20.0], 1.0)], outputs=1),
        flight([Cylinder([0.1, 4.0], 0.8)], outputs=2),
        flight([Sphere([0.1, 4.0, 0.1], 0.8)]),
    ],
    ids=["empty", "one output", "planar", "ball"],
)
def test_any_kind_of_problem_is_planned(scenario):
    result = plan(scenario)
    assert result.certified, result
    scenario.planner.initial_guess = "straight_line"
    assert result.cost <= 1.02 * plan(scenario).cost
    assert sum(c.chosen for c in result.candidates) == 1


def test_without_sides_the_straight_line_is_the_only_candidate():
    result = plan(flight([Cylinder([0.0, -3.0], 1.0)]))
    assert [c.start for c in result.candidates] == ["straight line"]


@register_model
class Unproven(IntegratorChain):
    """A model whose bounds nobody has proven, so that no plan is certified."""

    bounds_certified = False


def test_sides_matter_for_models_with_unproven_bounds_too():
    pair = [Cylinder([-0.95, 4.0], 0.7), Cylinder([0.95, 4.0], 0.7)]
    model = Unproven(num_outputs=2, order=2)
    scenario = flight([*pair, Cylinder([0.1, 6.0], 0.7)], outputs=2, model=model)
    search = plan(scenario)
    scenario.planner.initial_guess = "straight_line"
    straight = plan(scenario)
    assert search.status == straight.status == "not_certified"
    assert search.cost < 0.9 * straight.cost


def test_a_diagram_plans_on_the_best_side():
    """The search's threads run inside an event of a running simulator."""
    scenario = flight([Cylinder([0.1, 4.0], 0.8)], outputs=2)
    log = Simulate(scenario)
    assert log.status == "certified"
    assert log.tube_ratios.max() <= 1 and log.clearance.min() > 0


def test_the_other_solver_refines_the_same_candidates():
    scenario = flight([Cylinder([0.1, 4.0], 0.8)], outputs=2)
    clarabel = plan(scenario)
    scenario.planner.backend = "ipopt"
    scenario.planner.time_limit = 600.0  # on a busy machine, too
    ipopt = plan(scenario)
    assert clarabel.certified and ipopt.certified
    assert ipopt.backend == "ipopt"
    assert ipopt.cost == pytest.approx(clarabel.cost, rel=0.02)


def test_where_all_is_blocked_the_result_is_the_straight_lines():
    """A wall from side to side, too long to fly around: an honest status."""
    wall = [Cylinder([x, 4.0], 1.0) for x in np.arange(-14.0, 15.0, 1.5)]
    scenario = flight(wall)
    result = plan(scenario)
    scenario.planner.initial_guess = "straight_line"
    alone = plan(scenario)
    assert result.status == alone.status == "infeasible"
    assert result.message == alone.message and result.plan is None
    assert [c.start for c in result.candidates if c.chosen] == ["straight line"]


# Planning again.


def on_the_way(plan_, problem: Problem, time: float) -> Problem:
    reference = plan_.reference(time)
    return dataclasses.replace(
        problem,
        start_time=time,
        duration=plan_.end_time - time,
        start=reference[:2],
        start_highest=reference[2],
        start_bandwidth=plan_.bandwidth(time),
        tube_start=TubeStart.of_error(
            plan_.error_bound(time), plan_.boundary_layer(time), problem.law.slope
        ),
    )


def settings(budget: float = 0.4):
    return dataclasses.replace(
        load_scenario("best_side").planner, time_budget=budget, intervals=28
    )


def test_a_good_plan_is_kept_when_planning_again(best, best_problem):
    again = plan_problem(
        on_the_way(best.plan, best_problem, 2.0), settings(), warm_start=best.plan
    )
    assert again.certified
    assert [c.start for c in again.candidates if c.chosen] == ["earlier plan"]
    end = again.plan.reference(again.plan.sample_times())[:, 0]
    np.testing.assert_allclose(
        end, best.plan.reference(again.plan.sample_times())[:, 0], atol=0.2
    )


def test_a_dear_plan_is_left_for_a_clearly_cheaper_side(known_result, known_problem):
    """Before the first pair of pillars, the way through the gap is left."""
    problem = on_the_way(known_result.plan, known_problem, 0.5)
    again = plan_problem(problem, settings(1.0), warm_start=known_result.plan)
    assert again.certified
    earlier = next(c for c in again.candidates if c.start == "earlier plan")
    assert not earlier.chosen and earlier.status == "certified"
    assert again.cost <= SWITCH * earlier.cost
    reference = known_result.plan.reference(0.5)
    np.testing.assert_allclose(again.plan.reference(0.5), reference, atol=1e-6)


def test_a_search_on_the_way_is_as_safe_and_passes_on_better_sides():
    """Every plan on the way searches; the gap is left for the open side."""
    scenario = load_scenario("receding_horizon")
    scenario.planner.initial_guess = "best_side"
    scenario.planner.time_budget = 0.4
    log = Simulate(scenario)
    assert log.status == "certified"
    assert log.tube_ratios.max() <= 1 and log.clearance.min() > 0
    path = Way.along("-----", log.position)
    assert sides_of(Problem.from_scenario(load_scenario(KNOWN)), path)[:2] != "RL"


# Files and pictures.


def test_the_figure_shows_a_bar_for_every_candidate(best, tmp_path):
    scenario = load_scenario("best_side")
    figure = plot_candidates(
        scenario=scenario, plan=best.plan, candidates=best.candidates
    )
    _, bars = figure.axes
    heights = [bar.get_height() for bar in bars.patches]
    assert len(heights) == len(best.candidates)
    assert min(heights) == pytest.approx(best.cost)
    figure.savefig(tmp_path / "candidates.png")


def test_a_run_writes_the_table_and_the_figure(tmp_path):
    scenario = flight([Cylinder([0.1, 4.0], 0.8)], outputs=2)
    experiment = run(scenario, tmp_path)
    assert (tmp_path / CANDIDATES) in experiment.files
    assert (tmp_path / CANDIDATES).stat().st_size > 10_000
    assert "candidates" in repr(experiment)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert len(summary["candidates"]) == len(experiment.result.candidates) > 1
    assert sum(row["chosen"] for row in summary["candidates"]) == 1
    scenario.planner.initial_guess = "straight_line"
    run(scenario, tmp_path)
    assert not (tmp_path / CANDIDATES).exists()  # nothing of the earlier run is left


# Thirty fields.


@pytest.mark.slow
def test_more_random_fields_are_solved_than_from_the_straight_line():
    found = plan_fields(SEEDS)
    straight = {c.seed for c in found if c.straight.certified}
    search = {c.seed for c in found if c.search.certified}
    assert len(found) == 30
    assert straight <= search
    assert 5 < len(straight) < len(search)  # the set has fields of both kinds
    assert len(search) >= 25
    for c in found:
        if c.straight.certified:
            assert c.search.cost <= c.straight.cost, c


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 16, 18])
def test_a_search_is_never_dearer_among_balls_and_ellipsoids(seed):
    """There, fine programs sometimes end far from where their coarse ones did."""
    scenario = random_scenario(seed)
    straight = plan(scenario)
    scenario.planner.initial_guess = "best_side"
    search = plan(scenario)
    assert straight.certified and search.certified
    assert search.cost <= straight.cost
