"""Claims about the certificate: its bounds hold all along every interval.

The tube that they are held against is integrated here by SciPy, from the
differential equations alone.
"""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from dtmpc_drake.method.tightening import Instant, deviation_bound, input_bound
from dtmpc_drake.models import ConstantUncertainty, DragDoubleIntegrator
from dtmpc_drake.numerics.polynomials import Polynomial
from dtmpc_drake.obstacles import Ellipsoid, ObstacleSet, Sphere
from dtmpc_drake.planning import Problem, certify, plan_problem
from dtmpc_drake.planning.proof.certify import TOP_TOLERANCE, TUBE_TOLERANCE
from dtmpc_drake.planning.proof.enclosure import enclose
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Planner
from tests.models_for_tests import changed_problem, every_model, make_problem, name_of

CASES = [
    pytest.param(model, bound, id=f"{name_of(model)}-{i}-{bound}")
    for i, model in enumerate(every_model())
    for bound in ("comparison", "paper")
    if bound == "comparison" or model.order > 1
    # That one has no plan: the loose bound and the constant together are too much.
    if bound == "comparison" or not isinstance(model, ConstantUncertainty)
]
_planned: dict[str, PlanningResult] = {}


@pytest.fixture
def problem(model, velocity_bound) -> Problem:
    """From rest to rest with an error at the start."""
    error = np.zeros((model.order, model.num_outputs))
    error[0] = 0.02
    return make_problem(
        model, velocity_bound=velocity_bound, initial_error=error, input_limit=24.0
    )


@pytest.fixture
def result(problem, request) -> PlanningResult:
    """Its plan; made once a case."""
    key = request.node.callspec.id
    if key not in _planned:
        _planned[key] = plan_problem(problem, Planner(intervals=24))
    assert _planned[key].certified, _planned[key]
    return _planned[key]


def gain_along(plan: Plan, problem: Problem, time):
    """κ = αΦ that the plan's own layer implies."""
    reference = plan.reference(time)[..., : problem.model.order, :]
    return problem.law.gain(reference, plan.boundary_layer_rate(time))


def integrated_bounds(plan: Plan, problem: Problem, time):
    """R_0 ... R_(n-1) by SciPy, output by output, ``(K, n, m)``."""
    law, model = problem.law, problem.model
    slope, n = law.slope, law.order
    compare = problem.velocity_bound == "comparison"
    start, where = [], []
    for i, order in enumerate(law.chains.orders):
        own = [*problem.tube_start.stages[n - order : n - 1, i]]
        if compare and order > 1:
            own.append(problem.tube_start.highest[i])
        where.append(slice(len(start), len(start) + len(own)))
        start += own

    def bounds(t, states):
        """What is in use, and the cascade's own of the highest derivatives."""
        layer = plan.boundary_layer(t)
        R = np.zeros((n, model.num_outputs))
        loose = R.copy()
        for i, order in enumerate(law.chains.orders):
            stages = [*states[where[i]][: order - 1], layer[i]]
            for k in range(order):
                for j in range(k + 1):
                    R[k, i] += comb(k, j) * slope[i] ** (k - j) * stages[j]
            loose[:, i] = R[:, i]
            if compare and order > 1:
                R[order - 1, i] = states[where[i]][-1]
        return R, loose

    def rate(t, states):
        reference, layer = plan.reference(t)[:n], plan.boundary_layer(t)
        alpha = gain_along(plan, problem, t) / layer
        R, loose = bounds(t, states)
        largest = model.model_error_bound_over(reference, np.minimum(R, loose))
        known = model.model_error_bound(reference)
        E = law.disturbance_bound + 2 * largest - known
        rates = []
        for i, order in enumerate(law.chains.orders):
            stages = [*states[where[i]][: order - 1], layer[i]]
            lam = slope[i]
            rates += [b - lam * a for a, b in pairwise(stages)]
            if compare and order > 1:
                c = [comb(order - 1, k) * lam ** (order - 1 - k) for k in range(order)]
                top = -(alpha[i] + (order - 1) * lam) * R[order - 1, i] + E[i]
                top += alpha[i] * c[0] * R[0, i]
                for k in range(1, order - 1):
                    top += (alpha[i] * c[k] + c[k - 1]) * R[k, i]
                rates.append(top)
        return rates

    if not start:
        return plan.boundary_layer(time)[:, None]
    solution = solve_ivp(
        rate, (time[0], time[-1]), start, t_eval=time, rtol=1e-11, atol=1e-12
    )
    pairs = zip(time, solution.y.T, strict=True)
    return np.array([bounds(t, states)[0] for t, states in pairs])


