"""The tube: boundary layer Φ, position tube Ω and velocity tube W.

All three are positive first-order filters, written once here and integrated by
one fourth-order scheme with no loop over time.  A trajectory is sampled on a
*half grid*: M equal steps give the nodes 0, 2, ..., 2M and the midpoints
between them.  Design: boundary layer (eq. phidot), cascade (Theorem 1 made
rigorous), velocity comparison system.

Outputs may differ in their order n_i (`Chains`).  Stages are aligned at Φ, so that all
cascades are filtered together, and rows before an output's first stage are never read.
An output of order 1 has no W: its error is s, and Φ bounds it.
"""

from __future__ import annotations

import dataclasses
from math import comb
from typing import Literal

import numpy as np

from dtmpc_drake.method.chains import Chains, surface_coefficients
from dtmpc_drake.method.layer import integrate_layer
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.filters import half_grid, integrate_filter

_SWEEPS = 60
"""Of the comparison system, in which W stands on both sides."""
_SETTLED = 1e-7
"""It is solved when no sweep changes W by more, in the unit of W."""
_APART = 1e-3
"""Values of W that are nearer to each other give no secant."""
_GAIN = 0.9
"""Of the filter's decay that a secant may take away."""

VelocityBound = Literal["comparison", "paper"]


@dataclasses.dataclass(frozen=True, eq=False)
class Tube:
    """A tube sampled at the nodes of a uniform grid.

    Attributes:
        boundary_layer: Φ, ``(M + 1, m)``.
        boundary_layer_rate: dΦ/dt, ``(M + 1, m)``.
        error_bound: bounds of ``|ỹ^(k)|``, ``(M + 1, n, m)``; row 0 is the
            position tube Ω, row 1 the velocity tube W when n = 2.  Zero where
            k >= n_i.
        error_bound_rate: their time derivatives, same shape.
        stages: Y_0 ... Y_(n_i - 1) = Φ of the cascade, aligned at Φ,
            ``(M + 1, n, m)``.
    """

    boundary_layer: Array
    boundary_layer_rate: Array
    error_bound: Array
    error_bound_rate: Array
    stages: Array


def cascade_bound(stages: Array, slope: Array, derivative: int) -> Array:
    """``|ỹ^(k)| <= Σ_j C(k, j) λ^(k-j) Y_j``.

    Args:
        stages: Y_0 ... Y_(n-1), the first in the first row, shape ``(..., n, m)``.
        slope: λ, shape ``(m,)``.
        derivative: k.

    Returns:
        Shape ``(..., m)``.
    """
    terms = [
        comb(derivative, j) * slope ** (derivative - j) * stages[..., j, :]
        for j in range(derivative + 1)
    ]
    return np.asarray(sum(terms))


