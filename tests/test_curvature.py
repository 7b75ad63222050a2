"""What programs linearise away is the Hessian of the norms, priced."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dtmpc_drake.numerics import splines
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.obstacles.normals import tangent_space
from dtmpc_drake.planning import Problem, plan
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.scp.clarabel import borrowed
from dtmpc_drake.planning.scp.curvature import (
    LOSS,
    Multipliers,
    rotation_curvature,
    sampled_curvature,
    tube_curvature,
)
from dtmpc_drake.planning.scp.linearise import (
    Program,
    Shape,
    _needed,
    kinked_coordinates,
    program_layout,
)
from dtmpc_drake.planning.scp.sensitivity import transitions
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.scenario import Planner, Scenario, Waypoint, load_scenario
from tests.models_for_tests import changed_problem


@pytest.fixture(scope="module")
def around():
    """An iterate beside obstacles, the programs' variables, and random prices."""
    tr = Transcription(Problem.from_scenario(load_scenario("unknown_drag")), 28)
    wiggle = 0.3 * np.sin(np.arange(29 + 2)[:, None] + np.arange(3))
    coefficients, bandwidth = straight_line(tr)
    iterate = tr.evaluate(tr.ends.met_by(coefficients + wiggle), bandwidth)
    variables = Variables(tr, planes=len(iterate.planes), kinked=kinked_coordinates(tr))
    random = np.random.default_rng(2)
    none = Multipliers.none(tr, iterate)
    prices = Multipliers(
        random.uniform(0, 1, none.planes.shape),
        tuple(random.uniform(0, 1, own.shape) for own in none.sampled),
    )
    return tr, iterate, variables, prices


def second_difference(function, step: float) -> float:
    return float((function(step) - 2 * function(0.0) + function(-step)) / step**2)


def test_the_inputs_curvature_is_that_of_its_norm(around):
    tr, iterate, _, prices = around
    hessian = sampled_curvature(tr, iterate, prices)
    random = np.random.default_rng(3)
    (price,) = prices.sampled
    price = price[:, 0]
    nodes = np.arange(len(price) - 1)
    piece, _ = tr.within(nodes)
    for chosen in (0, 9, tr.intervals - 1):
        move = random.normal(size=(tr.degree + 1, tr.outputs))
        here = nodes[piece == chosen]
        by = splines.applied(tr.basis_at(here)[:, tr.order], move)

        def priced(t: float, here=here, by=by) -> float:
            highest = iterate.reference[2 * here, tr.order] + t * by
            return price[here] @ np.linalg.norm(highest, axis=1)

        curve = second_difference(priced, 1e-4)
        flat = move.ravel()
        assert flat @ hessian[chosen] @ flat == pytest.approx(curve, rel=1e-3)


def test_the_tubes_curvature_is_that_of_its_size(around):
    tr, iterate, variables, prices = around
    planes = iterate.planes
    hessian = tube_curvature(tr, iterate, planes, variables, prices)
    random = np.random.default_rng(4)
    assert len(planes.piece) > 20
    for chosen in np.unique(planes.piece)[::5]:
        move = random.normal(size=hessian.shape[1])
        rows = np.flatnonzero(planes.piece == chosen)

        def priced(t: float, chosen=chosen, rows=rows, move=move) -> float:
            tube = iterate.tube_controls[chosen] + t * variables.tube_matrix @ move
            H = np.abs(tr.problem.obstacles.shape[planes.obstacle[rows]])
            size = np.linalg.norm(np.einsum("pij,cj->pci", H, tube), axis=-1)
            return (prices.planes[chosen, planes.obstacle[rows]] * size).sum()

        curve = second_difference(priced, 1e-4)
        assert move @ hessian[chosen] @ move == pytest.approx(curve, rel=1e-3)


