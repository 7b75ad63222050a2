"""What a plan is charged for, all the time and at its end."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dtmpc_drake.costs import BandwidthCost, Cost, InputCost, StateCost
from dtmpc_drake.costs.weights import matrix_of, root_of, rooted, rooted_rows, square
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning import Problem, plan_problem
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.scp.clarabel import borrowed
from dtmpc_drake.planning.scp.curvature import Multipliers
from dtmpc_drake.planning.scp.linearise import Program, Shape, program_layout
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.scenario import (
    Costs,
    Planner,
    Waypoint,
    parse_scenario,
    to_yaml,
    validate,
)
from tests.costs_for_tests import FIELD, LINE, MATRIX, field, parts, planned, with_cost
from tests.models_for_tests import ThirdOrderPlanar, changed_problem, make_problem

DRAG = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.0)
numbers = st.floats(-3.0, 3.0, allow_nan=False, width=32)


def vectors(size: int) -> st.SearchStrategy[Array]:
    return st.lists(numbers, min_size=size, max_size=size).map(np.array)


def semi_definite(size: int) -> st.SearchStrategy[Any]:
    """A number, a list or a matrix, of any rank."""
    matrix = st.lists(vectors(size), min_size=1, max_size=size).map(
        lambda rows: (np.array(rows).T @ np.array(rows)).tolist()
    )
    positive = st.floats(0.0, 5.0, width=32)
    diagonal = st.lists(positive, min_size=size, max_size=size)
    return st.one_of(positive, diagonal, matrix)


@given(weight=semi_definite(3), x=vectors(3))
def test_a_root_squares_to_its_weight_whatever_its_form(weight, x):
    exact = x @ matrix_of(weight, 3) @ x
    close = {"rtol": 1e-6, "atol": 1e-6}
    np.testing.assert_allclose(square(weight, x), exact, **close)
    root = root_of(weight)
    np.testing.assert_allclose((rooted(root, x) ** 2).sum(), exact, **close)
    rows = np.stack([x, 2 * x], axis=1)
    np.testing.assert_allclose(rooted_rows(root, rows)[:, 0], rooted(root, x), **close)


@settings(deadline=None, max_examples=40)
@given(data=st.data(), n=st.integers(1, 3))
def test_slopes_of_state_costs_are_exact(data, n):
    m = 2
    weights = data.draw(st.lists(semi_definite(m), min_size=n, max_size=n))
    direction = data.draw(
        st.none() | vectors(m).filter(lambda d: np.linalg.norm(d) > 1e-2)
    )
    target, state = (data.draw(vectors(n * m)).reshape(n, m) for _ in range(2))
    law = make_problem(IntegratorChain(m, n)).law
    cost = StateCost.of(weights, target, direction)
    assume(len(cost.roots))
    at, highest = np.stack([state, -state]), np.zeros((2, m))
    exact = cost.slopes(law, at, highest, 0.1)
    general = Cost.slopes(cost, law, at, highest, 0.1)
    for one, other in zip(exact, general, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6, rtol=1e-6)
    across = np.eye(m)
    if direction is not None:
        across -= np.outer(direction, direction) / (direction @ direction)
    away = (state - target) @ across
    wanted = sum(e @ matrix_of(q, m) @ e for e, q in zip(away, weights, strict=True))
    found = (cost.residuals(law, state, highest[0]) ** 2).sum()
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-5)


def test_differences_see_what_depends_on_the_difference_of_two_axes():
    """As a lane does that runs along the diagonal."""
    law, state = make_problem(IntegratorChain(2, 2)).law, np.ones((1, 2, 2))
    cost = StateCost.of([[[1.0, -1.0], [-1.0, 1.0]]], np.zeros((2, 2)))
    found, _ = Cost.slopes(cost, law, state, np.zeros((1, 2)), 0.1)
    assert np.abs(found).max() > 0.5
    np.testing.assert_allclose(found[0], cost.roots, atol=1e-9)


@given(weight=semi_definite(2), rate=semi_definite(2), seed=st.integers(0, 99))
def test_the_bandwidths_cost_is_that_of_a_line_between_knots(weight, rate, seed):
    """Its rate is constant between knots, so that its integral is exact."""
    alpha = np.random.default_rng(seed).uniform(0.5, 4.0, (6, 2))
    step, trapezoid = 0.25, np.array([0.5, 1, 1, 1, 1, 0.5])
    cost = BandwidthCost(weight, 0.5, rate)
    total = step * trapezoid @ cost.running(alpha, step)
    moving = np.diff(alpha, axis=0) / step
    exact = step * sum(v @ matrix_of(rate, 2) @ v for v in moving)
    of_level = [a @ matrix_of(weight, 2) @ a for a in alpha - 0.5]
    np.testing.assert_allclose(total, exact + step * trapezoid @ of_level, rtol=1e-6)
    of_rate = cost.rate_hessian(2, step)
    ends = np.concatenate([alpha[:-1], alpha[1:]], axis=1)
    half = sum(x @ of_rate @ x for x in ends) / 2
    np.testing.assert_allclose(half, exact, rtol=1e-6, atol=1e-9)


def test_a_number_a_list_and_a_matrix_of_the_same_are_the_same_plan():
    costs = [
        planned(with_cost(text)).cost
        for text in (
            "{input: 2.0, bandwidth: 0.1}",
            "{input: [2.0, 2.0], bandwidth: [0.1, 0.1]}",
            "{input: [[2.0, 0], [0, 2.0]], bandwidth: [[0.1, 0], [0, 0.1]]}",
        )
    ]
    assert costs == pytest.approx([costs[0]] * 3, rel=1e-6)


def every_cost(model) -> Problem:
    """All kinds at once, with weights that are matrices."""
    n, m = model.order, model.num_outputs
    matrix = 0.5 * np.eye(m) + 0.1
    problem = make_problem(model)
    target = problem.goal + 0.3
    return dataclasses.replace(
        problem,
        costs=(
            InputCost(matrix),
            StateCost.of([matrix] * n, target),
            StateCost.of([0.7], target, np.arange(1.0, m + 1)),
        ),
        bandwidth_cost=BandwidthCost(matrix, 0.5, 0.2 * matrix),
        terminal=(StateCost.of([3.0 * matrix, 1.0], target),),
        soft=(0, 1),
    )


def test_the_programs_model_of_the_cost_is_exact_where_the_cost_is_quadratic():
    """Of a chain without drift all residuals are linear in the decisions."""
    tr = Transcription(every_cost(IntegratorChain(3, 2)), 12)
    random = np.random.default_rng(3)
    coefficients, alpha = straight_line(tr)
    alpha = alpha - random.uniform(0.0, 0.5, alpha.shape)
    coefficients = coefficients + random.normal(0.0, 0.3, coefficients.shape)
    iterate = tr.evaluate(coefficients, alpha)
    v = Variables(tr, planes=0, kinked=np.zeros(0, dtype=int))
    with borrowed(program_layout(tr, v)) as solver:
        program = Program(tr, v, solver, Multipliers.none(tr, iterate), accuracy=1e-6)
        program.update(iterate, Shape(penalty=1e3, secant=0.1))
        z = random.normal(0.0, 0.2, v.size)
        changes = (
            z[v.blocks[name]].reshape(-1, tr.outputs)
            for name in ("coefficients", "bandwidth")
        )
        moved = (
            old + new for old, new in zip((coefficients, alpha), changes, strict=True)
        )
        reached = tr.evaluate(*moved).cost
        assert program.model_cost(np.zeros(v.size)) == pytest.approx(iterate.cost)
        assert program.model_cost(z) == pytest.approx(reached, rel=1e-9)
        # What the solver is given is the same function: half z'Pz + q'z.
        given = sum(
            cost.evaluator().Eval(z[program_variables(cost)])[0]
            for cost in solver._program.quadratic_costs()
            if program_variables(cost)[0] < v.blocks["bandwidth"].stop
        )
        assert iterate.cost + given == pytest.approx(reached, rel=1e-6)


def program_variables(binding) -> Array:
    """The indices of a binding's variables."""
    return np.array([int(x.get_name()[2:-1]) for x in binding.variables()])


