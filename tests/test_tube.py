"""The tube: closed forms, comparison systems, and errors that stay inside."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.method.tube import (
    Tube,
    VelocityBound,
    cascade_bound,
    filter_rates,
    initial_stages,
    propagate,
    propagate_error_bounds,
)
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain, Model
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.filters import half_grid, integrate_filter, linear_recurrence
from dtmpc_drake.scenario import Scenario
from tests.models_for_tests import (
    every_adversary,
    fly,
    name_of,
    one_model_of_each_order,
    wave,
)

if TYPE_CHECKING:
    from dtmpc_drake.records.result import PlanningResult

each_order = pytest.mark.parametrize("model", one_model_of_each_order(), ids=name_of)
each_bound = pytest.mark.parametrize("velocity_bound", ["comparison", "paper"])
seeds = st.integers(0, 2**32 - 1)
rates = st.floats(0.3, 6)

REACHING_RATE = 0.1


def solve(rate: Callable[[float, Array], Array], initial: Array, times: Array) -> Array:
    """An independent, tight integration; the states at `times`, ``(K, ...)``."""
    start = np.asarray(initial, dtype=float)
    solution = scipy.integrate.solve_ivp(
        lambda t, x: np.ravel(rate(t, x.reshape(start.shape))),
        (times[0], times[-1]),
        start.ravel(),
        method="DOP853",
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
    )
    return solution.y.T.reshape(len(times), *start.shape)


# The filter that everything is made of.


@given(seed=seeds, length=st.integers(1, 70))
def test_the_scan_is_the_loop(seed: int, length: int) -> None:
    rng = np.random.default_rng(seed)
    gain, offset = rng.uniform(0, 1, (length, 2)), rng.normal(size=(length, 2))
    x = [rng.normal(size=2)]
    for g, o in zip(gain, offset, strict=True):
        x.append(g * x[-1] + o)
    before = gain.copy(), offset.copy()
    found = linear_recurrence(gain, offset, x[0])
    assert found == pytest.approx(np.array(x), abs=1e-12)
    assert (gain == before[0]).all() and (offset == before[1]).all()


def test_the_filter_is_integrated_to_fourth_order() -> None:
    def rate(t: Array) -> Array:
        return 2 + np.sin(3 * t)

    def forcing(t: Array) -> Array:
        return 1 + np.cos(2 * t)

    errors = []
    for steps in (20, 40, 80):
        half = np.linspace(0, 3, 2 * steps + 1)
        x, dx = integrate_filter(rate(half), forcing(half), np.array(0.7), 3 / steps)
        exact = solve(lambda t, x: forcing(t) - rate(t) * x, np.array(0.7), half[::2])
        errors.append(np.abs(x - exact).max())
        assert dx == pytest.approx(forcing(half[::2]) - rate(half[::2]) * x)
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (order > 3.7).all() and (order < 4.5).all()


@given(st.lists(st.floats(-3, 3), min_size=4, max_size=4))
def test_half_grid_midpoints_are_exact_for_cubics(powers: list[float]) -> None:
    t = np.linspace(0, 2, 5)
    cubic = np.polynomial.Polynomial(powers)
    found = half_grid(cubic(t), cubic.deriv()(t), 0.5)
    assert found == pytest.approx(cubic(np.linspace(0, 2, 9)), abs=1e-9)


# The boundary layer.


@given(
    alpha=rates,
    initial=st.floats(0.05, 2),
    disturbance=st.floats(0, 1),
    error=st.floats(0, 1),
)
def test_the_layer_is_exponential_at_constant_bandwidth(
    alpha: float, initial: float, disturbance: float, error: float
) -> None:
    model = IntegratorChain(num_outputs=2, order=1, error_bound=error)
    steps, step = 200, 0.01
    tube = propagate(
        model=model,
        reference=np.zeros((2 * steps + 1, 1, 2)),
        bandwidth=np.full((2 * steps + 1, 2), alpha),
        slope=np.full(2, 2.0),
        disturbance_bound=np.array([disturbance, 0.0]),
        reaching_rate=REACHING_RATE,
        initial_boundary_layer=np.full(2, initial),
        initial_error=np.zeros((1, 2)),
        velocity_bound="comparison",
        step=step,
    )
    t = np.arange(steps + 1)[:, None] * step
    final = (error + np.array([disturbance, 0.0]) + REACHING_RATE) / alpha
    expected = final + (initial - final) * np.exp(-alpha * t)
    assert tube.boundary_layer == pytest.approx(expected, rel=1e-7)
    assert tube.boundary_layer_rate == pytest.approx(
        -alpha * (initial - final) * np.exp(-alpha * t), abs=1e-6
    )


@given(start=rates, end=rates, initial=st.floats(0.05, 2))
def test_the_layer_at_linear_bandwidth(
    start: float, end: float, initial: float
) -> None:
    steps, duration = 160, 2.0
    half = np.linspace(0, duration, 2 * steps + 1)
    alpha = start + (end - start) * half / duration
    tube = propagate(
        model=IntegratorChain(num_outputs=1, order=1, error_bound=0.3),
        reference=np.zeros((len(half), 1, 1)),
        bandwidth=alpha[:, None],
        slope=np.array([2.0]),
        disturbance_bound=np.array([0.5]),
        reaching_rate=REACHING_RATE,
        initial_boundary_layer=np.array([initial]),
        initial_error=np.zeros((1, 1)),
        velocity_bound="comparison",
        step=duration / steps,
    )

    def rate(t: float, layer: Array) -> Array:
        return -(start + (end - start) * t / duration) * layer + 0.3 + 0.5 + 0.1

    exact = solve(rate, np.array([initial]), half[::2])
    assert tube.boundary_layer == pytest.approx(exact, rel=1e-7)


# The error bounds.


def flown(
    model: Model,
    *,
    alpha: Callable[[float | Array], Array],
    velocity_bound: VelocityBound,
    slope: Array,
    disturbance_bound: Array,
    initial_error: Array,
    initial_layer: float = 0.3,
    duration: float = 3.0,
    steps: int = 300,
    signal: tuple[float, float] = (1.0, 0.8),
) -> tuple[Array, Tube]:
    """Node times and the tube along a wave, at a bandwidth alpha(t)."""
    half = np.linspace(0, duration, 2 * steps + 1)
    tube = propagate(
        model=model,
        reference=wave(model, *signal)(half)[:, : model.order],
        bandwidth=np.broadcast_to(
            np.asarray(alpha(half))[:, None], (len(half), model.num_outputs)
        ),
        slope=slope,
        disturbance_bound=disturbance_bound,
        reaching_rate=REACHING_RATE,
        initial_boundary_layer=np.full(model.num_outputs, initial_layer),
        initial_error=initial_error,
        velocity_bound=velocity_bound,
        step=duration / steps,
    )
    return half[::2], tube


@each_order
@each_bound
@settings(max_examples=4)
@given(seed=seeds)
def test_all_bounds_against_their_differential_equations(
    model: Model, velocity_bound: VelocityBound, seed: int
) -> None:
    """The equations of the design, written out for each order."""
    rng = np.random.default_rng(seed)
    n, m = model.order, model.num_outputs
    lam, D = rng.uniform(0.8, 3, m), rng.uniform(0, 1, m)
    e0 = rng.normal(scale=0.1, size=(n, m))
    a, b = rng.uniform(1.5, 4), rng.uniform(0, 1)
    path = wave(model, 1.0, 0.8)

    def alpha(t: float | Array) -> Array:
        return np.asarray(a + b * np.sin(2 * t))

    times, tube = flown(
        model,
        alpha=alpha,
        velocity_bound=velocity_bound,
        slope=lam,
        disturbance_bound=D,
        initial_error=e0,
    )

    def cascade(x: Array) -> Array:
        """The paper's R_0 ... R_(n-1) of the states Φ, (W,) Ω, (Y_1)."""
        if n == 1:
            return x[:1]
        if n == 2:
            return np.stack([x[2], x[0] + lam * x[2]])
        speed = x[3] + lam * x[2]
        return np.stack([x[2], speed, x[0] + 2 * lam * x[3] + lam**2 * x[2]])

    def bounds(x: Array) -> Array:
        """The bounds in use."""
        result = cascade(x)
        if n > 1 and velocity_bound == "comparison":
            result[-1] = x[1]
        return result

    def rate(t: float, x: Array) -> Array:
        here = path(t)[:n]
        known, alpha_t = model.model_error_bound(here), alpha(t)
        layer = -alpha_t * x[0] + known + D + REACHING_RATE
        if n == 1:
            return np.stack([layer])
        # Both bounds of the top derivative hold, so Δ̄ looks at the smaller.
        R = np.minimum(bounds(x), cascade(x))
        E = D + 2 * model.model_error_bound_over(here, R) - known
        if n == 2:
            W = -(alpha_t + lam) * x[1] + alpha_t * lam * x[2] + E
            return np.stack([layer, W, x[0] - lam * x[2]])
        W = (
            -(alpha_t + 2 * lam) * x[1]
            + alpha_t * lam**2 * x[2]
            + (2 * alpha_t * lam + lam**2) * R[1]
            + E
        )
        return np.stack([layer, W, x[3] - lam * x[2], x[0] - lam * x[3]])

    start = [np.full(m, 0.3)]
    if n > 1:
        start += [np.abs(e0[-1]), np.abs(e0[0])]
    if n > 2:
        start += [np.abs(e0[1] + lam * e0[0])]
    exact = solve(rate, np.stack(start), times)
    expected = np.stack([bounds(x) for x in exact])
    # A magnitude's kink, where the reference turns round, costs a little.
    assert tube.error_bound == pytest.approx(expected, rel=2e-5, abs=2e-6)
    assert tube.boundary_layer == pytest.approx(exact[:, 0], rel=2e-5)


