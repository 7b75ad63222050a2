"""Limits answer for themselves: at an instant, between knots, and for all times."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtmpc_drake.limits import InputLimit, Limit, LinearLimit, SpeedLimit
from dtmpc_drake.method.tightening import Instant
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

    def unit(self, law):
        return "m"

    def where(self, column):
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


@models
@given(seed=st.integers(0, 2**16))
def test_what_is_proven_is_below_every_sample_and_near(model, seed):
    """For any plan, kept or not, and for limits on any derivative."""
    problem, _, _, plan = some_plan(model, seed)
    enclosure = enclose(plan, problem, longest=1e-3, velocity_slack=2e-3)
    time = np.linspace(plan.start_time, plan.end_time, 6001)
    at = instants(problem.law, plan, time)
    for limit in (SpeedLimit(2.0), InputLimit(9.0), *fences(model, seed)):
        proven = limit.proven(enclosure).min(axis=0)
        dense = limit.margins(problem.law, at).min(axis=0)
        assert (proven <= dense + 1e-6).all()
        assert (proven >= dense - 0.05 * (1 + np.abs(dense))).all()


@models
@given(seed=st.integers(0, 2**16))
def test_no_error_inside_the_tube_breaks_a_margin(model, seed):
    rng = np.random.default_rng(seed)
    problem, _, _, plan = some_plan(model, seed)
    time = np.linspace(plan.start_time, plan.end_time, 300)
    at = instants(problem.law, plan, time)
    signs = rng.choice([-1.0, 1.0], (50, *at.error_bound.shape))
    state = at.state + signs * at.error_bound
    for limit in fences(model, seed):
        left = limit.flown(state, np.zeros(state.shape[:1] + at.highest.shape))
        assert (left >= limit.margins(problem.law, at) - 1e-9).all()


@models
@given(seed=st.integers(0, 2**16))
def test_control_points_are_below_every_sample(model, seed):
    """So a limit that holds at control points holds between the knots, too."""
    problem, _, iterate, _ = some_plan(model, seed)
    own = tuple(fences(model, seed))
    problem = dataclasses.replace(problem, own_limits=own)
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
    for limit, margin in zip(problem.linear, iterate.linear, strict=True):
        dense = tr.pieces(limit.margins(problem.law, at)).min(axis=1)
        assert (margin.min(axis=1) <= dense + 1e-9).all()


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
    fenced = dataclasses.replace(free, own_limits=(fence,))
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
        problem = dataclasses.replace(known_problem, own_limits=own)
        certificate = certify(known_result.plan, problem)
        assert not certificate.certified
        assert len(certificate.margins) == len(kept.margins) + 2
        (broken,) = certificate.broken
        assert broken.startswith(name)
