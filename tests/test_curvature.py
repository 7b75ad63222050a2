"""What programs linearise away is the Hessian of the norms, priced."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dtmpc_drake.planning import Problem, plan
from dtmpc_drake.planning.curvature import (
    LOSS,
    Multipliers,
    input_curvature,
    rotation_curvature,
    tube_curvature,
)
from dtmpc_drake.planning.qp import borrowed
from dtmpc_drake.planning.scp import (
    Program,
    Shape,
    _needed,
    kinked_coordinates,
    tangent_space,
)
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.planning.variables import Variables
from dtmpc_drake.scenario import (
    Cylinder,
    Planner,
    Scenario,
    Waypoint,
    load_scenario,
)


@pytest.fixture(scope="module")
def around():
    """An iterate beside obstacles, the programs' variables, and random prices."""
    tr = Transcription(Problem.from_scenario(load_scenario("unknown_drag")), 28)
    wiggle = 0.3 * np.sin(np.arange(29 + 2)[:, None] + np.arange(3))
    coefficients, bandwidth = tr.straight_line()
    iterate = tr.evaluate(tr.with_ends(coefficients + wiggle), bandwidth)
    variables = Variables(
        tr, planes=len(iterate.planes.piece), kinked=kinked_coordinates(tr)
    )
    random = np.random.default_rng(2)
    none = Multipliers.none(tr)
    prices = Multipliers(
        random.uniform(0, 1, none.planes.shape), random.uniform(0, 1, none.input.shape)
    )
    return tr, iterate, variables, prices


def second_difference(function, step: float) -> float:
    return float((function(step) - 2 * function(0.0) + function(-step)) / step**2)


def test_the_inputs_curvature_is_that_of_its_norm(around):
    tr, iterate, _, prices = around
    hessian = input_curvature(tr, iterate, prices)
    random = np.random.default_rng(3)
    nodes = np.arange(len(prices.input) - 1)
    piece, _ = tr.within(nodes)
    for chosen in (0, 9, tr.intervals - 1):
        move = random.normal(size=(tr.degree + 1, tr.outputs))
        here = nodes[piece == chosen]
        by = tr.basis_at(here)[:, tr.order] @ move

        def priced(t: float, here=here, by=by) -> float:
            highest = iterate.reference[2 * here, tr.order] + t * by
            return prices.input[here] @ np.linalg.norm(highest, axis=1)

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
    finer = prices.refined(Transcription(tr.problem, 2 * tr.intervals))
    assert finer.planes.sum() == pytest.approx(prices.planes.sum())
    assert finer.input[:-1].sum() == pytest.approx(prices.input[:-1].sum())
    at = finer.input[:-1].reshape(tr.intervals, -1).sum(axis=1)
    before = prices.input[:-1].reshape(tr.intervals, -1).sum(axis=1)
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
    tr = Transcription(Problem.from_scenario(scenario), 40)
    coefficients, bandwidth = tr.straight_line()
    base = tr.evaluate(coefficients, bandwidth)
    # On the straight line y*^(n) is zero in the middle; the limit is just kept there.
    middle = slice(10 * tr.tube_steps, 30 * tr.tube_steps)
    used = tr.problem.input_limit - base.input_margin[middle]
    limit = float(used.max()) + 0.02
    problem = dataclasses.replace(tr.problem, input_limit=limit)
    tr = Transcription(problem, 40)
    base = tr.evaluate(coefficients, bandwidth)
    variables = Variables(
        tr, planes=len(base.planes.piece), kinked=kinked_coordinates(tr)
    )
    with borrowed(variables.layout) as solver:
        program = Program(tr, variables, solver, accuracy=1e-6)
        program.update(base, Shape(secant=1e-3, proximity=0.1))
        z, _ = program.solve()
    assert z is not None
    z *= 0.05 / np.abs(z[variables.blocks["coefficients"]]).max()
    reached = tr.evaluate(*program.decisions(base, z))
    inner = reached.reference[2 * middle.start : 2 * middle.stop, tr.order]
    assert np.linalg.norm(inner, axis=1).max() > 0.01  # it moved off the apex
    promised, actual = program.margins_after(z, reached)
    promised, actual = promised[z.size * 0 :], actual
    nodes = program._input_nodes
    count = len(nodes) + len(program._cuts[0])
    at = np.concatenate([nodes, nodes[program._cuts[0]]])
    worst_promised = np.full(len(reached.input_margin), np.inf)
    np.minimum.at(worst_promised, at, promised[:count])
    inside = [n for n in nodes if middle.start <= n < middle.stop]
    knots = [n for n in inside if n % tr.tube_steps == 0]
    assert len(knots) > 5
    missed = worst_promised[knots] - reached.input_margin[knots] / 3.0
    # All six directions together see at least 1/sqrt(3) of a norm that grows.
    size = np.linalg.norm(reached.reference[2 * np.array(knots), tr.order], axis=1)
    assert (missed <= (1 - 1 / np.sqrt(3)) * size / 3.0 + 2e-3).all()


def test_a_cruise_near_the_inputs_limit_converges_in_a_few_programs():
    result = plan(straight_cruise(6.0))
    assert result.certified, result.message
    assert len(result.history) <= 12
