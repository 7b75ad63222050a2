"""Claims about plans and certificates, on the paper's field and on small ones."""

from __future__ import annotations

import numpy as np
import pytest

from dtmpc_drake.models import DragDoubleIntegrator
from dtmpc_drake.obstacles import Cylinder, Sphere
from dtmpc_drake.obstacles.normals import separating_normals, tangent_space
from dtmpc_drake.planning import Problem, certify, plan, plan_problem, planner
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.scp.clarabel import borrowed
from dtmpc_drake.planning.scp.curvature import Multipliers
from dtmpc_drake.planning.scp.linearise import (
    Program,
    Shape,
    kinked_coordinates,
    program_layout,
)
from dtmpc_drake.planning.scp.sensitivity import transitions
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.scenario import Planner, Scenario, Waypoint, load_scenario
from tests.models_for_tests import (
    PlanarOnSlope,
    ThirdOrderPlanar,
    changed_problem,
    make_problem,
)
from tests.test_random_scenarios import random_scenario


@pytest.fixture(scope="module")
def known(known_result):
    return known_result


@pytest.fixture(scope="module")
def uncertain():
    return plan(load_scenario("state_dependent_uncertainty"))


def independent_margins(scenario, saved):
    """Margins from the samples of a plan alone, as a stranger would check them."""
    limits, bandwidth = scenario.limits, scenario.controller.bandwidth
    clearance = [
        np.linalg.norm(saved["position"][:, :2] - o.center, axis=1)
        - o.radius
        - np.linalg.norm(saved["position_tube"][:, :2], axis=1)
        for o in scenario.obstacles
    ]
    rate = np.diff(saved["bandwidth"], axis=0) / np.diff(saved["time"])[:, None]
    return {
        "clearance": np.min(clearance),
        "speed": (
            limits.speed - np.abs(saved["velocity"]) - saved["velocity_tube"]
        ).min(),
        "bandwidth": min(
            (saved["bandwidth"] - bandwidth.min).min(),
            (bandwidth.max - saved["bandwidth"]).min(),
        ),
        "rate": bandwidth.rate_max - np.abs(rate).max(),
    }


def test_known_environment_is_certified_and_a_stranger_agrees(known, tmp_path):
    assert known.status == "certified"
    known.plan.save(tmp_path / "plan.npz")
    saved = np.load(tmp_path / "plan.npz")
    scenario = load_scenario("known_environment")
    margins = independent_margins(scenario, saved)
    assert min(margins.values()) >= -1e-9, margins
    np.testing.assert_allclose(saved["position"][0], scenario.start.position, atol=1e-6)
    np.testing.assert_allclose(saved["position"][-1], scenario.goal.position, atol=1e-6)


def test_the_tube_obeys_its_differential_equations(known, known_problem):
    problem = known_problem
    s = known.plan.sample()
    step = s["time"][1] - s["time"][0]
    forcing = problem.law.forcing_of(0.0)
    np.testing.assert_allclose(
        s["boundary_layer_rate"],
        forcing - s["bandwidth"] * s["boundary_layer"],
        atol=1e-4,
    )
    rate = np.gradient(s["position_tube"], step, axis=0)
    np.testing.assert_allclose(
        rate[2:-2],
        (s["boundary_layer"] - problem.law.slope * s["position_tube"])[2:-2],
        atol=2e-3,
    )


def test_bandwidth_is_high_in_the_gap_and_low_in_the_open(known):
    """The paper's first result."""
    s = known.plan.sample()
    along = s["position"][:, 1]
    gap, end = (along > 5.0) & (along < 8.0), along > 24.0
    assert s["bandwidth"][gap].max() > 3.0
    assert s["bandwidth"][end].max() < 1.0
    # So the tube is narrowest between the first two obstacles.
    narrowest = along[5:][s["position_tube"][5:, 0].argmin()]
    assert s["position_tube"][along > 6.9][0, 0] < 0.3 * s["position_tube"].max()
    assert narrowest < 8.0


def test_unknown_drag_slows_the_vehicle_in_the_gap(uncertain):
    """The paper's third result."""
    assert uncertain.certified
    s = uncertain.plan.sample()
    speed = np.linalg.norm(s["velocity"], axis=1)
    gap = np.abs(s["position"][:, 1] - 7.0) < 0.3
    assert speed[gap].max() < 0.9 * speed.max()
    np.testing.assert_allclose(s["bandwidth"], 4.0, atol=1e-9)


