"""A goal that draws to itself, but need not be met."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.experiments.compare import currency, currency_text
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import Problem, certify, plan, plan_problem, replan
from dtmpc_drake.scenario import Scenario, load_scenario, validate
from dtmpc_drake.visualization import plot_plan
from dtmpc_drake.visualization.figures.view import View
from tests.costs_for_tests import LINE, MATRIX, field, parts, planned, with_cost


def test_a_soft_goal_is_missed_by_what_its_weight_is_worth():
    missed = []
    for weight in (0.5, 5.0, 50.0):
        scenario = with_cost(f"{{terminal: {{position: {weight}}}}}", soft=["position"])
        result = planned(scenario)
        end = result.plan.reference(6.0)
        np.testing.assert_allclose(end[1], [0.0, 0.5], atol=1e-6)  # still asked for
        missed.append(np.linalg.norm(end[0] - [0.3, 6.0]))
        assert "ends" in result.certificate.margins
    assert missed[0] > 3 * missed[1] > 9 * missed[2] > 0


def test_at_the_end_the_slope_of_the_terminal_cost_is_paid_by_the_rest():
    """At the optimum no shift of the goal's price is left: R_f e = the multiplier."""
    scenario = with_cost("{terminal: {position: 2.0}}", soft=["position"])
    scenario.planner.options = dataclasses.replace(
        scenario.planner.options, tolerance=1e-4
    )
    soft = planned(scenario)
    end = soft.plan.reference(6.0)[0]
    slope, h = 2 * 2.0 * (end - [0.3, 6.0]), 0.02
    found = []
    for i in range(2):
        costs = []
        for sign in (1.0, -1.0):
            hard = field(position=(end + sign * h * np.eye(2)[i]).tolist())
            hard.planner.options = scenario.planner.options
            costs.append(planned(hard).cost)
        found.append((costs[0] - costs[1]) / (2 * h))
    np.testing.assert_allclose(found, -slope, rtol=0.1, atol=0.02)


def test_what_is_soft_and_costs_nothing_is_free():
    """The cheapest way is then not to go at all."""
    result = planned(with_cost("{}", soft=True))
    assert result.cost < 0.2 * planned(field()).cost
    assert result.plan.reference(6.0)[0, 1] < 4.0


def test_a_terminal_weight_of_what_is_met_anyway_charges_nothing():
    hard = planned(with_cost("{terminal: {position: 5.0, velocity: 5.0}}"))
    assert hard.cost == pytest.approx(planned(field()).cost, rel=1e-9)


def test_a_soft_goal_may_be_where_no_plan_could_end():
    """In an obstacle, too far away, too fast: it only draws."""
    inside = with_cost("{terminal: {position: 2.0}}", soft=True)
    inside.obstacles = [Cylinder([0.3, 6.0], 0.7)]
    result = planned(inside)
    assert result.certificate.margins["obstacles"].value >= 0
    assert np.linalg.norm(result.plan.reference(6.0)[0] - [0.3, 6.0]) > 0.7
    far = with_cost("{terminal: {position: 0.1}}", soft=True)
    far.goal.position, far.goal.velocity = [0.0, 40.0], [0.0, 9.0]
    assert planned(far).plan.reference(6.0)[0, 1] > 6.0
    for scenario, field_ in ((inside, "goal.position"), (far, "goal.velocity")):
        scenario.goal.soft = False
        with pytest.raises(ScenarioError, match=field_):
            validate(scenario)


def test_a_warm_start_and_a_search_for_sides_go_to_a_soft_goal():
    scenario = with_cost("{terminal: {position: 2.0}}", soft=["position"])
    first = planned(scenario)
    again = plan(scenario, warm_start=first.plan)
    assert again.certified and again.cost == pytest.approx(first.cost, rel=0.02)
    scenario.planner.initial_guess, scenario.planner.time_budget = "best_side", 0.2
    best = planned(scenario)
    assert len(best.candidates) > 1 and best.cost <= 1.02 * first.cost


def test_a_stop_is_a_stop_whatever_the_goal():
    scenario = with_cost(
        "{state: {position: 0.5}, terminal: {position: 2.0, velocity: 1.0}}", soft=True
    )
    stop = Problem.from_scenario(scenario).to_rest()
    assert stop.goal_rows == [1] and not stop.terminal and len(stop.costs) == 1
    result = plan_problem(stop, scenario.planner)
    assert result.certified
    np.testing.assert_allclose(result.plan.reference(6.0)[1], 0.0, atol=1e-6)
    # One along a line is not of the goal.
    lane = with_cost(f"{{state: {{position: 1.0, {LINE}}}}}")
    assert len(Problem.from_scenario(lane).to_rest().costs) == 2


