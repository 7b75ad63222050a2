"""Models: what they bound is really bounded."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff
from pydrake.symbolic import Expression, MakeVectorVariable

from dtmpc_drake.models import (
    ConstantUncertainty,
    DragDoubleIntegrator,
    IntegratorChain,
    Model,
    SampledBoxBounds,
)
from dtmpc_drake.numerics.arrays import bends, euclidean_norm, jacobian, magnitude
from tests.models_for_tests import every_model, name_of

models = pytest.mark.parametrize("model", every_model(), ids=name_of)
seeds = st.integers(0, 2**32 - 1)


def draw_box(model: Model, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A centre, a radius, and states of the box: inside, on faces, on corners."""
    rng = np.random.default_rng(seed)
    shape = (model.order, model.num_outputs)
    # Some coordinates at exactly zero, where magnitudes have their kinks.
    x = rng.uniform(-3, 3, shape) * (rng.random(shape) > 0.2)
    radius = rng.uniform(0, 1.5, shape) * (rng.random(shape) > 0.2)
    inside = rng.uniform(-1, 1, (150, *shape))
    corners = rng.choice([-1.0, 0.0, 1.0], (150, *shape))
    return x, radius, x + radius * np.concatenate([inside, corners])


@models
@given(seed=seeds)
def test_bounds_over_a_box_hold_at_every_state_of_it(model: Model, seed: int) -> None:
    x, radius, states = draw_box(model, seed)
    drift = np.abs(model.drift(states))
    assert (drift <= model.drift_bound_over(x, radius) + 1e-12).all()
    error = model.model_error_bound(states)
    assert (error <= model.model_error_bound_over(x, radius) + 1e-12).all()
    assert (error >= model.model_error_bound_under(x, radius) - 1e-12).all()
    change = model.inverse_input_matrix(states) - model.inverse_input_matrix(x)
    allowed = model.inverse_input_deviation(x, radius)
    assert (np.abs(change) <= allowed + 1e-12).all()


@given(seed=seeds)
def test_the_drag_bounds_are_attained_at_a_corner(seed: int) -> None:
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    x, radius, _ = draw_box(model, seed)
    corner = x + np.where(x < 0, -1, 1) * radius
    assert model.drift_bound_over(x, radius) == pytest.approx(
        np.abs(model.drift(corner)), abs=1e-5
    )
    assert model.model_error_bound_over(x, radius) == pytest.approx(
        model.model_error_bound(corner), abs=1e-5
    )


@models
@given(seed=seeds)
def test_the_error_bound_covers_every_plant_in_the_interval(
    model: Model, seed: int
) -> None:
    _, _, states = draw_box(model, seed)
    if isinstance(model, ConstantUncertainty):  # holds up to its speed only
        speed = euclidean_norm(states[:, 1])
        states[:, 1] *= (2.5 / np.maximum(speed, 2.5))[:, None]
    for name in model.parameter_names:
        for value in np.linspace(*model.parameter_interval(name), 9):
            error = np.abs(
                model.true_drift(states, {name: value}) - model.drift(states)
            )
            assert (error <= model.model_error_bound(states) + 1e-6).all()


@pytest.mark.parametrize(
    "model",
    [m for m in every_model() if not isinstance(m, ConstantUncertainty)],
    ids=name_of,
)
def test_the_parameter_interval_is_no_wider_than_it_may_be(model: Model) -> None:
    _, _, states = draw_box(model, 1)
    for name in model.parameter_names:
        low, high = model.parameter_interval(name)
        for value in (low - 0.02, high + 0.02):
            error = np.abs(
                model.true_drift(states, {name: value}) - model.drift(states)
            )
            assert (error > model.model_error_bound(states)).any()


@models
def test_an_unknown_parameter_has_no_interval(model: Model) -> None:
    with pytest.raises(KeyError, match="colour"):
        model.parameter_interval("colour")


@models
@given(seed=seeds)
def test_a_batch_is_its_entries_one_by_one(model: Model, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-3, 3, (2, 3, model.order, model.num_outputs))
    radius = rng.uniform(0, 1, x.shape)
    functions = {
        "drift": lambda x, r: model.drift(x),
        "drift_bound_over": model.drift_bound_over,
        "model_error_bound": lambda x, r: model.model_error_bound(x),
        "model_error_bound_over": model.model_error_bound_over,
        "inverse_input_matrix": lambda x, r: model.inverse_input_matrix(x),
        "inverse_input_deviation": model.inverse_input_deviation,
        "input_matrix": lambda x, r: model.input_matrix(x),
    }
    for name, function in functions.items():
        whole = function(x, radius)
        for i in np.ndindex(2, 3):
            assert whole[i] == pytest.approx(function(x[i], radius[i])), name


