"""Claims about outputs of different order: each obeys the equations of its own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.symbolic import Expression, MakeVectorVariable
from scipy.integrate import solve_ivp

from dtmpc_drake.method.chains import Chains, surface_coefficients
from dtmpc_drake.method.layer import integrate_layer
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import (
    Instant,
    deviation_bound,
    feedback_bound,
    input_range,
)
from dtmpc_drake.method.tube import (
    Tube,
    TubeStart,
    cascade_bound,
    cascade_bounds,
    filter_rates,
    propagate,
    stages_of_bounds,
)
from dtmpc_drake.models import IntegratorChain, Model
from dtmpc_drake.numerics import splines
from tests.models_for_tests import (
    SkewedChains,
    every_adversary,
    fly,
    models_of_mixed_orders,
    name_of,
    wave,
)

seeds = st.integers(0, 2**32 - 1)
orders = st.lists(st.integers(1, 4), min_size=1, max_size=5).map(tuple)
mixed_models = pytest.mark.parametrize("model", models_of_mixed_orders(), ids=name_of)
REACHING_RATE = 0.1


def a_law(model: Model, rng: np.random.Generator) -> SlidingLaw:
    m = model.num_outputs
    return SlidingLaw(
        model, rng.uniform(0.8, 3, m), rng.uniform(0.1, 1, m), REACHING_RATE
    )


def a_state(chains: Chains, rng: np.random.Generator, *lead: int) -> np.ndarray:
    shape = (*lead, chains.order, chains.num_outputs)
    return chains.existing(rng.normal(size=shape))


# Arrays.


@given(order=st.integers(1, 4), m=st.integers(1, 4), seed=seeds)
def test_outputs_of_equal_order_are_what_they_were(
    order: int, m: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    chains = Chains((order,) * m)
    slope, rows = rng.uniform(0.1, 4, m), rng.normal(size=(3, order + 2, m))
    state = rows[:, :order]
    same = np.testing.assert_array_equal
    same(chains.coefficients(slope), surface_coefficients(slope, order))
    same(chains.state_of(rows), state)
    same(chains.highest_of(rows), rows[:, order])
    same(chains.reference_of(rows), rows[:, : order + 1])
    same(chains.top(state), state[:, -1])
    same(chains.from_first(state), state)
    same(chains.at_layer(state), state)
    same(chains.pack(state), state.reshape(3, -1))
    same(chains.unpack(state.reshape(3, -1)), state)
    each = [cascade_bound(state, slope, k) for k in range(order)]
    same(cascade_bounds(chains, state, slope), np.stack(each, axis=1))
    for k in range(order + 1):
        same(chains.derivative_of(state, rows[:, order], k), rows[:, k])


@given(orders=orders, seed=seeds)
def test_a_state_is_packed_without_loss_or_waste(orders: tuple, seed: int) -> None:
    chains = Chains(orders)
    state = a_state(chains, np.random.default_rng(seed), 2, 3)
    flat = chains.pack(state)
    assert flat.shape == (2, 3, sum(orders))
    np.testing.assert_array_equal(chains.unpack(flat), state)
    # All outputs first: that is where others look for the position.
    np.testing.assert_array_equal(flat[..., : len(orders)], state[..., 0, :])


def test_what_does_not_exist_is_a_zero_of_the_same_kind() -> None:
    x = MakeVectorVariable(3, "x")
    state = Chains((2, 1)).unpack(np.array([Expression(v) for v in x]))
    assert state[1, 1].EqualTo(Expression(0.0))
    with np.errstate(invalid="ignore"):  # NumPy looks at flags that Drake left
        assert isinstance(np.sqrt(state + 1.0)[1, 1], Expression)


@given(orders=orders, seed=seeds)
def test_stages_are_aligned_at_the_layer(orders: tuple, seed: int) -> None:
    chains = Chains(orders)
    first = a_state(chains, np.random.default_rng(seed))
    aligned = chains.at_layer(first)
    np.testing.assert_array_equal(aligned[-1], chains.top(first))
    np.testing.assert_array_equal(chains.from_first(aligned), first)
    for i, order in enumerate(orders):
        missing = chains.order - order
        np.testing.assert_array_equal(aligned[missing:, i], first[:order, i])
        assert not aligned[:missing, i].any()


@given(orders=orders, seed=seeds)
def test_a_cascade_follows_from_the_bounds_that_it_gives(
    orders: tuple, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    chains, slope = Chains(orders), rng.uniform(0.1, 3, len(orders))
    stages = chains.at_layer(np.abs(a_state(chains, rng)))
    bounds = cascade_bounds(chains, stages, slope)
    assert stages_of_bounds(chains, bounds, slope) == pytest.approx(stages, abs=1e-9)


@given(orders=orders, seed=seeds)
def test_splines_of_each_degree_are_those_of_one_output(
    orders: tuple, seed: int
) -> None:
    """Values, control points, pieces and finer grids, output by output."""
    rng = np.random.default_rng(seed)
    step, intervals, points = 0.4, 6, np.linspace(0, 1, 5)
    all_ = splines.Splines(orders, step)
    coefficients = rng.normal(size=(intervals + all_.degree, len(orders)))
    coefficients.reshape(-1)[all_.unused(intervals)] = 0.0
    windows = splines.windows(coefficients, all_.degree)
    finer, pieces = all_.refined(coefficients), all_.pieces(coefficients)
    values = all_.values(points)
    shape = values.shape
    values = splines.applied(values.reshape(-1, *shape[2:]), windows)
    values = values.reshape(intervals, *shape[:2], -1)
    for i, order in enumerate(orders):
        own = splines.Splines((order,), step)
        mine = coefficients[: intervals + order + 1, i : i + 1]
        close = splines.windows(mine, own.degree)
        for k in range(order + 1):
            row = k if k < order else -1
            basis = splines.basis(own.degree, k, points, step)
            expected = splines.applied(basis[..., None], close)[..., 0]
            assert values[:, :, row, i] == pytest.approx(expected, abs=1e-9)
            controls = all_.controls(k, all_.degree - k)
            found = splines.applied(controls, windows)[:, :, i]
            ends = found[:, [0, -1]]
            assert ends == pytest.approx(expected[:, [0, -1]], abs=1e-9)
            low, high = found.min(axis=1), found.max(axis=1)
            inside = (expected >= low[:, None] - 1e-9) & (
                expected <= high[:, None] + 1e-9
            )
            assert inside.all()
        assert not values[:, :, order:-1, i].any()
        expected = splines.piece_coefficients(mine, own.degree, step)[..., 0]
        assert pieces[:, : order + 2, i] == pytest.approx(expected)
        assert not pieces[:, order + 2 :, i].any()
        fine = own.refined(mine)[:, 0]
        assert finer[: len(fine), i] == pytest.approx(fine)
        assert not finer[len(fine) :, i].any()


# The method: chains that do not see each other are as they are alone.


def alone(law: SlidingLaw, i: int) -> SlidingLaw:
    """The controller of one output of an `IntegratorChain`."""
    model = law.model
    own = IntegratorChain(1, law.chains.orders[i], model.error_bound)
    slope, bound = law.slope[i : i + 1], law.disturbance_bound[i : i + 1]
    return SlidingLaw(own, slope, bound, law.reaching_rate)


@settings(max_examples=25)
@given(orders=orders, seed=seeds, paper=st.booleans())
def test_outputs_that_do_not_see_each_other_have_the_tubes_of_their_own(
    orders: tuple, seed: int, paper: bool
) -> None:
    rng = np.random.default_rng(seed)
    law = a_law(IntegratorChain(orders=list(orders), error_bound=0.2), rng)
    chains, m, half = law.chains, len(orders), np.linspace(0, 2, 121)
    error, layer = a_state(chains, rng) / 10, rng.uniform(0.5, 1, m)
    alpha = 2 + np.sin(half)[:, None] * rng.uniform(0, 1, m)
    highest = rng.normal(size=m)
    state, control = a_state(chains, rng), rng.normal(size=(2, m))

    def tube_of(own: SlidingLaw, some: slice, error: np.ndarray) -> Tube:
        return propagate(
            own,
            reference=np.zeros((len(half), own.order, own.num_outputs)),
            bandwidth=alpha[:, some],
            start=TubeStart.of_error(error, layer[some], own.slope, own.chains),
            velocity_bound="paper" if paper else "comparison",
            step=half[2],
        )

    tube = tube_of(law, slice(None), error)
    at = Instant(state, highest, 3 * layer, tube.error_bound[-1])
    u = law.control(
        state=state,
        reference=np.concatenate([0 * state, highest[None]]),
        layer=layer,
        layer_rate=control[0],
    )
    for i, order in enumerate(orders):
        own, some = alone(law, i), slice(i, i + 1)
        expected = tube_of(own, some, error[:order, some])
        assert tube.boundary_layer[:, some] == pytest.approx(expected.boundary_layer)
        for whole, part in (
            (tube.error_bound, expected.error_bound),
            (tube.error_bound_rate, expected.error_bound_rate),
        ):
            assert whole[:, :order, some] == pytest.approx(part, abs=1e-12)
            assert not whole[:, order:, some].any()
        one = Instant(
            state[:order, some],
            highest[some],
            3 * layer[some],
            expected.error_bound[-1],
        )
        assert feedback_bound(law, at)[some] == pytest.approx(feedback_bound(own, one))
        for k in range(chains.order + 1):
            found = deviation_bound(law, at, k)[i]
            wanted = deviation_bound(own, one, k)[0] if k <= order else 0.0
            assert found == pytest.approx(wanted)
        reference = np.concatenate([0 * state[:order, some], highest[None, some]])
        assert u[some] == pytest.approx(
            own.control(
                state=state[:order, some],
                reference=reference,
                layer=layer[some],
                layer_rate=control[0, some],
            )
        )


@mixed_models
def test_the_tubes_differential_equation_is_the_one_that_is_integrated(
    model: Model,
) -> None:
    """`filter_rates`, which the planner linearises, against `propagate`."""
    rng = np.random.default_rng(1)
    law, half = a_law(model, rng), np.linspace(0, 3, 1201)
    chains, m = law.chains, law.num_outputs
    reference = wave(model, 1.0, 0.8)(half)[:, :-1]
    alpha = 2 + np.sin(half)[:, None] * rng.uniform(0, 1, m)
    error = a_state(chains, rng) / 10
    tube = propagate(
        law,
        reference=reference,
        bandwidth=alpha,
        start=TubeStart.of_error(error, np.full(m, 1.0), law.slope, chains),
        velocity_bound="comparison",
        step=half[2],
    )
    top = chains.top(tube.error_bound)[:, None]
    found = filter_rates(
        law,
        reference=reference[::2],
        bandwidth=alpha[::2],
        states=np.concatenate([tube.stages, top], axis=1),
    )
    several = chains.each > 1
    assert found[:, -2] == pytest.approx(tube.boundary_layer_rate)
    rates = chains.top(tube.error_bound_rate)
    assert found[:, -1, several] == pytest.approx(rates[:, several], abs=1e-5)
    first = chains.from_first(found[:, :-1])[:, 0]
    of_order_two = chains.each >= 2
    expected = tube.error_bound_rate[:, 0]
    assert first[:, of_order_two] == pytest.approx(expected[:, of_order_two])


@settings(max_examples=5)
@given(seed=seeds)
def test_all_bounds_against_their_differential_equations(seed: int) -> None:
    """The equations of orders 1, 3 and 2, written out, by SciPy."""
    rng = np.random.default_rng(seed)
    model = SkewedChains()
    law, half = a_law(model, rng), np.linspace(0, 3, 601)
    lam, D = law.slope, law.disturbance_bound
    path, e0 = wave(model, 1.0, 0.8), a_state(law.chains, rng) / 10
    tube = propagate(
        law,
        reference=path(half)[:, :-1],
        bandwidth=np.broadcast_to((2 + np.sin(half))[:, None], (len(half), 3)),
        start=TubeStart.of_error(e0, np.full(3, 1.5), lam, law.chains),
        velocity_bound="comparison",
        step=half[2],
    )

    def bounds(x: np.ndarray) -> np.ndarray:
        """R of Φ (3), W of outputs 1 and 2, Ω and Y_1 of output 1, Ω of output 2."""
        layer, (w1, w2, o1, y1, o2) = x[:3], x[3:]
        R = np.zeros((3, 3))
        R[0] = layer[0], o1, o2
        R[1, 1], R[2, 1] = y1 + lam[1] * o1, w1
        R[1, 2] = w2
        return R

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        layer, (w1, w2, o1, y1, o2) = x[:3], x[3:]
        a, here, R = 2 + np.sin(t), path(t)[:3], bounds(x)
        known = model.model_error_bound(here)
        loose = R.copy()
        loose[2, 1] = layer[1] + 2 * lam[1] * y1 + lam[1] ** 2 * o1
        loose[1, 2] = layer[2] + lam[2] * o2
        E = D + 2 * model.model_error_bound_over(here, np.minimum(R, loose)) - known
        return np.concatenate(
            [
                -a * layer + known + D + REACHING_RATE,
                [
                    -(a + 2 * lam[1]) * w1
                    + a * lam[1] ** 2 * o1
                    + (2 * a * lam[1] + lam[1] ** 2) * R[1, 1]
                    + E[1],
                    -(a + lam[2]) * w2 + a * lam[2] * o2 + E[2],
                    y1 - lam[1] * o1,
                    layer[1] - lam[1] * y1,
                    layer[2] - lam[2] * o2,
                ],
            ]
        )

    start = np.concatenate(
        [
            np.full(3, 1.5),
            np.abs([e0[2, 1], e0[1, 2], e0[0, 1]]),
            np.abs([e0[1, 1] + lam[1] * e0[0, 1], e0[0, 2]]),
        ]
    )
    times = half[::2]
    exact = solve_ivp(
        rate, (0, 3), start, t_eval=times, rtol=1e-9, atol=1e-10, max_step=0.02
    )
    expected = np.stack([bounds(x) for x in exact.y.T])
    assert tube.error_bound == pytest.approx(expected, rel=2e-5, abs=5e-6)


@mixed_models
@settings(max_examples=4)
@given(seed=seeds)
def test_errors_and_inputs_stay_inside_their_bounds_under_every_adversary(
    model: Model, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    law, path = a_law(model, rng), wave(model, 1.0, 0.8)
    chains, m, duration, steps = law.chains, law.num_outputs, 3.0, 600
    adversary, trials = every_adversary(seed, chains=chains)
    size = a_state(chains, rng) / 20
    error = size * rng.uniform(-1, 1, (trials, *size.shape))
    s = np.abs(law.sliding_variable(error)).max(axis=0)
    initial = np.maximum(1.02 * s, 0.2)
    half = np.linspace(0, duration, 2 * steps + 1)
    alpha = np.broadcast_to((2 + np.sin(half))[:, None], (len(half), m))
    reference = path(half)
    layer, layer_rate = integrate_layer(
        alpha, law.forcing(reference[:, :-1]), initial, half[2]
    )

    def layer_at(t: float) -> tuple[np.ndarray, np.ndarray]:
        i = min(int(t / half[2]), steps - 1)
        x, h = t / half[2] - i, half[2]
        y0, y1, d0, d1 = (
            layer[i],
            layer[i + 1],
            h * layer_rate[i],
            h * layer_rate[i + 1],
        )
        c2, c3 = 3 * (y1 - y0) - 2 * d0 - d1, 2 * (y0 - y1) + d0 + d1
        return y0 + x * (d0 + x * (c2 + x * c3)), (d0 + x * (2 * c2 + 3 * x * c3)) / h

    times = half[::2]
    errors = fly(
        law=law,
        reference=path,
        layer=layer_at,
        initial_error=error,
        adversary=adversary,
        times=times,
    )
    # Signs differ from trial to trial: the largest |y_j| of all of them count.
    opened = [
        TubeStart.of_error(one, initial, law.slope, chains).stages for one in error
    ]
    tube = propagate(
        law,
        reference=reference[:, :-1],
        bandwidth=alpha,
        start=TubeStart(np.max(opened, axis=0), chains.top(np.abs(error)).max(axis=0)),
        velocity_bound="comparison",
        step=half[2],
    )
    allowed = tube.error_bound[:, None] * (1 + 1e-5) + 1e-6
    assert (np.abs(errors) <= allowed).all()
    s = np.abs(law.sliding_variable(errors))
    assert (s <= tube.boundary_layer[:, None] * (1 + 1e-5)).all()
    assert not errors[..., ~chains.exists].any()
    at = Instant(
        state=reference[::2, :-1],
        highest=reference[::2, -1],
        gain=alpha[::2] * layer,
        error_bound=tube.error_bound,
    )
    middle, spread = input_range(law, at)
    for i, t in enumerate(times):
        value, value_rate = layer_at(t)
        u = law.control(
            state=reference[2 * i, :-1] + errors[i],
            reference=reference[2 * i],
            layer=value,
            layer_rate=value_rate,
        )
        assert (np.abs(u - middle[i]) <= spread[i] + 1e-4).all()
