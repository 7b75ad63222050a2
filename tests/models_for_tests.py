"""Models, problems and adversaries that the tests share.

The paper's vehicle has n = 2, m = 3 and B = I.  The method claims none of that,
so these models differ in every one of them.  Each differs from the truth by a
fraction, in [-1, 1], of its own error bound.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dtmpc_drake.costs import BandwidthCost, InputCost
from dtmpc_drake.limits import BandwidthLimit, InputLimit, SpeedLimit
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tube import TubeStart
from dtmpc_drake.models import (
    ConstantUncertainty,
    DragDoubleIntegrator,
    IntegratorChain,
    LaggedMultirotor,
    Model,
    register_model,
)
from dtmpc_drake.numerics.arrays import Array, magnitude
from dtmpc_drake.obstacles import ObstacleSet
from dtmpc_drake.planning.problem import Problem


class FractionOfBound(Model):
    """A model whose true drift is F = F̂ + (a fraction in [-1, 1]) Δ(x)."""

    parameter_names = ("error_fraction",)

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """See base class."""
        fraction = np.asarray(parameters["error_fraction"])[..., None]
        return np.asarray(self.drift(x) + fraction * self.model_error_bound(x))

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        if name != "error_fraction":
            raise KeyError(name)
        return -1.0, 1.0

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since every Δ here grows with every ``|x|``."""
        return self.model_error_bound(np.maximum(np.abs(x) - radius, 0.0))


@register_model
@dataclasses.dataclass
class ThirdOrderPlanar(FractionOfBound):
    """n = 3, m = 2: ``d³y/dt³ = -damping ÿ + u``, Δ = offset + growth ‖ẏ‖²."""

    damping: float = 0.3
    offset: float = 0.1
    growth: float = 0.05

    num_outputs = 2
    order = 3

    def drift(self, x: Array) -> Array:
        """See base class."""
        return np.asarray(-self.damping * x[..., 2, :])

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact."""
        return np.asarray(self.damping * (magnitude(x) + radius)[..., 2, :])

    def model_error_bound(self, x: Array) -> Array:
        """See base class."""
        v = x[..., 1, :]
        square = np.asarray((v * v).sum(axis=-1))[..., None]
        return np.asarray(self.offset + self.growth * square + 0.0 * v)

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact up to the rounding of the magnitude."""
        return self.model_error_bound(magnitude(x) + radius)

    def constant_model_error_bound(self, speed: float) -> Array:
        """See base class."""
        return np.full(2, self.offset + self.growth * speed**2)


