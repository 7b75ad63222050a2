"""From the infinite problem to finitely many numbers, for both backends.

The *decisions* of a plan are the spline coefficients of y* and the bandwidth α
at the knots (first-order hold).  `Transcription.evaluate` turns them into an
`Iterate`: the exact tube that follows, the cost and every constraint, all
vectorised over knots.  `Transcription.local` says how the variables of the
programs enter at one knot; both backends build their rows from it.

Every iterate is propagated with the exact tube, so a program's tube only has to
be right to first order around it; no discretisation error is left in a plan.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property, lru_cache
from math import ceil, log2
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from dtmpc_drake.method.layer import layer_pieces
from dtmpc_drake.method.tightening import Instant, input_bound, rate_bound
from dtmpc_drake.method.tube import Tube, cascade_bound, filter_rates, propagate
from dtmpc_drake.models import ConstantUncertainty
from dtmpc_drake.numerics import splines
from dtmpc_drake.numerics.arrays import Array, FloatArray
from dtmpc_drake.obstacles.separation import Halfplanes, separate
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.records.plan import Plan

HAIR = 2e-3
"""By how much the bandwidth stays inside its limits, relative."""
INPUT_HAIR = 2e-3
"""By how much the input does: the tube's pieces round off the model's kinks."""
SPEED_HAIR = 1e-3
"""By how much the speed does: W is proven with some slack, see `enclosure`."""
REACH, REACH_OF_A_STEP = 0.8, 0.32
"""Pieces and obstacles that are further apart have no half-plane: in m, or in parts of
what the speed limit allows between two knots if that is more."""
SPEED_REACH = 0.28
"""Control points of the speed with more margin than this part of its limit are left
out of the programs."""
BLEND = 0.125
"""Part of the way, at each end, in which a start is bent to meet the ends."""
TUBE_STEPS = 8, 16
"""Steps of the tube in each interval, at least; the half grid has twice as many.  The
second where Δ varies and eight are longer than an eighth of a time constant."""
STIFF = 4
"""From so many steps in place of one the tube's derivatives are found implicitly."""


class Guess(Protocol):
    """What iterations may start from: an earlier plan, or what looks like one."""

    def reference(self, time: FloatArray | float) -> FloatArray:
        """See `Plan.reference`; only the position is looked at."""
        ...

    def bandwidth(self, time: FloatArray | float) -> FloatArray:
        """See `Plan.bandwidth`."""
        ...


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
        speed_margin: ``(N, n + 1, m, 2)``, both signs.
        input_margin: at the nodes of the fine grid, ``(M + 1,)``.
        error_margin: of the constant that stands for Δ over the true one, there,
            ``(M + 1, m)``; without such a constant there are no columns.
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
    speed_margin: Array
    input_margin: Array
    error_margin: Array
    cost: float


