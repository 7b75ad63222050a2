"""Plans: exact functions of time, and files that keep them exact."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.systems.primitives import TrajectorySource

from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.plan import Plan, join
from tests.models_for_tests import make_problem, name_of, one_model_of_each_order

seeds = st.integers(0, 2**32 - 1)
each_order = pytest.mark.parametrize("model", one_model_of_each_order(), ids=name_of)


def a_plan(model: Model, seed: int = 0, start_time: float = 1.5) -> Plan:
    """A random reference and bandwidth, with the tube that follows."""
    rng = np.random.default_rng(seed)
    transcription = Transcription(make_problem(model, start_time=start_time), 9)
    coefficients, bandwidth = straight_line(transcription)
    coefficients = coefficients + rng.normal(scale=0.1, size=coefficients.shape)
    bandwidth = rng.uniform(1, 3, bandwidth.shape)
    return transcription.plan(transcription.evaluate(coefficients, bandwidth))


def times_inside_pieces(grid: Array, seed: int) -> tuple[Array, Array]:
    """A random time well inside each piece, and the room to the piece's ends."""
    length = np.diff(grid)
    weight = np.random.default_rng(seed).uniform(0.2, 0.8, len(length))
    return grid[:-1] + weight * length, 0.2 * length


@each_order
@given(seed=seeds)
def test_each_row_of_the_reference_is_the_derivative_of_the_one_above(
    model: Model, seed: int
) -> None:
    plan = a_plan(model, seed)
    t, room = times_inside_pieces(plan.knots, seed)
    h = room[:, None, None] / 2
    at = [plan.reference(t + k * room / 2) for k in (-2, -1, 1, 2)]
    # This difference is exact for polynomials of degree four and less.
    slope = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h)
    assert plan.reference(t)[:, 1:] == pytest.approx(slope[:, :-1], abs=1e-8)


@each_order
def test_the_reference_is_continuous_up_to_its_highest_derivative(
    model: Model,
) -> None:
    plan = a_plan(model)
    inner = plan.knots[1:-1]
    before, after = plan.reference(inner - 1e-9), plan.reference(inner)
    assert before == pytest.approx(after, abs=1e-6)


@each_order
@given(seed=seeds)
def test_the_boundary_layer_rate_is_its_exact_derivative(
    model: Model, seed: int
) -> None:
    """Invariance rests on this: Φ moves by exactly the integral of its rate."""
    plan = a_plan(model, seed)
    middle, room = times_inside_pieces(plan.tube_times, seed)
    left, right = middle - room, middle + room
    # Gauss's rule of four points is exact for the derivative of degree six.
    points, weights = np.polynomial.legendre.leggauss(4)
    integral = sum(
        weight * room[:, None] * plan.boundary_layer_rate(middle + point * room)
        for point, weight in zip(points, weights, strict=True)
    )
    moved = plan.boundary_layer(right) - plan.boundary_layer(left)
    assert moved == pytest.approx(integral, abs=1e-13)


@each_order
def test_the_boundary_layer_is_c1(model: Model) -> None:
    plan = a_plan(model)
    inner = plan.tube_times[1:-1]
    for function in (plan.boundary_layer, plan.boundary_layer_rate):
        assert function(inner - 1e-12) == pytest.approx(function(inner), abs=1e-9)


@each_order
def test_a_layer_looked_up_once_is_the_layer_looked_up_twice(model: Model) -> None:
    plan = a_plan(model)
    t = np.linspace(plan.start_time - 1, plan.end_time + 1, 57)
    value, rate = plan.layer(t)
    assert (value == plan.boundary_layer(t)).all()
    assert (rate == plan.boundary_layer_rate(t)).all()


@each_order
def test_tube_and_bandwidth_meet_their_samples(model: Model) -> None:
    plan = a_plan(model)
    assert plan.bandwidth(plan.knots) == pytest.approx(plan.bandwidth_knots)
    middle = (plan.knots[1:] + plan.knots[:-1]) / 2
    mean = (plan.bandwidth_knots[1:] + plan.bandwidth_knots[:-1]) / 2
    assert plan.bandwidth(middle) == pytest.approx(mean)
    t = plan.tube_times
    assert plan.error_bound(t) == pytest.approx(plan.bound_samples)
    assert plan.position_tube(t) == pytest.approx(plan.bound_samples[:, 0])
    assert plan.boundary_layer(t[:-1]) == pytest.approx(plan.layer_coefficients[:, 0])
    rate = plan.boundary_layer_rate(t[:-1])
    assert rate == pytest.approx(plan.layer_coefficients[:, 1])