@register_model
@dataclasses.dataclass
class PlanarOnSlope(FractionOfBound):
    """n = 2, m = 2, B depends on where it is: a skewed vehicle on rough ground.

    ``ÿ = -pull sin(y) + B(y) u`` with
    ``B⁻¹ = [[1.5 + 0.3 sin y₀, 0.2 cos y₁], [-0.2, 1.2 + 0.2 sin y₁]]``
    and ``Δ = roughness (1 + |ẏ|)``.
    """

    pull: float = 0.2
    roughness: float = 0.1

    num_outputs = 2
    order = 2

    def drift(self, x: Array) -> Array:
        """See base class."""
        return np.asarray(-self.pull * np.sin(x[..., 0, :]))

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; the slope of a sine is at most one."""
        return np.asarray(
            magnitude(self.drift(x)) + self.pull * np.asarray(radius)[..., 0, :]
        )

    def model_error_bound(self, x: Array) -> Array:
        """See base class."""
        return np.asarray(self.roughness * (1.0 + magnitude(x[..., 1, :])))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact up to the rounding of the magnitude."""
        return self.model_error_bound(magnitude(x) + radius)

    def inverse_input_matrix(self, x: Array) -> Array:
        """See base class."""
        y = x[..., 0, :]
        s, c = np.sin(y), np.cos(y)
        rows = [
            [1.5 + 0.3 * s[..., 0], 0.2 * c[..., 1]],
            [-0.2 + 0.0 * s[..., 0], 1.2 + 0.2 * s[..., 1]],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    def inverse_input_deviation(self, x: Array, radius: Array) -> Array:
        """See base class; the slope of sine and cosine is at most one."""
        r = np.asarray(radius)[..., 0, :]
        rows = [
            [0.3 * r[..., 0], 0.2 * r[..., 1]],
            [0.0 * r[..., 0], 0.2 * r[..., 1]],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@register_model
@dataclasses.dataclass
class FirstOrderScalar(FractionOfBound):
    """n = 1, m = 1: ``ẏ = -decay y + u`` with Δ = offset + growth |y|."""

    decay: float = 0.2
    offset: float = 0.05
    growth: float = 0.1

    num_outputs = 1
    order = 1

    def drift(self, x: Array) -> Array:
        """See base class."""
        return np.asarray(-self.decay * x[..., 0, :])

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact."""
        return np.asarray(self.decay * (magnitude(x) + radius)[..., 0, :])

    def model_error_bound(self, x: Array) -> Array:
        """See base class."""
        return np.asarray(self.offset + self.growth * magnitude(x[..., 0, :]))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact up to the rounding of the magnitude."""
        return self.model_error_bound(magnitude(x) + radius)


def one_model_of_each_order() -> list[Model]:
    """n = 1, 2, 3, all with an error that depends on the state."""
    return [
        FirstOrderScalar(),
        DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2),
        PlanarOnSlope(),
        ThirdOrderPlanar(),
    ]


@register_model
@dataclasses.dataclass
class SkewedChains(FractionOfBound):
    """Orders 1, 3 and 2, each output of which sees the others.

    ``F̂ = -pull tanh(y₀ + ẏ₁ + ẏ₂)`` on every output, the inputs act askew, and
    ``Δ = roughness (1 + |y₀| + |ẏ₂|)``, ``roughness (1 + |ÿ₁|)`` and
    ``roughness (1 + |ẏ₁|)``.
    """

    pull: float = 0.1
    roughness: float = 0.05

    num_outputs = 3
    orders = 1, 3, 2
    order = 3

    def drift(self, x: Array) -> Array:
        """See base class."""
        seen = x[..., 0, :1] + x[..., 1, 1:2] + x[..., 1, 2:]
        return np.asarray(-self.pull * np.tanh(seen) * np.ones(3))

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; the slope of tanh is at most one."""
        r = np.asarray(radius)
        wide = r[..., 0, :1] + r[..., 1, 1:2] + r[..., 1, 2:]
        return np.asarray(magnitude(self.drift(x)) + self.pull * wide)

    def model_error_bound(self, x: Array) -> Array:
        """See base class."""
        size = magnitude(x)
        first = size[..., 0, :1] + size[..., 1, 2:]
        rows = first, size[..., 2, 1:2], size[..., 1, 1:2]
        return np.asarray(self.roughness * (1.0 + np.concatenate(rows, axis=-1)))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact up to the rounding of the magnitude."""
        return self.model_error_bound(magnitude(x) + radius)

    def inverse_input_matrix(self, x: Array) -> Array:
        """See base class; a constant."""
        inverse = np.array([[1.0, 0.0, 0.2], [0.1, 0.8, 0.0], [0.0, -0.2, 1.2]])
        return np.broadcast_to(inverse, (*x.shape[:-2], 3, 3))


def models_of_mixed_orders() -> list[Model]:
    """Outputs of different order, with errors that depend on the state or do not."""
    return [
        IntegratorChain(orders=[3, 1, 2], error_bound=0.2),
        SkewedChains(),
        LaggedMultirotor(drag_error_bound=0.05, yaw_bias_bound=0.05),
    ]


def every_model() -> list[Model]:
    """All models, the library's and the tests'."""
    drag = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    return [
        *one_model_of_each_order(),
        DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.0),
        IntegratorChain(num_outputs=1, order=3, error_bound=0.4),
        ConstantUncertainty(drag, drag.constant_model_error_bound(2.5)),
        *models_of_mixed_orders(),
    ]


def name_of(model: Model) -> str:
    """For the test's id."""
    return f"{type(model).__name__}-n{model.order}-m{model.num_outputs}"


def make_problem(model: Model, **changes: Any) -> Problem:
    """From rest to rest, 3 m along the first output in 6 s, without obstacles."""
    n, m = model.order, model.num_outputs
    goal = np.zeros((n, m))
    goal[0, 0] = 3.0
    defaults: dict[str, Any] = {
        "law": SlidingLaw(model, np.full(m, 2.0), np.full(m, 0.3), 0.1),
        "obstacles": ObstacleSet.stack([], m),
        "tube_margin": "norm",
        "input": InputLimit(12.0),
        "speed": SpeedLimit(4.0),
        "bandwidth": BandwidthLimit(np.full(m, 0.5), np.full(m, 4.0), 2.0),
        "costs": (InputCost(2.0),),
        "bandwidth_cost": BandwidthCost(0.1, 0.5),
        "start_time": 0.0,
        "duration": 6.0,
        "start": np.zeros((n, m)),
        "goal": goal,
        "tube_start": TubeStart(np.zeros((n, m)), np.zeros(m)),
        "velocity_bound": "comparison",
    }
    start = {"initial_error": np.zeros((n, m)), "layer": np.full(m, 0.3)}
    return changed_problem(Problem(**defaults), **(start | changes))


