"""Tightening: what the limits leave for the tube is really enough."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import (
    Instant,
    deviation_bound,
    feedback_bound,
    input_bound,
    input_range,
)
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain, Model
from dtmpc_drake.numerics.arrays import Array
from tests.models_for_tests import FractionOfBound, PlanarOnSlope, every_model, name_of


@dataclasses.dataclass
class CalmAway(FractionOfBound):
    """m = 1, whose error is largest at the origin: Δ = 2 / (1 + y²)."""

    order: int = 2
    num_outputs = 1

    def drift(self, x: Array) -> Array:
        """See base class."""
        return np.asarray(0.0 * x[..., 0, :])

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.drift(x)

    def model_error_bound(self, x: Array) -> Array:
        """See base class."""
        y = x[..., 0, :]
        return np.asarray(2.0 / (1.0 + y * y))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact, at the point of the box nearest the origin."""
        nearest = np.maximum(np.abs(x) - radius, 0.0)
        return self.model_error_bound(nearest)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class; exact, at the point of the box furthest from the origin."""
        return self.model_error_bound(np.abs(x) + radius)


models = pytest.mark.parametrize(
    "model", [*every_model(), CalmAway(), CalmAway(order=1)], ids=name_of
)


@dataclasses.dataclass
class Situation:
    """A reference, a box of errors around it, a layer, and states of the box."""

    law: SlidingLaw
    at: Instant
    states: Array
    inputs: Array

    @classmethod
    def draw(cls, model: Model, seed: int) -> Situation:
        """At random, with states inside the box and on its corners."""
        rng = np.random.default_rng(seed)
        n, m = model.order, model.num_outputs
        chains = Chains.of(model)
        reference = chains.reference_of(rng.uniform(-2, 2, (n + 1, m)))
        radius = chains.existing(rng.uniform(0, 1, (n, m)))
        slope, D, eta = rng.uniform(0.5, 3, m), rng.uniform(0, 1, m), 0.1
        gain = rng.uniform(0, 1.5, m)
        # The layer's rate that makes this gain, growing layers included.
        layer = rng.uniform(0.05, 0.5, m)
        law = SlidingLaw(model, slope, D, eta)
        layer_rate = law.forcing(reference[:n]) - gain
        unit = np.concatenate(
            [
                rng.uniform(-1, 1, (150, n, m)),
                rng.choice([-1.0, 0.0, 1.0], (150, n, m)),
            ]
        )
        states = reference[:n] + unit * radius
        inputs = law.control(
            state=states, reference=reference, layer=layer, layer_rate=layer_rate
        )
        at = Instant(reference[:n], reference[n], gain, radius)
        return cls(law, at, states, inputs)


seeds = st.integers(0, 2**32 - 1)


@models
@given(seed=seeds)
def test_the_feedback_bound_holds_everywhere_in_the_tube(
    model: Model, seed: int
) -> None:
    case = Situation.draw(model, seed)
    bound = feedback_bound(case.law, case.at)
    effect = np.einsum("bij,bj->bi", model.input_matrix(case.states), case.inputs)
    assert (np.abs(effect - case.at.highest) <= bound + 1e-9).all()


@models
@given(seed=seeds)
def test_the_input_bound_holds_everywhere_in_the_tube(model: Model, seed: int) -> None:
    case = Situation.draw(model, seed)
    bound = input_bound(case.law, case.at)
    assert bound.shape == ()
    assert np.linalg.norm(case.inputs, axis=-1).max() <= bound + 1e-9


@pytest.mark.parametrize(
    ("highest", "velocity_error"), [(5.0, 0.0), (0.0, 1.0)], ids=["nominal", "feedback"]
)
def test_how_the_input_matrix_changes_over_the_tube_matters(
    highest: float, velocity_error: float
) -> None:
    """The plain B⁻¹(x*) in place of its bound over the tube would fail here."""
    model = PlanarOnSlope(pull=0.0, roughness=0.0)
    reference = np.array([[0.0, 0.0], [0.0, 0.0], [highest, 0.0]])
    error = np.array([[1.0, 0.0], [velocity_error, 0.0]])
    law = SlidingLaw(model, np.full(2, 2.0), np.full(2, 0.0), 0.1)
    u = law.control(
        state=reference[:2] + error,
        reference=reference,
        layer=np.full(2, 0.1),
        layer_rate=np.full(2, 0.0),
    )

    def bound(position_tube: float) -> float:
        tube = np.array([[position_tube, 0.0], [velocity_error, 0.0]])
        at = Instant(reference[:2], reference[2], np.full(2, 0.1), tube)
        return float(input_bound(law, at))

    assert bound(0.0) < np.linalg.norm(u) <= bound(1.0)


@models
@given(seed=seeds)
def test_the_highest_derivative_stays_within_its_bound(model: Model, seed: int) -> None:
    """It is what the input and all that is unknown make of it."""
    case = Situation.draw(model, seed)
    rng = np.random.default_rng(seed)
    chains, at = case.law.chains, case.at
    each = [deviation_bound(case.law, at, k) for k in range(chains.order + 1)]
    for k in range(chains.order):
        state = chains.each > k
        assert (each[k] == at.error_bound[k])[state].all()
        assert not each[k][chains.each < k].any()
    bound = np.stack(each)[chains.each, np.arange(chains.num_outputs)]
    effect = np.einsum("bij,bj->bi", model.input_matrix(case.states), case.inputs)
    here = model.model_error_bound(case.states)
    f, d = rng.choice([-1.0, 1.0], (2, 20, *here.shape))
    highest = model.drift(case.states) + effect + f * here
    highest = highest + d * case.law.disturbance_bound
    assert (np.abs(highest - at.highest) <= bound + 1e-9).all()


@models
@given(seed=seeds)
def test_no_input_in_the_tube_is_out_of_its_range(model: Model, seed: int) -> None:
    case = Situation.draw(model, seed)
    middle, spread = input_range(case.law, case.at)
    assert (np.abs(case.inputs - middle) <= spread + 1e-9).all()


def test_the_feedback_bound_of_the_paper_by_hand() -> None:
    """ū_fb = Ĉ_d ‖v‖ |v| + λW + κ + (Δ̄ - Δ(x*)) with v = |ṙ*| + W."""
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    reference = np.array([[0.0, 0.0, 1.0], [0.0, -2.0, 0.0]])
    tube = np.array([[0.1, 0.1, 0.1], [0.0, 0.4, 0.0]])
    gain = np.array([0.6, 1.4, 0.6])
    law = SlidingLaw(model, np.full(3, 2.0), np.zeros(3), 0.1)
    found = feedback_bound(law, Instant(reference, np.zeros(3), gain, tube))
    along = 0.1 * 2.4**2 + 2 * 0.4 + 1.4 + 0.2 * (2.4**2 - 2.0**2)
    assert found == pytest.approx([0.6, along, 0.6], abs=1e-5)


def test_the_input_bound_without_a_tube_is_the_papers_sum_of_norms() -> None:
    model = IntegratorChain(num_outputs=3, order=2)
    at = Instant(
        state=np.zeros((2, 3)),
        highest=np.array([3.0, 4.0, 0.0]),
        gain=np.array([0.0, 0.6, 0.8]),
        error_bound=np.zeros((2, 3)),
    )
    found = input_bound(SlidingLaw(model, np.full(3, 2.0), np.zeros(3), 0.1), at)
    assert found == pytest.approx(6.0, abs=1e-5)


@models
def test_bounds_along_a_plan_are_those_of_each_instant(model: Model) -> None:
    rng = np.random.default_rng(2)
    n, m = model.order, model.num_outputs
    reference, radius = rng.normal(size=(4, n, m)), rng.uniform(0, 1, (4, n, m))
    highest, gain = rng.normal(size=(4, m)), rng.uniform(0, 1, (4, m))
    law = SlidingLaw(model, np.full(m, 2.0), np.zeros(m), 0.1)
    whole = input_bound(law, Instant(reference, highest, gain, radius))
    for i in range(4):
        one = Instant(reference[i], highest[i], gain[i], radius[i])
        single = input_bound(law, one)
        assert whole[i] == pytest.approx(single)