@each_order
@each_bound
def test_the_rates_of_a_tube_are_its_derivatives(
    model: Model, velocity_bound: VelocityBound
) -> None:
    m = model.num_outputs
    times, tube = flown(
        model,
        alpha=lambda t: 2 + np.sin(t),
        velocity_bound=velocity_bound,
        slope=np.full(m, 2.0),
        disturbance_bound=np.full(m, 0.4),
        initial_error=np.full((model.order, m), 0.05),
        steps=600,
    )
    step = times[1]
    for value, rate in (
        (tube.boundary_layer, tube.boundary_layer_rate),
        (tube.error_bound, tube.error_bound_rate),
    ):
        slope = (value[2:] - value[:-2]) / (2 * step)
        assert rate[1:-1] == pytest.approx(slope, abs=2e-3)


@each_order
def test_the_tubes_differential_equation_is_the_one_that_is_integrated(
    model: Model,
) -> None:
    """`filter_rates`, which the planner linearises, against `propagate`."""
    n, m = model.order, model.num_outputs
    slope, D = np.full(m, 2.0), np.full(m, 0.4)
    times, tube = flown(
        model,
        alpha=lambda t: 2 + np.sin(t),
        velocity_bound="comparison",
        slope=slope,
        disturbance_bound=D,
        initial_error=np.full((n, m), 0.05),
    )
    states = [tube.stages] + ([tube.error_bound[:, -1:]] if n > 1 else [])
    found = filter_rates(
        model=model,
        reference=wave(model, 1.0, 0.8)(times)[:, :n],
        bandwidth=np.broadcast_to((2 + np.sin(times))[:, None], (len(times), m)),
        states=np.concatenate(states, axis=1),
        slope=slope,
        disturbance_bound=D,
        reaching_rate=REACHING_RATE,
    )
    assert found[:, n - 1] == pytest.approx(tube.boundary_layer_rate)
    assert found[:, 0] == pytest.approx(tube.error_bound_rate[:, 0])
    if n > 1:
        assert found[:, n] == pytest.approx(tube.error_bound_rate[:, -1], abs=1e-6)