@pytest.mark.parametrize(("model", "velocity_bound"), CASES)
def test_the_enclosed_tube_holds_the_integrated_one_and_is_tight(result, problem):
    time = np.linspace(0.0, result.plan.end_time, 4001)
    enclosure = enclose(
        result.plan, problem, longest=2e-3, velocity_slack=TOP_TOLERANCE
    )
    exact = integrated_bounds(result.plan, problem, time)
    index = np.searchsorted(enclosure.corridor.time, time, side="right") - 1
    index = np.minimum(index, len(enclosure.corridor.time) - 2)
    above = enclosure.error_bound[index] - exact
    assert above.min() > -1e-7
    chains = problem.law.chains
    assert (chains.below_top * above).max(initial=0.0) < 5e-3
    assert above.max() < 2e-2
    reference = chains.state_of(enclosure.corridor.reference.derivatives[index])
    off = np.abs(result.plan.reference(time)[:, :-1] - reference)
    assert (off <= enclosure.reference_radius[index] + 1e-12).all()


@pytest.mark.parametrize(("model", "velocity_bound"), CASES)
def test_every_margin_is_below_a_dense_sample_of_it_and_near(result, problem):
    plan = result.plan
    time = np.linspace(0.0, plan.end_time, 4001)
    n = problem.model.order
    reference, gain = plan.reference(time), gain_along(plan, problem, time)
    bound = integrated_bounds(plan, problem, time)
    bandwidth = gain / plan.boundary_layer(time)
    at = Instant(reference[:, :n], reference[:, n], gain, bound)
    velocity = problem.law.chains.derivative_of(at.state, at.highest, 1)
    speed = np.abs(velocity) + deviation_bound(problem.law, at, 1)
    used = input_bound(problem.law, at)
    dense = {
        "speed": problem.speed.bound - speed.max(),
        "input": problem.input.bound - used.max(),
        "bandwidth_min": (bandwidth - problem.bandwidth.low).min(),
        "bandwidth_max": (problem.bandwidth.high - bandwidth).min(),
        "boundary_layer": plan.boundary_layer(time).min(),
    }
    for name, value in dense.items():
        margin = result.certificate.margins[name].value
        assert margin <= value + 1e-6, name
        assert margin >= 0.9 * value - 0.1, name


@pytest.mark.parametrize("factor", [0.9, 0.97])
def test_a_tube_that_claims_too_little_is_caught(known_result, known_problem, factor):
    """Δ̄ looks at the plan's own W only after that is proven."""
    plan = known_result.plan
    samples, rates = plan.bound_samples.copy(), plan.bound_rate_samples.copy()
    samples[:, 1] *= factor
    rates[:, 1] *= factor
    smaller = dataclasses.replace(plan, bound_samples=samples, bound_rate_samples=rates)
    certificate = certify(smaller, known_problem)
    assert certificate.margins["tube"].value < 0
    assert not certificate.certified


def test_an_error_that_feeds_on_itself_has_no_velocity_tube():
    """With so much unknown drag the velocity bound would run away."""
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    problem = make_problem(model)
    result = plan_problem(problem, Planner(intervals=24))
    assert result.certified
    wild = dataclasses.replace(model, drag_error_bound=20.0)
    problem = changed_problem(problem, model=wild)
    assert not certify(result.plan, problem).certified