def test_a_constant_uncertainty_bound_is_infeasible():
    """The paper's claim against rigid bounds; the message names a constraint."""
    result = plan(load_scenario("constant_uncertainty"))
    assert result.status == "infeasible"
    assert result.plan is None
    assert "cannot keep" in result.message


def test_plans_are_deterministic(known):
    again = plan(load_scenario("known_environment"))
    np.testing.assert_array_equal(again.plan.coefficients, known.plan.coefficients)
    np.testing.assert_array_equal(
        again.plan.bandwidth_knots, known.plan.bandwidth_knots
    )


def test_a_warm_start_keeps_the_certificate_in_fewer_iterations(known):
    scenario = load_scenario("known_environment")
    scenario.start.position = [0.05, 0.0, 1.0]
    warm = plan(scenario, warm_start=known.plan)
    assert warm.certified
    assert len(warm.history) < len(known.history)


def test_a_plan_may_start_on_the_way_with_an_open_tube(known, known_problem):
    time = 1.0
    reference = known.plan.reference(time)
    problem = changed_problem(
        known_problem,
        start_time=time,
        duration=known.plan.end_time - time,
        start=reference[:2],
        start_highest=reference[2],
        start_bandwidth=known.plan.bandwidth(time),
        layer=known.plan.boundary_layer(time),
        initial_error=np.array([[0.02, 0.01, 0.0], [0.05, 0.0, 0.0]]),
    )
    settings = load_scenario("known_environment").planner
    result = plan_problem(problem, settings, warm_start=known.plan)
    assert result.certified, result
    new = result.plan.reference(time)
    np.testing.assert_allclose(new, reference, atol=1e-6)
    np.testing.assert_allclose(
        result.plan.bandwidth(time), known.plan.bandwidth(time), atol=1e-6
    )
    np.testing.assert_allclose(result.plan.error_bound(time)[0], [0.02, 0.01, 0.0])


# The certificate catches what is planted.


def test_an_obstacle_between_two_knots_is_caught(known):
    """Knots are 0.25 s apart: a thin pole fits between two of them."""
    middle = 0.5 * (known.plan.knots[40] + known.plan.knots[41])
    position = known.plan.reference(middle)[0]
    pole = Sphere(center=position.tolist(), radius=1e-3)
    scenario = load_scenario("known_environment")
    scenario.obstacles = [pole]
    problem = Problem.from_scenario(scenario)
    certificate = certify(known.plan, problem)
    assert not certificate.certified
    margin = certificate.margins["obstacles"]
    assert margin.value < 0
    assert abs(margin.time - middle) < 0.25


@pytest.mark.parametrize(
    ("field", "value", "name"),
    [
        ("input_limit", 1.0, "input"),
        ("speed_limit", 1.0, "speed"),
        ("bandwidth_max", np.full(3, 2.0), "bandwidth_max"),
        ("bandwidth_min", np.full(3, 0.6), "bandwidth_min"),
        ("bandwidth_rate_max", 0.5, "bandwidth_rate"),
        ("goal", np.array([[0, 25, 1.1], [0, 1, 0]]), "ends"),
        ("initial_error", np.full((2, 3), 0.1), "tube"),
        ("disturbance_bound", np.full(3, 1.0), "tube"),
    ],
)
def test_every_broken_limit_is_caught(known, known_problem, field, value, name):
    problem = changed_problem(known_problem, **{field: value})
    certificate = certify(known.plan, problem)
    assert not certificate.certified
    assert certificate.margins[name].value < 0


def test_margins_are_lower_bounds_of_dense_samples(known, uncertain, known_problem):
    obstacles = known_problem.obstacles  # of both experiments
    for result in (known, uncertain):
        time = np.linspace(0, result.plan.end_time, 50_001)
        dense = obstacles.clearance(
            result.plan.reference(time)[:, 0], result.plan.position_tube(time)
        ).min()
        margin = result.certificate.margins["obstacles"].value
        assert margin <= dense + 1e-6
        assert margin >= dense - 1e-3  # and not merely small


# Any model, any shape.


def field(model, **changes) -> Scenario:
    m = model.num_outputs
    start, goal = np.zeros(m), np.zeros(m)
    goal[-1] = 6.0
    scenario = Scenario(
        model=model,
        start=Waypoint(position=start.tolist()),
        goal=Waypoint(position=goal.tolist()),
        duration=6.0,
    )
    scenario.disturbance.bound = [0.3] * m
    scenario.controller.slope = [2.0] * m
    scenario.controller.initial_boundary_layer = 0.2
    scenario.planner.intervals = 24
    for name, value in changes.items():
        setattr(scenario, name, value)
    return scenario


