"""What is called certified is so: planted faults, each with its own word."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtmpc_drake.method.margin import Margin
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.planning import Problem, certify, plan_problem
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Planner
from tests.models_for_tests import changed_problem, make_problem

UNKNOWN = ("not a number", "infinite")


# What is not a number.


class Poisoned(DragDoubleIntegrator):
    """A drag model one of whose answers is poisoned somewhere along the way."""

    def __init__(self, method: str, value: float) -> None:
        super().__init__(0.1, 0.0)
        self._method, self._value = method, value

    def _answer(self, method: str, x, answer):
        if method != self._method:
            return answer
        answer = np.array(answer, dtype=float)
        near = np.abs(x[..., 0, 1] - 7.0) < 0.2  # of 14 m
        answer[near] = self._value
        return answer

    def drift_bound_over(self, x, radius):
        return self._answer("drift_bound_over", x, super().drift_bound_over(x, radius))

    def model_error_bound(self, x):
        return self._answer("model_error_bound", x, super().model_error_bound(x))

    def model_error_bound_over(self, x, radius):
        bound = super().model_error_bound_over(x, radius)
        return self._answer("model_error_bound_over", x, bound)

    def model_error_bound_under(self, x, radius):
        bound = super().model_error_bound_under(x, radius)
        return self._answer("model_error_bound_under", x, bound)

    def inverse_input_matrix(self, x):
        return self._answer("inverse_input_matrix", x, super().inverse_input_matrix(x))

    def inverse_input_deviation(self, x, radius):
        bound = super().inverse_input_deviation(x, radius)
        return self._answer("inverse_input_deviation", x, bound)


POISONED = {
    "drift_bound_over": "input",
    "model_error_bound": "",
    "model_error_bound_over": "",
    "model_error_bound_under": "bandwidth_min",
    "inverse_input_matrix": "input",
    "inverse_input_deviation": "input",
}


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("method", POISONED)
def test_a_model_that_is_not_finite_somewhere_has_no_certificate(
    known_result, known_problem, method, value
):
    model = Poisoned(method, value)
    problem = changed_problem(known_problem, model=model)
    certificate = certify(known_result.plan, problem)
    assert not certificate.certified and not certificate.kept
    assert certificate.reason.startswith(UNKNOWN)
    assert POISONED[method] in certificate.reason
    assert "t = " in certificate.reason
    assert "sampled" not in str(certificate)


def test_a_model_that_is_not_finite_is_not_planned_for(known_result):
    """Neither as certified nor as infeasible: nothing can be said."""
    problem = make_problem(Poisoned("drift_bound_over", math.nan), duration=8.0)
    goal = problem.goal.copy()
    goal[0] = [0.0, 14.0, 0.0]
    result = plan_problem(
        dataclasses.replace(problem, goal=goal), Planner(intervals=24)
    )
    assert result.status == "failed" and result.plan is None
    assert "not a number in input" in result.message


LIMITS = {
    "input_limit": "input",
    "speed_limit": "speed",
    "bandwidth_min": "bandwidth_min",
    "bandwidth_max": "bandwidth_max",
    "bandwidth_rate_max": "bandwidth_rate",
    "slope": "",
    "disturbance_bound": "",
    "reaching_rate": "",
    "layer": "hand_over",
    "initial_error": "",
    "start": "ends",
    "start_time": "time",
    "duration": "time",
}


@pytest.mark.parametrize("field", LIMITS)
def test_a_limit_that_is_not_a_number_is_a_broken_one(
    known_result, known_problem, field
):
    law, bandwidth = known_problem.law, known_problem.bandwidth
    own = {
        "input_limit": known_problem.input.bound,
        "speed_limit": known_problem.speed.bound,
        "bandwidth_min": bandwidth.low,
        "bandwidth_max": bandwidth.high,
        "bandwidth_rate_max": bandwidth.rate,
        "slope": law.slope,
        "disturbance_bound": law.disturbance_bound,
        "reaching_rate": law.reaching_rate,
        "layer": known_problem.tube_start.layer,
        "initial_error": np.zeros((2, 3)),
    }
    value = own[field] if field in own else getattr(known_problem, field)
    poisoned = np.array(value, dtype=float)
    poisoned.flat[0] = np.nan
    problem = changed_problem(
        known_problem,
        **{field: poisoned if isinstance(value, np.ndarray) else math.nan},
    )
    certificate = certify(known_result.plan, problem)
    assert not certificate.certified
    assert certificate.reason.startswith("not a number in ")
    assert LIMITS[field] in certificate.reason


@pytest.mark.parametrize("field", ["input_limit", "speed_limit", "bandwidth_rate_max"])
def test_an_infinite_limit_is_no_limit_that_can_be_kept(
    known_result, known_problem, field
):
    problem = changed_problem(known_problem, **{field: math.inf})
    certificate = certify(known_result.plan, problem)
    assert not certificate.certified
    assert certificate.reason.startswith("infinite in ")


@pytest.mark.parametrize("field", ["shape", "center", "radius"])
def test_an_obstacle_that_is_not_a_number_is_not_passed(
    known_result, known_problem, field
):
    obstacles = known_problem.obstacles
    array = getattr(obstacles, field).copy()
    array[2] = np.nan
    poisoned = dataclasses.replace(obstacles, **{field: array})
    problem = dataclasses.replace(known_problem, obstacles=poisoned)
    certificate = certify(known_result.plan, problem)
    assert not certificate.certified
    assert certificate.reason.startswith("not a number in obstacles")
    assert "obstacle 2" in certificate.reason


def test_without_obstacles_there_is_no_margin_of_that_name(known_result, known_problem):
    none = known_problem.obstacles.subset(np.zeros(5, dtype=bool))
    problem = dataclasses.replace(known_problem, obstacles=none)
    certificate = certify(known_result.plan, problem)
    assert certificate.certified
    assert "obstacles" not in certificate.margins


# What is no plan, or not this problem's.


def changed(plan: Plan, **arrays: Callable[[np.ndarray], np.ndarray]) -> Plan:
    return dataclasses.replace(
        plan, **{n: f(getattr(plan, n).copy()) for n, f in arrays.items()}
    )


def put(row, value):
    def change(array):
        array[row] = value
        return array

    return change


def add(rows, value):
    def change(array):
        array[rows] += value
        return array

    return change


# Of real numbers; what `orders` may be is in test_mixed_orders.
FIELDS = [field.name for field in dataclasses.fields(Plan) if field.name != "orders"]


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("field", FIELDS)
def test_an_array_that_is_not_finite_is_named(
    known_result, known_problem, field, value
):
    certificate = certify(
        changed(known_result.plan, **{field: put(5, value)}), known_problem
    )
    assert not certificate.certified
    assert certificate.reason.startswith(f"{field}: ")
    assert any(word in certificate.reason for word in UNKNOWN)


@pytest.mark.parametrize("field", FIELDS)
def test_an_array_of_another_shape_is_named(known_result, known_problem, field):
    cut = changed(known_result.plan, **{field: lambda a: a[:-1]})
    certificate = certify(cut, known_problem)
    assert not certificate.certified
    # Times give the others their shape, so those are named in their stead.
    assert ":" in certificate.reason and "shape" in certificate.reason


def test_a_plan_of_another_order_is_told_so(known_result):
    other = make_problem(IntegratorChain(3, 3))
    certificate = certify(known_result.plan, other)
    assert "order 2" in certificate.reason and "order 3" in certificate.reason


PLANTED = {
    "the reference jumps": (
        {"coefficients": add((slice(20, None), 0, 0), 0.3)},
        ("continuity", "y* on axis x"),
    ),
    "its velocity jumps": (
        {"coefficients": add((slice(20, None), 1, 1), 1e-3)},
        ("continuity", "y*^(1) on axis y"),
    ),
    "the layer jumps": (
        {"layer_coefficients": add((slice(100, None), 0, 2), 1e-3)},
        ("continuity", "Φ* on axis z"),
    ),
    "it starts later": (
        {"knots": add(..., 0.1), "tube_times": add(..., 0.1)},
        ("time",),
    ),
    "it takes longer": (
        {"knots": lambda a: 1.01 * a, "tube_times": lambda a: 1.01 * a},
        ("time", "continuity"),
    ),
    "the layer starts thicker": (
        {"layer_coefficients": add((slice(None), 0), 0.01)},
        ("hand_over", "Φ*"),
    ),
    "the bandwidth has nothing to do with the layer": (
        {"bandwidth_knots": put(..., 1.0)},
        ("bandwidth_knots",),
    ),
    "one knot of the bandwidth is another": (
        {"bandwidth_knots": add((30, 1), 0.2)},
        ("bandwidth_knots",),
    ),
    "it starts elsewhere": (
        {"coefficients": add((slice(None), 0, 2), 1e-3)},
        ("ends", "y*^(0) on axis z"),
    ),
}


@pytest.mark.parametrize("fault", PLANTED)
def test_a_planted_fault_is_found_and_named(known_result, known_problem, fault):
    changes, words = PLANTED[fault]
    certificate = certify(changed(known_result.plan, **changes), known_problem)
    assert not certificate.certified
    name = words[0]
    assert not certificate.margins[name].kept
    line = certificate.margins[name].named(name)
    assert all(word in line for word in words[1:] if word not in certificate.margins)


HAND_OVER = {
    "start_highest": ("y*^(2)", 0.05),
    "start_bandwidth": ("α", 0.05),
    "layer": ("Φ*", 1e-3),
}


@pytest.mark.parametrize("field", HAND_OVER)
def test_what_a_hand_over_asks_for_is_part_of_the_proof(
    known_result, known_problem, field
):
    plan, name = known_result.plan, HAND_OVER[field][0]
    asked = {
        "start_highest": plan.reference(0.0)[2],
        "start_bandwidth": plan.bandwidth(0.0),
        "layer": plan.boundary_layer(0.0),
    }
    problem = changed_problem(known_problem, **asked)
    assert certify(plan, problem).certified
    wrong = changed_problem(problem, **{field: asked[field] + HAND_OVER[field][1]})
    certificate = certify(plan, wrong)
    assert not certificate.margins["hand_over"].kept
    assert name in certificate.margins["hand_over"].where
    assert not certificate.certified


def test_a_broken_margin_never_reads_as_zero():
    margin = Margin(-2e-6, "m", 1.0, "obstacle 3")
    assert (
        margin.named("obstacles") == "obstacles -2.0e-06 m at t = 1.00 s (obstacle 3)"
    )
    assert not margin.kept
    assert Margin(0.0, "m", 1.0, "").kept


# The bandwidth.


def implied_bandwidth(plan: Plan, problem: Problem, time):
    """(Δ + D + η - dΦ*/dt)/Φ* for constant Δ."""
    layer, rate = plan.layer(time)
    delta = problem.model.model_error_bound(problem.start)
    return (
        delta + problem.law.disturbance_bound + problem.law.reaching_rate - rate
    ) / layer


def implied_rate(plan: Plan, problem: Problem) -> float:
    """The largest, by differences within the steps of the layer's grid."""
    fraction = np.linspace(1e-4, 1 - 1e-4, 33)
    step = np.diff(plan.tube_times)[:, None]
    time = plan.tube_times[:-1, None] + step * fraction
    alpha = implied_bandwidth(plan, problem, time)
    slope = np.diff(alpha, axis=1) / (step * (fraction[1] - fraction[0]))[..., None]
    return float(np.abs(slope).max())


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    order=st.integers(1, 3),
    highest=st.floats(5.0, 60.0),
    rate=st.floats(0.05, 40.0),
    layer=st.floats(0.02, 0.6),
)
def test_the_bandwidth_that_a_certified_layer_implies_keeps_its_rate(
    seed, order, highest, rate, layer
):
    """Also fast ones that leave a thick layer and change slowly."""
    g = np.random.default_rng(seed)
    problem = make_problem(
        IntegratorChain(2, order, float(g.choice([0.0, 0.1]))),
        bandwidth_max=np.full(2, highest),
        bandwidth_rate_max=rate,
        bandwidth_weight=float(g.choice([0.0, 0.1])),
        layer=np.full(2, layer),
        duration=float(g.uniform(1.5, 6.0)),
        input_limit=1000.0,
        speed_limit=100.0,
    )
    result = plan_problem(problem, Planner(intervals=int(g.integers(8, 24))))
    assert result.certified, result
    dense = implied_rate(result.plan, problem)
    assert dense <= rate * (1 + 1e-6)
    margin = result.certificate.margins["bandwidth_rate"].value
    assert 0 <= margin <= rate - dense + 1e-6 * rate
    assert margin >= rate - dense - 1e-2 * rate - 1e-3  # and it is no wild bound