@pytest.mark.parametrize("soft", [["position"], True], ids=["position", "all"])
def test_after_a_stop_a_new_plan_goes_to_the_soft_goal_again(soft):
    scenario = with_cost("{terminal: {position: 5.0, velocity: 1.0}}", soft=soft)
    scenario.goal.velocity, scenario.planner.replan_period = [0.0, 0.0], 1.0
    known = scenario.known_at_start()
    problem = Problem.from_scenario(scenario, known)
    short = dataclasses.replace(problem.to_rest(), duration=3.0)
    stop = plan_problem(short, dataclasses.replace(scenario.planner, intervals=10))
    assert stop.certified and stop.plan.reference(3.0)[0, 1] < 1.0
    decision = replan(
        scenario,
        stop.plan,
        known=known,
        measured_at=0.5,
        state=stop.plan.reference(0.5)[:2],
        start=0.7,
        news=False,
    )
    assert decision.status == "certified", decision.message
    assert decision.plan.reference(6.0)[0, 1] > 4.0
    # What goes there is gone on with.
    later = replan(
        scenario,
        decision.plan,
        known=known,
        measured_at=1.5,
        state=decision.plan.reference(1.5)[:2],
        start=1.7,
        news=False,
    )
    assert later.status == "certified"
    assert later.plan.reference(6.0)[0, 1] > 4.0
    assert later.iterations < decision.iterations


def test_pictures_show_a_soft_goal_and_tables_what_is_charged():
    scenario = with_cost(
        f"{{input: {MATRIX}, bandwidth_rate: 0.5, terminal: {{position: 2.0}}}}",
        soft=["position"],
    )
    result = planned(scenario)

    def labels(scenario: Scenario) -> list[str]:
        (legend,) = plot_plan(scenario=scenario, plan=result.plan).legends
        return [text.get_text() for text in legend.get_texts()]

    assert "soft goal" in labels(scenario)
    assert "soft goal" not in labels(field())
    view = View.of(scenario, result.plan, "bandwidth")
    low, high = view.window()
    goal = view.seen(np.array(scenario.goal.position))
    assert (low < goal).all() and (goal < high).all()
    line, _ = currency_text(scenario)
    assert "(u*)'[[2, 1], [1, 2]](u*) + 0.1‖α − 0.5‖² + 0.5‖dα/dt‖² dt" in line
    assert "dt + 2‖y*(t_f) − goal‖², with α" in line
    assert currency(scenario)["terminal_weights"]["position"] == 2.0


def test_the_proof_asks_for_nothing_that_is_soft_and_for_all_else():
    scenario = with_cost("{terminal: {position: 2.0}}", soft=["position"])
    result, problem = planned(scenario), Problem.from_scenario(scenario)
    hard = dataclasses.replace(problem, soft=())
    assert certify(result.plan, hard).broken == ("ends",)
    elsewhere = problem.goal.copy()
    elsewhere[1, 0] = 0.1
    faster = dataclasses.replace(problem, goal=elsewhere)
    assert certify(result.plan, faster).broken == ("ends",)


def test_charges_name_what_a_plan_costs():
    scenario = with_cost(
        "{bandwidth_rate: 0.1, state: {velocity: 0.1}, terminal: {position: 2.0}}",
        soft=True,
    )
    result = planned(scenario)
    found = parts(scenario, result)
    assert set(found) == {"input", "bandwidth", "state", "terminal"}
    assert min(found.values()) > 0
    assert sum(found.values()) == pytest.approx(result.cost)


def test_the_shipped_soft_goal_does_what_its_first_lines_say():
    scenario = load_scenario("soft_goal")
    result, hard = planned(scenario), planned(load_scenario("known_environment"))
    beside, before, _ = result.plan.reference(14.0)[0] - [0.0, 25.0, 1.0]
    assert beside == pytest.approx(0.51, abs=0.01)
    assert before == pytest.approx(-0.42, abs=0.01)
    assert result.cost == pytest.approx(15.64, abs=0.01) and result.cost < hard.cost
    found = parts(scenario, result)
    assert found["terminal"] == pytest.approx(0.87, abs=0.01)
    assert found["terminal"] == pytest.approx(2 * (beside**2 + before**2))