@pytest.mark.parametrize("model", [DRAG, ThirdOrderPlanar()], ids=["drag", "third"])
def test_slopes_of_every_cost_are_those_of_its_value(model):
    """The gradient of a plan's cost, against differences along random decisions."""
    tr = Transcription(every_cost(model), 12)
    random = np.random.default_rng(5)
    coefficients, alpha = straight_line(tr)
    coefficients = coefficients + random.normal(0.0, 0.3, coefficients.shape)
    along = random.normal(size=coefficients.shape), random.normal(size=alpha.shape)

    def cost(by: float) -> float:
        return tr.evaluate(coefficients + by * along[0], alpha + by * along[1]).cost

    iterate = tr.evaluate(coefficients, alpha)
    v = Variables(tr, planes=0, kinked=np.zeros(0, dtype=int))
    with borrowed(program_layout(tr, v)) as solver:
        program = Program(tr, v, solver, Multipliers.none(tr, iterate), accuracy=1e-6)
        program.update(iterate, Shape(penalty=1e3, secant=1e-4))
        z = np.zeros(v.size)
        z[v.blocks["coefficients"]], z[v.blocks["bandwidth"]] = map(np.ravel, along)
        h = 1e-5
        model_slope = (program.model_cost(h * z) - program.model_cost(-h * z)) / (2 * h)
    assert model_slope == pytest.approx((cost(h) - cost(-h)) / (2 * h), rel=1e-4)