def test_a_layer_of_cubics_breaks_the_rate_and_is_caught():
    """The second derivative of cubics through Φ and dΦ/dt jumps at every sample."""
    problem = make_problem(
        IntegratorChain(2, 1, 0.0),
        bandwidth_min=np.full(2, 55.0),
        bandwidth_max=np.full(2, 60.0),
        bandwidth_rate_max=0.1,
        layer=np.full(2, 0.6),
        duration=1.5,
        input_limit=1000.0,
        speed_limit=100.0,
    )
    result = plan_problem(problem, Planner(intervals=8))
    plan = result.plan
    h = np.diff(plan.tube_times)[:, None]
    value, rate = plan.layer(plan.tube_times)
    rise = np.diff(value, axis=0) / h
    cubic = np.stack(
        [
            value[:-1],
            rate[:-1],
            (3 * rise - 2 * rate[:-1] - rate[1:]) / h,
            (rate[:-1] + rate[1:] - 2 * rise) / h**2,
        ],
        axis=1,
    )
    rough = dataclasses.replace(plan, layer_coefficients=cubic)
    assert implied_rate(rough, problem) > 1.0
    certificate = certify(rough, problem)
    assert not certificate.margins["bandwidth_rate"].kept


def test_where_the_model_error_varies_the_rate_is_that_of_the_knots():
    problem = make_problem(DragDoubleIntegrator(0.1, 0.1))
    result = plan_problem(problem, Planner(intervals=24))
    assert result.certified
    assert "bandwidth_knots_rate" in result.certificate.margins
    assert "bandwidth_rate" not in result.certificate.margins
    # And the implied one is near it for all times.
    plan = result.plan
    time = plan.sample_times(1e-3)
    layer, rate = plan.layer(time)
    model_error = problem.model.model_error_bound(plan.reference(time)[:, :2])
    constant = problem.law.disturbance_bound + problem.law.reaching_rate
    implied = (model_error + constant - rate) / layer
    off = np.abs(implied - plan.bandwidth(time)) / plan.bandwidth(time)
    assert off.max() <= 5e-3


