"""Sliding control: the layer is invariant, whatever the plant may do."""

from __future__ import annotations

from collections.abc import Callable
from math import comb

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pydrake.autodiffutils import InitializeAutoDiff

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import (
    SlidingLaw,
    gain_crossover,
    saturation,
    sliding_variable,
    surface_coefficients,
)
from dtmpc_drake.models import ConstantUncertainty, IntegratorChain, Model
from dtmpc_drake.numerics.arrays import Array
from tests.models_for_tests import (
    every_adversary,
    every_model,
    fly,
    name_of,
    one_model_of_each_order,
    wave,
)

models = pytest.mark.parametrize("model", every_model(), ids=name_of)
each_order = pytest.mark.parametrize("model", one_model_of_each_order(), ids=name_of)
seeds = st.integers(0, 2**32 - 1)


def binomial_operator(error: Array, slope: Array, times: int) -> Array:
    """(d/dt + λ) applied repeatedly to a jet, one derivative lost each time."""
    for _ in range(times):
        error = error[1:] + slope * error[:-1]
    return error[0]


@given(order=st.integers(1, 5), seed=seeds)
def test_s_is_the_filter_applied_n_minus_one_times(order: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    error, slope = rng.normal(size=(order, 3)), rng.uniform(0.1, 5, 3)
    expected = binomial_operator(error, slope, order - 1)
    assert sliding_variable(error, slope) == pytest.approx(expected)


def test_the_papers_sliding_variable_for_two_derivatives() -> None:
    error = np.array([[0.1, -0.2], [0.5, 1.0]])
    slope = np.array([2.0, 3.0])
    assert sliding_variable(error, slope) == pytest.approx([0.7, 0.4])
    assert surface_coefficients(slope, 3) == pytest.approx(
        np.array([[4.0, 9.0], [4.0, 6.0], [1.0, 1.0]])
    )


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=6))
def test_saturation_is_the_identity_inside_and_one_outside(v: list[float]) -> None:
    value = np.array(v)
    expected = [x if abs(x) <= 1 else np.sign(x) for x in v]
    assert saturation(value) == pytest.approx(expected)


def test_saturation_has_derivatives() -> None:
    values = InitializeAutoDiff([[-2.0, -0.5, 0.5, 2.0]]).ravel()
    result = saturation(values)
    assert [r.value() for r in result] == [-1.0, -0.5, 0.5, 1.0]
    slopes = [r.derivatives()[i] for i, r in enumerate(result)]
    assert slopes == [0.0, 1.0, 1.0, 0.0]


def test_the_gain_and_the_bandwidth_are_the_papers() -> None:
    model = ConstantUncertainty(IntegratorChain(2, 1), np.array([0.4, 0.0]))
    law = SlidingLaw(model, np.full(2, 2.0), np.array([0.5, 0.5]), 0.1)
    anywhere, layer_rate = np.zeros((1, 2)), np.array([-0.2, 0.3])
    assert law.gain(anywhere, layer_rate) == pytest.approx([1.2, 0.3])
    layer = np.array([0.3, 0.1])
    implied = law.implied_bandwidth(anywhere, layer, layer_rate)
    assert implied == pytest.approx([4.0, 3.0])


@models
@given(seed=seeds)
def test_outside_the_layer_s_approaches_it_at_the_reaching_rate(
    model: Model, seed: int
) -> None:
    """d|s|/dt <= dΦ/dt - η at |s| >= Φ: at every state, for every f̃ and d."""
    rng = np.random.default_rng(seed)
    n, m, batch = model.order, model.num_outputs, 60
    slope, D = rng.uniform(0.3, 5, m), rng.uniform(0, 1, m)
    eta = 0.1
    layer, layer_rate = rng.uniform(0.05, 1, m), rng.uniform(-3, 3, m)
    chains = Chains.of(model)
    reference = chains.reference_of(rng.normal(size=(n + 1, m)))
    error = chains.existing(rng.normal(size=(batch, n, m)))
    # Place s on the surface of the layer, or beyond it.
    side = rng.choice([-1.0, 1.0], (batch, m))
    wanted = side * layer * rng.choice([1.0, 1.0, 3.0], (batch, m))
    s = sliding_variable(error, slope, chains)
    chains.set_row(error, chains.top(error) + wanted - s)
    state = reference[:n] + error
    u = SlidingLaw(model, slope, D, eta).control(
        state=state, reference=reference, layer=layer, layer_rate=layer_rate
    )
    f = rng.uniform(-1, 1, (batch, m)) * model.model_error_bound(state)
    d = rng.choice([-1.0, 1.0], (batch, m)) * D
    effect = np.einsum("bij,bj->bi", model.input_matrix(state), u)
    highest = model.drift(state) + f + effect + d
    # ds/dt from the jet itself: (d/dt + λ)^(n-1) of dỹ/dt.
    rates = np.concatenate([error[:, 1:], np.zeros((batch, 1, m))], axis=1)
    chains.set_row(rates, highest - reference[n])
    rate = sliding_variable(rates, slope, chains)
    assert (side * rate <= layer_rate - eta + 1e-9).all()