KINDS = {
    "input by a list": ("{input: [4.0, 1.0], bandwidth: [0.1, 0.3]}", False),
    "matrices": (f"{{input: {MATRIX}, bandwidth: [[0.2, 0.1], [0.1, 0.1]]}}", False),
    "bandwidth rate": ("{bandwidth_rate: 0.5}", False),
    "state": ("{state: {position: 0.2, velocity: [0.1, 0.3]}}", False),
    "line": (
        "{state: {position: 2.0, line: {point: [0.3, 0], direction: [0, 2]}}}",
        False,
    ),
    "soft position": ("{terminal: {position: 2.0}}", ["position"]),
    "soft": (f"{{terminal: {{position: {MATRIX}, velocity: 1.0}}}}", True),
    "free velocity": ("{}", ["velocity"]),
}


@pytest.mark.parametrize("text, soft", KINDS.values(), ids=KINDS)
def test_both_backends_agree_on_every_kind_of_cost(text, soft):
    costs = []
    for backend in ("clarabel", "ipopt"):
        scenario = with_cost(text, soft=soft, backend=backend)
        # So near that what is left is not what iterations stop at.
        scenario.planner.options = dataclasses.replace(
            scenario.planner.options, tolerance=5e-3
        )
        result = planned(scenario)
        assert sum(parts(scenario, result).values()) == pytest.approx(result.cost)
        costs.append(result.cost)
    assert costs[0] == pytest.approx(costs[1], rel=0.02)


@pytest.mark.parametrize(
    "text, soft, term",
    [
        ("{input: 0.5, bandwidth: W}", False, "bandwidth"),
        ("{input: 2.0, bandwidth: 0.1, bandwidth_rate: W}", False, "bandwidth"),
        ("{state: {position: W}}", False, "state"),
        ("{terminal: {position: W}}", True, "terminal"),
    ],
)
def test_what_weighs_more_is_less(text, soft, term):
    """A term, over its weight, falls as the weight grows."""
    measure = {}
    for weight in (0.3, 3.0):
        scenario = with_cost(text.replace("W", str(weight)), soft=soft)
        result = planned(scenario)
        if "rate" in text:
            alpha = result.plan.bandwidth_knots
            measure[weight] = float((np.diff(alpha, axis=0) ** 2).sum())
        else:
            measure[weight] = parts(scenario, result)[term] / weight
    assert measure[3.0] < 0.9 * measure[0.3]


def test_an_axis_that_costs_more_bears_less():
    """Of two equal ways an obstacle is passed by the cheaper axis' motion."""
    used = []
    for weight in ([4.0, 1.0], [1.0, 4.0]):
        problem = dataclasses.replace(
            make_problem(IntegratorChain(2, 2)),
            costs=(InputCost(weight), StateCost.of([1.0], np.ones((2, 2)))),
        )
        result = plan_problem(problem, Planner(intervals=16))
        assert result.certified
        used.append((result.plan.reference(result.plan.knots)[:, 2] ** 2).sum(axis=0))
    assert used[0][0] < used[1][0] and used[1][1] < used[0][1]


def test_a_line_draws_to_itself_and_lets_go_along_it():
    far, near = (
        planned(with_cost(f"{{state: {{position: {w}, velocity: {w}, {LINE}}}}}"))
        for w in (0.01, 10.0)
    )
    time = np.linspace(0.0, 6.0, 50)
    away = [abs(r.plan.reference(time)[:, 0, 0] - 0.3).mean() for r in (far, near)]
    assert away[1] < 0.8 * away[0]
    cost = Problem.from_scenario(
        with_cost(f"{{state: {{position: 1.0, velocity: 1.0, {LINE}}}}}")
    ).costs[1]
    on_it = np.array([[0.3, 4.0], [0.0, 2.0]])
    law = make_problem(IntegratorChain(2, 2)).law
    np.testing.assert_allclose(cost.residuals(law, on_it, np.zeros(2)), 0.0, atol=1e-12)