# Any perturbation.


def dense_complaints(plan: Plan, problem: Problem) -> list[str]:
    """What a dense integration from the formulas alone has against a plan.

    For known quadratic drag (n = 2, B = 1, Δ = 0): written without the package's
    mathematics, in 10 ms steps of Runge-Kutta's fourth order.
    """
    steps = 2 * int(problem.duration / 5e-3)
    half = problem.start_time + problem.duration * np.arange(2 * steps + 1) / (
        2 * steps
    )
    h = problem.duration / steps
    y = plan.reference(half)
    layer, layer_rate = plan.layer(half)
    law = problem.law
    D, eta, slope = law.disturbance_bound, law.reaching_rate, law.slope
    gain = D + eta - layer_rate
    alpha = gain / layer
    found = []
    jump = np.abs(np.diff(y[:, :2], axis=0))[:, 0].max(initial=0.0)
    if jump > 2 * h * np.abs(y[:, 1]).max() + 1e-6:
        found.append("y* jumps")
    if np.abs(np.diff(layer, axis=0)).max() > 2 * h * np.abs(layer_rate).max() + 1e-6:
        found.append("Φ jumps")

    def rates(i, x):
        omega, W = x
        return np.stack(
            [
                layer[i] - slope * omega,
                D + alpha[i] * slope * omega - (alpha[i] + slope) * W,
            ]
        )

    # For n = 2 the first stage is the position's own error.
    x = np.stack([problem.tube_start.stages[0], problem.tube_start.highest])
    tube = [x]
    for i in range(0, 2 * steps, 2):
        k1 = rates(i, x)
        k2 = rates(i + 1, x + h / 2 * k1)
        k3 = rates(i + 1, x + h / 2 * k2)
        k4 = rates(i + 2, x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        tube.append(x)
    omega, W = np.array(tube).swapaxes(0, 1)
    y, alpha, gain, time = y[::2], alpha[::2], gain[::2], half[::2]
    speed = np.abs(y[:, 1]) + W
    drag = problem.model.drag_estimate
    fast = np.linalg.norm(speed, axis=1, keepdims=True)
    feedback = drag * fast * speed + slope * W + np.abs(gain)
    used = np.linalg.norm(y[:, 2], axis=1) + np.linalg.norm(feedback, axis=1)
    obstacles = problem.obstacles
    offset = np.einsum("oij,kj->koi", obstacles.shape, y[:, 0]) - obstacles.center
    wide = np.einsum("oij,kj->koi", np.abs(obstacles.shape), omega)
    clear = np.linalg.norm(offset, axis=-1) - np.linalg.norm(wide, axis=-1)
    hair = 1e-6
    checks = {
        "obstacles": (clear - obstacles.radius).min(),
        "speed": problem.speed.bound - speed.max(),
        "input": problem.input.bound - used.max(),
        "bandwidth_min": (alpha - problem.bandwidth.low).min(),
        "bandwidth_max": (problem.bandwidth.high - alpha).min(),
        "layer": layer.min(),
        "start": 1e-5 - np.abs(y[0, :2] - problem.start).max(),
        "goal": 1e-5 - np.abs(y[-1, :2] - problem.goal).max(),
        "bandwidth_knots": 0.05 - np.abs(alpha - plan.bandwidth(time)).max(),
        "position_tube": 1e-3 - (omega - plan.error_bound(time)[:, 0]).max(),
        "velocity_tube": 3e-3 - (W - plan.error_bound(time)[:, 1]).max(),
    }
    # Written so that what is not a number is a complaint.
    found += [name for name, value in checks.items() if not value >= -hair]
    return found


def test_the_plan_itself_has_nothing_against_it(known_result, known_problem):
    assert dense_complaints(known_result.plan, known_problem) == []


KINDS = ("nan", "infinity", "entry", "noise", "swap", "scale", "row")


@settings(max_examples=100)
@given(
    field=st.sampled_from(FIELDS),
    kind=st.sampled_from(KINDS),
    size=st.floats(-12.0, 1.0),
    seed=st.integers(0, 2**31),
)
def test_a_perturbed_plan_is_certified_truly_or_refused_by_name(
    known_result: PlanningResult,
    known_problem: Problem,
    field: str,
    kind: str,
    size: float,
    seed: int,
):
    g = np.random.default_rng(seed)
    array = getattr(known_result.plan, field).copy()
    entry = tuple(g.integers(0, n) for n in array.shape)
    if kind == "nan":
        array[entry] = np.nan
    elif kind == "infinity":
        array[entry] = g.choice([-np.inf, np.inf])
    elif kind == "entry":
        array[entry] += 10.0**size * g.normal()
    elif kind == "noise":
        array += 10.0**size * g.normal(size=array.shape)
    elif kind == "swap":
        other = int(g.integers(0, len(array)))
        array[[entry[0], other]] = array[[other, entry[0]]]
    elif kind == "scale":
        array *= 1 + 10.0**size * g.normal()
    else:
        array = np.delete(array, entry[0], axis=0)
    plan = dataclasses.replace(known_result.plan, **{field: array})
    certificate = certify(plan, known_problem)
    if certificate.certified:
        assert dense_complaints(plan, known_problem) == []
        return
    assert certificate.reason and "\n" not in certificate.reason
    if not certificate.faults:
        name, margin = certificate.worst
        assert not margin.kept and name in certificate.reason
    assert "sampled" not in certificate.reason


def test_some_perturbations_are_certified(known_result, known_problem):
    """Else the claim above would be empty."""
    plan = known_result.plan
    wider = dataclasses.replace(plan, bound_samples=plan.bound_samples * 1.001)
    for harmless in (
        wider,
        changed(plan, coefficients=add((slice(None), 0, 0), 1e-8)),
        changed(plan, bandwidth_knots=add((slice(None), 1), 1e-9)),
    ):
        assert certify(harmless, known_problem).certified