@given(order=st.integers(1, 5), seed=seeds)
def test_the_cascade_bounds_every_derivative_of_every_error(
    order: int, seed: int
) -> None:
    """|ỹ^(k)| <= Σ C(k, j) λ^(k-j) |y_j|, for any jet; and it can be attained."""
    rng = np.random.default_rng(seed)
    slope = rng.uniform(0.1, 4, 2)
    error = rng.normal(size=(order, 2))
    stages = initial_stages(error, slope)
    for k in range(order):
        bound = cascade_bound(stages, slope, k)
        assert (np.abs(error[k]) <= bound + 1e-9).all()
    assert stages[-1] == pytest.approx(np.abs(sliding_variable(error, slope)))
    # y_j = (-1)^j: every term of ỹ^(k) = Σ C(k, j) (-λ)^(k-j) y_j has one sign.
    worst = np.zeros((order, 2))
    for k in range(order):
        below = sliding_variable(np.vstack([worst[:k], 0 * worst[:1]]), slope)
        worst[k] = (-1.0) ** k - below
    ones = np.ones((order, 2))
    for k in range(order):
        assert np.abs(worst[k]) == pytest.approx(cascade_bound(ones, slope, k))


@each_order
@each_bound
@settings(max_examples=4)
@given(seed=seeds)
def test_errors_stay_inside_their_bounds_under_every_adversary(
    model: Model, velocity_bound: VelocityBound, seed: int
) -> None:
    """|ỹ^(k)| <= R_k for k < n, from an arbitrary C1 layer and initial error."""
    rng = np.random.default_rng(seed)
    n, m = model.order, model.num_outputs
    slope, D = rng.uniform(1, 3, m), rng.uniform(0.1, 0.6, m)
    path = wave(model, 1.0, 0.8)
    mean, depth, frequency = 0.4, rng.uniform(0, 0.3), rng.uniform(0.2, 1.5)

    def layer(t: float | Array) -> tuple[Array, Array]:
        angle = frequency * np.asarray(t)[..., None] + np.arange(m)
        return (
            mean * (1 + depth * np.sin(angle)),
            mean * depth * frequency * np.cos(angle),
        )

    steps, step = 300, 0.01
    half = np.arange(2 * steps + 1) * step / 2
    times = half[::2]
    value, rate = layer(half)
    known = model.model_error_bound(path(half)[:, :n])
    alpha = (known + D + REACHING_RATE - rate) / value
    assert (alpha > 0).all()
    adversary, trials = every_adversary(seed)
    error = rng.normal(scale=0.05, size=(trials, n, m))
    wanted = rng.choice([-0.99, 0.99, 0.3], (trials, m)) * value[0]
    error[:, -1] += wanted - sliding_variable(error, slope)
    # Bounds hold for a set of starts when they are given its largest stages.
    largest = np.abs(error).max(axis=0)
    tube = propagate_error_bounds(
        model=model,
        reference=path(half)[:, :n],
        bandwidth=alpha,
        boundary_layer=value[::2],
        boundary_layer_rate=rate[::2],
        slope=slope,
        disturbance_bound=D,
        initial_error=largest,
        velocity_bound=velocity_bound,
        step=step,
    )
    errors = fly(
        model=model,
        reference=path,
        layer=layer,
        slope=slope,
        disturbance_bound=D,
        reaching_rate=REACHING_RATE,
        initial_error=error,
        adversary=adversary,
        times=times,
    )
    ratio = np.abs(errors) / tube.error_bound[:, None]
    assert ratio.max() <= 1 + 1e-4


