"""What iterations go through: one iterate, and what enters at an instant of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.method.tube import Tube
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.obstacles.separation import Halfplanes

Decisions = tuple[Array, Array]
"""Spline coefficients of y*, ``(N + n + 1, m)``, and α at the knots, ``(N + 1, m)``."""


@dataclasses.dataclass(frozen=True)
class Local:
    """Everything that enters at one instant, batched over leading axes.

    Attributes:
        state: x*, ``(..., n, m)``.
        highest: y*^(n), ``(..., m)``.
        layer: Φ, ``(..., m)``.
        bandwidth: α, ``(..., m)``.
        error_bound: R, ``(..., n, m)``.
    """

    state: Array
    highest: Array
    layer: Array
    bandwidth: Array
    error_bound: Array

    @property
    def instant(self) -> Instant:
        """What the pointwise mathematics asks for."""
        return Instant(
            state=self.state,
            highest=self.highest,
            gain=self.bandwidth * self.layer,
            error_bound=self.error_bound,
        )

    def at(self, which: Array) -> Local:
        """What enters at some of the instants."""
        return Local(
            state=self.state[which],
            highest=self.highest[which],
            layer=self.layer[which],
            bandwidth=self.bandwidth[which],
            error_bound=self.error_bound[which],
        )

    def pack(self) -> Array:
        """One flat vector an instant, ``(..., (2 n + 3) m)``."""
        lead = self.layer.shape[:-1]
        return np.concatenate(
            [
                self.state.reshape(*lead, -1),
                self.highest,
                self.layer,
                self.bandwidth,
                self.error_bound.reshape(*lead, -1),
            ],
            axis=-1,
        )

    @classmethod
    def unpack(cls, flat: Array, order: int, outputs: int) -> Local:
        """The inverse of `pack`."""
        nm, m = order * outputs, outputs
        shape = (*flat.shape[:-1], order, outputs)
        return cls(
            state=flat[..., :nm].reshape(shape),
            highest=flat[..., nm : nm + m],
            layer=flat[..., nm + m : nm + 2 * m],
            bandwidth=flat[..., nm + 2 * m : nm + 3 * m],
            error_bound=flat[..., nm + 3 * m :].reshape(shape),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Iterate:
    """Decisions, the exact tube that follows, and what they cost.

    Attributes:
        coefficients: of y*, ``(N + n + 1, m)``.
        bandwidth: α at the knots, ``(N + 1, m)``.
        reference: y* and derivatives on the half grid, ``(2 M + 1, n + 1, m)``.
        tube: at the nodes of the fine grid.
        local: at the knots.
        controls: Bézier points of y*, ``(N, degree + 1, m)``.
        tube_controls: Bézier points that bound Ω from above, same shape.
        planes: that part the pieces from the obstacles within reach.
        sampled: margins of each of `Problem.sampled` at the nodes of the fine grid,
            ``(M + 1, q)``.
        convex: margins of each of `Problem.convex` at the control points of its
            derivative, ``(N, c, q)``.
        convex_points: for each the control points, and those of what bounds the
            deviation from above, ``(N, c, m)`` each.
        cost: of the plan.
    """

    coefficients: Array
    bandwidth: Array
    reference: Array
    tube: Tube
    local: Local
    controls: Array
    tube_controls: Array
    planes: Halfplanes
    sampled: Sequence[Array]
    convex: Sequence[Array]
    convex_points: Sequence[tuple[Array, Array]]
    cost: float

    @property
    def decisions(self) -> Decisions:
        """Coefficients and bandwidth."""
        return self.coefficients, self.bandwidth