# Input.

REFUSED = {
    "negative number": ("{input: -2}", "cost.input: got -2, .* at least 0"),
    "negative entry": ("{bandwidth: [0.1, -1]}", r"cost.bandwidth\[1\]: got -1"),
    "short list": ("{input: [1]}", r"cost.input: got \[1\], .* 2 numbers"),
    "nothing": ("{input: []}", r"cost.input: got \[\], .* 2 numbers"),
    "ragged": ("{bandwidth_rate: [[1, 0], [0]]}", r"cost.bandwidth_rate: .* 2 rows"),
    "asymmetric": (
        "{state: {position: [[1, 0.5], [0, 1]]}}",
        r"state.position\[0\]\[1\]: got 0.5, .* 0 as in .*\[1\]\[0\]: .* symmetric",
    ),
    "indefinite": (
        "{terminal: {velocity: [[1, 2], [2, 1]]}}",
        "cost.terminal.velocity: .* positive semi-definite: .* eigenvalue is -1",
    ),
    "no number": ("{input: much}", "cost.input: got 'much', .* a number"),
    "deeper": ("{input: [[[1]]]}", "cost.input: .* a number or a list of numbers or"),
    "order": ("{state: {acceleration: 1}}", "acceleration: got 1, .* order 2"),
    "no direction": (
        "{state: {position: 1, line: {point: [0, 0], direction: [0, 0]}}}",
        r"cost.state.line.direction: got \[0, 0\], .* longer than 0",
    ),
    "half a line": ("{state: {line: {point: [0, 0]}}}", "line.direction: .* missing"),
    "line of three": (
        "{state: {line: {point: [0, 0, 0], direction: [0, 1]}}}",
        "line.point: .* 2 numbers",
    ),
    "line at the end": (
        "{terminal: {position: 1, line: {point: [0, 0], direction: [0, 1]}}}",
        "cost.terminal.line: .* left out",
    ),
}


@pytest.mark.parametrize("text, message", REFUSED.values(), ids=REFUSED)
def test_a_weight_that_is_none_is_refused_by_name(text, message):
    with pytest.raises(ScenarioError, match=message):
        with_cost(text)


@pytest.mark.parametrize(
    "soft, message",
    [
        ("[speed]", r"goal.soft\[0\]: got 'speed', .* position, velocity"),
        ("[acceleration]", r"goal.soft\[0\]: got 'acceleration'"),
        ("velocity", "goal.soft: got 'velocity', .* true/false or a list of names"),
        ("2", "goal.soft: got 2, .* true/false"),
    ],
)
def test_what_is_soft_is_named(soft, message):
    text = FIELD.replace("velocity: [0, 0.5]", f"velocity: [0, 0.5], soft: {soft}")
    with pytest.raises(ScenarioError, match=message):
        parse_scenario(text)


def test_only_a_goal_is_soft():
    scenario = field()
    scenario.start = Waypoint(position=[0.0, 0.0], soft=True)
    with pytest.raises(ScenarioError, match=r"start.soft: got True, .* only a goal"):
        validate(scenario)


def test_costs_come_back_from_a_file_as_they_were():
    scenario = with_cost(
        f"{{input: {MATRIX}, bandwidth: [0.1, 0.2], bandwidth_rate: 0.3,"
        f" state: {{position: 1.0, {LINE}}}, terminal: {{velocity: [1.0, 2.0]}}}}",
        soft=["velocity"],
    )
    again = parse_scenario(to_yaml(scenario))
    assert again.cost == scenario.cost and again.goal == scenario.goal
    assert "soft" not in to_yaml(field())
    # Arrays of NumPy are as good as lists.
    scenario.cost = Costs(input=np.eye(2))  # type: ignore[arg-type]
    assert parse_scenario(to_yaml(scenario)).cost.input == [[1.0, 0.0], [0.0, 1.0]]
    assert planned(scenario).certified


def test_a_fixed_bandwidth_has_no_rate_to_pay_for():
    problem = changed_problem(
        make_problem(IntegratorChain(2, 2)),
        bandwidth_min=np.full(2, 2.0),
        bandwidth_max=np.full(2, 2.0),
    )
    problem = dataclasses.replace(problem, bandwidth_cost=BandwidthCost(0.1, 0.5, 9.0))
    free = dataclasses.replace(problem, bandwidth_cost=BandwidthCost(0.1, 0.5))
    costs = [plan_problem(p, Planner(intervals=12)).cost for p in (problem, free)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)
