"""From the infinite problem to finitely many numbers, for every backend.

The *decisions* of a plan are the spline coefficients of y* and the bandwidth α
at the knots (first-order hold).  `Transcription.evaluate` turns them into an
`Iterate`: the exact tube that follows, the cost and the margins of all limits, all
vectorised over knots.

Every iterate is propagated with the exact tube, so a program's tube only has to
be right to first order around it; no discretisation error is left in a plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import ceil, log2

import numpy as np

from dtmpc_drake.costs import Cost
from dtmpc_drake.limits import ConvexLimit
from dtmpc_drake.method.layer import layer_pieces
from dtmpc_drake.method.tightening import Instant, deviation_bound
from dtmpc_drake.method.tube import Tube, cascade_bounds, filter_rates, propagate
from dtmpc_drake.numerics import splines
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.obstacles.separation import Halfplanes, separate
from dtmpc_drake.planning.bandwidth_knots import BandwidthKnots
from dtmpc_drake.planning.ends import Ends
from dtmpc_drake.planning.iterate import Iterate, Local
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import SolverOptions

TUBE_STEPS = 8, 16
"""Steps of the tube in each interval, at least; the half grid has twice as many.  The
second where Δ varies and eight are longer than an eighth of a time constant."""
DEFAULTS = SolverOptions()
LAST = np.array([-1])
"""The knot at the end."""
SIZE = 2.5
"""Of limits of positions, which may be anything, in a problem's own units."""
STIFF = 4
"""From so many steps in place of one the tube's derivatives are found implicitly."""


def size_of(limit: ConvexLimit) -> float:
    """What a limit is about so large as, in a problem's own units."""
    return SIZE if limit.size is None else limit.size