@each_order
def test_between_its_samples_the_tube_is_that_of_a_finer_grid(model: Model) -> None:
    plan = a_plan(model)
    coarse = dataclasses.replace(
        plan,
        tube_times=plan.tube_times[::2],
        layer_coefficients=plan.layer_coefficients[::2],
        bound_samples=plan.bound_samples[::2],
        bound_rate_samples=plan.bound_rate_samples[::2],
    )
    t = plan.tube_times[1::2]
    assert coarse.error_bound(t) == pytest.approx(plan.error_bound(t), abs=1e-4)
    assert coarse.boundary_layer(t) == pytest.approx(plan.boundary_layer(t), abs=1e-4)


@each_order
def test_the_bandwidth_is_the_one_that_the_layer_implies(model: Model) -> None:
    plan, problem = a_plan(model), make_problem(model)
    t = plan.tube_times
    known = model.model_error_bound(plan.reference(t)[:, : plan.order])
    layer, rate = plan.layer(t)
    gain = known + problem.law.disturbance_bound + problem.law.reaching_rate - rate
    assert gain / layer == pytest.approx(plan.bandwidth(t))


@each_order
def test_outside_its_time_a_plan_holds_its_first_and_last_values(
    model: Model,
) -> None:
    plan = a_plan(model)
    for function in (
        plan.reference,
        plan.bandwidth,
        plan.boundary_layer,
        plan.error_bound,
    ):
        assert (function(plan.start_time - 5) == function(plan.start_time)).all()
        assert (function(plan.end_time + 5) == function(plan.end_time)).all()


@each_order
def test_times_may_have_any_shape(model: Model) -> None:
    plan = a_plan(model)
    n, m = model.order, model.num_outputs
    assert (plan.order, plan.num_outputs) == (n, m)
    times = np.linspace(2, 5, 6).reshape(2, 3)
    for function, shape in (
        (plan.reference, (n + 1, m)),
        (plan.bandwidth, (m,)),
        (plan.boundary_layer, (m,)),
        (plan.boundary_layer_rate, (m,)),
        (plan.error_bound, (n, m)),
        (plan.position_tube, (m,)),
    ):
        assert function(3.0).shape == shape
        batch = function(times)
        assert batch.shape == (2, 3, *shape)
        assert batch[1, 2] == pytest.approx(function(times[1, 2]))


@each_order
def test_a_sample_has_every_field_on_at_most_five_milliseconds(model: Model) -> None:
    plan = a_plan(model)
    sample = plan.sample()
    time, m = sample["time"], model.num_outputs
    assert time[0] == plan.start_time and time[-1] == plan.end_time
    assert np.diff(time).max() <= 0.005 + 1e-12
    assert np.diff(time) == pytest.approx(np.full(len(time) - 1, time[1] - time[0]))
    fields = ["position", "velocity", "bandwidth", "boundary_layer"]
    fields += ["boundary_layer_rate", "position_tube"]
    if model.order >= 2:
        fields += ["acceleration", "velocity_tube"]
    for field in fields:
        assert sample[field].shape == (len(time), m), field
    reference = plan.reference(time)
    assert (sample["position"] == reference[:, 0]).all()
    assert (sample["velocity"] == reference[:, 1]).all()
    assert (sample["bandwidth"] == plan.bandwidth(time)).all()
    assert (sample["boundary_layer"] == plan.boundary_layer(time)).all()
    assert (sample["boundary_layer_rate"] == plan.boundary_layer_rate(time)).all()
    assert (sample["position_tube"] == plan.position_tube(time)).all()
    if model.order >= 2:
        assert (sample["acceleration"] == reference[:, 2]).all()
        assert (sample["velocity_tube"] == plan.error_bound(time)[:, 1]).all()


@given(
    start=st.floats(0, 100), duration=st.floats(0.01, 30), period=st.floats(0.001, 0.1)
)
def test_sample_times_are_never_further_apart_than_asked(
    start: float, duration: float, period: float
) -> None:
    knots = np.array([start, start + duration])
    zeros = np.zeros((2, 1))
    plan = Plan(
        knots=knots,
        coefficients=np.zeros((1, 3, 1)),
        bandwidth_knots=zeros,
        tube_times=knots,
        layer_coefficients=np.zeros((1, 8, 1)),
        bound_samples=np.zeros((2, 1, 1)),
        bound_rate_samples=np.zeros((2, 1, 1)),
    )
    times = plan.sample_times(period)
    assert times[0] == knots[0] and times[-1] == knots[-1]
    assert np.diff(times).max() <= period * (1 + 1e-6) + 1e-12


