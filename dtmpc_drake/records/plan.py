"""A plan: the reference and the tube around it, as functions of time."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.numerics.arrays import FloatArray, IntArray
from dtmpc_drake.numerics.polynomials import cut, locate, power_derivatives, shifted
from dtmpc_drake.records.archive import DAMAGE, require_archive

if TYPE_CHECKING:
    from pydrake.trajectories import PiecewisePolynomial

_SAMPLE_PERIOD = 0.005  # of a saved plan, in s
_JUMP = 1e-6  # in which joined plans change their tubes, in s


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Plan:
    """A reference y*(t), the tube around it and the bandwidth that makes it.

    The reference is a piecewise polynomial of degree n + 1 whose n-th
    derivative is continuous; where outputs differ in their order, each has its own
    n_i for n.  The bandwidth α is piecewise linear between the
    same knots.  The tube that follows from both is kept on a finer grid.  Φ* is a
    polynomial on each of its steps, and `boundary_layer_rate` is the exact
    derivative, which is all that the invariance of the layer needs; the bandwidth
    that it implies is α (see `dtmpc_drake.method.layer`).  The bounds of the errors are
    cubic Hermite pieces.

    Outside ``[start_time, end_time]`` a plan holds its first or last value.

    Attributes:
        knots: ``(N + 1,)``, in s.
        coefficients: of y* in powers of the time since a piece began,
            ``(N, n + 2, m)``; zero beyond the power n_i + 1.
        bandwidth_knots: α, ``(N + 1, m)``, in rad/s.
        tube_times: the finer grid, ``(M + 1,)``, in s.
        layer_coefficients: of Φ* in powers of the time since a step of that grid
            began, ``(M, any number, m)``.
        bound_samples: bounds of ``|ỹ^(k)|``, ``(M + 1, n, m)``; zero where k >= n_i.
        bound_rate_samples: their time derivatives, same shape.
        orders: n_i, ``(m,)``; all n if left out.
    """

    knots: FloatArray
    coefficients: FloatArray
    bandwidth_knots: FloatArray
    tube_times: FloatArray
    layer_coefficients: FloatArray
    bound_samples: FloatArray
    bound_rate_samples: FloatArray
    orders: IntArray | None = None

    def __post_init__(self) -> None:
        """Makes what is shared read-only, and the same bits in and out of a file."""
        if self.orders is None:
            alike = np.full(self.coefficients.shape[2:], self.order)
            object.__setattr__(self, "orders", alike)
        for field in dataclasses.fields(self):
            view = np.ascontiguousarray(getattr(self, field.name)).view()
            view.flags.writeable = False
            object.__setattr__(self, field.name, view)

    def __deepcopy__(self, memo: dict[int, Any]) -> Plan:
        """Itself: nothing in it changes, and Contexts are copied often."""
        return self

    @property
    def start_time(self) -> float:
        """The first knot, in s."""
        return float(self.knots[0])

    @property
    def end_time(self) -> float:
        """The last knot, in s."""
        return float(self.knots[-1])

    @property
    def order(self) -> int:
        """n, the order of the outputs, or the largest if they differ."""
        return int(self.coefficients.shape[1]) - 2

    @property
    def num_outputs(self) -> int:
        """m, the number of outputs."""
        return int(self.coefficients.shape[2])

    @cached_property
    def chains(self) -> Chains:
        """The orders of the outputs."""
        return Chains(tuple(map(int, np.asarray(self.orders))))

    @property
    def is_uniform(self) -> bool:
        """Whether all knots are equally spaced, and the tube's grid within them."""
        pieces, steps = len(self.knots) - 1, len(self.tube_times) - 1
        span = self.end_time - self.start_time
        even = self.start_time + span * np.arange(steps + 1) / steps
        if steps % pieces:
            return False
        off = np.abs(self.tube_times - even).max()
        off = max(off, np.abs(self.knots - even[:: steps // pieces]).max())
        return bool(off <= 1e-9 * span)

    def reference(self, time: FloatArray | float) -> FloatArray:
        """x* and y*^(n): y* and its derivatives up to the n-th.

        Args:
            time: shape ``(...)``, in s.

        Returns:
            Shape ``(..., n + 1, m)``; row k is the k-th derivative.  Where outputs
            differ in their order the last row is y_i*^(n_i) of each, and rows between
            it and n_i - 1 are zero; see `derivatives`.
        """
        return self.chains.reference_of(self.derivatives(time))

    def derivatives(self, time: FloatArray | float) -> FloatArray:
        """y* and its derivatives up to the n-th of every output, whatever its order.

        Args:
            time: shape ``(...)``, in s.

        Returns:
            Shape ``(..., n + 1, m)``; row k is the k-th derivative.
        """
        t, piece = locate(self.knots, time)
        factor, exponent = power_derivatives(self.order + 1, self.coefficients.shape[1])
        basis = factor * t[..., None, None] ** exponent
        return basis @ self.coefficients[piece]

    def bandwidth(self, time: FloatArray | float) -> FloatArray:
        """α*, shape ``(..., m)``, in rad/s."""
        t, piece = locate(self.knots, time)
        weight = (t / np.diff(self.knots)[piece])[..., None]
        start, end = self.bandwidth_knots[piece], self.bandwidth_knots[piece + 1]
        return (1 - weight) * start + weight * end

    def boundary_layer(self, time: FloatArray | float) -> FloatArray:
        """Φ*, shape ``(..., m)``."""
        return self.layer(time)[0]

    def boundary_layer_rate(self, time: FloatArray | float) -> FloatArray:
        """dΦ*/dt, the exact derivative of `boundary_layer`, ``(..., m)``."""
        return self.layer(time)[1]

    def layer(self, time: FloatArray | float) -> tuple[FloatArray, FloatArray]:
        """Φ* and dΦ*/dt in one look-up."""
        t, step = locate(self.tube_times, time)
        factor, exponent = power_derivatives(2, self.layer_coefficients.shape[1])
        basis = factor * t[..., None, None] ** exponent
        both = basis @ self.layer_coefficients[step]
        return both[..., 0, :], both[..., 1, :]

    def error_bound(self, time: FloatArray | float) -> FloatArray:
        """Bounds of ``|ỹ^(k)|``, k < n, shape ``(..., n, m)``."""
        x, c, _ = self._bound_piece(time)
        y0, d0, c2, c3 = (c[..., k, :, :] for k in range(4))
        return y0 + x * (d0 + x * (c2 + x * c3))

    def _error_bound_rate(self, time: FloatArray | float) -> FloatArray:
        """The exact time derivative of `error_bound`."""
        x, c, h = self._bound_piece(time)
        _, d0, c2, c3 = (c[..., k, :, :] for k in range(4))
        return (d0 + x * (2 * c2 + 3 * x * c3)) / h

    def _bound_piece(
        self, time: FloatArray | float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The share of a step of the tube that is over, its cubic and its length."""
        t, step = locate(self.tube_times, time)
        length, cubics = self._bound_cubics
        h = length[step].reshape(*t.shape, 1, 1)
        return t.reshape(h.shape) / h, cubics[step], h

    @cached_property
    def _bound_cubics(self) -> tuple[FloatArray, FloatArray]:
        """Lengths of the tube's steps, ``(M,)``, and the bounds as cubics on each.

        They are Hermite's, in powers of the share of a step, ``(M, 4, n, m)``.
        """
        length = np.diff(self.tube_times)
        h = length[:, None, None]
        y0, y1 = self.bound_samples[:-1], self.bound_samples[1:]
        d0, d1 = h * self.bound_rate_samples[:-1], h * self.bound_rate_samples[1:]
        c2 = 3 * (y1 - y0) - 2 * d0 - d1
        c3 = 2 * (y0 - y1) + d0 + d1
        return length, np.stack([y0, d0, c2, c3], axis=1)

    def position_tube(self, time: FloatArray | float) -> FloatArray:
        """Ω, the bound of ``|ỹ|``, shape ``(..., m)``."""
        return self.error_bound(time)[..., 0, :]

    def trajectory(self) -> PiecewisePolynomial:
        """y* as a trajectory of Drake's, ``(m, 1)``, in s: the plan's own pieces.

        So are its derivatives up to the n-th, which is continuous.  It holds its ends
        as the plan does.
        """
        return _drake_trajectory(self.knots, self.coefficients)

    def layer_trajectory(self) -> PiecewisePolynomial:
        """Φ* as a trajectory of Drake's, ``(m, 1)``; its derivative is dΦ*/dt."""
        return _drake_trajectory(self.tube_times, self.layer_coefficients)

    def tube_trajectory(self) -> PiecewisePolynomial:
        """Ω as a trajectory of Drake's, ``(m, 1)``."""
        length, cubics = self._bound_cubics
        scale = length[:, None, None] ** np.arange(4)[:, None]
        return _drake_trajectory(self.tube_times, cubics[:, :, 0] / scale)

    def between(self, start: float, end: float) -> Plan:
        """A part of the plan, which is the same functions of time.

        Args:
            start: in s, within the plan.
            end: in s, within the plan and after `start`.
        """
        knots, piece = cut(self.knots, start, end)
        shift = start - self.knots[piece[0]]
        coefficients = self.coefficients[piece].copy()
        coefficients[0] = shifted(coefficients[0], shift)
        grid, step = cut(self.tube_times, start, end)
        layer = self.layer_coefficients[step].copy()
        layer[0] = shifted(layer[0], start - self.tube_times[step[0]])
        return Plan(
            knots=knots,
            coefficients=coefficients,
            bandwidth_knots=self.bandwidth(knots),
            tube_times=grid,
            layer_coefficients=layer,
            bound_samples=self.error_bound(grid),
            bound_rate_samples=self._error_bound_rate(grid),
            orders=self.orders,
        )

    def sample_times(self, period: float = _SAMPLE_PERIOD) -> FloatArray:
        """Uniform times from start to end, at most `period` apart."""
        count = int(np.ceil((self.end_time - self.start_time) / period - 1e-9))
        return np.linspace(self.start_time, self.end_time, max(count, 1) + 1)

    def sample(self, period: float = _SAMPLE_PERIOD) -> dict[str, FloatArray]:
        """Everything that a plan says, on uniform times, under its field name.

        For n > 2 ``acceleration`` is the second derivative, and
        ``error_bound`` has the bounds of all derivatives.  For n = 1 there is
        no velocity tube and no acceleration; an output of order 1 beside others has
        a velocity tube of zero, which says nothing.
        """
        time = self.sample_times(period)
        reference, derivatives = self.reference(time), self.derivatives(time)
        bound = self.error_bound(time)
        layer, layer_rate = self.layer(time)
        arrays = {
            "time": time,
            "position": derivatives[:, 0],
            "velocity": derivatives[:, 1],
            "bandwidth": self.bandwidth(time),
            "boundary_layer": layer,
            "boundary_layer_rate": layer_rate,
            "position_tube": bound[:, 0],
            "reference": reference,
            "error_bound": bound,
        }
        if self.order >= 2:
            arrays["acceleration"] = derivatives[:, 2]
            arrays["velocity_tube"] = bound[:, 1]
        return arrays

    def save(self, path: str | Path) -> None:
        """Writes the samples (at most 5 ms apart) and the exact plan as ``.npz``."""
        exact: dict[str, Any] = {
            f"plan_{field.name}": getattr(self, field.name)
            for field in dataclasses.fields(self)
        }
        with open(path, "wb") as file:
            arrays: dict[str, Any] = {**self.sample(), **exact}
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Reads what `save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a saved plan, or anything in it is wrong;
                it names the file and the field.
        """
        require_archive(path, "plan")
        arrays: dict[str, Any] = {}
        reading = "the archive"
        try:
            with np.load(path, allow_pickle=False) as data:
                for field in dataclasses.fields(cls):
                    reading = field.name
                    if field.name == "orders" and "plan_orders" not in data:
                        continue  # of a plan whose outputs are alike
                    arrays[field.name] = data[f"plan_{field.name}"]
        except DAMAGE as error:
            why = " ".join(str(error).split())
            raise ValueError(f"{path}: not a saved plan ({reading}: {why})") from None
        return cls.from_arrays(arrays, where=str(path))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any], *, where: str) -> Plan:
        """A plan from its fields by name, all of them checked.

        Raises:
            ValueError: if anything is wrong with one; it starts with `where`, and
                names the field.
        """
        plan = cls(**arrays)
        for fault in plan.faults():  # the first
            raise ValueError(f"{where}: not a saved plan ({fault})")
        return plan

    def faults(self) -> Iterator[str]:
        """What makes this no plan at all, one line each that begins with a field.

        Every array is a finite one of real numbers that has its shape, times
        increase, bandwidths and, at the samples, the layer are positive.  Whether
        the functions are continuous is a matter of its certificate.
        """
        shapes = self._shapes()
        if isinstance(shapes, str):
            yield shapes
            return
        sound = True
        for name, (shape, times) in shapes.items():
            fault = _fault(getattr(self, name), shape, times)
            if fault:
                sound = False
                yield f"{name}: {fault}"
        if not sound:
            return
        if not self.chains.are_alike:
            k = np.arange(self.order + 2)[:, None]
            if self.coefficients[:, k > self.chains.each + 1].any():
                yield "coefficients: an output has a power beyond its order plus one"
            for name in ("bound_samples", "bound_rate_samples"):
                if getattr(self, name)[:, ~self.chains.exists].any():
                    yield f"{name}: must be zero for derivatives that are no state"
        apart = np.abs(self.knots[[0, -1]] - self.tube_times[[0, -1]]).max()
        if apart > 1e-9 * (self.end_time - self.start_time):
            yield "tube_times: must begin and end where the knots do"
        if not (self.bandwidth_knots > 0).all():
            yield f"bandwidth_knots: {self.bandwidth_knots.min():g} is not positive"
        if not (self.layer_coefficients[:, 0] > 0).all():
            least = self.layer_coefficients[:, 0].min()
            yield f"layer_coefficients: the layer is {least:g}, which is not positive"

    def _shapes(self) -> dict[str, tuple[tuple[int, ...], FloatArray]] | str:
        """The shape that every field must have and its times, or why there is none."""
        dimensions = {"knots": 1, "tube_times": 1, "coefficients": 3}
        dimensions["layer_coefficients"] = 3
        for name, count in dimensions.items():
            array = getattr(self, name)
            if array.ndim != count or array.size == 0:
                return f"{name}: has shape {array.shape}, not {count} axes"
        n, m = self.order, self.num_outputs
        N, M = len(self.knots) - 1, len(self.tube_times) - 1
        if n < 1 or N < 1 or M < 1:
            shape = self.coefficients.shape
            return f"coefficients: {shape} with {N} pieces is of no order"
        orders = np.asarray(self.orders)
        if orders.shape != (m,):
            return f"orders: has shape {orders.shape} where {(m,)} is needed"
        if orders.dtype.kind not in "iu":
            return f"orders: must hold whole numbers, not {orders.dtype}"
        if orders.min() < 1 or orders.max() != n:
            return f"orders: {orders.tolist()} where the largest must be {n}"
        powers = self.layer_coefficients.shape[1]
        return {
            "knots": ((N + 1,), self.knots),
            "tube_times": ((M + 1,), self.tube_times),
            "coefficients": ((N, n + 2, m), self.knots),
            "bandwidth_knots": ((N + 1, m), self.knots),
            "layer_coefficients": ((M, powers, m), self.tube_times),
            "bound_samples": ((M + 1, n, m), self.tube_times),
            "bound_rate_samples": ((M + 1, n, m), self.tube_times),
        }

    def __repr__(self) -> str:
        """Names what a reader wants to know first."""
        a, w = self.bandwidth_knots, self.bound_samples[:, 0]
        return (
            f"Plan({self.start_time:g} to {self.end_time:g} s, "
            f"{len(self.knots) - 1} intervals, {self.chains.words}, "
            f"{self.num_outputs} outputs, bandwidth {a.min():.2f} to {a.max():.2f} "
            f"rad/s, position tube at most {w.max():.3f})"
        )


def _fault(array: FloatArray, shape: tuple[int, ...], times: FloatArray) -> str:
    """What is wrong with one array of a plan; nothing if that is empty."""
    if array.dtype.kind != "f":
        return f"must hold real numbers, not {array.dtype}"
    if array.shape != shape:
        return f"has shape {array.shape} where {shape} is needed"
    finite = np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    if not finite.all():
        row = int(finite.argmin())
        what = "not a number" if np.isnan(array[row]).any() else "infinite"
        return what if array is times else f"{what} at t = {times[row]:.4g} s"
    if array is times and not (np.diff(array) > 0).all():
        return "must increase"
    return ""


def _drake_trajectory(times: FloatArray, coefficients: FloatArray) -> Any:
    """Drake's piecewise polynomial of the same pieces.

    Args:
        times: where they meet, ``(K + 1,)``, in s.
        coefficients: in powers of the time since a piece began, ``(K, powers, m)``.
    """
    # Not before it is asked for: plans are read where Drake is not needed, too.
    from pydrake.polynomial import Polynomial
    from pydrake.trajectories import PiecewisePolynomial

    pieces = [
        np.array([[Polynomial(powers)] for powers in piece.T]) for piece in coefficients
    ]
    return PiecewisePolynomial(pieces, times)


def join(plans: Sequence[Plan], times: Sequence[float]) -> Plan:
    """What was in force when each plan replaced the one before it.

    Reference, boundary layer and bandwidth are continuous where they were so at
    the hand-overs; the bounds of the errors jump there, within a microsecond.

    Args:
        plans: in order, at least one.
        times: when each of them takes effect, in s, increasing and more than
            a microsecond apart; the first plan's start counts for the first.
    """
    starts = [plans[0].start_time, *times[1:]]
    ends = [*(time - _JUMP for time in times[1:]), plans[-1].end_time]
    parts = [
        plan.between(start, end)
        for plan, start, end in zip(plans, starts, ends, strict=True)
    ]

    def stacked(name: str, drop: int = 0) -> FloatArray:
        """One field of all parts, without the last rows of all but the last part."""
        rows = [getattr(part, name) for part in parts]
        return np.concatenate([*(r[: len(r) - drop] for r in rows[:-1]), rows[-1]])

    # The polynomials reach on to the hand-over, of the reference and of the layer.
    layers = [parts[0].layer_coefficients]
    for before, after in pairwise(parts):
        length = before.tube_times[-1] - before.tube_times[-2]
        layers.append(shifted(before.layer_coefficients[-1], length)[None])
        layers.append(after.layer_coefficients)
    return Plan(
        knots=stacked("knots", drop=1),
        coefficients=stacked("coefficients"),
        bandwidth_knots=stacked("bandwidth_knots", drop=1),
        tube_times=stacked("tube_times"),
        layer_coefficients=np.concatenate(layers),
        bound_samples=stacked("bound_samples"),
        bound_rate_samples=stacked("bound_rate_samples"),
        orders=plans[0].orders,
    )