class Transcription:
    """One problem on one uniform grid of knots.

    Args:
        problem: to plan.
        intervals: N.
        options: tolerances and reaches.
        reach: part of the usual reaches within which limits enter the programs, and
            obstacles enter at all.  A limit that turns out to be missed enters the
            next program.
        refinement: times as many steps of the tube as usual.
    """

    def __init__(
        self,
        problem: Problem,
        intervals: int,
        options: SolverOptions = DEFAULTS,
        *,
        reach: float = 1.0,
        refinement: int = 1,
    ) -> None:
        self.problem, self.options, self.reach = problem, options, reach
        law = problem.law
        self.chains = law.chains
        self.order, self.outputs = law.order, law.num_outputs
        self.intervals = intervals
        self.step = problem.duration / intervals
        far = options.obstacle_reach_of_a_step * size_of(problem.speed) * self.step
        self.obstacle_reach = reach * max(options.obstacle_reach, far)
        self.degree = self.order + 1
        self.control_degree = max(self.degree, 3)
        self.knots: Array = problem.start_time + self.step * np.arange(intervals + 1)
        self.weights = np.full(intervals + 1, self.step)
        self.weights[[0, -1]] /= 2
        self.bandwidth = BandwidthKnots(problem, self.step, options)
        # Steps of the tube of at most half the fastest filter's time constant.  Those
        # of its derivatives need only be as short as the bandwidth asks, but then each
        # costs as much as several explicit ones.
        high = problem.bandwidth.high
        slow = _power_of_two(self.step * high)
        finest = _power_of_two(self.step * (high + self.order * law.slope))
        self.is_stiff = finest > STIFF * slow
        self.substeps = slow if self.is_stiff else finest
        least, most = TUBE_STEPS
        if law.model.error_bound_varies:
            # Δ(x*) may have kinks, which parabolas on the steps round off.
            least = min(max(_power_of_two(8 * self.step * high), least), most)
        self.tube_steps = refinement * max(least, 2 * finest)
        fine = np.arange(2 * self.tube_steps) / (2 * self.tube_steps)
        self.splines = splines.Splines(self.chains.orders, self.step)
        half = self.splines.values(fine)
        self._half_basis = half.reshape(-1, *half.shape[2:])
        (self._end_basis,) = self.splines.values(np.ones(1))
        self.position_basis = self.splines.controls(0, self.control_degree)
        self._hermite_elevation = splines.elevation(3, self.control_degree)
        self._fine = np.linspace(0, 1, self.tube_steps + 1)

    @cached_property
    def ends(self) -> Ends:
        """What both ends ask of the coefficients."""
        return Ends(self.problem, self.intervals)

    @cached_property
    def convex_bases(self) -> tuple[Array, ...]:
        """From coefficients to the control points of each of `Problem.convex`."""
        return tuple(
            self.splines.controls(limit.derivative, self.degree - limit.derivative)
            for limit in self.problem.convex
        )

    # Decisions to iterate.

    def evaluate(
        self, coefficients: Array, bandwidth: Array, *, hint: Halfplanes | None = None
    ) -> Iterate:
        """Propagates the exact tube and evaluates cost and margins.

        Args:
            coefficients: of y*.
            bandwidth: at the knots.
            hint: half-planes to take where they part more than those found here.
        """
        p, n = self.problem, self.order
        windows = splines.windows(coefficients, self.degree)
        half = splines.applied(self._half_basis, windows)
        half = half.reshape(-1, n + 1, self.outputs)
        last = splines.applied(self._end_basis, windows[-1])
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
        at_knots = slice(None, None, self.tube_steps)
        local = self._local(reference, tube, bandwidth, at_knots)
        controls = splines.applied(self.position_basis, windows)
        tube_controls = self._tube_controls(tube)
        points = [
            (
                splines.applied(basis, windows),
                self._deviation_controls(limit, at_nodes, len(basis)),
            )
            for limit, basis in zip(p.convex, self.convex_bases, strict=True)
        ]
        reserve = self.options.sampled_reserve
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
            sampled=[
                limit.margins(p.law, at_nodes) - reserve * limit.size
                for limit in p.sampled
            ],
            convex=[
                self._convex_margins(limit, *own)
                for limit, own in zip(p.convex, points, strict=True)
            ],
            convex_points=points,
            cost=self._cost(local, bandwidth),
        )

    def _deviation_controls(
        self, limit: ConvexLimit, at_nodes: Instant, count: int
    ) -> Array:
        """Control points of what bounds a deviation from above, ``(N, count, m)``."""
        used = deviation_bound(self.problem.law, at_nodes, limit.derivative)
        # Where the knots under-represent a piece, add the difference.
        chord = self._chord(used[:: self.tube_steps], count - 1)
        return chord + self._bulge(used)[:, None]

    def _convex_margins(self, limit: ConvexLimit, value: Array, spread: Array) -> Array:
        """At control points of the limited derivative, ``(N, c, q)``."""
        reserve = self.options.convex_reserve * size_of(limit)
        margin = limit.left(value, spread) - reserve
        # Neighbouring pieces share a control point, and so their margin there.
        shared = np.minimum(margin[1:, 0], margin[:-1, -1])
        margin[1:, 0] = margin[:-1, -1] = shared
        return np.asarray(margin)

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
        """Spline basis of the reference at nodes of the fine grid.

        Args:
            nodes: of the fine grid.

        Returns:
            ``(len(nodes), n + 1, degree + 1, m or 1)``.
        """
        piece, _ = self.within(nodes)
        return self._node_basis[nodes - piece * self.tube_steps]

    @cached_property
    def _node_basis(self) -> Array:
        """The basis at the nodes of any piece, both its ends included."""
        shape = self._end_basis.shape
        half = self._half_basis.reshape(-1, *shape)
        return np.concatenate([half[::2], self._end_basis[None]])

    def _cost(self, local: Local, bandwidth: Array) -> float:
        p = self.problem
        running = p.bandwidth_cost.running(bandwidth, self.step)
        running = running + (self.residuals(local) ** 2).sum(1)
        cost = self.weights @ running
        if p.terminal:
            last = local.at(LAST)
            cost = cost + (self.residuals(last, p.terminal) ** 2).sum()
        return float(cost)

    def residuals(self, local: Local, costs: Sequence[Cost] | None = None) -> Array:
        """Of some costs of the reference, ``(..., r)``; of the running ones by default.

        Generic in the scalar.
        """
        p = self.problem
        some = p.costs if costs is None else costs
        each = [c.residuals(p.law, local.state, local.highest) for c in some]
        return each[0] if len(each) == 1 else np.concatenate(each, axis=-1)

    def residual_slopes(
        self, local: Local, costs: Sequence[Cost], secant: float
    ) -> Array:
        """Their derivatives by x* and y*^(n), ``(K, r, (n + 1) m)``."""
        law = self.problem.law
        each = [c.slopes(law, local.state, local.highest, secant) for c in costs]
        return np.concatenate([np.concatenate(both, axis=2) for both in each], axis=1)

    def _chord(self, at_knots: Array, degree: int) -> Array:
        """Values on the straight lines between knots, ``(N, degree + 1, ...)``."""
        weight = np.linspace(0, 1, degree + 1)[:, None]
        return at_knots[:-1, None] * (1 - weight) + at_knots[1:, None] * weight

    def _bulge(self, nodes: Array) -> Array:
        """How far each piece rises above its chord, ``(N, ...)``."""
        chord = self._chord(nodes[:: self.tube_steps], self.tube_steps)
        return (self.pieces(nodes) - chord).max(axis=1)

    def pieces(self, nodes: Array) -> Array:
        """Node values piece by piece, both ends included."""
        index = np.arange(self.intervals)[:, None] * self.tube_steps
        return nodes[index + np.arange(self.tube_steps + 1)]

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
        return self._hermite_elevation @ points

    # What is left of the limits.

    def violation(self, iterate: Iterate) -> float:
        """The worst of all limits, in m and in the units of limits over their scales.

        Measured from the backed-off limits: at most `backoff` is feasible.
        """
        p, backoff = self.problem, self.options.backoff
        margins = [margin.min() for margin in iterate.convex]
        for limit, margin in zip(p.sampled, iterate.sampled, strict=True):
            margins.append(margin.min() / limit.scale)
        margins.append(iterate.planes.margin.min(initial=np.inf))
        # What is not a number violates everything.
        return float(
            np.nan_to_num(np.maximum(0.0, backoff - np.min(margins)), nan=np.inf)
        )

    def near_convex(self, iterate: Iterate) -> list[Array]:
        """Which control points of `Iterate.convex` enter the programs."""
        found = []
        for limit, margin in zip(self.problem.convex, iterate.convex, strict=True):
            near = margin < self.reach * self.options.convex_reach * size_of(limit)
            near[1:, 0] = False  # the last control point of the piece before
            found.append(np.asarray(near))
        return found

    def complaints(self, iterate: Iterate) -> list[tuple[float, str]]:
        """Which limits are broken, by how much, and all that in words."""
        p, knots, law = self.problem, self.knots, self.problem.law
        found: list[tuple[float, str]] = []

        def note(margin: float, unit: str, title: str, time: float) -> None:
            if margin < 0:
                when = time * p.units.time
                text = f"{title} by {-margin:.3f} {unit} at t = {when:.2f} s"
                found.append((-margin, text))

        planes = iterate.planes
        if planes.margin.size:
            row, point = np.unravel_index(planes.margin.argmin(), planes.margin.shape)
            time = knots[planes.piece[row]] + self.step * point / self.control_degree
            obstacle = p.obstacles.index[planes.obstacle[row]]
            worst = planes.margin.min() * p.units.length
            unit = law.model.length_unit
            note(float(worst), unit, f"obstacle {obstacle}", float(time))
        for convex, margin in zip(p.convex, iterate.convex, strict=True):
            piece, _, last = np.unravel_index(margin.argmin(), margin.shape)
            column = int(last)
            where = convex.where(law, column)
            title = f"{convex.title} on {where}" if where else convex.title
            worst = margin.min() * convex.worth(p.units, self.order)
            note(float(worst), convex.unit(law, column), title, float(knots[piece]))
        for sampled, margin in zip(p.sampled, iterate.sampled, strict=True):
            node, last = np.unravel_index(margin.argmin(), margin.shape)
            column = int(last)
            where = sampled.where(law, column)
            title = f"{sampled.title} on {where}" if where else sampled.title
            time = knots[0] + self.step * node / self.tube_steps
            worst = margin.min() * sampled.worth(p.units, self.order)
            note(float(worst), sampled.unit(law, column), title, float(time))
        return found

    # The tube's states in the programs.

    def tube_rates(self, reference: Array, bandwidth: Array, states: Array) -> Array:
        """The tube's differential equation; shapes as `tube.filter_rates`."""
        return filter_rates(
            self.problem.law, reference=reference, bandwidth=bandwidth, states=states
        )

    def tube_states(self, iterate: Iterate, stride: int | None = None) -> Array:
        """The stages, aligned at Φ, and, if it is a state, W; at knots by default."""
        rows = [iterate.tube.stages]
        if self.has_velocity_state:
            rows.append(self.chains.top(iterate.tube.error_bound)[:, None])
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
        bounds = cascade_bounds(self.chains, unit[:, :n], self.problem.law.slope)
        if self.has_velocity_state:
            self.chains.set_top(bounds, unit[:, n])
        return [bounds[:, k].T for k in range(n)]

    # Results.

    def plan(self, iterate: Iterate) -> Plan:
        """The plan that an iterate stands for."""
        tube, p = iterate.tube, self.problem
        count = self.intervals * self.tube_steps
        return Plan(
            knots=self.knots,
            coefficients=self.splines.pieces(iterate.coefficients),
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
            orders=self.chains.each,
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