def changed_problem(problem: Problem, **changes: Any) -> Problem:
    """The same with other fields: its own, those of its parts, or of its tube's start.

    The latter are `initial_error`, ``(n, m)``, or bounds of it, and `layer`, ``(m,)``.
    """

    def replaced(part: Any, **names: str) -> Any:
        given = {of: changes.pop(name) for of, name in names.items() if name in changes}
        return dataclasses.replace(part, **given)

    law = replaced(
        problem.law,
        model="model",
        slope="slope",
        disturbance_bound="disturbance_bound",
        reaching_rate="reaching_rate",
    )
    parts = {
        "law": law,
        "input": replaced(problem.input, bound="input_limit"),
        "speed": replaced(problem.speed, bound="speed_limit"),
        "bandwidth": replaced(
            problem.bandwidth,
            low="bandwidth_min",
            high="bandwidth_max",
            rate="bandwidth_rate_max",
        ),
        "bandwidth_cost": replaced(problem.bandwidth_cost, weight="bandwidth_weight"),
    }
    start = problem.tube_start
    layer = changes.pop("layer", start.layer)
    if "initial_error" in changes:
        error = changes.pop("initial_error")
        start = TubeStart.of_error(error, layer, law.slope, law.chains)
    stages = np.concatenate([start.stages[:-1], np.asarray(layer)[None]])
    parts["tube_start"] = TubeStart(stages, start.highest)
    return dataclasses.replace(problem, **(parts | changes))


Signal = Callable[[float], Array]
Adversary = Callable[[float, Array, Array], tuple[Array, Array]]
"""(time, error (T, n, m), s (T, m)) to the fractions of Δ and of D, (T, m)."""


def every_adversary(
    seed: int, trials: int = 4, chains: Chains | None = None
) -> tuple[Adversary, int]:
    """All adversaries side by side, one a row; and how many rows they take.

    They push along s or against it, along ỹ, along the highest error
    derivative, to one side for ever, with Δ against D, from side to side in
    resonance, and at random from one end to the other.
    """
    generator = np.random.default_rng(seed)

    def adversary(t: float, error: Array, s: Array) -> tuple[Array, Array]:
        one = np.ones(s.shape[-1])
        w = error[:, -1] if chains is None else chains.top(error)
        rows = [
            np.sign(s[0]) + (s[0] == 0),
            -np.sign(s[1]),
            np.sign(error[2, 0]) + (error[2, 0] == 0),
            np.sign(w[3]) + (w[3] == 0),
            one,
            -one,
            np.sign(s[6]) + (s[6] == 0),
            np.sign(np.sin(2.0 * t) + 1e-9) * one,
        ]
        random = generator.choice([-1.0, 1.0], size=(trials, len(one)))
        disturbance = np.concatenate([np.array(rows), random])
        model_error = disturbance.copy()
        model_error[6] *= -1
        return model_error, disturbance

    return adversary, 8 + trials


def fly(
    *,
    law: SlidingLaw,
    reference: Signal,
    layer: Callable[[float], tuple[Array, Array]],
    initial_error: Array,
    adversary: Adversary,
    times: Array,
) -> Array:
    """Integrates the closed loop under an adversary, for many trials at once.

    The adversary picks f̃ and d at the start of every step and holds them, which
    is one legal realisation; between, the loop is integrated by Runge-Kutta 4.

    Args:
        law: the controller; its model has the plant's F̂, B and Δ.
        reference: y* and its derivatives up to the n-th, ``(n + 1, m)``.
        layer: Φ and dΦ/dt, both ``(m,)``.
        initial_error: ``(T, n, m)``.
        adversary: of all T trials.
        times: uniform, ``(K,)``.

    Returns:
        Errors ỹ^(k), ``(K, T, n, m)``.
    """
    model, n = law.model, law.order
    step = times[1] - times[0]

    def rate(t: float, error: Array, f: Array, d: Array) -> Array:
        y = reference(t)
        x = y[:n] + error
        thickness, thickness_rate = layer(t)
        u = law.control(
            state=x, reference=y, layer=thickness, layer_rate=thickness_rate
        )
        effect = (model.input_matrix(x) @ u[..., None])[..., 0]
        drift = model.drift(x) + f * model.model_error_bound(x)
        highest = drift + effect + d * law.disturbance_bound
        top = (highest - y[n])[:, None]
        rates = np.concatenate([error[:, 1:], top], axis=1)
        law.chains.set_row(rates, top[:, 0])
        return law.chains.existing(rates)

    errors = np.empty((len(times), *initial_error.shape))
    errors[0] = initial_error
    for i, t in enumerate(times[:-1]):
        e = errors[i]
        f, d = adversary(t, e, law.sliding_variable(e))
        k1 = rate(t, e, f, d)
        k2 = rate(t + step / 2, e + step / 2 * k1, f, d)
        k3 = rate(t + step / 2, e + step / 2 * k2, f, d)
        k4 = rate(t + step, e + step * k3, f, d)
        errors[i + 1] = e + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return errors


def wave(model: Model, amplitude: float, frequency: float) -> Signal:
    """A smooth reference that keeps moving, every output at its own phase."""
    chains = Chains.of(model)
    phases = np.arange(model.num_outputs) * 0.7

    def reference(t: float | Array) -> Array:
        angle = frequency * np.asarray(t)[..., None] + phases
        rows = [
            amplitude * frequency**k * np.sin(angle + k * np.pi / 2)
            for k in range(model.order + 1)
        ]
        return chains.reference_of(np.stack(rows, axis=-2))

    return reference