@given(low=rates, more=st.floats(0, 3), seed=seeds)
@settings(max_examples=10)
def test_more_bandwidth_never_makes_the_tube_larger(
    low: float, more: float, seed: int
) -> None:
    slope = np.random.default_rng(seed).uniform(0.5, 3, 2)
    model = IntegratorChain(num_outputs=2, order=2, error_bound=0.2)
    wide, narrow = (
        flown(
            model,
            alpha=lambda t, a=a: np.full_like(t, a),
            velocity_bound="comparison",
            slope=slope,
            disturbance_bound=np.full(2, 0.4),
            initial_error=np.zeros((2, 2)),
        )[1]
        for a in (low, low + more)
    )
    assert (narrow.boundary_layer <= wide.boundary_layer + 1e-12).all()
    assert (narrow.error_bound[:, 0] <= wide.error_bound[:, 0] + 1e-12).all()


@each_order
@each_bound
def test_a_larger_initial_error_never_makes_the_tube_smaller(
    model: Model, velocity_bound: VelocityBound
) -> None:
    n, m = model.order, model.num_outputs
    small, large = (
        flown(
            model,
            alpha=lambda t: np.full_like(t, 2.0),
            velocity_bound=velocity_bound,
            slope=np.full(m, 2.0),
            disturbance_bound=np.full(m, 0.4),
            initial_error=np.full((n, m), e),
        )[1]
        for e in (0.0, 0.05)
    )
    assert (large.error_bound >= small.error_bound - 1e-12).all()


