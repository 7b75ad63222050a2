"""Limits answer for themselves: at an instant, between knots, and for all times."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtmpc_drake.limits import (
    ConvexLimit,
    InputLimit,
    InputRange,
    Limit,
    LinearLimit,
    PositionLimit,
    SpeedLimit,
    flown,
)
from dtmpc_drake.limits.norms import MOST_READ, DerivativeNorm, InputNorm, Norm
from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.models import DragDoubleIntegrator
from dtmpc_drake.planning import certify, plan_problem
from dtmpc_drake.planning.proof.enclosure import enclose
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Planner
from tests.models_for_tests import every_model, make_problem, name_of

models = pytest.mark.parametrize("model", every_model(), ids=name_of)


@dataclasses.dataclass(frozen=True, eq=False)
class Fence(LinearLimit):
    """``a'y <= b`` for some rows, of the position or of another derivative."""

    rows: np.ndarray
    most: np.ndarray
    derivative: int = 0
    name = "fence"

    @property
    def bounds(self):
        return self.most

    @property
    def size(self):
        return 1.0

    def normals(self, num_outputs):
        return self.rows

    def unit(self, law, column=None):
        return "m"

    def where(self, law, column):
        return f"row {column}"


def instants(law, plan: Plan, time) -> Instant:
    n, y = law.order, plan.reference(time)
    gain = law.gain(y[:, :n], plan.boundary_layer_rate(time))
    return Instant(y[:, :n], y[:, n], gain, plan.error_bound(time))


def some_plan(model, seed: int) -> tuple:
    """A plan that keeps nothing, with the tube that follows."""
    rng = np.random.default_rng(seed)
    problem = make_problem(model)
    tr = Transcription(problem, 12)
    coefficients, bandwidth = straight_line(tr)
    coefficients = coefficients + rng.normal(scale=0.1, size=coefficients.shape)
    bandwidth = tr.bandwidth.feasible(rng.uniform(1, 3, bandwidth.shape))
    iterate = tr.evaluate(coefficients, bandwidth)
    return problem, tr, iterate, tr.plan(iterate)


def fences(model, seed: int) -> list[Limit]:
    rng = np.random.default_rng(seed + 1)
    m = model.num_outputs
    return [
        Fence(rng.normal(size=(4, m)), rng.normal(size=4), derivative=k)
        for k in range(model.order)
    ]


def convex_limits(model, seed: int) -> list[ConvexLimit]:
    """On every derivative, of every kind."""
    rng = np.random.default_rng(seed + 2)
    m = model.num_outputs
    low = rng.normal(size=m)
    norms = [
        DerivativeNorm(
            k, Norm(rng.normal(size=(2, m)), rng.normal(size=2), rng.uniform(1, 3))
        )
        for k in range(model.order + 1)
    ]
    return [
        *fences(model, seed),
        *norms,
        PositionLimit(min=low.tolist(), max=[float(low[0]) + 2.0] + [None] * (m - 1)),
        SpeedLimit(rng.uniform(1, 3, m).tolist()),
    ]


def all_limits(model, seed: int) -> list[Limit]:
    rng = np.random.default_rng(seed + 3)
    m = model.num_outputs
    high = rng.uniform(2, 9, m).tolist()
    return [
        *convex_limits(model, seed),
        InputLimit(9.0),
        InputRange(min=[-3.0] + [None] * (m - 1), max=high),
        InputNorm(Norm(rng.normal(size=(m, m)), rng.normal(size=m), 9.0)),
        InputNorm(Norm(None, None, 9.0)),
    ]


@models
@given(seed=st.integers(0, 2**16))
def test_what_is_proven_is_below_every_sample_and_near(model, seed):
    """For any plan, kept or not, and for limits on any derivative."""
    problem, _, _, plan = some_plan(model, seed)
    enclosure = enclose(plan, problem, longest=1e-3, velocity_slack=2e-3)
    time = np.linspace(plan.start_time, plan.end_time, 6001)
    at = instants(problem.law, plan, time)
    # The tube that a plan carries may be a little wider than the one that is proven.
    spare = 1e-6 + 10 * max(enclosure.claim_excess.max(), 0.0)
    assert spare < 1e-3
    for limit in (SpeedLimit(2.0), *all_limits(model, seed)):
        proven = limit.proven(enclosure).min()
        dense = limit.margins(problem.law, at).min()
        assert proven <= dense + spare
        assert proven >= dense - 0.05 * (1 + np.abs(dense))