@pytest.mark.parametrize("backend", ["clarabel", "ipopt"])
def test_a_constant_bound_is_kept_above_the_true_one(backend):
    """Where the speed must come near the one that the constant is made for."""
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.05)
    scenario = field(model, duration=4.0)
    scenario.limits.speed = 2.2
    scenario.controller.bandwidth.fixed = 3.0
    scenario.planner.uncertainty = "constant"
    scenario.planner.intervals = 12
    scenario.planner.backend = backend
    scenario.planner.time_limit = 600.0
    result = plan(scenario)
    assert result.certified, result
    margin = result.certificate.margins["model_error"].value
    assert 0 <= margin < 0.01  # the limit is felt


def test_a_model_that_is_known_has_the_constant_zero():
    scenario = field(DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.0))
    expected = plan(scenario)
    scenario.planner.uncertainty = "constant"
    result = plan(scenario)
    assert result.certified
    assert result.cost == pytest.approx(expected.cost, rel=1e-3)


@pytest.mark.parametrize(
    "model", [PlanarOnSlope(), ThirdOrderPlanar()], ids=["n=2", "n=3"]
)
@pytest.mark.parametrize("margin", ["norm", "support"])
def test_other_models_are_planned_around_an_obstacle(model, margin):
    scenario = field(model, obstacles=[Cylinder(center=[0.1, 3.0], radius=0.5)])
    scenario.limits.input = 8.0
    scenario.planner.tube_margin = margin
    result = plan(scenario)
    assert result.certified, result
    assert result.plan.order == model.order


def test_the_support_margin_is_never_more_expensive():
    scenario = load_scenario("known_environment")
    scenario.planner.intervals = 28
    norm = plan(scenario)
    scenario.planner.tube_margin = "support"
    support = plan(scenario)
    assert support.certified and norm.certified
    assert support.cost < norm.cost


def test_the_comparison_bound_beats_the_papers():
    """Measured by the design: the literal bound costs a fifth more."""
    scenario = load_scenario("known_environment")
    scenario.planner.intervals = 28
    ours = plan(scenario)
    scenario.planner.velocity_bound = "paper"
    paper = plan(scenario)
    assert ours.certified
    assert not paper.certified or paper.cost > ours.cost


@pytest.mark.parametrize("intervals", [28, 56])
def test_both_backends_agree(intervals):
    scenario = load_scenario("known_environment")
    scenario.planner.intervals = intervals
    clarabel = plan(scenario)
    scenario.planner.backend = "ipopt"
    scenario.planner.time_limit = 600.0  # on a busy machine, too
    ipopt = plan(scenario)
    assert clarabel.certified and ipopt.certified
    assert clarabel.cost == pytest.approx(ipopt.cost, rel=0.02)


def test_both_backends_agree_on_a_stop_anywhere():
    """A row of the goal that is not a number is free: here, the position."""
    start, goal = np.zeros((2, 3)), np.zeros((2, 3))
    start[1, 0], goal[0] = 1.0, np.nan
    problem = make_problem(DragDoubleIntegrator(), start=start, goal=goal, duration=3.0)
    results = [
        plan_problem(problem, Planner(intervals=8, backend=backend, time_limit=600.0))
        for backend in ("clarabel", "ipopt")
    ]
    for result in results:
        assert result.certified, result
        position, velocity = result.plan.reference(3.0)[:2]
        np.testing.assert_allclose(velocity, 0.0, atol=1e-6)
        assert 0.5 < position[0] < 3.0
    assert results[0].cost == pytest.approx(results[1].cost, rel=0.02)


def test_both_backends_agree_on_a_small_field():
    scenario = field(
        PlanarOnSlope(), obstacles=[Cylinder(center=[0.1, 3.0], radius=0.5)]
    )
    scenario.limits.input = 8.0
    scenario.planner.intervals = 12
    clarabel = plan(scenario)
    scenario.planner.backend = "ipopt"
    scenario.planner.time_limit = 600.0  # on a busy machine, too
    ipopt = plan(scenario)
    assert clarabel.certified and ipopt.certified
    assert clarabel.cost == pytest.approx(ipopt.cost, rel=0.02)


# The parts.