@each_order
def test_a_saved_plan_is_loaded_exactly(model: Model, tmp_path: Path) -> None:
    plan = a_plan(model)
    file = tmp_path / "plan.npz"
    plan.save(file)
    loaded = Plan.load(file)
    for field in dataclasses.fields(Plan):
        before, after = getattr(plan, field.name), getattr(loaded, field.name)
        assert before.dtype == after.dtype and (before == after).all(), field.name
    with np.load(file) as data:
        for name, value in plan.sample().items():
            assert (data[name] == value).all(), name


def test_a_plan_is_saved_under_exactly_the_name_it_was_given(tmp_path: Path) -> None:
    plan = a_plan(one_model_of_each_order()[0])
    plan.save(tmp_path / "my plan")
    assert [p.name for p in tmp_path.iterdir()] == ["my plan"]
    assert Plan.load(str(tmp_path / "my plan")).end_time == plan.end_time


def write_text(path: Path) -> None:
    path.write_text("name: known_environment\n")


def write_nothing(path: Path) -> None:
    path.write_bytes(b"")


def write_one_array(path: Path) -> None:
    with open(path, "wb") as file:
        np.save(file, np.zeros(3))


def write_other_arrays(path: Path) -> None:
    with open(path, "wb") as file:
        np.savez(file, time=np.zeros(3), position=np.zeros((3, 3)))


def write_half_a_plan(path: Path) -> None:
    a_plan(one_model_of_each_order()[0]).save(path)
    path.write_bytes(path.read_bytes()[:2000])


@pytest.mark.parametrize(
    "write",
    [
        write_text,
        write_nothing,
        write_one_array,
        write_other_arrays,
        write_half_a_plan,
    ],
)
def test_a_file_that_is_no_plan_says_so(write, tmp_path: Path) -> None:
    file = tmp_path / "wrong.npz"
    write(file)
    with pytest.raises(ValueError, match=r"wrong\.npz: not a saved plan") as error:
        Plan.load(file)
    assert "\n" not in str(error.value)


DAMAGE = {
    "a layer that is not a number": ("layer_coefficients", {3: np.nan}, "not a number"),
    "an infinite tube": ("bound_samples", {2: np.inf}, "infinite"),
    "times that do not increase": ("knots", {4: 1.6}, "must increase"),
    "a layer of nothing": ("layer_coefficients", {...: 0.0}, "not positive"),
    "a negative bandwidth": ("bandwidth_knots", {0: -1.0}, "not positive"),
    "a tube of another time": ("tube_times", {0: 1.4}, "begin and end"),
}


def saved_with(path: Path, **changes: object) -> None:
    """A plan's file with some of its arrays replaced."""
    a_plan(one_model_of_each_order()[1]).save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    with open(path, "wb") as file:
        np.savez(file, **(arrays | {f"plan_{n}": a for n, a in changes.items()}))


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_plan_is_refused_by_the_name_of_its_array(
    damage: str, tmp_path: Path
) -> None:
    field, changes, words = DAMAGE[damage]
    array = getattr(a_plan(one_model_of_each_order()[1]), field).copy()
    for row, value in changes.items():
        array[row] = value
    file = tmp_path / "damaged.npz"
    saved_with(file, **{field: array})
    with pytest.raises(ValueError, match=rf"damaged\.npz: .*{field}: .*{words}"):
        Plan.load(file)


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(Plan)])
@pytest.mark.parametrize(
    "array",
    [
        np.array([{}], dtype=object),
        np.zeros(3, dtype=complex),
        np.array(["a"]),
        np.zeros((0, 2)),
        np.zeros(()),
        np.zeros((2, 2, 2, 2)),
        np.arange(5),
    ],
    ids=["pickle", "complex", "text", "empty", "scalar", "axes", "whole"],
)
def test_no_other_array_is_taken_for_a_plans(
    field: str, array: np.ndarray, tmp_path: Path
) -> None:
    file = tmp_path / "damaged.npz"
    saved_with(file, **{field: array})
    with pytest.raises(ValueError, match=r"damaged\.npz: not a saved plan") as error:
        Plan.load(file)
    assert "\n" not in str(error.value)