@models
@given(seed=st.integers(0, 2**16))
def test_no_error_inside_the_tube_breaks_a_margin(model, seed):
    rng = np.random.default_rng(seed)
    problem, _, _, plan = some_plan(model, seed)
    time = np.linspace(plan.start_time, plan.end_time, 300)
    at = instants(problem.law, plan, time)
    signs = rng.choice([-1.0, 1.0], (50, *at.error_bound.shape))
    state = at.state + signs * at.error_bound
    for limit in convex_limits(model, seed):
        control = np.zeros(state.shape[:1] + at.highest.shape)
        left = flown(limit, plan.chains, state, control)
        read = limit.reads(model.num_outputs)
        if (read & (plan.chains.each <= limit.derivative)).any():
            assert left is None  # it is no state
            continue
        rounding = 1e-5  # of norms near zero
        margins = limit.margins(problem.law, at).min(axis=-1)
        assert (left.min(axis=-1) >= margins - rounding).all()


@models
@given(seed=st.integers(0, 2**16))
def test_control_points_are_below_every_sample(model, seed):
    """So a limit that holds at control points holds between the knots, too."""
    problem, _, iterate, _ = some_plan(model, seed)
    own = tuple(convex_limits(model, seed))
    problem = dataclasses.replace(problem, other_limits=own)
    tr = Transcription(problem, 12)
    iterate = tr.evaluate(*iterate.decisions)
    nodes = iterate.reference[::2]
    n = model.order
    alpha = tr._on_half_grid(iterate.bandwidth)[::2]
    at = Instant(
        nodes[:, :n],
        nodes[:, n],
        alpha * iterate.tube.boundary_layer,
        iterate.tube.error_bound,
    )
    for limit, margin in zip(problem.convex, iterate.convex, strict=True):
        dense = tr.pieces(limit.margins(problem.law, at)).min(axis=(1, 2))
        assert (margin.min(axis=(1, 2)) <= dense + 1e-9).all()


@pytest.mark.parametrize("backend", ["clarabel", "ipopt"])
@models
def test_a_fence_is_planned_around_and_certified(model, backend):
    """The cheapest plan comes too near; another one does not, tube and all."""
    m = model.num_outputs
    goal = np.zeros((model.order, m))
    goal[0, 0] = 2.0
    free = make_problem(model, goal=goal, duration=4.0)
    settings = Planner(intervals=16, backend=backend, time_limit=300.0)
    cheapest = plan_problem(free, settings)
    assert cheapest.certified
    rows, time = np.eye(m)[:1], np.linspace(0, 4, 1001)
    at = instants(free.law, cheapest.plan, time)
    farthest = float((at.state[:, 0, 0] + at.error_bound[:, 0, 0]).max())
    fence = Fence(rows, np.array([farthest - 0.03]))
    fenced = dataclasses.replace(free, other_limits=(fence,))
    broken = certify(cheapest.plan, fenced)
    assert broken.broken == ("fence",)
    assert broken.margins["fence"].where == "row 0"
    result = plan_problem(fenced, settings)
    assert result.certified, result.message
    assert fence.margins(free.law, instants(free.law, result.plan, time)).min() >= 0


@pytest.mark.parametrize("name", ["fence", "speed", "tube", "continuity"])
def test_no_margin_hides_another_one_of_its_name(known_result, known_problem, name):
    class Named(Fence):
        """Called as another one is."""

    Named.name = name
    far, near = (Named(np.eye(3)[:1], np.array([most])) for most in (9.0, -9.0))
    kept = certify(known_result.plan, known_problem)
    for own in ((far, near), (near, far)):
        problem = dataclasses.replace(known_problem, other_limits=own)
        certificate = certify(known_result.plan, problem)
        assert not certificate.certified
        assert len(certificate.margins) == len(kept.margins) + 2
        (broken,) = certificate.broken
        assert broken.startswith(name)


@models
@given(seed=st.integers(0, 2**16))
def test_slopes_of_convex_limits_are_those_of_what_is_left(model, seed):
    rng = np.random.default_rng(seed)
    m, h = model.num_outputs, 1e-6
    value, spread = rng.normal(size=(5, m)), rng.uniform(0.1, 1, (5, m))
    moves = h * np.eye(m)[:, None]
    for limit in convex_limits(model, seed):
        by_value, by_spread = limit.left_slopes(value, spread)
        ahead, behind = (limit.left(value + sign * moves, spread) for sign in (1, -1))
        found = np.moveaxis((ahead - behind) / (2 * h), 0, -1)
        np.testing.assert_allclose(by_value, found, rtol=1e-3, atol=1e-3)
        ahead, behind = (limit.left(value, spread + sign * moves) for sign in (1, -1))
        found = np.moveaxis((ahead - behind) / (2 * h), 0, -1)
        np.testing.assert_allclose(by_spread, found, rtol=1e-3, atol=1e-3)