@models
@given(seed=seeds)
def test_the_input_matrix_is_the_inverse_of_its_inverse(
    model: Model, seed: int
) -> None:
    _, _, states = draw_box(model, seed)
    product = model.input_matrix(states) @ model.inverse_input_matrix(states)
    expected = np.broadcast_to(np.eye(model.num_outputs), product.shape)
    assert product == pytest.approx(expected, abs=1e-12)


def test_the_plants_parameters_may_differ_in_a_batch() -> None:
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.1)
    x = np.broadcast_to([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]], (3, 2, 3))
    drift = model.true_drift(x, {"drag": np.array([0.0, 0.1, 0.2])})
    expected = np.outer([0.0, -0.5, -1.0], [3.0, 4.0, 0.0])
    assert drift == pytest.approx(expected, abs=1e-6)


def test_the_papers_constant_bound_of_the_third_experiment() -> None:
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    assert model.constant_model_error_bound(2.5) == pytest.approx([1.25] * 3)


@given(seed=seeds)
def test_the_constant_bound_covers_every_state_up_to_that_speed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for model in every_model():
        try:
            bound = model.constant_model_error_bound(2.5)
        except NotImplementedError:
            continue
        x = rng.normal(size=(100, model.order, model.num_outputs))
        if model.order > 1:
            speed = np.linalg.norm(x[:, 1], axis=-1, keepdims=True)
            x[:, 1] *= rng.uniform(0, 2.5, speed.shape) / speed
        # Up to the rounding of the norm.
        assert (model.model_error_bound(x) <= bound + 1e-6).all()


def test_constant_uncertainty_changes_nothing_but_the_error_bound() -> None:
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    constant = ConstantUncertainty(model, model.constant_model_error_bound(2.5))
    x, radius, states = draw_box(model, 3)
    assert (constant.drift(states) == model.drift(states)).all()
    assert (
        constant.drift_bound_over(x, radius) == model.drift_bound_over(x, radius)
    ).all()
    assert (constant.model_error_bound(states) == 1.25).all()
    assert (constant.model_error_bound_over(x, radius) == 1.25).all()
    assert constant.parameter_interval("drag") == model.parameter_interval("drag")
    assert constant.bounds_certified


class Bump(SampledBoxBounds):
    """Its error is largest in the middle of a box, where no corner looks."""

    num_outputs = 1
    order = 1

    def drift(self, x):
        return np.sin(x[..., 0, :])

    def model_error_bound(self, x):
        return np.exp(-np.square(x[..., 0, :] - 0.3))

    def true_drift(self, x, parameters):
        return self.drift(x)


def test_bounds_sampled_at_corners_admit_that_they_are_not_certified() -> None:
    model = Bump()
    x, radius = np.zeros((1, 1)), np.ones((1, 1))
    sampled = model.model_error_bound_over(x, radius)
    largest = model.model_error_bound(np.array([[0.3]]))
    assert sampled < largest
    assert not model.bounds_certified
    assert all(m.bounds_certified for m in every_model())
    assert not ConstantUncertainty(model, np.ones(1)).bounds_certified


def test_sampled_bounds_are_right_where_functions_are_monotone() -> None:
    class Sampled(SampledBoxBounds, IntegratorChain):
        def drift(self, x):
            return 2.0 * x[..., 1, :] + x[..., 0, :]

    model = Sampled(num_outputs=2, order=2)
    x = np.array([[[1.0, -1.0], [0.5, 0.0]]] * 4)
    radius = np.array([[[0.1, 0.2], [0.3, 0.4]]] * 4)
    expected = np.array([[2.0 + 0.1 + 0.6, 1.0 + 0.2 + 0.8]] * 4)
    assert model.drift_bound_over(x, radius) == pytest.approx(expected)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=4))
def test_smooth_norms_are_upper_bounds_by_at_most_a_millionth(v: list[float]) -> None:
    array = np.array(v)
    rounding = 1e-15 * np.abs(array).max()
    excess = magnitude(array) - np.abs(array)
    assert (excess >= -rounding).all()
    assert (excess <= 1.001e-6 + rounding).all()
    norm_excess = euclidean_norm(array) - np.linalg.norm(array)
    assert -rounding * 4 <= norm_excess <= 1.001e-6 + rounding * 4