def test_transitions_are_the_derivative_of_the_exact_tube():
    scenario = load_scenario("known_environment")
    scenario.model.drag_error_bound = 0.1
    tr = Transcription(Problem.from_scenario(scenario), 28)
    coefficients, bandwidth = straight_line(tr)
    coefficients = coefficients + 0.05 * np.sin(np.arange(coefficients.size)).reshape(
        coefficients.shape
    )
    base = tr.evaluate(coefficients, bandwidth)
    sensitivity = transitions(tr, base, secant=1e-6)[:, -1]
    piece, axis, step = 5, 1, 1e-5
    moved = bandwidth.copy()
    moved[piece + 1, axis] += step
    after = tr.evaluate(coefficients, moved)
    actual = (after.local.layer - base.local.layer)[piece + 1, axis] / step
    states, m = 3, 3
    predicted = sensitivity[piece, m + axis, states * m + m + axis]
    assert actual == pytest.approx(predicted, rel=1e-2)


@pytest.mark.parametrize("tube_margin", ["norm", "support"])
@pytest.mark.parametrize("drag_error_bound", [0.0, 0.2])
def test_a_program_predicts_every_limit_to_first_order(drag_error_bound, tube_margin):
    """Between the knots too, across the kinks of |v|, and with turning half-planes."""
    scenario = load_scenario("known_environment")
    scenario.planner.tube_margin = tube_margin
    scenario.model.drag_error_bound = drag_error_bound
    scenario.limits.input = 4.0
    tr = Transcription(Problem.from_scenario(scenario), 28)
    wiggle = 0.02 * np.sin(np.arange(29 + 2)[:, None] + np.arange(3))
    coefficients, bandwidth = straight_line(tr)
    base = tr.evaluate(tr.ends.met_by(coefficients + wiggle), bandwidth - 0.5)
    variables = Variables(
        tr, planes=len(base.planes.piece), kinked=kinked_coordinates(tr)
    )
    with borrowed(program_layout(tr, variables)) as solver:
        program = Program(
            tr, variables, solver, Multipliers.none(tr, base), accuracy=1e-6
        )
        program.update(base, Shape(1e3, 1e-3, proximity=1.0))
        z, _ = program.solve()
    z *= 1e-3 / np.abs(z[program.variables.blocks["coefficients"]]).max()
    promised, actual = program.margins_after(
        z, tr.evaluate(*program.decisions(base, z))
    )
    assert len(actual) > 100
    change = np.abs(promised - program.margins_now).max()
    assert np.abs(actual - promised).max() < 0.1 * change


def test_normals_separate_better_than_any_other_direction():
    generator = np.random.default_rng(1)
    hull = generator.normal(size=(50, 4, 2)) * 0.2 + [1.5, 0.5]
    size = generator.uniform(0, 0.3, (50, 4))
    normal = separating_normals(hull, size)
    best = (np.einsum("pci,pi->pc", hull, normal) - size).min(axis=1)
    for angle in np.linspace(0, 2 * np.pi, 721):
        other = (hull @ [np.cos(angle), np.sin(angle)] - size).min(axis=1)
        assert (best >= other - 1e-4).all()


@pytest.mark.parametrize("rows", [2, 3])
def test_tangents_are_square_to_their_normal(rows):
    normal = np.random.default_rng(0).normal(size=(20, rows))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangents = tangent_space(normal)
    np.testing.assert_allclose(np.einsum("pti,pi->pt", tangents, normal), 0, atol=1e-12)
    gram = np.einsum("pti,psi->pts", tangents, tangents)
    expected = np.broadcast_to(np.eye(rows - 1), gram.shape)
    np.testing.assert_allclose(gram, expected, atol=1e-12)


def test_a_tube_that_is_sampled_too_coarsely_is_sampled_finer(monkeypatch):
    """Δ(x*) has kinks that coarse samples round off, in the plan's own bandwidth."""
    scenario = random_scenario(162)
    finer = plan(scenario)
    monkeypatch.setattr(planner, "OF_THE_SAMPLES", frozenset())
    coarse = plan(scenario)
    assert coarse.status == "not_certified"
    assert set(coarse.certificate.broken) <= {"tube", "bandwidth_knots"}
    assert finer.certified
    np.testing.assert_array_equal(finer.plan.coefficients, coarse.plan.coefficients)
    assert len(finer.plan.tube_times) == 2 * len(coarse.plan.tube_times) - 1
