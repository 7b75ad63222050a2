"""IPOPT is given true derivatives, and agrees with the convex programs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff

from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.numerics.arrays import jacobian
from dtmpc_drake.obstacles import Cylinder, ObstacleSet
from dtmpc_drake.obstacles.normals import turned
from dtmpc_drake.planning import plan, plan_problem
from dtmpc_drake.planning.ipopt import solver as nlp
from dtmpc_drake.planning.ipopt.rows import ROUNDING, rounded
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.scenario import Planner, load_scenario
from tests.models_for_tests import changed_problem, every_model, make_problem, name_of

GOOD = ("Success", "Stop at acceptable point")


def obstructed(model, **changes):
    """With a cylinder beside the straight line, or with none on a line."""
    cylinders = [Cylinder([1.5, 0.3], 0.4)] if model.num_outputs > 1 else []
    obstacles = ObstacleSet.stack(cylinders, model.num_outputs)
    return make_problem(model, obstacles=obstacles, **changes)


def near_the_start(problem, intervals=6):
    """A program, and values of its variables away from any symmetry."""
    transcription = Transcription(problem, intervals)
    guess = transcription.evaluate(*straight_line(transcription))
    correction = 0.01 * np.ones_like(transcription.tube_states(guess))
    program = nlp._Program(transcription, guess, correction)
    x = program.program.GetInitialGuess(program.x)
    return program, x + np.random.default_rng(1).uniform(0.0, 0.1, x.size)


@pytest.mark.parametrize("margin", ["norm", "support"])
@pytest.mark.parametrize("bound", ["comparison", "paper"])
@pytest.mark.parametrize("model", every_model(), ids=name_of)
def test_derivatives_are_those_of_the_values(model, bound, margin):
    # A low speed limit, so that there are rows for it.
    problem = obstructed(
        model, tube_margin=margin, velocity_bound=bound, speed_limit=0.7
    )
    program, x = near_the_start(problem)
    bindings = [*program.program.GetAllConstraints(), *program.program.GetAllCosts()]
    for binding in bindings:
        evaluator = binding.evaluator()
        point = x[program.program.FindDecisionVariableIndices(binding.variables())]
        given = ExtractGradient(evaluator.Eval(InitializeAutoDiff(point).ravel()))
        size = np.ptp(given)

        def values(batch, evaluator=evaluator):
            flat = batch.reshape(-1, batch.shape[-1])
            rows = np.array([evaluator.Eval(row) for row in flat])
            return rows.reshape(*batch.shape[:-1], -1)

        true = jacobian(values, point[None])[0]
        np.testing.assert_allclose(given, true, atol=1e-6 * (1 + size))
        pattern = evaluator.gradient_sparsity_pattern()
        if pattern is not None:
            told = np.zeros(given.shape, dtype=bool)
            told[tuple(np.transpose(pattern))] = True
            np.testing.assert_array_equal(given[~told], 0.0)


def test_the_layout_holds_an_iterate():
    """What is linear in z, such as the ends, holds where a plan starts."""
    problem = obstructed(DragDoubleIntegrator())
    transcription = Transcription(problem, 8)
    guess = transcription.evaluate(*straight_line(transcription))
    program = nlp._Program(transcription, guess, 0 * transcription.tube_states(guess))
    for binding in program.program.linear_constraints():
        evaluator = binding.evaluator()
        if (evaluator.lower_bound() == evaluator.upper_bound()).all():
            x = program.program.GetInitialGuess(binding.variables())
            value = evaluator.Eval(x)
            np.testing.assert_allclose(value, evaluator.upper_bound(), atol=1e-9)
    x = program.program.GetInitialGuess(program.x)
    same = program.evaluate(program.scale * x)
    assert same.cost == pytest.approx(guess.cost)
    total = sum(
        cost.evaluator().Eval(program.program.GetInitialGuess(cost.variables())).item()
        for cost in program.program.GetAllCosts()
    )
    assert total == pytest.approx(guess.cost)


@pytest.mark.parametrize("fixed", [False, True], ids=["free", "fixed"])
@pytest.mark.parametrize("margin", ["norm", "support"])
@pytest.mark.parametrize(
    "model",
    [IntegratorChain(2, 1, 0.1), DragDoubleIntegrator(0.1, 0.1)],
    ids=name_of,
)
def test_the_cost_is_that_of_the_convex_programs_or_less(model, margin, fixed):
    changes = {"bandwidth_min": np.full(model.num_outputs, 4.0)} if fixed else {}
    problem = obstructed(model, tube_margin=margin, **changes)
    clarabel, ipopt = (
        plan_problem(problem, Planner(intervals=12, backend=backend, time_limit=600.0))
        for backend in ("clarabel", "ipopt")
    )
    assert clarabel.certified and ipopt.certified
    # The convex programs stop when little is left to gain.
    assert 0.93 * clarabel.cost < ipopt.cost < 1.002 * clarabel.cost
    assert {iteration.status for iteration in ipopt.history} <= set(GOOD)


@pytest.mark.parametrize("weight", ["input", "bandwidth"])
def test_a_part_of_the_cost_may_weigh_nothing(weight):
    scenario = load_scenario("known_environment")
    setattr(scenario.cost, weight, 0.0)
    scenario.planner.intervals = 28
    scenario.planner.backend = "ipopt"
    scenario.planner.time_limit = 600.0
    assert plan(scenario).certified


def test_a_model_error_with_kinks_at_rest_is_no_obstacle_to_convergence():
    """The vertical speed is zero at the optimum, where the drag's bound has a kink."""
    scenario = load_scenario("unknown_drag")
    scenario.planner.intervals = 28
    clarabel = plan(scenario)
    scenario.planner.backend = "ipopt"
    scenario.planner.time_limit = 600.0  # on a busy machine, too
    ipopt = plan(scenario)
    assert clarabel.certified and ipopt.certified
    assert {iteration.status for iteration in ipopt.history} <= set(GOOD)
    assert ipopt.cost == pytest.approx(clarabel.cost, rel=0.01)


