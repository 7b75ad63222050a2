"""Uncertain feedback-linearisable models (the paper's assumptions 1, 2 and 4).

A model has m outputs y, each of order n,

    y^(n) = F(x) + B(x) u + d,    F = F̂ + f̃,    |f̃| <= Δ(x),    |d| <= D,

with the state x = (y, dy/dt, ..., y^(n-1)).  In code a state is an array of
shape ``(..., n, m)``: row k holds the k-th derivative of every output.  Every
function is batched over the leading axes and generic in the scalar (float,
``AutoDiffXd``, ``symbolic.Expression``).
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.math import inv as drake_inv

# Arrays hold floats in the planner and AutoDiffXd or Expression in the systems.
Array = npt.NDArray[Any]

_SMOOTHING = 1e-6
"""Below this speed a norm is rounded off, so that it has a derivative at rest."""


def magnitude(v: Array) -> Array:
    """A differentiable upper bound of abs(v), at most 1e-6 too large."""
    return np.asarray(np.sqrt(v * v + _SMOOTHING**2))


def euclidean_norm(v: Array) -> Array:
    """A differentiable upper bound of the 2-norm over the last axis.

    Args:
        v: shape ``(..., m)``.

    Returns:
        Shape ``(...)``; at most 1e-6 too large.
    """
    if v.strides[-1] != v.itemsize:  # the same order of additions in any memory order
        v = np.ascontiguousarray(v)
    return np.asarray(np.sqrt(np.einsum("...i,...i", v, v) + _SMOOTHING**2))


def jacobian(
    function: Callable[[Array], Array], point: Array, step: Array | float = 1e-6
) -> Array:
    """The derivative of a batched function by central differences.

    All perturbed points are evaluated in one batched call.

    Args:
        function: maps ``(..., p)`` to ``(..., r)``, each batch entry alone.
        point: shape ``(K, p)``.
        step: of the differences, broadcast to ``(K, p)``.  A large one is a
            secant: it sees a kink (such as that of a speed's magnitude) before
            it is reached.

    Returns:
        Shape ``(K, r, p)``.
    """
    step = np.broadcast_to(step, point.shape)
    ahead, behind = _perturbed(function, point, step, np.arange(point.shape[1]))
    return np.asarray(np.moveaxis((ahead - behind) / (2 * step.T[:, :, None]), 0, -1))


def bends(
    function: Callable[[Array], Array],
    point: Array,
    step: Array | float,
    coordinates: Array,
) -> Array:
    """How much steeper a batched function is ahead of a point than behind, halved.

    With the slope of `jacobian`, ``slope dx + bend |dx|`` agrees with the function at
    both ends of the step; at a kink it is the function.

    Args:
        function: as for `jacobian`.
        point: shape ``(K, p)``.
        step: broadcast to ``(K, p)``.
        coordinates: indices of the q coordinates that are moved.

    Returns:
        Shape ``(K, r, q)``.
    """
    middle = function(point)
    if not len(coordinates):
        return np.zeros((*middle.shape, 0))
    step = np.broadcast_to(step, point.shape)
    ahead, behind = _perturbed(function, point, step, coordinates)
    change = ahead + behind - 2 * middle
    width = step.T[coordinates][:, :, None]
    return np.asarray(np.moveaxis(change / (2 * width), 0, -1))


def _perturbed(
    function: Callable[[Array], Array], point: Array, step: Array, coordinates: Array
) -> tuple[Array, Array]:
    """The function a step ahead and behind along each coordinate, ``(q, K, r)``."""
    offsets = np.eye(point.shape[1])[coordinates, None, :] * step
    values = function(np.concatenate([point + offsets, point - offsets]))
    return values[: len(coordinates)], values[len(coordinates) :]


class Model(abc.ABC):
    """What the planner and the controller may know about a plant.

    Subclasses give the nominal dynamics, the bound of what is unknown, and the
    bounds of both over a box ``|x' - x| <= radius`` around a state.  The true
    plant differs from the model by numeric `parameters` (such as the true drag
    coefficient), which only the simulated plant knows.
    """

    num_outputs: int
    """m, the number of outputs and of inputs."""
    order: int
    """n, the order of every output."""
    parameter_names: tuple[str, ...] = ()
    """Names of the parameters of the true plant."""

    @abc.abstractmethod
    def drift(self, x: Array) -> Array:
        """F̂(x), the nominal drift.

        Args:
            x: shape ``(..., n, m)``.

        Returns:
            Shape ``(..., m)``, in output unit / s^n.
        """

    @abc.abstractmethod
    def model_error_bound(self, x: Array) -> Array:
        """Δ(x), the bound of ``|F(x) - F̂(x)|`` (assumption 1); as `drift`."""

    @abc.abstractmethod
    def drift_bound(self, x: Array, radius: Array) -> Array:
        """An upper bound of ``|F̂|`` over the box ``|x' - x| <= radius``.

        Args:
            x: centre, shape ``(..., n, m)``.
            radius: shape ``(..., n, m)``, non-negative.

        Returns:
            Shape ``(..., m)``.
        """

    @abc.abstractmethod
    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """Δ̄, an upper bound of Δ over the box; as `drift_bound`."""

    @abc.abstractmethod
    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """A lower bound of Δ over the box; as `drift_bound`.

        Only the certificate asks, for the smallest bandwidth between samples.
        """

    @abc.abstractmethod
    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """F(x) of the plant that has these parameters; as `drift`."""

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """The values of a parameter for which ``|F - F̂| <= Δ`` holds.

        Raises:
            KeyError: if the model has no such parameter.
        """
        raise KeyError(name)

    @property
    def bounds_certified(self) -> bool:
        """Whether the bounds over a box are proven rather than sampled."""
        return True

    @property
    def error_bound_varies(self) -> bool:
        """Whether Δ depends on the state; False saves the planner some work."""
        return True

    @property
    def input_is_identity(self) -> bool:
        """Whether B is the identity everywhere, so that nobody needs to multiply."""
        return type(self).inverse_input_matrix is Model.inverse_input_matrix

    def inverse_input_matrix(self, x: Array) -> Array:
        """B(x)⁻¹, shape ``(..., m, m)``; the identity unless overridden."""
        eye = np.eye(self.num_outputs)
        return np.broadcast_to(eye, (*x.shape[:-2], *eye.shape))

    def input_for(self, x: Array, demand: Array) -> Array:
        """The input that B(x) makes a demand of, B(x)⁻¹ demand.

        Args:
            x: shape ``(..., n, m)``.
            demand: shape ``(..., m)``, in output unit / s^n.

        Returns:
            Shape ``(..., m)``.
        """
        if self.input_is_identity:
            return np.asarray(demand)
        inverse = self.inverse_input_matrix(x)
        return np.asarray(np.einsum("...ij,...j->...i", inverse, demand))

    def inverse_input_deviation(self, x: Array, radius: Array) -> Array:
        """An upper bound of ``|B(x')⁻¹ - B(x)⁻¹|`` over the box, ``(..., m, m)``.

        Zero unless overridden, which is right for a constant B only.
        """
        return np.zeros((*x.shape[:-2], self.num_outputs, self.num_outputs))

    def input_matrix(self, x: Array) -> Array:
        """B(x), shape ``(..., m, m)``."""
        inverse = self.inverse_input_matrix(x)
        if inverse.dtype != object:
            if not any(inverse.strides[:-2]):  # one matrix, broadcast over the batch
                one = inverse[(0,) * (inverse.ndim - 2)]
                return np.broadcast_to(np.linalg.inv(one), inverse.shape)
            return np.asarray(np.linalg.inv(inverse))
        flat = inverse.reshape(-1, *inverse.shape[-2:])
        return np.array([drake_inv(B) for B in flat]).reshape(inverse.shape)

    def constant_model_error_bound(self, speed: float) -> Array:
        """The supremum of Δ over all states with ``‖dy/dt‖ <= speed``, ``(m,)``.

        Raises:
            NotImplementedError: if the model does not know it.
        """
        raise NotImplementedError(
            f"{type(self).__name__} gives no constant bound of its model error"
        )


class SampledBoxBounds(Model):
    """Bounds over a box from its corners and its centre: *not* certified.

    The maximum over the corners is a bound only where the functions are
    monotone in every coordinate (the paper's Theorem 2 takes this for
    granted).  A model that can do better overrides the methods; until then
    its plans say that their bounds were sampled.
    """

    def _corners(self, x: Array, radius: Array) -> Array:
        n, m = self.order, self.num_outputs
        signs = np.stack(
            np.meshgrid(*[(-1.0, 1.0)] * (n * m), indexing="ij"), axis=-1
        ).reshape(-1, n, m)
        signs = np.concatenate([np.zeros((1, n, m)), signs])
        lead = (1,) * (x.ndim - 2)
        return np.asarray(x + signs.reshape(-1, *lead, n, m) * radius)

    def drift_bound(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return np.asarray(np.abs(self.drift(self._corners(x, radius))).max(axis=0))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return np.asarray(self.model_error_bound(self._corners(x, radius)).max(axis=0))

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return np.asarray(self.model_error_bound(self._corners(x, radius)).min(axis=0))

    @property
    def bounds_certified(self) -> bool:
        """See base class."""
        return False


@dataclasses.dataclass
class DragDoubleIntegrator(Model):
    """The paper's collision avoidance model (section VI): a point with drag.

    ``r̈ = -C_d ‖ṙ‖ ṙ + u + d`` with ``|C_d - Ĉ_d| <= drag_error_bound``.  The
    input u is net of gravity compensation.

    Attributes:
        drag_estimate: Ĉ_d, in 1/m.
        drag_error_bound: the bound of ``|C_d - Ĉ_d|``, in 1/m.
    """

    drag_estimate: float = 0.1
    drag_error_bound: float = 0.0

    # Unannotated, so that they are no fields of the dataclass.
    num_outputs = 3
    order = 2
    parameter_names = ("drag",)

    def drift(self, x: Array) -> Array:
        """F̂ = -Ĉ_d ‖ṙ‖ ṙ."""
        return self.true_drift(x, {"drag": self.drag_estimate})

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """F = -C_d ‖ṙ‖ ṙ."""
        v = x[..., 1, :]
        drag = np.asarray(parameters["drag"])[..., None]
        return np.asarray(-drag * euclidean_norm(v)[..., None] * v)

    def model_error_bound(self, x: Array) -> Array:
        """Δ = drag_error_bound ‖ṙ‖ |ṙ|."""
        v = x[..., 1, :]
        if self.drag_error_bound == 0:  # known drag is common, and worth a shortcut
            return np.asarray(0.0 * v)
        return np.asarray(
            self.drag_error_bound * euclidean_norm(v)[..., None] * magnitude(v)
        )

    def _largest_velocity(self, x: Array, radius: Array) -> Array:
        # Drag grows with every |ṙ_i|, so the corner |ṙ*| + radius is the worst.
        x = np.asarray(x)
        return np.asarray((magnitude(x) + radius)[..., 1:2, :].repeat(2, axis=-2))

    def drift_bound(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since drag is monotone in every speed."""
        return -self.drift(self._largest_velocity(x, radius))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since drag is monotone in every speed."""
        if self.drag_error_bound == 0:
            return self.model_error_bound(x)
        return self.model_error_bound(self._largest_velocity(x, radius))

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class; exact, since drag is monotone in every speed."""
        return self.model_error_bound(np.maximum(np.abs(x) - radius, 0.0))

    @property
    def error_bound_varies(self) -> bool:
        """See base class."""
        return self.drag_error_bound != 0

    def constant_model_error_bound(self, speed: float) -> Array:
        """``drag_error_bound * speed²`` on every axis."""
        return np.full(3, self.drag_error_bound * speed**2)

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        if name != "drag":
            raise KeyError(name)
        return (
            self.drag_estimate - self.drag_error_bound,
            self.drag_estimate + self.drag_error_bound,
        )


@dataclasses.dataclass
class IntegratorChain(Model):
    """m chains of n integrators with an additive model error, B = I.

    ``y^(n) = u + f̃ + d`` with ``|f̃| <= error_bound`` on every output.

    Attributes:
        num_outputs: m.
        order: n.
        error_bound: Δ, one number for all outputs, in output unit / s^n.
    """

    num_outputs: int = 3
    order: int = 2
    error_bound: float = 0.0

    # The true model error of every output, in output unit / s^n.
    parameter_names = ("model_error",)

    def drift(self, x: Array) -> Array:
        """F̂ = 0."""
        return np.asarray(0.0 * x[..., 0, :])

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """F = f̃, the same on every output."""
        error = np.asarray(parameters["model_error"])[..., None]
        return np.asarray(self.drift(x) + error)

    def model_error_bound(self, x: Array) -> Array:
        """Δ, a constant."""
        return np.asarray(self.drift(x) + self.error_bound)

    def drift_bound(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.drift(x)

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model_error_bound(x)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model_error_bound(x)

    @property
    def error_bound_varies(self) -> bool:
        """See base class."""
        return False

    def constant_model_error_bound(self, speed: float) -> Array:
        """Δ itself."""
        return np.full(self.num_outputs, self.error_bound)

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        if name != "model_error":
            raise KeyError(name)
        return -self.error_bound, self.error_bound


class ConstantUncertainty(Model):
    """Another model with its error bound replaced by a constant.

    This is the simplification that the paper's third experiment argues
    against: `bound` must hold wherever the vehicle may go.

    Args:
        model: the model whose Δ(x) is replaced.
        bound: Δ, shape ``(m,)``.
        covers: whether plans must stay where the bound covers the model's own Δ;
            False is for comparison with planners that do not ask.
    """

    def __init__(self, model: Model, bound: Array, *, covers: bool = True) -> None:
        self.model = model
        self.covers = covers
        self.bound = np.asarray(bound, dtype=float)
        self.num_outputs = model.num_outputs
        self.order = model.order
        self.parameter_names = model.parameter_names

    def drift(self, x: Array) -> Array:
        """See base class."""
        return self.model.drift(x)

    def drift_bound(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model.drift_bound(x, radius)

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        """See base class."""
        return self.model.true_drift(x, parameters)

    def model_error_bound(self, x: Array) -> Array:
        """The constant, broadcast over the batch."""
        return np.broadcast_to(self.bound, (*x.shape[:-2], self.num_outputs))

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """The constant, broadcast over the batch."""
        return self.model_error_bound(x)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """The constant, broadcast over the batch."""
        return self.model_error_bound(x)

    @property
    def input_is_identity(self) -> bool:
        """See base class."""
        return self.model.input_is_identity

    def inverse_input_matrix(self, x: Array) -> Array:
        """See base class."""
        return self.model.inverse_input_matrix(x)

    def inverse_input_deviation(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model.inverse_input_deviation(x, radius)

    def input_matrix(self, x: Array) -> Array:
        """See base class."""
        return self.model.input_matrix(x)

    def parameter_interval(self, name: str) -> tuple[float, float]:
        """See base class."""
        return self.model.parameter_interval(name)

    @property
    def error_bound_varies(self) -> bool:
        """See base class."""
        return False

    def constant_model_error_bound(self, speed: float) -> Array:
        """The constant itself."""
        return self.bound

    @property
    def bounds_certified(self) -> bool:
        """See base class."""
        return self.model.bounds_certified