@given(seed=seeds)
def test_central_differences_agree_with_the_analytic_jacobian(seed: int) -> None:
    v = np.random.default_rng(seed).uniform(-3, 3, (5, 3))
    model = DragDoubleIntegrator(drag_estimate=0.1)

    def drag(v: np.ndarray) -> np.ndarray:
        return model.drift(np.stack([0 * v, v], axis=-2))

    speed = np.linalg.norm(v, axis=-1)[:, None, None]
    outer = v[:, :, None] * v[:, None, :]
    expected = -0.1 * (speed * np.eye(3) + outer / speed)
    assert jacobian(drag, v) == pytest.approx(expected, abs=1e-6)


def test_a_jacobian_of_another_size_and_with_a_step_for_each_coordinate() -> None:
    point = np.array([[1.0, 2.0], [3.0, -1.0], [0.0, 0.0]])

    def function(x: np.ndarray) -> np.ndarray:
        a, b = x[..., 0], x[..., 1]
        return np.stack([a * b, a**2, 3 * b], axis=-1)

    a, b = point.T
    zero = 0 * a
    rows = [[b, a], [2 * a, zero], [zero, zero + 3]]
    expected = np.moveaxis(np.array(rows), -1, 0)
    # Differences of quadratics are exact for any step.
    step = np.array([0.5, 0.25])
    assert jacobian(function, point, step) == pytest.approx(expected, abs=1e-12)


def test_a_wide_secant_sees_a_kink_before_it_is_reached() -> None:
    point = np.array([[0.05]])
    assert jacobian(np.abs, point) == pytest.approx(1.0)
    assert jacobian(np.abs, point, 0.1) == pytest.approx(0.5)


@given(seed=seeds)
def test_slope_and_bend_meet_a_function_at_both_ends_of_the_step(seed: int) -> None:
    g = np.random.default_rng(seed)
    point, step = g.uniform(-1, 1, (6, 3)), g.uniform(0.01, 0.5, (6, 3))
    mixing = g.normal(size=(3, 2))

    def function(x: np.ndarray) -> np.ndarray:
        return np.abs(x) @ mixing + 0.3 * (x**2) @ mixing

    chosen = np.array([0, 2])
    slope = jacobian(function, point, step)
    bend = bends(function, point, step, chosen)
    for k, coordinate in enumerate(chosen):
        for sign in (-1.0, 1.0):
            offset = sign * step * np.eye(3)[coordinate]
            change = np.einsum("krp,kp->kr", slope, offset)
            change += bend[:, :, k] * step[:, coordinate, None]
            assert function(point + offset) - function(point) == pytest.approx(
                change, abs=1e-12
            )


def test_without_coordinates_there_are_no_bends() -> None:
    none = np.zeros(0, dtype=int)
    assert bends(np.abs, np.ones((4, 3)), 0.1, none).shape == (4, 3, 0)


@models
def test_models_are_differentiable_by_drake(model: Model) -> None:
    x = np.random.default_rng(5).uniform(0.3, 2, (model.order, model.num_outputs))
    radius = np.full_like(x, 0.1)

    def flat(function):
        return lambda p: function(p.reshape(*p.shape[:-1], *x.shape))

    for function in (
        model.drift,
        model.model_error_bound,
        lambda x: model.drift_bound_over(x, radius),
        lambda x: model.model_error_bound_over(x, radius),
    ):
        result = function(InitializeAutoDiff(x.ravel()).reshape(x.shape))
        if result.dtype != object:  # a constant has no gradient to check
            assert isinstance(model, ConstantUncertainty)
            continue
        assert isinstance(result[0], AutoDiffXd)
        gradient = ExtractGradient(result)
        expected = jacobian(flat(function), x.reshape(1, -1))[0]
        assert gradient == pytest.approx(expected, abs=1e-6)


# Numpy reads floating-point flags that symbolic arithmetic happens to set.
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
@models
def test_models_can_be_written_symbolically(model: Model) -> None:
    variables = MakeVectorVariable(model.order * model.num_outputs, "x")
    symbolic = np.array([Expression(v) for v in variables])
    value = np.random.default_rng(6).uniform(-2, 2, len(variables))
    environment = dict(zip(variables, value, strict=True))
    shape = (model.order, model.num_outputs)
    for function in (model.drift, model.model_error_bound):
        result = function(symbolic.reshape(shape))
        numbers = [
            e.Evaluate(environment) if isinstance(e, Expression) else e for e in result
        ]
        assert numbers == pytest.approx(function(value.reshape(shape)))