@models
@given(seed=st.integers(0, 2**16))
def test_what_is_left_is_concave_and_falls_with_the_spread(model, seed):
    """Which is all that the control points and the proof rest on."""
    rng = np.random.default_rng(seed)
    m = model.num_outputs
    value, other = rng.normal(size=(2, 20, m))
    spread, wider = rng.uniform(0, 1, (2, 20, m))
    part = rng.uniform(0, 1, (20, 1))
    for limit in convex_limits(model, seed):
        left, right = limit.left(value, spread), limit.left(other, wider)
        between = limit.left(
            part * value + (1 - part) * other, part * spread + (1 - part) * wider
        )
        assert (between >= part * left + (1 - part) * right - 1e-9).all()
        least = left.min(axis=-1)
        assert (limit.left(value, spread + wider).min(axis=-1) <= least + 1e-9).all()
        inside = rng.uniform(-1, 1, (50, 20, m)) * spread
        found = limit.left(value + inside, np.zeros_like(inside)).min(axis=-1)
        assert (found >= least - 1e-5).all()


@given(seed=st.integers(0, 2**16))
def test_a_norm_of_many_numbers_is_bounded_from_above(seed):
    """Their box has too many corners to look at."""
    rng = np.random.default_rng(seed)
    m = MOST_READ + 1
    norm = Norm(rng.normal(size=(3, m)), rng.normal(size=3), 2.0)
    value, spread = rng.normal(size=m), rng.uniform(0, 1, m)
    inside = rng.uniform(-1, 1, (400, m)) * spread
    found = norm.left(value + inside, np.zeros(m))
    assert found.min() >= norm.left(value, spread).min() - 1e-5
    by_value, by_spread = norm.left_slopes(value, spread)
    h = 1e-6 * rng.normal(size=m)
    gained = norm.left(value + h, spread) - norm.left(value, spread)
    assert gained == pytest.approx(by_value @ h, rel=1e-2, abs=1e-9)
    gained = norm.left(value, spread + h) - norm.left(value, spread)
    assert gained == pytest.approx(by_spread @ h, rel=1e-2, abs=1e-9)


class Relaxed(Limit):
    """Another limit with something added to what is left of it."""

    name = "relaxed"

    def __init__(self, limit: Limit, amount: float) -> None:
        self.limit, self.amount = limit, amount

    def margins(self, law, at):
        return self.limit.margins(law, at) + self.amount

    def proven(self, enclosure):
        return self.limit.proven(enclosure) + self.amount

    def unit(self, law, column=None):
        return self.limit.unit(law, column)


def test_what_is_broken_only_between_knots_is_caught():
    """A limit of each kind that all knots of a plan keep, but no time between."""
    model, N, steps = DragDoubleIntegrator(0.1, 0.1), 12, 64
    problem = make_problem(model, goal=np.zeros((2, 3)))
    tr = Transcription(problem, N)
    planted = {}
    for seed in range(25):  # hovering, with a bandwidth that goes up and down
        coefficients, bandwidth = straight_line(tr)
        rng = np.random.default_rng(seed)
        bandwidth = tr.bandwidth.feasible(rng.uniform(0.5, 4, bandwidth.shape))
        plan = tr.plan(tr.evaluate(coefficients, bandwidth))
        time = np.linspace(plan.start_time, plan.end_time, N * steps + 1)
        at = instants(problem.law, plan, time)
        for number, limit in enumerate(all_limits(model, 0)):
            left = limit.margins(problem.law, at).min(axis=-1)
            knots, between = left[::steps].min(), left.min()
            if knots - between > planted.get(number, [1e-3])[0]:
                planted[number] = knots - between, limit, plan, (knots + between) / 2
    assert len(planted) == len(all_limits(model, 0))
    for gap, limit, plan, middle in planted.values():
        for amount in (-middle, gap - middle):
            own = (Relaxed(limit, amount),)
            limited = dataclasses.replace(problem, other_limits=own)
            margin = certify(plan, limited).margins["relaxed"].value
            assert (margin < 0) == (amount == -middle)