def cascade_bounds(
    chains: Chains, stages: Array, slope: Array, count: int | None = None
) -> Array:
    """`cascade_bound` of all derivatives, or of the first so many.

    Args:
        chains: the orders of the outputs.
        stages: aligned at Φ, ``(..., n, m)``.
        slope: λ, ``(m,)``.
        count: how many; n if left out.

    Returns:
        ``(..., count, m)``; zero where k >= n_i.
    """
    count = chains.order if count is None else count
    first = chains.from_first(stages)
    rows = [cascade_bound(first, slope, k) for k in range(count)]
    if not rows:
        return np.zeros((*stages.shape[:-2], 0, stages.shape[-1]))
    bounds = np.stack(rows, axis=-2)
    if chains.are_alike:
        return bounds
    return np.where(chains.exists[:count], bounds, 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class TubeStart:
    """What a tube opens from.

    Attributes:
        stages: bounds of |y_j(t0)| with y_j = (d/dt + λ)^j ỹ for the first n_i - 1,
            and Φ(t0) in the last row, at which they are aligned, ``(n, m)``.
        highest: a bound of ``|ỹ^(n_i - 1)(t0)|``, ``(m,)``.
    """

    stages: Array
    highest: Array

    @classmethod
    def of_error(
        cls, error: Array, layer: Array, slope: Array, chains: Chains | None = None
    ) -> TubeStart:
        """From an error that is known.

        Args:
            error: ỹ^(k)(t0), or bounds of their sizes, ``(n, m)``.
            layer: Φ(t0), ``(m,)``.
            slope: λ, ``(m,)``.
            chains: gives the order of each output; all n if left out.
        """
        chains = chains or Chains((len(error),) * len(layer))
        stages = [
            np.abs((surface_coefficients(slope, j + 1) * error[: j + 1]).sum(axis=0))
            for j in range(len(error) - 1)
        ]
        stacked = chains.at_layer(np.stack([*stages, layer]))
        stacked[-1] = layer
        return cls(stacked, np.abs(chains.top(error)))

    @property
    def layer(self) -> Array:
        """Φ(t0), ``(m,)``."""
        return self.stages[-1]


def stages_of_bounds(chains: Chains, bounds: Array, slope: Array) -> Array:
    """The cascade that gives bounds, the inverse of `cascade_bounds`.

    Args:
        chains: the orders of the outputs.
        bounds: R_0 ... R_(n-1) of a tube, ``(n, m)``.
        slope: λ, ``(m,)``.

    Returns:
        Y_0 ... Y_(n_i - 2), aligned at Φ, and in the last row what the last bound
        would need.
    """
    stages = np.zeros_like(bounds)
    for k, bound in enumerate(bounds):
        stages[k] = bound - cascade_bound(stages[: k + 1], slope, k)
    return chains.at_layer(stages)


def comparison_forcing(
    law: SlidingLaw, *, bandwidth: Array, lower_bounds: Array, model_error: Array
) -> Array:
    """What drives the velocity comparison system of W, the bound of ``|ỹ^(n-1)|``.

    dW/dt = -(α + (n-1)λ) W + α c_0 Ω + Σ_{k=1}^{n-2} (α c_k + c_{k-1}) R_k + E
    with E = D + Δ̄ + (Δ̄ - Δ(x*)).

    Args:
        law: gives λ and D.
        bandwidth: α, ``(..., m)``.
        lower_bounds: Ω = R_0 ... R_(n-2), the bounds of ``|ỹ^(k)|``,
            ``(..., n - 1, m)``, n >= 2; of output i those below n_i - 1 count.
        model_error: Δ̄ + (Δ̄ - Δ(x*)), ``(..., m)``.

    Returns:
        All but the first term, shape ``(..., m)``.
    """
    order, c = law.order, law.coefficients
    if not law.chains.are_alike:  # W is not what drives W
        lower_bounds = np.where(law.chains.below_top[:-1], lower_bounds, 0.0)
    forcing = law.disturbance_bound + model_error
    forcing = forcing + bandwidth * c[0] * lower_bounds[..., 0, :]
    for k in range(1, order - 1):
        forcing = forcing + (bandwidth * c[k] + c[k - 1]) * lower_bounds[..., k, :]
    return np.asarray(forcing)


def comparison_rate(
    law: SlidingLaw, *, reference: Array, bandwidth: Array, error_bound: Array
) -> Array:
    """dW/dt of the velocity comparison system; see `comparison_forcing`.

    Args:
        law: gives λ, D, Δ and Δ̄.
        reference: x*, ``(..., n, m)``.
        bandwidth: α, ``(..., m)``.
        error_bound: R_k, the bounds of ``|ỹ^(k)|``, ``(..., n, m)``, n >= 2.

    Returns:
        Shape ``(..., m)``.
    """
    largest = law.model.model_error_bound_over(reference, error_bound)
    forcing = comparison_forcing(
        law,
        bandwidth=bandwidth,
        lower_bounds=error_bound[..., :-1, :],
        model_error=2 * largest - law.model.model_error_bound(reference),
    )
    decay = bandwidth + (law.chains.each - 1) * law.slope
    return forcing - decay * law.chains.top(error_bound)


def propagate_cascade(
    *, layer: Array, layer_rate: Array, slope: Array, start: TubeStart, step: float
) -> tuple[Array, Array]:
    """The cascade ``dY_j/dt = -λ Y_j + Y_(j+1)``, ``Y_(n-1) = Φ`` (Theorem 1).

    Args:
        layer: Φ at the nodes, ``(M + 1, m)``.
        layer_rate: dΦ/dt at the nodes, ``(M + 1, m)``.
        slope: λ, ``(m,)``.
        start: what the tube opens from.
        step: between two nodes, in s.

    Returns:
        The stages, aligned at Φ, and their time derivatives, both ``(M + 1, n, m)``.
    """
    stages, rates = [layer], [layer_rate]
    for j in range(len(start.stages) - 2, -1, -1):
        forcing = half_grid(stages[0], rates[0], step)
        decay = np.broadcast_to(slope, forcing.shape)
        stage, rate = integrate_filter(decay, forcing, start.stages[j], step)
        stages.insert(0, stage)
        rates.insert(0, rate)
    return np.stack(stages, axis=1), np.stack(rates, axis=1)


def propagate_error_bounds(
    law: SlidingLaw,
    *,
    reference: Array,
    bandwidth: Array,
    layer: Array,
    layer_rate: Array,
    start: TubeStart,
    velocity_bound: VelocityBound,
    step: float,
) -> Tube:
    """Bounds of every error derivative along a reference with a given layer.

    Args:
        law: gives λ, D, Δ and Δ̄.
        reference: x* on the half grid, ``(2 M + 1, n, m)``.
        bandwidth: α on the half grid, ``(2 M + 1, m)``.
        layer: Φ at the nodes, ``(M + 1, m)``.
        layer_rate: dΦ/dt at the nodes, ``(M + 1, m)``.
        start: what the tube opens from.
        velocity_bound: ``comparison``, or the ``paper``'s looser one.
        step: between two nodes, in s.

    Returns:
        The tube at the nodes.
    """
    model, chains, slope = law.model, law.chains, law.slope
    Y, dY = propagate_cascade(
        layer=layer, layer_rate=layer_rate, slope=slope, start=start, step=step
    )
    bound = cascade_bounds(chains, Y, slope)
    bound_rate = cascade_bounds(chains, dY, slope)
    if chains.order == 1 or velocity_bound == "paper":
        return Tube(layer, layer_rate, bound, bound_rate, Y)

    # Δ̄ looks at W itself.  From a valid bound follows a valid one, so both hold at
    # once and Δ̄ takes the smaller of W and the paper's; without that, a model error
    # that grows faster than W would let W run away.
    decay = bandwidth + (chains.each - 1) * slope
    R = np.maximum(half_grid(bound, bound_rate, step), 0.0)
    largest = chains.top(R).copy()
    forcing = comparison_forcing(
        law,
        bandwidth=bandwidth,
        lower_bounds=R[:, :-1],
        model_error=-model.model_error_bound(reference),
    )
    W, gain = chains.top(bound).copy(), np.zeros_like(decay)
    earlier = None
    for _ in range(_SWEEPS if model.error_bound_varies else 1):
        last, doubled = W, 2 * model.model_error_bound_over(reference, R)
        top = chains.top(R)
        if earlier is not None:
            # Newton's method, with the secant of each value by itself: in a fixed
            # point W is the same whatever the gain, which must leave a stable filter.
            moved, rise = top - earlier[0], doubled - earlier[1]
            far = np.abs(moved) > _APART
            gain = np.clip(np.divide(rise, moved, out=gain.copy(), where=far), 0, None)
            gain = np.minimum(gain, _GAIN * decay)
        earlier = top.copy(), doubled
        W, dW = integrate_filter(
            decay - gain, forcing + doubled - gain * top, start.highest, step
        )
        if np.abs(W - last).max() < _SETTLED:
            break
        chains.set_top(R, np.clip(half_grid(W, dW, step), 0.0, largest))
    chains.set_top(bound, W)
    chains.set_top(bound_rate, dW)
    return Tube(layer, layer_rate, bound, bound_rate, Y)


def filter_rates(
    law: SlidingLaw, *, reference: Array, bandwidth: Array, states: Array
) -> Array:
    """The whole tube's differential equation, at one instant.

    Args:
        law: gives λ, D, η, Δ and Δ̄.
        reference: x*, ``(..., n, m)``.
        bandwidth: α, ``(..., m)``.
        states: the stages, aligned at Φ, and, if there is one more row, W;
            ``(..., n or n + 1, m)``.

    Returns:
        Their time derivatives, shaped as `states`.
    """
    order, slope = law.order, law.slope
    stages, layer = states[..., :order, :], states[..., order - 1, :]
    cascade = stages[..., 1:, :] - slope * stages[..., :-1, :]
    own = law.forcing(reference) - bandwidth * layer
    rates = [cascade, own[..., None, :]]
    if states.shape[-2] > order:
        lower = cascade_bounds(law.chains, stages, slope, order - 1)
        velocity = comparison_rate(
            law,
            reference=reference,
            bandwidth=bandwidth,
            error_bound=law.chains.with_top(lower, states[..., order, :]),
        )
        rates.append(velocity[..., None, :])
    return np.concatenate(rates, axis=-2)


def propagate(
    law: SlidingLaw,
    *,
    reference: Array,
    bandwidth: Array,
    start: TubeStart,
    velocity_bound: VelocityBound,
    step: float,
) -> Tube:
    """The whole tube along a reference flown with a given bandwidth.

    dΦ/dt = -α Φ + Δ(x*) + D + η  (eq. phidot), then the error bounds.

    Args:
        law: gives λ, D, η, Δ and Δ̄.
        reference: x* on the half grid, ``(2 M + 1, n, m)``.
        bandwidth: α on the half grid, ``(2 M + 1, m)``.
        start: what the tube opens from.
        velocity_bound: ``comparison``, or the ``paper``'s looser one.
        step: between two nodes, in s.

    Returns:
        The tube at the nodes.
    """
    layer, layer_rate = integrate_layer(
        bandwidth, law.forcing(reference), start.layer, step
    )
    return propagate_error_bounds(
        law,
        reference=reference,
        bandwidth=bandwidth,
        layer=layer,
        layer_rate=layer_rate,
        start=start,
        velocity_bound=velocity_bound,
        step=step,
    )