@given(seed=seeds)
def test_damaged_bytes_are_a_value_error_or_a_plan(seed: int, tmp_path_factory) -> None:
    file = tmp_path_factory.mktemp("bytes") / "damaged.npz"
    a_plan(one_model_of_each_order()[1]).save(file)
    data = bytearray(file.read_bytes())
    g = np.random.default_rng(seed)
    for place in g.integers(0, len(data), g.integers(1, 20)):
        data[place] = g.integers(0, 256)
    file.write_bytes(data[: g.integers(len(data) // 2, len(data) + 1)])
    try:
        plan = Plan.load(file)
    except ValueError as error:
        assert str(error).startswith(f"{file}: not a saved plan")
    else:
        assert not list(plan.faults())


def test_a_missing_file_is_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Plan.load(tmp_path / "nothing.npz")


def test_a_plan_introduces_itself() -> None:
    text = repr(a_plan(one_model_of_each_order()[-1]))
    assert text.startswith("Plan(1.5 to 7.5 s, 9 intervals, order 3, 2 outputs")
    assert "rad/s" in text and "position tube at most" in text


@each_order
def test_a_part_of_a_plan_is_the_same_functions_of_time(model: Model) -> None:
    plan = a_plan(model)
    for start, end in ((2.03, 6.71), (plan.start_time, 3.0), (4.0, plan.end_time)):
        part = plan.between(start, end)
        assert (part.start_time, part.end_time) == (start, end)
        time = np.linspace(start, end, 301)
        for name in (
            "reference",
            "bandwidth",
            "boundary_layer",
            "boundary_layer_rate",
            "error_bound",
        ):
            whole, cut = getattr(plan, name)(time), getattr(part, name)(time)
            np.testing.assert_allclose(cut, whole, atol=1e-9, err_msg=name)


@each_order
def test_joined_plans_are_each_in_force_in_turn(model: Model) -> None:
    plan = a_plan(model)
    wider = dataclasses.replace(plan, bound_samples=2 * plan.bound_samples)
    joined = join([plan, wider, plan], [plan.start_time, 3.3, 5.0])
    assert (joined.start_time, joined.end_time) == (plan.start_time, plan.end_time)
    time = plan.sample_times()
    np.testing.assert_allclose(joined.reference(time), plan.reference(time), atol=1e-9)
    np.testing.assert_allclose(joined.bandwidth(time), plan.bandwidth(time), atol=1e-9)
    for start, end, expected in ((1.5, 3.29, plan), (3.3, 4.99, wider), (5, 7.5, plan)):
        inside = np.linspace(start, end, 50)
        np.testing.assert_allclose(
            joined.error_bound(inside), expected.error_bound(inside), atol=1e-9
        )


@each_order
@given(seed=seeds, start_time=st.floats(-20, 20))
def test_a_trajectory_of_drakes_is_the_plan(
    model: Model, seed: int, start_time: float
) -> None:
    """At any time: at knots and hand-overs, inside pieces, before and after."""
    first, second = (a_plan(model, seed + i, start_time) for i in range(2))
    joined = join([first, second, first], start_time + np.array([0.0, 1.7, 3.4]))
    for plan in (first, joined):
        reference, layer = plan.trajectory(), plan.layer_trajectory()
        tube = plan.tube_trajectory()
        for drawn in (reference, layer, tube):
            assert drawn.start_time() == plan.start_time
            assert drawn.end_time() == plan.end_time
            assert (drawn.rows(), drawn.cols()) == (plan.num_outputs, 1)
        rng = np.random.default_rng(seed)
        anywhere = rng.uniform(plan.start_time - 1, plan.end_time + 1, 40)
        for t in np.concatenate([plan.knots, plan.tube_times[::7], anywhere]).tolist():
            for k, row in enumerate(plan.reference(t)):
                assert at(reference, t, k) == pytest.approx(row, rel=1e-12, abs=1e-12)
            for k, row in enumerate(plan.layer(t)):
                assert at(layer, t, k) == pytest.approx(row, rel=1e-12, abs=1e-12)
            position_tube = plan.position_tube(t)
            assert at(tube, t, 0) == pytest.approx(position_tube, rel=1e-12, abs=1e-12)


def at(trajectory: Any, time: float, derivative: int) -> Array:
    if derivative == 0:
        return trajectory.value(time)[:, 0]
    return trajectory.EvalDerivative(time, derivative)[:, 0]


def test_a_source_of_drakes_gives_the_reference_and_its_derivatives() -> None:
    plan = a_plan(one_model_of_each_order()[1])
    source = TrajectorySource(plan.trajectory(), output_derivative_order=plan.order)
    context = source.CreateDefaultContext()
    context.SetTime(4.4)
    given = source.get_output_port().Eval(context)
    assert given == pytest.approx(plan.reference(4.4).ravel())


def test_nothing_in_a_plan_can_be_changed_so_copies_are_shared() -> None:
    plan = a_plan(one_model_of_each_order()[0])
    assert copy.deepcopy(plan) is plan
    with pytest.raises(ValueError, match="read-only"):
        plan.coefficients[0] = 0.0