class Transcription:
    """One problem on one uniform grid of knots.

    Args:
        problem: to plan.
        intervals: N.
        reach: part of the usual reaches within which limits enter the programs, and
            obstacles enter at all.  A limit that turns out to be missed enters the
            next program.
        refinement: times as many steps of the tube as usual.
    """

    def __init__(
        self,
        problem: Problem,
        intervals: int,
        *,
        reach: float = 1.0,
        refinement: int = 1,
    ) -> None:
        self.problem, self.reach = problem, reach
        model = problem.model
        self.order, self.outputs = model.order, model.num_outputs
        self.intervals = intervals
        self.step = problem.duration / intervals
        far = REACH_OF_A_STEP * problem.speed_limit * self.step
        self.obstacle_reach = reach * max(REACH, far)
        self.speed_reach = reach * SPEED_REACH * problem.speed_limit
        self.degree = self.order + 1
        self.control_degree = max(self.degree, 3)
        self.knots: Array = problem.start_time + self.step * np.arange(intervals + 1)
        self.weights = np.full(intervals + 1, self.step)
        self.weights[[0, -1]] /= 2
        # A hair inside the limits, where interpolation cannot break them.
        low, high = problem.bandwidth_min, problem.bandwidth_max
        middle = (low + high) / 2
        self.bandwidth_low = np.minimum(low * (1 + HAIR), middle)
        self.bandwidth_high = np.maximum(high * (1 - HAIR), middle)
        # A limit beyond the whole range is none, and only spoils the scale.
        self.bandwidth_change = (1 - HAIR) * min(
            problem.bandwidth_rate_max * self.step, float(high.max())
        )
        # Steps of the tube of at most half the fastest filter's time constant.  Those
        # of its derivatives need only be as short as the bandwidth asks, but then each
        # costs as much as several explicit ones.
        high = problem.bandwidth_max
        slow = _power_of_two(self.step * high)
        finest = _power_of_two(self.step * (high + self.order * problem.law.slope))
        self.is_stiff = finest > STIFF * slow
        self.substeps = slow if self.is_stiff else finest
        least, most = TUBE_STEPS
        if model.error_bound_varies:
            # Δ(x*) may have kinks, which parabolas on the steps round off.
            least = min(max(_power_of_two(8 * self.step * high), least), most)
        self.tube_steps = refinement * max(least, 2 * finest)
        fine = np.arange(2 * self.tube_steps) / (2 * self.tube_steps)
        self._half_basis = np.stack(
            [
                splines.basis(self.degree, k, fine, self.step)
                for k in range(self.order + 1)
            ],
            axis=1,
        ).reshape(-1, self.degree + 1)
        self._end_basis = np.stack(
            [
                splines.basis(self.degree, k, np.ones(1), self.step)[0]
                for k in range(self.order + 1)
            ]
        )
        elevate = splines.elevation(self.degree, self.control_degree)
        self.position_basis = elevate @ splines.control_basis(self.degree, 0, self.step)
        self.speed_basis = splines.control_basis(self.degree, 1, self.step)
        self._hermite_elevation = splines.elevation(3, self.control_degree)
        self._fine = np.linspace(0, 1, self.tube_steps + 1)

    # Decisions to iterate.

    def straight_line(self) -> tuple[Array, Array]:
        """The paper's start: a straight line, at the highest bandwidth."""
        p = self.problem
        count = self.intervals + self.degree
        # Greville abscissae reproduce linear functions exactly.
        greville = (np.arange(count) - (self.degree - 1) / 2) / self.intervals
        way = np.nan_to_num(p.goal[0] - p.start[0])  # a free end stays where it is
        line = p.start[0] + greville[:, None] * way
        alpha = np.broadcast_to(self.bandwidth_high, (self.intervals + 1, self.outputs))
        return self.with_ends(line), self.feasible_bandwidth(alpha)

    def along(self, points: Array) -> tuple[Array, Array]:
        """At constant speed along a path, at the highest bandwidth.

        Args:
            points: evenly spaced from start to goal, ``(any number, m)``.
        """
        share = np.linspace(0, 1, 2 * self.intervals + 1)
        given = np.linspace(0, 1, len(points))
        wanted = np.stack([np.interp(share, given, x) for x in points.T], axis=1)
        alpha = np.broadcast_to(self.bandwidth_high, (self.intervals + 1, self.outputs))
        return self._nearest(wanted), self.feasible_bandwidth(alpha)

    def from_plan(self, plan: Guess) -> tuple[Array, Array]:
        """The decisions nearest to an earlier plan, from now to its end."""
        grid = self.knots[0] + self.step * np.arange(2 * self.intervals + 1) / 2
        alpha = self.feasible_bandwidth(plan.bandwidth(self.knots))
        return self._nearest(plan.reference(grid)[:, 0]), alpha

    def _nearest(self, wanted: Array) -> Array:
        """The spline nearest to values at all knots and midpoints, with its ends."""
        operator, normal = _least_squares(self.intervals, self.degree)
        return self.with_ends(normal.solve(operator.T @ wanted))

    def with_ends(self, coefficients: Array) -> Array:
        """The nearest spline that meets both end states.

        Nearest in the highest derivative, with only the first and last part of
        the way changed, so that a shifted end leaves the rest where it was.
        """
        conditions, wanted, free, correction = self._ends
        result = coefficients.copy()
        result[free] += correction @ (wanted - conditions @ coefficients)
        return result

    @property
    def goal_rows(self) -> list[int]:
        """The derivatives that the goal prescribes."""
        return [k for k, row in enumerate(self.problem.goal) if np.isfinite(row).all()]

    @cached_property
    def _ends(self) -> tuple[Array, Array, Array, Array]:
        """What the ends ask of the coefficients, and how these may answer.

        Returns:
            Conditions ``(rows, N + degree)`` and their values ``(rows, m)``; the
            indices of the coefficients that may change, and how they change with
            what is missing, ``(free, rows)``.
        """
        p, count = self.problem, self.intervals + self.degree
        goal = self.goal_rows
        start = [*p.start] + ([] if p.start_highest is None else [p.start_highest])
        conditions = np.concatenate(
            [
                _end_conditions(self.intervals, self.degree, 0, self.step)[
                    : len(start)
                ],
                _end_conditions(self.intervals, self.degree, self.intervals, self.step)[
                    goal
                ],
            ]
        )
        wanted = np.concatenate([start, p.goal[goal]])
        part = min(int(BLEND * self.intervals) + 2 * self.order, count // 2)
        free = np.r_[:part, count - part : count]
        # In units of the step, so that problems on as many intervals share them.
        rows = tuple(range(len(start))), tuple(goal)
        answers = _end_answers(self.intervals, self.degree, part, rows)
        scale = self.step ** np.concatenate([*map(np.array, rows)])
        return conditions, wanted, free, answers * scale

    def feasible_bandwidth(self, bandwidth: Array) -> Array:
        """The smallest α above the given one that obeys bounds and rate limit.

        More bandwidth means a smaller tube, so nothing that was clear of an
        obstacle is lost.
        """
        p = self.problem
        alpha = np.clip(bandwidth, self.bandwidth_low, self.bandwidth_high)
        index = np.arange(len(alpha))[:, None] * self.bandwidth_change
        forward = np.maximum.accumulate(alpha + index) - index
        backward = np.maximum.accumulate((alpha - index)[::-1])[::-1] + index
        alpha = np.maximum(forward, backward)
        if p.start_bandwidth is not None:
            low, high = p.start_bandwidth - index, p.start_bandwidth + index
            alpha = np.clip(alpha, low, high)
        return np.asarray(alpha)

    def evaluate(
        self, coefficients: Array, bandwidth: Array, *, hint: Halfplanes | None = None
    ) -> Iterate:
        """Propagates the exact tube and evaluates cost and constraints.

        Args:
            coefficients: of y*.
            bandwidth: at the knots.
            hint: half-planes to take where they part more than those found here.
        """
        p, n = self.problem, self.order
        windows = splines.windows(coefficients, self.degree)
        half = (self._half_basis @ windows).reshape(-1, n + 1, self.outputs)
        last = self._end_basis @ windows[-1]
        reference = np.concatenate([half, last[None]])
        alpha = self._on_half_grid(bandwidth)
        tube = propagate(
            p.law,
            reference=reference[:, :n],
            bandwidth=alpha,
            start=p.tube_start,
            velocity_bound=p.velocity_bound,
            step=self.step / self.tube_steps,
        )
        nodes = reference[::2]
        at_nodes = Instant(
            state=nodes[:, :n],
            highest=nodes[:, n],
            gain=alpha[::2] * tube.boundary_layer,
            error_bound=tube.error_bound,
        )
        used_rate = rate_bound(p.law, at_nodes)
        at_knots = slice(None, None, self.tube_steps)
        local = self._local(reference, tube, bandwidth, at_knots)
        rate_chord = self._chord(used_rate[at_knots], n)
        speed_controls = self.speed_basis @ windows
        # Where the knots under-represent a piece, take off the difference.
        limit = p.speed_limit * (1 - SPEED_HAIR) - self._bulge(used_rate)[:, None]
        limit = limit - rate_chord
        speed_margin = np.stack([limit - speed_controls, limit + speed_controls], -1)
        # Neighbouring pieces share a control point, and so their margin there.
        shared = np.minimum(speed_margin[1:, 0], speed_margin[:-1, -1])
        speed_margin[1:, 0] = speed_margin[:-1, -1] = shared
        controls = self.position_basis @ windows
        tube_controls = self._tube_controls(tube)
        return Iterate(
            coefficients=coefficients,
            bandwidth=bandwidth,
            reference=reference,
            tube=tube,
            local=local,
            controls=controls,
            tube_controls=tube_controls,
            planes=separate(
                p.obstacles,
                controls,
                tube_controls,
                tube_margin=p.tube_margin,
                reach=self.obstacle_reach,
                hint=hint,
            ),
            speed_margin=speed_margin,
            input_margin=p.input_limit * (1 - INPUT_HAIR)
            - input_bound(p.law, at_nodes),
            error_margin=self.error_margin(nodes[:, :n], tube.error_bound),
            cost=self._cost(local, bandwidth),
        )

    def _on_half_grid(self, bandwidth: Array) -> Array:
        """Between the knots α is linear."""
        weight = (np.arange(2 * self.tube_steps) / (2 * self.tube_steps))[:, None]
        inner = bandwidth[:-1, None] * (1 - weight) + bandwidth[1:, None] * weight
        return np.concatenate([inner.reshape(-1, self.outputs), bandwidth[-1:]])

    def local_at(self, iterate: Iterate, nodes: Array) -> Local:
        """What enters at some nodes of the fine grid of an iterate."""
        piece, later = self.within(nodes)
        alpha = iterate.bandwidth
        between = alpha[piece] + later[:, None] * (alpha[piece + 1] - alpha[piece])
        return self._local(iterate.reference, iterate.tube, between, nodes)

    def _local(
        self, reference: Array, tube: Tube, bandwidth: Array, nodes: Array | slice
    ) -> Local:
        """What enters at some nodes, the bandwidth there given."""
        state = reference[::2][nodes]
        return Local(
            state=state[:, : self.order],
            highest=state[:, self.order],
            layer=tube.boundary_layer[nodes],
            bandwidth=bandwidth,
            error_bound=tube.error_bound[nodes],
        )

    def within(self, nodes: Array) -> tuple[Array, Array]:
        """The pieces that nodes of the fine grid are in, and how far, in [0, 1]."""
        piece = np.minimum(nodes // self.tube_steps, self.intervals - 1)
        return piece, nodes / self.tube_steps - piece

    def basis_at(self, nodes: Array) -> Array:
        """Spline basis of y* and its derivatives, ``(len(nodes), n + 1, degree + 1)``.

        Args:
            nodes: of the fine grid.
        """
        piece, _ = self.within(nodes)
        return np.asarray(self._node_basis[nodes - piece * self.tube_steps])

    @cached_property
    def _node_basis(self) -> Array:
        """The basis at the nodes of any piece, both its ends included."""
        half = self._half_basis.reshape(-1, self.order + 1, self.degree + 1)
        return np.concatenate([half[::2], self._end_basis[None]])

    def _cost(self, local: Local, bandwidth: Array) -> float:
        p = self.problem
        u = self.feedforward(local)
        excess = bandwidth - p.bandwidth_floor
        running = p.input_weight * (u**2).sum(1)
        running = running + p.bandwidth_weight * (excess**2).sum(1)
        return float(self.weights @ running)

    def _chord(self, at_knots: Array, degree: int) -> Array:
        """Values on the straight lines between knots, ``(N, degree + 1, ...)``."""
        weight = np.linspace(0, 1, degree + 1)[:, None]
        return np.asarray(
            at_knots[:-1, None] * (1 - weight) + at_knots[1:, None] * weight
        )

    def _bulge(self, nodes: Array) -> Array:
        """How far each piece rises above its chord, ``(N, ...)``."""
        chord = self._chord(nodes[:: self.tube_steps], self.tube_steps)
        return np.asarray((self.pieces(nodes) - chord).max(axis=1))

    def near_the_speed_limit(self, iterate: Iterate) -> Array:
        """Which control points of the speed enter the programs, as `speed_margin`."""
        near = iterate.speed_margin < self.speed_reach
        near[1:, 0] = False  # the last control point of the piece before
        return np.asarray(near)

    def pieces(self, nodes: Array) -> Array:
        """Node values piece by piece, both ends included."""
        index = np.arange(self.intervals)[:, None] * self.tube_steps
        return np.asarray(nodes[index + np.arange(self.tube_steps + 1)])

    def _tube_controls(self, tube: Tube) -> Array:
        """Bézier points of a curve above Ω on every piece."""
        at = slice(None, None, self.tube_steps)
        value, rate = tube.error_bound[at, 0], tube.error_bound_rate[at, 0]
        points = hermite_controls(value, rate, self.step)
        t = self._fine[:, None]
        bernstein = np.concatenate(
            [(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1
        )
        excess = self.pieces(tube.error_bound[:, 0]) - bernstein @ points
        points = points + np.maximum(excess.max(axis=1), 0.0)[:, None]
        return np.asarray(self._hermite_elevation @ points)

    # What enters at one instant; generic in the scalar.

    def feedforward(self, local: Local) -> Array:
        """u* = B⁻¹ (y*^(n) - F̂(x*)), ``(..., m)``."""
        model = self.problem.model
        return model.input_for(local.state, local.highest - model.drift(local.state))

    def used_input(self, local: Local) -> Array:
        """The bound of the input's norm, ``(...)``."""
        return input_bound(self.problem.law, local.instant)

    def used_rate(self, local: Local) -> Array:
        """The bound of the velocity error, ``(..., m)``."""
        return rate_bound(self.problem.law, local.instant)

    def error_margin(self, state: Array, error_bound: Array) -> Array:
        """How far a constant that stands for Δ lies above the true one.

        Returns:
            ``(..., m)``; ``(..., 0)`` where Δ is not replaced by a constant.
        """
        model = self.problem.model
        if not isinstance(model, ConstantUncertainty) or not model.covers:
            return np.zeros((*state.shape[:-2], 0))
        true = model.model.model_error_bound_over(state, error_bound)
        return np.asarray(model.bound * (1 - INPUT_HAIR) - true)

    def tube_rates(self, reference: Array, bandwidth: Array, states: Array) -> Array:
        """The tube's differential equation; shapes as `tube.filter_rates`."""
        return filter_rates(
            self.problem.law, reference=reference, bandwidth=bandwidth, states=states
        )

    def tube_states(self, iterate: Iterate, stride: int | None = None) -> Array:
        """Y_0 ... Y_(n-1) = Φ and, if it is a state, W; at every knot by default."""
        rows = [iterate.tube.stages]
        if self.has_velocity_state:
            rows.append(iterate.tube.error_bound[:, -1:])
        return np.concatenate(rows, axis=1)[:: stride or self.tube_steps]

    @property
    def has_velocity_state(self) -> bool:
        """Whether W is a state of the programs (else it is Φ, or a cascade)."""
        return self.order > 1 and self.problem.velocity_bound == "comparison"

    @cached_property
    def state_bounds(self) -> list[Array]:
        """From the tube's states to R_0 ... R_(n-1), each ``(m, S m)``."""
        n, m = self.order, self.outputs
        S = n + self.has_velocity_state
        unit = np.eye(S * m).reshape(S * m, S, m)
        slope = self.problem.law.slope
        bounds = [cascade_bound(unit[:, :n], slope, k).T for k in range(n)]
        if self.has_velocity_state:
            bounds[-1] = unit[:, n].T
        return bounds

    # Results.

    def plan(self, iterate: Iterate) -> Plan:
        """The plan that an iterate stands for."""
        tube, p = iterate.tube, self.problem
        count = self.intervals * self.tube_steps
        return Plan(
            knots=self.knots,
            coefficients=splines.piece_coefficients(
                iterate.coefficients, self.degree, self.step
            ),
            bandwidth_knots=iterate.bandwidth,
            tube_times=p.start_time + p.duration * np.arange(count + 1) / count,
            layer_coefficients=layer_pieces(
                p.law,
                reference=iterate.reference[:, : self.order],
                bandwidth=self._on_half_grid(iterate.bandwidth),
                initial=p.tube_start.layer,
                step=self.step / self.tube_steps,
            ),
            bound_samples=tube.error_bound,
            bound_rate_samples=tube.error_bound_rate,
        )


def _power_of_two(least: Array) -> int:
    """The smallest that is not below any of some numbers, nor below two."""
    return int(2 ** ceil(log2(max(float(least.max()), 2.0))))


def hermite_controls(value: Array, rate: Array, step: float) -> Array:
    """Bézier points of the cubic Hermite pieces between knots, ``(N, 4, m)``."""
    return np.stack(
        [
            value[:-1],
            value[:-1] + step / 3 * rate[:-1],
            value[1:] - step / 3 * rate[1:],
            value[1:],
        ],
        axis=1,
    )


def _end_conditions(intervals: int, degree: int, knot: int, step: float) -> Array:
    """Every derivative up to the n-th at the first or last knot."""
    rows = np.zeros((degree, intervals + degree))
    for k in range(degree):
        start = splines.basis(degree, k, np.zeros(1), step)[0]
        rows[k, knot : knot + degree] = start[:degree]
    return rows


@lru_cache
def _least_squares(intervals: int, degree: int) -> tuple[splines.Sparse, Any]:
    """A spline's values at knots and midpoints, and the factors of A'A."""
    operator = splines.midpoint_operator(intervals, degree)
    return operator, scipy.sparse.linalg.splu((operator.T @ operator).tocsc())


@lru_cache
def _end_answers(
    intervals: int, degree: int, part: int, rows: tuple[tuple[int, ...], ...]
) -> Array:
    """How the outer coefficients answer to conditions at both ends, in unit steps.

    So that y*^(n) changes least.

    Args:
        intervals: of the grid.
        degree: of the spline.
        part: so many coefficients may change at each end.
        rows: the derivatives that are prescribed at the start and at the end.

    Returns:
        ``(2 part, conditions)``.
    """
    count = intervals + degree
    free = np.r_[:part, count - part : count]
    changed = np.concatenate(
        [
            _end_conditions(intervals, degree, knot, 1.0)[list(some)]
            for knot, some in zip((0, intervals), rows, strict=True)
        ]
    )[:, free]
    highest = splines.knot_operator(intervals, degree, degree - 1, 1.0)[:, free]
    few = sp.csr_array(changed)
    system = sp.block_array([[highest.T @ highest, few.T], [few, None]]).tocsc()
    wanted = np.eye(len(free) + len(changed))[:, len(free) :]
    return np.asarray(scipy.sparse.linalg.splu(system).solve(wanted)[: len(free)])