# How tight the tube is, on the paper's first experiment.


def along_the_known_plan(
    known_scenario: Scenario, known_result: PlanningResult
) -> tuple[Array, Array, Array]:
    """Times; worst ratios |ỹ|/Ω and |dỹ/dt|/W over all adversaries at each."""
    plan = known_result.plan
    assert plan is not None
    times = plan.sample_times(0.01)
    adversary, trials = every_adversary(seed=0, trials=6)

    errors = fly(
        model=known_scenario.planning_model(),
        reference=plan.reference,
        layer=plan.layer,
        slope=known_scenario.slope(),
        disturbance_bound=known_scenario.disturbance_bound(),
        reaching_rate=known_scenario.controller.reaching_rate,
        initial_error=np.zeros((trials, 2, 3)),
        adversary=adversary,
        times=times,
    )
    # At the start both are exactly zero.
    ratio = np.abs(errors[1:]) / plan.error_bound(times[1:])[:, None]
    worst = ratio.max(axis=(1, 3))
    return times[1:], worst[:, 0], worst[:, 1]


def test_the_known_plans_tube_is_tight_and_never_left(
    known_scenario: Scenario, known_result: PlanningResult
) -> None:
    _, position, velocity = along_the_known_plan(known_scenario, known_result)
    assert 0.8 < position.max() <= 1 + 1e-4
    assert 0.95 < velocity.max() <= 1 + 1e-4


def test_the_comparison_bound_is_a_fraction_of_the_papers(
    known_scenario: Scenario, known_result: PlanningResult
) -> None:
    plan = known_result.plan
    assert plan is not None
    times = plan.sample_times(0.02)[1:]
    bound = plan.error_bound(times)
    paper = plan.boundary_layer(times) + known_scenario.slope() * bound[:, 0]
    assert (bound[:, 1] < paper).all()
    # About three times, once the start is forgotten.
    assert np.median(paper / bound[:, 1]) > 2


def test_the_comparison_bound_feels_its_own_size_through_the_drag() -> None:
    """Δ̄ depends on W; the fixed point is W's own equation, and is below."""
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    tubes = {
        bound: flown(
            model,
            alpha=lambda t: np.full_like(t, 4.0),
            velocity_bound=bound,
            slope=np.full(3, 2.0),
            disturbance_bound=np.full(3, 0.5),
            initial_error=np.zeros((2, 3)),
            signal=(2.0, 0.7),
        )[1]
        for bound in ("comparison", "paper")
    }
    ratio = tubes["paper"].error_bound[1:, 1] / tubes["comparison"].error_bound[1:, 1]
    assert ratio.min() > 1