def test_a_warm_start_is_where_it_starts():
    problem = obstructed(DragDoubleIntegrator())
    settings = Planner(intervals=12, backend="ipopt", time_limit=600.0)
    first = plan_problem(problem, settings)
    again = plan_problem(problem, settings, warm_start=first.plan)
    assert again.certified
    assert again.cost == pytest.approx(first.cost, rel=1e-3)
    assert again.history[0].step < first.history[0].step / 3


def test_a_start_that_must_be_continuous_is_kept():
    """The highest derivative and the bandwidth, as where plans are joined."""
    model = DragDoubleIntegrator()
    given = {"start_highest": np.full(3, 0.2), "start_bandwidth": np.full(3, 1.5)}
    problem = obstructed(model, **given)
    result = plan_problem(
        problem, Planner(intervals=12, backend="ipopt", time_limit=600.0)
    )
    assert result.certified
    np.testing.assert_allclose(result.plan.reference(0.0)[2], 0.2, atol=1e-6)
    np.testing.assert_allclose(result.plan.bandwidth(0.0), 1.5, atol=1e-6)


def test_the_solved_half_planes_are_kept_where_they_are_better():
    """Those that are found without a solver are not the best for this margin."""
    problem = obstructed(IntegratorChain(2, 1, 0.1), tube_margin="support")
    program, x = near_the_start(problem)
    z = program.scale * x
    kept = program.evaluate(z).planes
    found = program.transcription.evaluate(
        program._block(z, "coefficients"),
        program.transcription.bandwidth.feasible(program._block(z, "bandwidth")),
    ).planes
    assert (kept.margin.min(axis=1) >= found.margin.min(axis=1)).all()


def test_turned_normals_have_unit_length():
    generator = np.random.default_rng(0)
    normal = generator.normal(size=(5, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    result = turned(normal, generator.normal(size=(5, 2)))
    np.testing.assert_allclose(np.linalg.norm(result, axis=1), 1.0)
    np.testing.assert_allclose(turned(normal, np.zeros((5, 2))), normal)


def test_a_kink_is_rounded_off_from_above_and_odd_functions_are_left_alone():
    kinked = rounded(lambda x: np.abs(x[..., :1]), signed=1, size=2)
    x = np.linspace(-1.0, 1.0, 201)[:, None] * [1.0, 0.0]
    above = kinked(x)[:, 0] - np.abs(x[:, 0])
    assert (above >= 0).all() and above.max() == pytest.approx(ROUNDING)
    bend = np.diff(kinked(x)[:, 0], 2) / 0.01**2
    assert bend.max() < 1.01 / ROUNDING
    odd = rounded(lambda x: x[..., :1] ** 3, signed=1, size=2)
    np.testing.assert_array_equal(odd(x), x[:, :1] ** 3)


def test_both_backends_look_at_the_speed_in_parts_of_its_limit():
    """Not in m/s: a limit ten times as high is near ten times as early."""
    problem = make_problem(IntegratorChain(2, 2, 0.1))
    fast = changed_problem(problem, speed_limit=10 * problem.speed.bound)
    for each in (problem, fast):
        tr = Transcription(each, 16)
        iterate = tr.evaluate(*straight_line(tr))
        room = np.linspace(0, each.speed.bound, iterate.convex[0].size)
        margin = room.reshape(iterate.convex[0].shape)
        (near,) = tr.near_convex(dataclasses.replace(iterate, convex=[margin]))
        allowed = margin[near].max() / each.speed.bound
        assert 0.2 < allowed < 0.3
        assert not near[1:, 0].any() and near[0, 0].any()
