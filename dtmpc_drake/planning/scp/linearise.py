"""Sequential convex programming on Clarabel (the paper's section VII).

Each iteration linearises everything around an exactly propagated iterate,
solves one convex quadratic program with an exact penalty on a shared slack, and
walks along the step as far as the merit function (exact cost plus exact
penalty on the worst true violation) keeps its promise.  Bandwidth bounds and
rate limit are convex in the decisions, so every iterate obeys them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.numerics.arrays import Array, bends, euclidean_norm
from dtmpc_drake.obstacles.separation import Halfplanes
from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.scp.clarabel import QuadraticProgram
from dtmpc_drake.planning.scp.curvature import (
    Multipliers,
    input_curvature,
    rotation_curvature,
    tube_curvature,
)
from dtmpc_drake.planning.scp.layout import Variables
from dtmpc_drake.planning.scp.rows import ZERO, Rows
from dtmpc_drake.planning.scp.sensitivity import kinks, transitions
from dtmpc_drake.planning.scp.slopes import feedforward_slopes, limit_slopes
from dtmpc_drake.planning.transcription import Iterate, Local, Transcription

PENALTY = 1e3
"""First weight of the slack; raised while a converged plan still needs slack."""
BACKOFF = 3e-4
"""How much the programs ask for beyond every limit, in m and m/s and of the input by
`INPUT_SCALE`, so that an iterate that is feasible to this keeps the limit itself."""
INPUT_SCALE = 8.0
"""So much violation of the input's limit, in m/s^n, weighs like one metre."""
INPUT_BACKOFF = 1e-3
"""The same of the input, so scaled: it peaks between the nodes that are looked at."""
ROTATION = 1.0
"""Weight of a half-plane's rotation, at least."""
NEXT_TO_NOTHING = 1e-4
"""Weight of moves, which are bounded from below only."""
SECANT = 0.1
"""Half-width of the differences along the state, in its units.  Model errors
often have a kink at rest; a derivative would not see it, a secant does."""
RATE_REACH = 0.5
"""Bandwidth rates below this part of their limit are left to the projection."""
INPUT_REACH = 0.2
"""Knots with more margin than this part of the limit are left out of a program."""
BETWEEN, BETWEEN_REACH = 4, 0.06
"""Parts of a piece at whose ends the input is limited too, and with which margin."""
BANDWIDTH_REACH = 0.6
"""Bandwidths that are further above their lower bound, in parts of their range, are
left to the projection."""
APEX = 0.05
"""Below this part of the input's limit the norm of B⁻¹ y*^(n) is cut from all sides."""
NO_ROWS = np.zeros((0, 1)), np.zeros((0, 1), dtype=int)
RIGID = 1e-2
"""A start that violates no more than this is hoped to need no slack."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """What the next convex program looks like.

    Attributes:
        penalty: weight of the slack.
        proximity: weight of the square of the step (a soft trust region).
        secant: half-width of the differences along the state, in its units.
        rigid: whether there is no slack.  Without it a program takes a third fewer
            iterations, but it may be infeasible.
    """

    penalty: float = PENALTY
    proximity: float = 0.0
    secant: float = SECANT
    rigid: bool = False


class Program:
    """The convex program around one iterate after the other.

    Args:
        transcription: of the problem.
        variables: of the program.
        solver: of their layout.
        accuracy: of the solutions, see `QuadraticProgram.solve`.

    Attributes:
        multipliers: of the last solution.
    """

    def __init__(
        self,
        transcription: Transcription,
        variables: Variables,
        solver: QuadraticProgram,
        *,
        accuracy: float,
    ) -> None:
        self.transcription, self.variables = transcription, variables
        self.multipliers = Multipliers.none(transcription)
        self._solver, self._accuracy = solver, accuracy
        for name, weight in (("moves", NEXT_TO_NOTHING), ("rotation", ROTATION)):
            if name in dict(variables.layout.costs):
                width = dict(variables.layout.costs)[name].width
                solver.set_cost(name, quadratic=2 * weight * np.eye(width))

    def update(self, iterate: Iterate, shape: Shape) -> None:
        """Linearises around an iterate; z is the deviation from it."""
        tr = self.transcription
        rows, equations = Rows(self.variables.size), Rows(self.variables.size)
        self._add_ends(equations, iterate)
        if tr.problem.bandwidth_is_fixed:
            alpha = self.variables.alpha_columns.reshape(-1, 1)
            equations.equate(np.ones(alpha.shape), alpha, 0.0)
        else:
            self._add_bandwidth(rows, iterate)
        sensitivity = transitions(
            tr, iterate, secant=shape.secant, kinked=self.variables.kinked
        )
        before = rows.count
        self._planes = iterate.planes.nearer_than(tr.obstacle_reach)
        self._add_hard(rows, iterate, sensitivity, shape.secant)
        self._hard = slice(before, rows.count)
        self._add_tube(rows, equations, sensitivity[:, -1])
        slack = np.ones((1, 1)), np.array([[self.variables.size - 1]])
        self._rigid = shape.rigid
        if shape.rigid:
            equations.equate(*slack, 0.0)
        else:
            rows.add(*slack, 0.0)
        same, self._rows = equations.assemble(), rows.assemble()
        # Drake ends the process at a number that is none.
        self._finite = same.finite and self._rows.finite
        if not self._finite:
            return
        self._solver.set_rows(same, self._rows)
        self._update_cost(iterate, shape)

    def _add_ends(self, equations: Rows, iterate: Iterate) -> None:
        """Both end states."""
        tr, v, p = self.transcription, self.variables, self.transcription.problem
        n, m, local = tr.order, tr.outputs, iterate.local
        layer = slice((n + 1) * m, (n + 2) * m)
        wanted = [(0, slice(0, n * m), (p.start - local.state[0]).ravel())]
        for k in tr.goal_rows:
            missing = p.goal[k] - local.state[-1, k]
            wanted.append((-1, slice(k * m, (k + 1) * m), missing))
        if p.start_highest is not None:
            highest = slice(n * m, (n + 1) * m)
            wanted.append((0, highest, p.start_highest - local.highest[0]))
        if p.start_bandwidth is not None:
            wanted.append((0, slice(layer.stop, layer.stop + m), np.zeros(m)))
        for knot, part, value in wanted:
            matrix = v.local_matrix[part]
            columns = np.broadcast_to(v.knot_columns[knot], matrix.shape)
            equations.equate(matrix, columns, value)

    def _add_tube(self, rows: Rows, equations: Rows, sensitivity: Array) -> None:
        """The tube follows the decisions, as far as the rows so far look at it.

        Far from all limits it may be what it likes: states that no row needs, now or
        later, have no equation.
        """
        tr, v = self.transcription, self.variables
        m, N = tr.outputs, tr.intervals
        S, reads = v.num_states * m, rows.reads()
        links = (np.abs(sensitivity[:, :, :S]) > ZERO).any(axis=0)
        states = reads[v.blocks["states"]].reshape(N + 1, S)
        needed = _needed(states, np.asarray(links))
        first = v.state_columns[0, :S][needed[0], None]
        equations.equate(np.ones(first.shape), first, 0.0)
        piece, state = np.nonzero(needed[1:])
        after = v.state_columns[piece, S + state, None]
        columns = np.concatenate([after, v.piece_columns[piece]], axis=1)
        by = sensitivity[piece, state]
        values = np.concatenate([np.ones(after.shape), -by], axis=1)
        equations.equate(values, columns, 0.0)
        used = reads | equations.reads()
        self._add_moves(rows, used[v.move_columns])

    def _add_moves(self, rows: Rows, used: Array) -> None:
        """|dx| <= e for the kinked coordinates of x*, where a row reads e."""
        v = self.variables
        for j, coordinate in enumerate(v.kinked):
            knots = np.flatnonzero(used[:, j])
            columns = np.concatenate(
                [v.knot_columns[knots], v.move_columns[knots, j, None]], axis=1
            )
            row = np.append(v.local_matrix[coordinate], 0.0)
            for sign in (-1.0, 1.0):
                values = np.broadcast_to(sign * row, columns.shape).copy()
                values[:, -1] = 1.0
                rows.add(values, columns, 0.0)

    def _add_bandwidth(self, rows: Rows, iterate: Iterate) -> None:
        """Bounds of α and of its rate."""
        tr, v, alpha = self.transcription, self.variables, iterate.bandwidth
        columns = v.alpha_columns.reshape(-1, 1)
        ones = np.ones(columns.shape)
        low, high = tr.bandwidth_low - alpha, tr.bandwidth_high - alpha
        # Where α, or its rate, is far from its limit the projection will do.
        span = tr.bandwidth_high - tr.bandwidth_low
        high = np.where(high > span / 2, np.inf, high).ravel()
        low = np.where(low < -BANDWIDTH_REACH * tr.reach * span, -np.inf, low).ravel()
        near = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
        rows.add(ones[near], columns[near], low[near], high[near])
        change, limit = np.diff(alpha, axis=0).ravel(), tr.bandwidth_change
        fast = np.flatnonzero(np.abs(change) > RATE_REACH * limit)
        pairs = columns[fast] + [0, tr.outputs]
        values = np.broadcast_to([-1.0, 1.0], pairs.shape)
        rows.add(values, pairs, -limit - change[fast], limit - change[fast])

    def _add_hard(
        self, rows: Rows, iterate: Iterate, sensitivity: Array, secant: float
    ) -> None:
        """Input, speed and obstacles, each relaxed by the shared slack."""
        tr, v = self.transcription, self.variables
        self._input_nodes = self._nodes_near_the_input_limit(iterate)
        self._cuts = self._apex_cuts(iterate)
        self._speeds = np.nonzero(tr.near_the_speed_limit(iterate))
        rate, trusted = self._by_knot(iterate, secant)
        asked = [INPUT_BACKOFF, BACKOFF, BACKOFF, BACKOFF]
        blocks = [
            self._input_rows(iterate, self._input_nodes, sensitivity, secant),
            trusted,
            self._speed_rows(self._speeds, rate),
            self._halfplane_rows(iterate, self._planes),
        ]
        here = self._hard_margin = self._hard_margins(iterate, self._planes.margin)
        for beyond, (values, columns) in zip(asked, blocks, strict=True):
            slack = np.full((len(values), 1), v.size - 1)
            rows.add(
                np.concatenate([values, np.ones(slack.shape)], axis=1),
                np.concatenate([columns, slack], axis=1),
                beyond - here[: len(values)],
            )
            here = here[len(values) :]

    def _hard_margins(self, at: Iterate, of_planes: Array) -> Array:
        """Margins of the relaxed rows at an iterate, but those of half-planes given."""
        return np.concatenate(
            [
                at.input_margin[self._input_nodes] / INPUT_SCALE,
                self._cut_margins(at) / INPUT_SCALE,
                at.error_margin[:: self.transcription.tube_steps].ravel(),
                at.speed_margin[self._speeds],
                of_planes.ravel(),
            ]
        )

    def _nodes_near_the_input_limit(self, iterate: Iterate) -> Array:
        """Knots, some fixed nodes between them, and where the input peaks."""
        tr = self.transcription
        limit = tr.reach * tr.problem.input_limit
        inner = tr.pieces(iterate.input_margin)[:, 1:-1]
        chosen = np.zeros(inner.shape, dtype=bool)
        chosen[:, tr.tube_steps // BETWEEN - 1 :: tr.tube_steps // BETWEEN] = True
        chosen[np.arange(len(inner)), inner.argmin(axis=1)] = True
        piece, node = np.nonzero(chosen & (inner < BETWEEN_REACH * limit))
        at_knots = iterate.input_margin[:: tr.tube_steps]
        knots = np.flatnonzero(at_knots < INPUT_REACH * limit)
        both = [knots * tr.tube_steps, piece * tr.tube_steps + node + 1]
        return np.concatenate(both)

    def _apex_cuts(self, iterate: Iterate) -> tuple[Array, Array]:
        """Where the input's norm is near its apex, and along what it is cut there.

        A norm is the largest of u'v over all unit vectors u.  Its slope at v is one of
        them; near zero v turns within a step, and more are needed.

        Returns:
            Places in the input's nodes, and unit vectors, ``(c, m)``.
        """
        tr, m = self.transcription, self.transcription.outputs
        nominal = self._nominal_input(iterate)
        small = np.linalg.norm(nominal, axis=1) < APEX * tr.problem.input_limit
        # Between knots y*^(n) is linear, and its norm never the largest.
        small = np.flatnonzero(small & (self._input_nodes % tr.tube_steps == 0))
        directions = np.concatenate([np.eye(m), -np.eye(m)])
        return small.repeat(2 * m), np.tile(directions, (len(small), 1))

    def _nominal_input(self, iterate: Iterate) -> Array:
        """B⁻¹ y*^(n) at the input's nodes, ``(p, m)``."""
        tr = self.transcription
        at = iterate.reference[2 * self._input_nodes]
        return tr.problem.model.input_for(at[:, : tr.order], at[:, tr.order])

    def _cut_margins(self, iterate: Iterate) -> Array:
        """Margins of the input's limit with u'v for the norm of v, ``(c,)``."""
        cut, direction = self._cuts
        nominal = self._nominal_input(iterate)[cut]
        margin = iterate.input_margin[self._input_nodes][cut]
        return np.asarray(
            margin + euclidean_norm(nominal) - (direction * nominal).sum(axis=1)
        )

    def _input_rows(
        self, iterate: Iterate, nodes: Array, sensitivity: Array, secant: float
    ) -> tuple[Array, Array]:
        """Values and columns of the input's limit at some nodes of the fine grid.

        The reference there is linear in its coefficients, and the tube's states answer
        as `transitions` says, between whose times they are interpolated.
        """
        tr, v = self.transcription, self.variables
        n, m = tr.order, tr.outputs
        if not len(nodes):
            return NO_ROWS
        local = tr.local_at(iterate, nodes)

        def used_input(x: Array) -> Array:
            return tr.used_input(Local.unpack(x, n, m))[..., None]

        slopes = limit_slopes(tr.problem, local, secant)
        cut, direction = self._cuts
        each = np.concatenate([np.arange(len(nodes)), cut])
        along = np.concatenate([slopes.steepest, direction])
        slope = Local.unpack(slopes.rows(each).along(along), n, m)
        nodes = nodes[each]
        rows = np.concatenate([slope.state, slope.highest[:, None]], axis=1)
        coefficients = np.einsum("pkc,pkm->pcm", tr.basis_at(nodes), rows)
        states = np.einsum("pkm,kms->ps", slope.error_bound, np.stack(v.bounds))
        states[:, (n - 1) * m : n * m] += slope.layer
        piece, later = tr.within(nodes)
        sub = np.minimum((later * tr.substeps).astype(int), tr.substeps - 1)
        part = (later * tr.substeps - sub)[:, None, None]
        answer = (1 - part) * sensitivity[piece, sub]
        answer = answer + part * sensitivity[piece, sub + 1]
        values = (states[:, None] @ answer)[:, 0]
        of_alpha, of_spline, of_moves = v.piece_parts
        values[:, of_alpha] += _at_ends(slope.bandwidth, later)
        values[:, of_spline] += coefficients.reshape(len(piece), -1)
        if len(v.kinked):
            bend = bends(used_input, local.pack(), secant, v.kinked)[:, 0]
            values[:, of_moves] += _at_ends(kinks(bend, secant)[each], later)
        return -values / INPUT_SCALE, v.piece_columns[piece]

    def _by_knot(
        self, iterate: Iterate, secant: float
    ) -> tuple[Array, tuple[Array, Array]]:
        """What every knot reads: of the velocity error's bound, and of Δ's margin.

        Returns:
            The bound by the entries of z that a knot and its moves read, broadcast to
            ``(K, m, C + q)``; values and columns of the margins' rows.
        """
        tr, v = self.transcription, self.variables
        n, m, K = tr.order, tr.outputs, tr.intervals + 1
        reads = np.concatenate([v.knot_columns, v.move_columns], axis=1)
        if n > 1:
            states = slice(v.local_matrix.shape[1] - v.num_states * m, None)
            rate = np.zeros((m, reads.shape[1]))
            rate[:, : v.local_matrix.shape[1]][:, states] = v.rate_matrix
            rate = np.broadcast_to(rate, (K, *rate.shape))
            if not iterate.error_margin.size:
                return rate, NO_ROWS

        def limited(x: Array) -> Array:
            local = Local.unpack(x, n, m)
            margin = tr.error_margin(local.state, local.error_bound)
            return np.concatenate([tr.used_rate(local), -margin], axis=-1)

        slopes = limit_slopes(tr.problem, iterate.local, secant)
        bend = np.zeros((K, m + iterate.error_margin.shape[1], len(v.kinked)))
        if len(v.kinked):
            flat = iterate.local.pack()
            bend = kinks(bends(limited, flat, secant, v.kinked), secant)
        if n == 1:
            by_rate = slopes.used_rate @ v.local_matrix
            rate = np.concatenate([by_rate, bend[:, :m]], axis=2)
        trusted = np.concatenate(
            [slopes.error_margin @ v.local_matrix, -bend[:, m:]], axis=2
        )
        count = trusted.shape[1]
        return rate, (
            trusted.reshape(K * count, reads.shape[1]),
            reads.repeat(count, axis=0),
        )

    def _speed_rows(
        self, speeds: tuple[Array, ...], rate: Array
    ) -> tuple[Array, Array]:
        """Values and columns of the speed's limit.

        Args:
            speeds: piece, control point, axis and sign of each row.
            rate: the velocity error's bound, see `_by_knot`.
        """
        tr, v = self.transcription, self.variables
        piece, control, axis, sign = speeds
        reads = np.concatenate([v.knot_columns, v.move_columns], axis=1)
        speed = tr.speed_basis[control] * np.where(sign, 1.0, -1.0)[:, None]
        own = piece[:, None] + np.arange(speed.shape[1])
        weight = (control / tr.order)[:, None]
        before, after = rate[piece, axis], rate[piece + 1, axis]
        values = [speed, (weight - 1) * before, -weight * after]
        columns = [own * tr.outputs + axis[:, None], reads[piece], reads[piece + 1]]
        return np.concatenate(values, axis=1), np.concatenate(columns, axis=1)

    def _halfplane_rows(
        self, iterate: Iterate, planes: Halfplanes
    ) -> tuple[Array, Array]:
        """Values and columns of every half-plane at every control point."""
        tr, v = self.transcription, self.variables
        controls, count = tr.position_basis.shape
        P, m = len(planes), tr.outputs
        position = np.einsum("cq,pj->pcqj", tr.position_basis, planes.by_position())
        tube = np.einsum("pcj,cjs->pcs", planes.by_tube, v.tube_matrix)
        # As many normals as have room may turn.
        turn = np.zeros((P, controls, v.tangents))
        rotation = np.zeros((P, v.tangents), dtype=int) + v.blocks["rotation"].start
        free = min(P, v.num_planes) if v.tangents else 0
        if free:
            turn[:free] = planes.by_turning(iterate.tube_controls, free)
            rotation[:free] += np.arange(free * v.tangents).reshape(free, -1)
        values = np.concatenate(
            [position.reshape(P, controls, count * m), -tube, turn], axis=2
        )
        columns = np.concatenate(
            [
                v.coefficient_columns(planes.piece, count),
                v.state_columns[planes.piece],
                rotation,
            ],
            axis=1,
        )
        return (
            values.reshape(P * controls, values.shape[2]),
            columns.repeat(controls, axis=0),
        )

    def _update_cost(self, iterate: Iterate, shape: Shape) -> None:
        """Gauss-Newton model of the cost, exact where it is quadratic.

        And the curvature of the norms in the rows, where Δ varies: elsewhere the
        tube has nothing to trade, and as many programs are needed without it.
        """
        tr, v, p = self.transcription, self.variables, self.transcription.problem
        m, N, width = tr.outputs, tr.intervals, tr.degree * tr.outputs
        scale = np.sqrt(p.input_weight * tr.weights)[:, None]
        self._residual = scale * tr.feedforward(iterate.local)
        by_local = feedforward_slopes(p.model, iterate.local, shape.secant)
        self._slopes = scale[..., None] * (by_local @ v.local_matrix[:, :width])
        square = 2 * (self._slopes.swapaxes(1, 2) @ self._slopes)
        gradient = 2 * (self._residual[:, None] @ self._slopes)[:, 0]
        # Knots read what acts on the piece after them, and the last one before it.
        window = (tr.degree + 1) * m
        quadratic, linear = np.zeros((N, window, window)), np.zeros((N, window))
        quadratic[:, :width, :width], linear[:, :width] = square[:-1], gradient[:-1]
        quadratic[-1, m:, m:] += square[-1]
        linear[-1, m:] += gradient[-1]
        if p.model.error_bound_varies:
            prices = self.multipliers
            quadratic += input_curvature(tr, iterate, prices)
            bow = tube_curvature(tr, iterate, self._planes, v, prices)
            self._solver.set_cost("states", quadratic=bow)
            if v.tangents:
                turn = rotation_curvature(self._planes, prices)[: v.num_planes]
                weight = np.full(v.num_planes, 2 * ROTATION)
                np.maximum(weight[: len(turn)], turn, out=weight[: len(turn)])
                self._solver.set_cost(
                    "rotation", quadratic=weight[:, None, None] * np.eye(v.tangents)
                )
        self._solver.set_cost(
            "coefficients",
            quadratic=quadratic,
            linear=linear,
            diagonal=2 * (shape.proximity + 1e-9),
        )
        self._weight = p.bandwidth_weight * tr.weights[:, None]
        self._excess = iterate.bandwidth - p.bandwidth_floor
        self._solver.set_cost(
            "bandwidth",
            quadratic=2 * self._weight[..., None] * np.eye(m),
            linear=2 * self._weight * self._excess,
            diagonal=2 * shape.proximity,
        )
        self._solver.set_slack_cost(shape.penalty)

    def solve(self, deadline: Deadline = NEVER) -> tuple[Array | None, str]:
        """The step z, or None, and the solver's status."""
        if not self._finite:
            return None, "numbers that are too large"
        tr = self.transcription
        solution = self._solver.solve(
            accuracy=self._accuracy, deadline=deadline, doubtful=self._rigid
        )
        if solution.z is not None and tr.problem.model.error_bound_varies:
            self._note(solution.multipliers[self._hard])
        return solution.z, solution.status

    def _note(self, prices: Array) -> None:
        """Keeps the multipliers of the rows whose norms bend."""
        found = Multipliers.none(self.transcription)
        count = len(self._input_nodes)
        found.input[self._input_nodes] = prices[:count] / INPUT_SCALE
        planes = self._planes
        of_planes = prices[len(prices) - planes.margin.size :]
        found.planes[planes.piece, planes.obstacle] = of_planes.reshape(
            planes.margin.shape
        )
        self.multipliers = found

    @property
    def margins_now(self) -> Array:
        """Of the relaxed rows, at the iterate that was linearised around."""
        return self._hard_margin

    def margins_after(self, z: Array, reached: Iterate) -> tuple[Array, Array]:
        """Margins of the relaxed rows as promised for a step, and as reached."""
        promised = self._hard_margin + (self._rows.matrix @ z)[self._hard] - z[-1]
        turned = self.turned(z).at(reached.controls, reached.tube_controls)
        return promised, self._hard_margins(reached, turned.margin)

    def correct(self, z: Array, reached: Iterate) -> None:
        """Shifts the relaxed rows to what a step really led to (second order)."""
        promised, actual = self.margins_after(z, reached)
        low = self._rows.low.copy()
        low[self._hard] -= actual - promised
        self._solver.set_lower_bounds(low)

    def turned(self, z: Array) -> Halfplanes:
        """The half-planes as a step turns them."""
        v, planes = self.variables, self._planes
        free = min(len(planes), v.num_planes) if v.tangents else 0
        turn = z[v.blocks["rotation"]].reshape(-1, max(v.tangents, 1))[:free]
        return planes.turned(turn) if free else planes

    def decided(self, z: Array) -> Array:
        """The decisions' part of a step."""
        blocks = self.variables.blocks
        return z[blocks["coefficients"].start : blocks["bandwidth"].stop]

    def model_cost(self, z: Array) -> float:
        """The program's idea of the cost after a step."""
        blocks = self.variables.blocks
        moves = z[self.variables.knot_columns[:, : self._slopes.shape[2]]]
        u = self._residual + (self._slopes @ moves[..., None])[..., 0]
        bandwidth = z[blocks["bandwidth"]].reshape(self._excess.shape)
        excess = self._excess + bandwidth
        return float((u**2).sum() + (self._weight * excess**2).sum())

    def decisions(self, iterate: Iterate, z: Array) -> tuple[Array, Array]:
        """Coefficients and bandwidth after a whole step."""
        tr, v = self.transcription, self.variables
        coefficients = iterate.coefficients + z[v.blocks["coefficients"]].reshape(
            -1, tr.outputs
        )
        # The solver is a little off, but plans must join exactly.
        coefficients = tr.with_ends(coefficients)
        if tr.problem.bandwidth_is_fixed:
            return coefficients, iterate.bandwidth
        local = Local.unpack(iterate.local.pack() + v.local(z), tr.order, tr.outputs)
        # The bandwidth that makes the program's layer, so that its constraints
        # hold, rather than the program's own, whose layer is only first order.
        before = iterate.local
        gain = before.bandwidth * before.layer
        gain = gain + before.bandwidth * (local.layer - before.layer)
        gain = gain + before.layer * (local.bandwidth - before.bandwidth)
        layer = np.maximum(local.layer, 1e-3)
        return coefficients, tr.feasible_bandwidth(gain / layer)


def _at_ends(values: Array, later: Array) -> Array:
    """Slopes by what is linear along a piece, as slopes by its ends, ``(p, 2 q)``."""
    later = later[:, None]
    return np.concatenate([(1 - later) * values, later * values], axis=1)


def _needed(read: Array, links: Array) -> Array:
    """Which states some row needs, at their knot or at a later one.

    Args:
        read: what rows look at, ``(K, S)``.
        links: which states follow from which, ``(S, S)``.
    """
    later = np.logical_or.accumulate(read[::-1])[::-1]
    for _ in range(len(links)):
        later = later | (later @ links)
    return np.asarray(later)


def kinked_coordinates(transcription: Transcription) -> Array:
    """Coordinates of x*, flattened, in which the model error may have kinks.

    Those that Δ depends on, seen by a step from rest.
    """
    model = transcription.problem.model
    if not model.error_bound_varies:
        return np.zeros(0, dtype=int)
    size = transcription.order * transcription.outputs
    states = np.concatenate([np.zeros((1, size)), np.eye(size)])
    shape = (1 + size, transcription.order, transcription.outputs)
    values = model.model_error_bound(states.reshape(shape))
    return np.flatnonzero((np.abs(values[1:] - values[0]) > 1e-9).any(axis=1))