@given(seed=seeds)
def test_on_the_reference_with_nothing_unknown_the_control_is_feedforward(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    for model in every_model():
        reference = rng.normal(size=(model.order + 1, model.num_outputs))
        reference = Chains.of(model).reference_of(reference)
        state = reference[:-1]
        m = model.num_outputs
        law = SlidingLaw(model, np.full(m, 2.0), np.full(m, 0.5), 0.1)
        u = law.control(
            state=state,
            reference=reference,
            layer=np.array(0.3),
            layer_rate=np.array(0.0),
        )
        reached = model.drift(state) + model.input_matrix(state) @ u
        assert reached == pytest.approx(reference[-1])


def breathing_layer(
    mean: Array, depth: float, frequency: float
) -> Callable[[float], tuple[Array, Array]]:
    """An arbitrary C1 layer: what no solution of the planner looks like."""
    phase = np.arange(len(mean))

    def layer(t: float) -> tuple[Array, Array]:
        angle = frequency * t + phase
        value = mean * (1 + depth * np.sin(angle))
        return value, mean * depth * frequency * np.cos(angle)

    return layer


@each_order
@settings(max_examples=5)
@given(
    mean=st.floats(0.1, 0.5),
    depth=st.floats(0, 0.8),
    frequency=st.floats(0.2, 5),
    seed=seeds,
)
# A layer that grows faster than D + η: the gain K is negative for a while.
@example(mean=0.5, depth=0.8, frequency=5.0, seed=0)
def test_the_layer_is_invariant_for_any_smooth_layer(
    model: Model, mean: float, depth: float, frequency: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    n, m = model.order, model.num_outputs
    adversary, trials = every_adversary(seed)
    slope = rng.uniform(1, 3, m)
    layer = breathing_layer(np.full(m, mean), depth, frequency)
    times = np.arange(601) * 0.005
    # From anywhere in the layer, its surface included.
    error = rng.normal(scale=0.2, size=(trials, n, m))
    wanted = rng.choice([-1.0, 1.0, 0.5], (trials, m)) * layer(0.0)[0]
    error[:, -1] += wanted - sliding_variable(error, slope)
    errors = fly(
        law=SlidingLaw(model, slope, np.full(m, 0.5), 0.1),
        reference=wave(model, 1.0, 0.8),
        layer=layer,
        initial_error=error,
        adversary=adversary,
        times=times,
    )
    s = sliding_variable(errors, slope)
    ratio = np.abs(s) / np.stack([layer(t)[0] for t in times])[:, None]
    assert ratio.max() <= 1 + 1e-4


def test_the_layer_would_not_be_invariant_under_a_larger_disturbance() -> None:
    """The counterpart, so that the test above is known to be able to fail."""
    model = IntegratorChain(num_outputs=1, order=2)
    slope = np.array([2.0])

    def push(t: float, error: Array, s: Array) -> tuple[Array, Array]:
        return np.zeros_like(s), 1.5 * np.ones_like(s)

    errors = fly(
        law=SlidingLaw(model, slope, np.array([0.5]), 0.1),
        reference=wave(model, 1.0, 0.8),
        layer=lambda t: (np.array([0.3]), np.array([0.0])),
        initial_error=np.zeros((1, 2, 1)),
        adversary=push,
        times=np.arange(601) * 0.005,
    )
    # Beyond the layer by (1.5 D - D - η) for good: it leaves.
    assert np.abs(sliding_variable(errors, slope)).max() > 0.33


@models
def test_a_batch_of_controls_is_its_entries_one_by_one(model: Model) -> None:
    rng = np.random.default_rng(7)
    n, m = model.order, model.num_outputs
    state = rng.normal(size=(4, n, m))
    reference = rng.normal(size=(4, n + 1, m))
    layer, layer_rate = rng.uniform(0.1, 1, (4, m)), rng.normal(size=(4, m))

    law = SlidingLaw(model, np.full(m, 2.0), np.full(m, 0.5), 0.1)

    def one(state: Array, reference: Array, layer: Array, rate: Array) -> Array:
        return law.control(
            state=state, reference=reference, layer=layer, layer_rate=rate
        )

    whole = one(state, reference, layer, layer_rate)
    for i in range(4):
        single = one(state[i], reference[i], layer[i], layer_rate[i])
        assert whole[i] == pytest.approx(single)


def test_the_coefficients_are_those_of_the_control_law() -> None:
    """C(n-1, k-1) λ^(n-k) of the law is the surface's c_(k-1) times λ^0."""
    n, slope = 4, np.array([1.5])
    c = surface_coefficients(slope, n)[:, 0]
    law = [comb(n - 1, k - 1) * 1.5 ** (n - k) for k in range(1, n)]
    assert c[:-1] == pytest.approx(law)


def loop_gain(frequency: Array, bandwidth: Array, slope: Array, order: int) -> Array:
    """|L(jω)| of the loop broken at the plant's input, from its definition."""
    p = 1j * frequency
    loop = ((p + bandwidth) * (p + slope) ** (order - 1) - p**order) / p**order
    return np.asarray(abs(loop))


@given(order=st.integers(1, 10), seed=seeds)
def test_beyond_the_crossover_the_loop_does_not_amplify(order: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    alpha, slope = 10 ** rng.uniform(-2, 2, (7, 3)), 10 ** rng.uniform(-2, 2, 3)
    crossing = gain_crossover(bandwidth=alpha, slope=slope, order=order)
    assert crossing.shape == (7, 3)
    assert loop_gain(crossing, alpha, slope, order) == pytest.approx(1.0)
    for factor in np.geomspace(1.001, 1e3, 50):
        assert (loop_gain(factor * crossing, alpha, slope, order) < 1).all()
    # A first guess that needs no formula.
    assert crossing == pytest.approx(alpha + (order - 1) * slope, rel=0.035)


@given(seed=seeds)
def test_the_crossover_of_the_first_two_orders_has_a_closed_form(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = 10 ** rng.uniform(-2, 2, (2, 5))
    first = gain_crossover(bandwidth=a, slope=b, order=1)
    assert first == pytest.approx(a)
    second = gain_crossover(bandwidth=a, slope=b, order=2)
    square = (a + b) ** 2
    assert second**2 == pytest.approx(
        (square + np.sqrt(square**2 + 4 * (a * b) ** 2)) / 2
    )
    # Both filters are in the loop alike: only their sum and product count.
    swapped = gain_crossover(bandwidth=b, slope=a, order=2)
    assert second == pytest.approx(swapped)


@given(order=st.integers(1, 6), seed=seeds)
def test_at_the_crossover_the_control_law_answers_as_much_as_it_is_given(
    order: int, seed: int
) -> None:
    """A sine of ỹ^(n) with ω_c comes back from the law itself with its own size."""
    rng = np.random.default_rng(seed)
    model = IntegratorChain(num_outputs=2, order=order)
    alpha, slope = rng.uniform(0.3, 5, 2), rng.uniform(0.3, 5, 2)
    D, eta = np.full(2, 0.4), 0.1
    frequency = gain_crossover(bandwidth=alpha, slope=slope, order=order)
    powers = np.arange(order + 1)[:, None]
    jet = 1e-3 * 1j**powers * frequency ** (powers - order)  # within the layer

    def answer(error: Array) -> Array:
        return SlidingLaw(model, slope, D, eta).control(
            state=error,
            reference=np.zeros((order + 1, 2)),
            layer=(D + eta) / alpha,
            layer_rate=np.zeros(2),
        )

    back = answer(jet[:-1].real) + 1j * answer(jet[:-1].imag)
    assert abs(back) == pytest.approx(abs(jet[-1]), rel=1e-6)