def test_a_turned_half_plane_loses_what_is_priced(around):
    _, iterate, _, prices = around
    planes = iterate.planes
    priced = rotation_curvature(planes, prices) / LOSS
    turn = 1e-3
    normal = planes.normal + turn * tangent_space(planes.normal)[:, 0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    back = planes.normal - turn * tangent_space(planes.normal)[:, 0]
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    price = prices.planes[planes.piece, planes.obstacle]
    change = normal + back - 2 * planes.normal
    along = np.einsum("pci,pi->pc", planes.hull, planes.normal)
    outside = (along > 0).all(axis=1)
    lost = -(price * np.einsum("pci,pi->pc", planes.hull, change)).sum(1) / turn**2
    assert outside.sum() > 10
    np.testing.assert_allclose(priced[outside], lost[outside], rtol=1e-4)


def test_prices_are_shared_by_the_rows_of_a_finer_grid(around):
    tr, _, _, prices = around
    twice = Transcription(tr.problem, 2 * tr.intervals)
    finer = prices.refined(twice, twice.evaluate(*straight_line(twice)))
    assert finer.planes.sum() == pytest.approx(prices.planes.sum())
    (own,), (input_prices,) = finer.sampled, prices.sampled
    assert own[:-1].sum() == pytest.approx(input_prices[:-1].sum())
    at = own[:-1].reshape(tr.intervals, -1).sum(axis=1)
    before = input_prices[:-1].reshape(tr.intervals, -1).sum(axis=1)
    np.testing.assert_allclose(at, before)


def test_states_are_left_out_only_after_the_last_row_that_looks():
    # State 0 follows from 1, and 1 from 2.
    links = np.array([[1, 1, 0], [0, 1, 1], [0, 0, 1]], dtype=bool)
    read = np.zeros((6, 3), dtype=bool)
    read[3, 0] = read[4, 2] = True
    needed = _needed(read, links)
    assert needed[:4].all()
    assert needed[4].tolist() == [False, False, True]
    assert not needed[5].any()


def straight_cruise(input_limit: float) -> Scenario:
    """Nearly no acceleration on the way, but drag near the input's limit."""
    scenario = load_scenario("unknown_drag")
    return dataclasses.replace(
        scenario,
        start=Waypoint(position=[0.0, 0.0, 0.0]),
        goal=Waypoint(position=[0.0, 40.0, 0.0]),
        duration=20.0,
        obstacles=[Cylinder([-0.6, 20.0], 0.8)],
        limits=dataclasses.replace(scenario.limits, input=input_limit),
        planner=Planner(intervals=40),
    )


def test_steps_through_the_inputs_apex_keep_their_promise():
    """y*^(n) turns round within the step, which one slope of its norm does not see."""
    scenario = straight_cruise(6.0)
    scenario.model.drag_error_bound = 0.0  # so that the tube stays as it is
    tr = Transcription(Problem.from_scenario(scenario), 40)
    start = straight_line(tr)
    middle = slice(10 * tr.tube_steps, 30 * tr.tube_steps)
    used = tr.problem.input.bound - tr.evaluate(*start).sampled[0][middle]
    limit = float(used.max()) + 0.02
    tr = Transcription(changed_problem(tr.problem, input_limit=limit), 40)
    base = tr.evaluate(*start)
    variables = Variables(tr, planes=len(base.planes.piece), kinked=np.zeros(0, int))
    z = np.zeros(variables.size)
    wiggle = 0.03 * np.sin(np.arange(20)[:, None] + np.array([0.0, 1.0, 2.0]))
    first = variables.blocks["coefficients"].start + 11 * 3
    z[first : first + wiggle.size] = wiggle.ravel()
    with borrowed(program_layout(tr, variables)) as solver:
        program = Program(
            tr, variables, solver, Multipliers.none(tr, base), accuracy=1e-6
        )
        program.update(base, Shape(1e3, 1e-3))
    reached = tr.evaluate(start[0] + z[: start[0].size].reshape(-1, 3), start[1])
    promised, _ = program.margins_after(z, reached)

    (block,) = program._sampled
    nodes, cuts = block.nodes, block._facets.place
    lowest = promised[: len(nodes)].copy()
    np.minimum.at(lowest, cuts, promised[len(nodes) : len(nodes) + len(cuts)])
    size = np.linalg.norm(reached.reference[2 * nodes, tr.order], axis=1)
    inside = (nodes > middle.start) & (nodes < middle.stop)
    inside &= (nodes % tr.tube_steps == 0) & (size > 0.05)
    assert inside.sum() > 10
    scale = tr.problem.input.scale
    actual = reached.sampled[0][nodes, 0] / scale
    # Six directions see at least 1/sqrt(3) of a norm; one alone may miss all of it.
    missed = ((lowest - actual) * scale)[inside] / size[inside]
    alone = ((promised[: len(nodes)] - actual) * scale)[inside] / size[inside]
    assert missed.max() < 1 - 1 / np.sqrt(3) + 0.05
    assert alone.max() > 0.9


def test_a_cruise_near_the_inputs_limit_converges_in_a_few_programs():
    result = plan(straight_cruise(6.0))
    assert result.certified, result.message
    assert len(result.history) <= 12


@pytest.mark.parametrize("tube_margin", ["norm", "support"])
def test_turning_half_planes_are_predicted_to_first_order(tube_margin):
    """With `support` the tube's extent turns with its half-plane."""
    scenario = load_scenario("known_environment")
    scenario.planner.tube_margin = tube_margin
    tr = Transcription(Problem.from_scenario(scenario), 28)
    wiggle = 0.3 * np.sin(np.arange(29 + 2)[:, None] + np.arange(3))
    coefficients, bandwidth = straight_line(tr)
    base = tr.evaluate(tr.ends.met_by(coefficients + wiggle), bandwidth)
    variables = Variables(tr, planes=len(base.planes.piece), kinked=np.zeros(0, int))
    z = np.zeros(variables.size)
    z[variables.blocks["rotation"]] = 1e-3
    with borrowed(program_layout(tr, variables)) as solver:
        program = Program(
            tr, variables, solver, Multipliers.none(tr, base), accuracy=1e-6
        )
        program.update(base, Shape(1e3, 0.1))
    promised, actual = program.margins_after(z, base)
    assert len(base.planes.piece) > 20
    assert np.abs(promised - program.margins_now).max() > 5e-4
    assert np.abs(promised - actual).max() < 2e-5


@pytest.mark.parametrize("slope", [2.0, 60.0])
def test_the_tube_answers_along_each_piece_as_predicted(slope):
    """Between the knots, too; with a fast cascade the derivatives are implicit."""
    scenario = load_scenario("unknown_drag")
    scenario.controller.slope = [slope] * 3
    tr = Transcription(Problem.from_scenario(scenario), 28)
    assert tr.is_stiff == (slope > 10)
    coefficients, bandwidth = straight_line(tr)
    wave = np.sin(np.arange(len(coefficients))[:, None] + np.arange(3))
    coefficients = tr.ends.met_by(coefficients + 0.02 * wave)
    bandwidth = bandwidth - 1.0
    base = tr.evaluate(coefficients, bandwidth)
    sensitivity = transitions(tr, base, secant=1e-6)
    piece, step = 9, 1e-5
    S = sensitivity.shape[2]
    for knot, axis in ((piece, 0), (piece + 1, 1)):
        moved = bandwidth.copy()
        moved[knot, axis] += step
        ahead = tr.evaluate(coefficients, moved)
        stride = tr.tube_steps // tr.substeps
        nodes = piece * tr.tube_steps + stride * np.arange(tr.substeps + 1)
        actual = tr.tube_states(ahead, 1)[nodes] - tr.tube_states(base, 1)[nodes]
        actual = actual.reshape(len(nodes), S) / step
        column = S + (knot - piece) * 3 + axis
        # What the pieces before have left in the states at the start.
        predicted = sensitivity[piece, :, :, :S] @ actual[0]
        predicted = predicted + sensitivity[piece, :, :, column]
        scale = np.abs(actual).max()
        np.testing.assert_allclose(predicted, actual, atol=0.03 * scale)


def test_a_steps_own_half_planes_are_kept_where_they_part_more():
    scenario = load_scenario("known_environment")
    scenario.planner.tube_margin = "support"
    tr = Transcription(Problem.from_scenario(scenario), 28)
    coefficients, bandwidth = straight_line(tr)
    wiggle = 0.3 * np.sin(np.arange(len(coefficients))[:, None] + np.arange(3))
    decisions = tr.ends.met_by(coefficients + wiggle), bandwidth
    found = tr.evaluate(*decisions).planes
    random = np.random.default_rng(5)
    turned = found.normal + 0.05 * random.normal(size=found.normal.shape)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    hint = dataclasses.replace(found, normal=turned)
    hinted = tr.evaluate(*decisions, hint=hint).planes
    iterate = tr.evaluate(*decisions)
    alone = hint.at(iterate.controls, iterate.tube_controls).margin.min(axis=1)
    best = np.maximum(found.margin.min(axis=1), alone)
    np.testing.assert_allclose(hinted.margin.min(axis=1), best, atol=1e-12)
    assert (alone > found.margin.min(axis=1) + 1e-6).any()
    nothing = hint.nearer_than(-np.inf)
    same = tr.evaluate(*decisions, hint=nothing).planes
    np.testing.assert_array_equal(same.normal, found.normal)