def test_the_claimed_tube_is_the_proven_one_but_for_the_tolerance(
    known_result, known_problem
):
    enclosure = enclose(
        known_result.plan,
        known_problem,
        longest=2e-3,
        velocity_slack=TOP_TOLERANCE,
    )
    assert enclosure.claim_excess[:, 0].min() > -TUBE_TOLERANCE
    assert enclosure.claim_excess[:, 1].min() > -TOP_TOLERANCE
    assert enclosure.claim_excess.max() < TOP_TOLERANCE  # nor is it larger


def test_a_grid_that_is_not_uniform_is_refused(known_result, known_problem):
    plan = known_result.plan
    knots = plan.knots.copy()
    knots[3] += 0.01
    uneven = dataclasses.replace(plan, knots=knots)
    certificate = certify(uneven, known_problem)
    assert not certificate.certified
    assert "knots: must be equally spaced" in certificate.reason
    with pytest.raises(ValueError, match="equally spaced"):
        enclose(uneven, known_problem, longest=2e-3, velocity_slack=TOP_TOLERANCE)


@pytest.mark.parametrize("margin", ["norm", "support"])
@given(seed=st.integers(0, 2**31))
def test_the_clearance_bound_is_below_any_sample_for_any_shape(
    known_result, known_problem, margin, seed
):
    """Obstacles of random shapes near the reference, grazing or cut by the tube."""
    g = np.random.default_rng(seed)
    plan = known_result.plan
    obstacles = []
    for _ in range(3):
        center = plan.reference(g.uniform(0, 14))[0] + g.normal(0, 0.6, 3)
        shape = g.normal(size=(3, 3)) * 0.3 + np.eye(3)
        radius = float(g.uniform(0.02, 0.3))
        if g.random() < 0.5:
            obstacles.append(Sphere(center.tolist(), radius))
        else:
            obstacles.append(Ellipsoid(center.tolist(), shape.tolist(), radius))
    stacked = ObstacleSet.stack(obstacles, 3)
    problem = dataclasses.replace(known_problem, obstacles=stacked, tube_margin=margin)
    found = certify(plan, problem).margins["obstacles"].value
    time = np.linspace(0, 14, 20_001)
    dense = stacked.clearance(
        plan.reference(time)[:, 0], plan.position_tube(time), margin
    ).min()
    assert found <= dense + 1e-6
    if dense > 0.05:
        assert found > 0  # a clear plan is found clear


@given(
    coefficients=st.lists(st.floats(-3, 3), min_size=4, max_size=4),
    step=st.floats(0.01, 2.0),
    parts=st.integers(1, 8),
)
def test_a_polynomial_stays_in_its_range(coefficients, step, parts):
    powers = np.array(coefficients)[None, :, None]
    whole = Polynomial.on_intervals(powers, step, parts)
    fraction = np.linspace(0, 1, 30)
    for k in range(parts):
        time = (k + fraction) * step / parts
        for order in range(3):
            value = np.polynomial.Polynomial(coefficients).deriv(order)(time)
            middle = whole.derivatives[k, order, 0]
            assert np.abs(value - middle).max() <= whole.radius(order)[k, 0] + 1e-9
            assert np.abs(value).max() <= whole.largest(order)[k, 0] + 1e-9
    ends = np.polynomial.Polynomial(coefficients)(np.arange(parts + 1) * step / parts)
    np.testing.assert_allclose(whole.at_ends()[:, 0], ends, atol=1e-9)


def test_no_plan_is_refused_for_a_hair_that_long_intervals_lose(
    known_result: PlanningResult, known_problem: Problem
) -> None:
    plan, problem = known_result.plan, known_problem
    time = plan.sample_times(1e-3)
    position, tube = plan.reference(time)[:, 0], plan.error_bound(time)[:, 0]
    true = problem.obstacles.clearance(position, tube, problem.tube_margin).min()
    for room in (3e-5, 1e-5, -1e-5):
        obstacles = dataclasses.replace(
            problem.obstacles, radius=problem.obstacles.radius + true - room
        )
        certificate = certify(plan, dataclasses.replace(problem, obstacles=obstacles))
        assert certificate.kept == (room > 0), certificate
