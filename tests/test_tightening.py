"""Tightening: what the limits leave for the tube is really enough."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtmpc_drake.method.sliding import control
from dtmpc_drake.method.tightening import feedback_bound, input_bound, rate_bound
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain, Model
from dtmpc_drake.numerics.arrays import Array
from tests.models_for_tests import FractionOfBound, PlanarOnSlope, every_model, name_of


@dataclasses.dataclass
class CalmAway(FractionOfBound):
    """n = 2, m = 1, whose error is largest at the origin: Δ = 2 / (1 + y²)."""

    num_outputs = 1
    order = 2

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


models = pytest.mark.parametrize("model", [*every_model(), CalmAway()], ids=name_of)


@dataclasses.dataclass
class Situation:
    """A reference, a box of errors around it, a layer, and states of the box."""

    model: Model
    reference: Array
    radius: Array
    gain: Array
    slope: Array
    D: Array
    states: Array
    inputs: Array

    @classmethod
    def draw(cls, model: Model, seed: int) -> Situation:
        """At random, with states inside the box and on its corners."""
        rng = np.random.default_rng(seed)
        n, m = model.order, model.num_outputs
        reference = rng.uniform(-2, 2, (n + 1, m))
        radius = rng.uniform(0, 1, (n, m))
        slope, D, eta = rng.uniform(0.5, 3, m), rng.uniform(0, 1, m), 0.1
        gain = rng.uniform(0, 1.5, m)
        # The layer's rate that makes this gain, growing layers included.
        layer = rng.uniform(0.05, 0.5, m)
        layer_rate = model.model_error_bound(reference[:n]) + D + eta - gain
        unit = np.concatenate(
            [
                rng.uniform(-1, 1, (150, n, m)),
                rng.choice([-1.0, 0.0, 1.0], (150, n, m)),
            ]
        )
        states = reference[:n] + unit * radius
        inputs = control(
            model=model,
            state=states,
            reference=reference,
            boundary_layer=layer,
            boundary_layer_rate=layer_rate,
            slope=slope,
            disturbance_bound=D,
            reaching_rate=eta,
        )
        return cls(model, reference, radius, gain, slope, D, states, inputs)


seeds = st.integers(0, 2**32 - 1)


@models
@given(seed=seeds)
def test_the_feedback_bound_holds_everywhere_in_the_tube(
    model: Model, seed: int
) -> None:
    case = Situation.draw(model, seed)
    bound = feedback_bound(
        model=model,
        reference=case.reference[:-1],
        error_bound=case.radius,
        gain=case.gain,
        slope=case.slope,
    )
    effect = np.einsum("bij,bj->bi", model.input_matrix(case.states), case.inputs)
    assert (np.abs(effect - case.reference[-1]) <= bound + 1e-9).all()


@models
@given(seed=seeds)
def test_the_input_bound_holds_everywhere_in_the_tube(model: Model, seed: int) -> None:
    case = Situation.draw(model, seed)
    bound = input_bound(
        model=model,
        reference=case.reference[:-1],
        highest=case.reference[-1],
        error_bound=case.radius,
        gain=case.gain,
        slope=case.slope,
    )
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
    u = control(
        model=model,
        state=reference[:2] + error,
        reference=reference,
        boundary_layer=np.full(2, 0.1),
        boundary_layer_rate=np.full(2, 0.0),
        slope=np.full(2, 2.0),
        disturbance_bound=np.full(2, 0.0),
        reaching_rate=0.1,
    )

    def bound(position_tube: float) -> float:
        tube = np.array([[position_tube, 0.0], [velocity_error, 0.0]])
        return float(
            input_bound(
                model=model,
                reference=reference[:2],
                highest=reference[2],
                error_bound=tube,
                gain=np.full(2, 0.1),
                slope=np.full(2, 2.0),
            )
        )

    assert bound(0.0) < np.linalg.norm(u) <= bound(1.0)


@models
@given(seed=seeds)
def test_the_rate_bound_tightens_the_speed_limit_by_enough(
    model: Model, seed: int
) -> None:
    case = Situation.draw(model, seed)
    rng = np.random.default_rng(seed)
    found = rate_bound(
        model=model,
        reference=case.reference[:-1],
        error_bound=case.radius,
        gain=case.gain,
        disturbance_bound=case.D,
    )
    if model.order > 1:
        assert (found == case.radius[1]).all()
        return
    # For n = 1 the speed is what the input and all that is unknown make of it.
    # The drift is cancelled, so it is f̃ + d - K sat(s / Φ) for any saturation.
    known = model.model_error_bound(case.reference[:-1])
    here = model.model_error_bound(case.states)
    gain = case.gain + here - known
    f, d, sat = rng.choice([-1.0, 1.0], (3, 20, *here.shape))
    speeds = f * here + d * case.D - gain * sat
    assert (np.abs(speeds) <= found + 1e-9).all()


def test_the_feedback_bound_of_the_paper_by_hand() -> None:
    """ū_fb = Ĉ_d ‖v‖ |v| + λW + κ + (Δ̄ - Δ(x*)) with v = |ṙ*| + W."""
    model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    reference = np.array([[0.0, 0.0, 1.0], [0.0, -2.0, 0.0]])
    tube = np.array([[0.1, 0.1, 0.1], [0.0, 0.4, 0.0]])
    gain = np.array([0.6, 1.4, 0.6])
    found = feedback_bound(
        model=model,
        reference=reference,
        error_bound=tube,
        gain=gain,
        slope=np.full(3, 2.0),
    )
    along = 0.1 * 2.4**2 + 2 * 0.4 + 1.4 + 0.2 * (2.4**2 - 2.0**2)
    assert found == pytest.approx([0.6, along, 0.6], abs=1e-5)


def test_the_input_bound_without_a_tube_is_the_papers_sum_of_norms() -> None:
    model = IntegratorChain(num_outputs=3, order=2)
    found = input_bound(
        model=model,
        reference=np.zeros((2, 3)),
        highest=np.array([3.0, 4.0, 0.0]),
        error_bound=np.zeros((2, 3)),
        gain=np.array([0.0, 0.6, 0.8]),
        slope=np.full(3, 2.0),
    )
    assert found == pytest.approx(6.0, abs=1e-5)


@models
def test_bounds_along_a_plan_are_those_of_each_instant(model: Model) -> None:
    rng = np.random.default_rng(2)
    n, m = model.order, model.num_outputs
    reference, radius = rng.normal(size=(4, n, m)), rng.uniform(0, 1, (4, n, m))
    highest, gain = rng.normal(size=(4, m)), rng.uniform(0, 1, (4, m))
    slope = np.full(m, 2.0)
    whole = input_bound(
        model=model,
        reference=reference,
        highest=highest,
        error_bound=radius,
        gain=gain,
        slope=slope,
    )
    for i in range(4):
        single = input_bound(
            model=model,
            reference=reference[i],
            highest=highest[i],
            error_bound=radius[i],
            gain=gain[i],
            slope=slope,
        )
        assert whole[i] == pytest.approx(single)
