"""What a model of a plant must say of itself."""

import abc
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.math import inv as drake_inv

from dtmpc_drake.checks import Part, derivative_unit
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.registry import Registry


class Model(Part, abc.ABC):
    """What the planner and the controller may know about a plant.

    Subclasses give the nominal dynamics, the bound of what is unknown, and the
    bounds of both over a box ``|x' - x| <= radius`` around a state.  The true
    plant differs from the model by numeric `parameters` (such as the true drag
    coefficient), which only the simulated plant knows.
    """

    num_outputs: int
    """m, the number of outputs and of inputs."""
    order: int
    """n, the order of every output, or the largest if they differ."""
    orders: Sequence[int] | None = None
    """n_i, the order of each output; None if all are `order`.  States have the rows
    of the largest, and those that an output does not have are zero."""
    num_positions: int | None = None
    """So many outputs, the first ones, say where it is: obstacles are in their space.
    Others, such as a heading, no obstacle sees.  All are such if None."""
    parameter_names: tuple[str, ...] = ()
    """Names of the parameters of the true plant."""
    length_unit: str = "m"
    """Of positions and of obstacles; times are in seconds."""

    @property
    def output_units(self) -> tuple[str, ...]:
        """Of every output; the unit of lengths unless overridden."""
        return (self.length_unit,) * self.num_outputs

    @property
    def output_names(self) -> tuple[str, ...]:
        """Of the outputs, for a reader: x, y and z, or their numbers."""
        m = self.num_outputs
        return tuple("xyz"[:m]) if m <= 3 else tuple(str(i) for i in range(m))

    @property
    def axes(self) -> list[str]:
        """The outputs in a message: ``axis x`` and so on."""
        return [f"axis {name}" for name in self.output_names]

    @property
    def input_names(self) -> tuple[str, ...]:
        """Of the inputs, for a reader; u and the number of each."""
        return tuple(f"u{i}" for i in range(self.num_outputs))

    def units_of(self, order: int) -> tuple[str, ...]:
        """The units of a derivative of each output, such as ``m/s²``."""
        return tuple(derivative_unit(unit, order) for unit in self.output_units)

    def highest_units(self, below: int = 0) -> tuple[str, ...]:
        """The units of the derivatives of order n_i, or of so many orders less."""
        orders = self.orders or [self.order] * self.num_outputs
        units = zip(self.output_units, orders, strict=True)
        return tuple(derivative_unit(unit, order - below) for unit, order in units)

    def derivative_unit(self, order: int) -> str:
        """The unit of a derivative, one text for all outputs."""
        return joined(self.units_of(order))

    @property
    def input_unit(self) -> str:
        """The unit of the inputs, one text for all."""
        return joined(self.input_units)

    @property
    def input_units(self) -> tuple[str, ...]:
        """Of the inputs; those of the highest derivatives unless overridden."""
        return self.highest_units()

    @abc.abstractmethod
    def drift(self, x: Array) -> Array:
        """F̂(x), the nominal drift.

        Args:
            x: shape ``(..., n, m)``.

        Returns:
            Shape ``(..., m)``, in output unit / s^n_i.
        """

    @abc.abstractmethod
    def model_error_bound(self, x: Array) -> Array:
        """Δ(x), the bound of ``|F(x) - F̂(x)|`` (assumption 1); as `drift`."""

    @abc.abstractmethod
    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """An upper bound of ``|F̂|`` over the box ``|x' - x| <= radius``.

        Args:
            x: centre, shape ``(..., n, m)``.
            radius: shape ``(..., n, m)``, non-negative.

        Returns:
            Shape ``(..., m)``.
        """

    @abc.abstractmethod
    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """Δ̄, an upper bound of Δ over the box; as `drift_bound_over`."""

    @abc.abstractmethod
    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """A lower bound of Δ over the box; as `drift_bound_over`.

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
            demand: shape ``(..., m)``, in output unit / s^n_i.

        Returns:
            Shape ``(..., m)``.
        """
        if self.input_is_identity:
            return np.asarray(demand)
        inverse = self.inverse_input_matrix(x)
        return np.einsum("...ij,...j->...i", inverse, demand)

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
            return np.linalg.inv(inverse)
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


def joined(units: Iterable[str]) -> str:
    """One text for what may have several units."""
    return " or ".join(dict.fromkeys(units))


MODELS: Registry[Model] = Registry(Model, "register_model")
register_model = MODELS.register
