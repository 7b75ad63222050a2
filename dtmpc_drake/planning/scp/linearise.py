"""From an iterate to the convex program around it.

Equations hold both ends and how the tube answers; the limits' rows are relaxed by one
shared slack.  Bandwidth bounds and rate limit are convex in the decisions, so every
iterate obeys them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.obstacles.separation import Halfplanes
from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.iterate import Decisions, Iterate, Local
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.scp.clarabel import Layout, QuadraticProgram, Window
from dtmpc_drake.planning.scp.curvature import (
    Multipliers,
    rotation_curvature,
    sampled_curvature,
    tube_curvature,
)
from dtmpc_drake.planning.scp.limit_rows import (
    Block,
    ConvexRows,
    PlaneRows,
    SampledRows,
)
from dtmpc_drake.planning.scp.rows import ZERO, Rows
from dtmpc_drake.planning.scp.sensitivity import transitions
from dtmpc_drake.planning.transcription import LAST, Transcription

NEXT_TO_NOTHING = 1e-4
"""Weight of moves, which are bounded from below only."""
RATE = "bandwidth_rate"
BLOCKS = {RATE: "bandwidth"}
"""Of the variables that a cost is of, where it is not called so itself."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """What the next convex program looks like.

    Attributes:
        penalty: weight of the slack.
        secant: half-width of the differences along the state, in its units.
        proximity: weight of the square of the step (a soft trust region).
        rigid: whether there is no slack.  Without it a program takes a third fewer
            iterations, but it may be infeasible.
    """

    penalty: float
    secant: float
    proximity: float = 0.0
    rigid: bool = False


class Program:
    """The convex program around one iterate after the other.

    Args:
        transcription: of the problem.
        variables: of the program.
        solver: of their layout.
        multipliers: to begin with.
        accuracy: of the solutions, see `QuadraticProgram.solve`.

    Attributes:
        multipliers: of the last solution.
    """

    def __init__(
        self,
        transcription: Transcription,
        variables: Variables,
        solver: QuadraticProgram,
        multipliers: Multipliers,
        *,
        accuracy: float,
    ) -> None:
        self.transcription, self.variables = transcription, variables
        self.multipliers = multipliers
        self._solver, self._accuracy = solver, accuracy
        rotation = transcription.options.rotation
        windows = dict(program_layout(transcription, variables).costs)
        for name, weight in (("moves", NEXT_TO_NOTHING), ("rotation", rotation)):
            if name in windows:
                width = windows[name].width
                solver.set_cost(name, quadratic=2 * weight * np.eye(width))

    def update(self, iterate: Iterate, shape: Shape) -> None:
        """Linearises around an iterate; z is the deviation from it."""
        tr = self.transcription
        rows, equations = Rows(self.variables.size), Rows(self.variables.size)
        self._add_ends(equations, iterate)
        if tr.problem.bandwidth.is_fixed:
            alpha = self.variables.alpha_columns.reshape(-1, 1)
            equations.equate(np.ones(alpha.shape), alpha, 0.0)
        else:
            self._add_bandwidth(rows, iterate)
        sensitivity = transitions(
            tr, iterate, secant=shape.secant, kinked=self.variables.kinked
        )
        before = rows.count
        self._planes = iterate.planes.nearer_than(tr.obstacle_reach)
        self._blocks = self._limit_blocks(iterate, sensitivity, shape.secant)
        for block in self._blocks:
            slack = np.full((len(block.values), 1), self.variables.size - 1)
            rows.add(
                np.concatenate([block.values, np.ones(slack.shape)], axis=1),
                np.concatenate([block.columns, slack], axis=1),
                block.backoff - block.margin,
            )
        self._hard_margin = np.concatenate([block.margin for block in self._blocks])
        self._hard = slice(before, rows.count)
        self._add_tube(rows, equations, sensitivity[:, -1])
        last = np.ones((1, 1)), np.array([[self.variables.size - 1]])
        self._rigid = shape.rigid
        if shape.rigid:
            equations.equate(*last, 0.0)
        else:
            rows.add(*last, 0.0)
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
        layer = (n + 1) * m + np.arange(m)
        exists = np.flatnonzero(tr.chains.exists)
        wanted = [(0, exists, (p.start - local.state[0]).ravel()[exists])]
        for k in p.goal_rows:
            missing = p.goal[k] - local.state[-1, k]
            some = np.flatnonzero(tr.chains.exists[k])
            wanted.append((-1, k * m + some, missing[some]))
        if p.start_highest is not None:
            highest = n * m + np.arange(m)
            wanted.append((0, highest, p.start_highest - local.highest[0]))
        if p.start_bandwidth is not None:
            wanted.append((0, layer + m, np.zeros(m)))
        for knot, part, value in wanted:
            matrix = v.local_matrix[part]
            columns = np.broadcast_to(v.knot_columns[knot], matrix.shape)
            equations.equate(matrix, columns, value)
        unused = tr.splines.unused(tr.intervals)[:, None]
        if len(unused):
            equations.equate(np.ones(unused.shape), unused, 0.0)

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
        knots, options = tr.bandwidth, tr.options
        low, high = knots.low - alpha, knots.high - alpha
        # Where α, or its rate, is far from its limit the projection will do.
        span = knots.high - knots.low
        far = options.bandwidth_reach * tr.reach * span
        high = np.where(high > span / 2, np.inf, high).ravel()
        low = np.where(low < -far, -np.inf, low).ravel()
        near = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
        rows.add(ones[near], columns[near], low[near], high[near])
        change, limit = np.diff(alpha, axis=0).ravel(), knots.change
        fast = np.flatnonzero(np.abs(change) > options.bandwidth_rate_reach * limit)
        pairs = columns[fast] + [0, tr.outputs]
        values = np.broadcast_to([-1.0, 1.0], pairs.shape)
        rows.add(values, pairs, -limit - change[fast], limit - change[fast])

    def _limit_blocks(
        self, iterate: Iterate, sensitivity: Array, secant: float
    ) -> list[Block]:
        """The rows of all limits."""
        tr, v, p = self.transcription, self.variables, self.transcription.problem
        self._sampled = [
            SampledRows(tr, v, number, iterate, sensitivity, secant)
            for number in range(len(p.sampled))
        ]
        convex = [
            ConvexRows(tr, v, number, iterate, near, secant)
            for number, near in enumerate(tr.near_convex(iterate))
        ]
        planes = PlaneRows(tr, v, iterate, self._planes)
        return [*self._sampled, *convex, planes]

    def _update_cost(self, iterate: Iterate, shape: Shape) -> None:
        """Gauss-Newton model of the cost, exact where it is quadratic.

        And the curvature of the norms in the rows, where Δ varies: elsewhere the
        tube has nothing to trade, and as many programs are needed without it.
        """
        tr, v, p = self.transcription, self.variables, self.transcription.problem
        m, N, width = tr.outputs, tr.intervals, tr.degree * tr.outputs
        scale = np.sqrt(tr.weights)[:, None]
        self._residual = scale * tr.residuals(iterate.local)
        by_knot = v.local_matrix[: (tr.order + 1) * m, :width]
        by_state = tr.residual_slopes(iterate.local, p.costs, shape.secant)
        self._slopes = scale[..., None] * (by_state @ by_knot)
        square = 2 * (self._slopes.swapaxes(1, 2) @ self._slopes)
        gradient = 2 * (self._residual[:, None] @ self._slopes)[:, 0]
        # Knots read what acts on the piece after them, and the last one before it.
        window = (tr.degree + 1) * m
        quadratic, linear = np.zeros((N, window, window)), np.zeros((N, window))
        quadratic[:, :width, :width], linear[:, :width] = square[:-1], gradient[:-1]
        quadratic[-1, m:, m:] += square[-1]
        linear[-1, m:] += gradient[-1]
        self._last: tuple[Array, Array] | None = None
        if p.terminal:
            last = iterate.local.at(LAST)
            (residual,) = tr.residuals(last, p.terminal)
            (slopes,) = tr.residual_slopes(last, p.terminal, shape.secant) @ by_knot
            quadratic[-1, m:, m:] += 2 * slopes.T @ slopes
            linear[-1, m:] += 2 * residual @ slopes
            self._last = residual, slopes
        if p.model.error_bound_varies:
            prices = self.multipliers
            quadratic += sampled_curvature(tr, iterate, prices)
            bow = tube_curvature(tr, iterate, self._planes, v, prices)
            self._solver.set_cost("states", quadratic=bow)
            if v.tangents:
                turn = rotation_curvature(self._planes, prices)[: v.num_planes]
                weight = np.full(v.num_planes, 2 * tr.options.rotation)
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
        self._bandwidth = iterate.bandwidth
        hessian = tr.weights[:, None, None] * p.bandwidth_cost.hessian(m)
        excess = iterate.bandwidth - p.bandwidth_cost.floor
        self._solver.set_cost(
            "bandwidth",
            quadratic=hessian,
            linear=(hessian @ excess[..., None])[..., 0],
            diagonal=2 * shape.proximity,
        )
        if p.bandwidth_cost.charges_rate:
            of_rate = p.bandwidth_cost.rate_hessian(m, tr.step)
            ends = np.concatenate([iterate.bandwidth[:-1], iterate.bandwidth[1:]], 1)
            self._solver.set_cost(RATE, quadratic=of_rate, linear=ends @ of_rate)
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
        tr, planes = self.transcription, self._planes
        shape = tr.intervals, len(tr.problem.obstacles), tr.control_degree + 1
        of_planes = np.zeros(shape)
        own = prices[len(prices) - planes.margin.size :].reshape(planes.margin.shape)
        of_planes[planes.piece, planes.obstacle] = own
        sampled = []
        for block in self._sampled:
            sampled.append(block.prices(prices[: len(block.values)]))
            prices = prices[len(block.values) :]
        self.multipliers = Multipliers(of_planes, tuple(sampled))

    @property
    def margins_now(self) -> Array:
        """Of the relaxed rows, at the iterate that was linearised around."""
        return self._hard_margin

    def margins_after(self, z: Array, reached: Iterate) -> tuple[Array, Array]:
        """Margins of the relaxed rows as promised for a step, and as reached."""
        promised = self._hard_margin + (self._rows.matrix @ z)[self._hard] - z[-1]
        planes = self.turned(z)
        actual = [block.margins(reached, planes) for block in self._blocks]
        return promised, np.concatenate(actual)

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
        tr, cost = self.transcription, self.transcription.problem.bandwidth_cost
        moves = z[self.variables.knot_columns[:, : self._slopes.shape[2]]]
        u = self._residual + (self._slopes @ moves[..., None])[..., 0]
        bandwidth = z[blocks["bandwidth"]].reshape(self._bandwidth.shape)
        running = cost.running(self._bandwidth + bandwidth, tr.step)
        total = (u**2).sum() + tr.weights @ running
        if self._last is not None:
            residual, slopes = self._last
            total += ((residual + slopes @ moves[-1]) ** 2).sum()
        return float(total)

    def decisions(self, iterate: Iterate, z: Array) -> Decisions:
        """Coefficients and bandwidth after a whole step."""
        tr, v = self.transcription, self.variables
        coefficients = iterate.coefficients + z[v.blocks["coefficients"]].reshape(
            -1, tr.outputs
        )
        # The solver is a little off, but plans must join exactly.
        coefficients = tr.ends.met_by(coefficients)
        if tr.problem.bandwidth.is_fixed:
            return coefficients, iterate.bandwidth
        local = Local.unpack(iterate.local.pack() + v.local(z), tr.order, tr.outputs)
        # The bandwidth that makes the program's layer, so that its constraints
        # hold, rather than the program's own, whose layer is only first order.
        before = iterate.local
        gain = before.bandwidth * before.layer
        gain = gain + before.bandwidth * (local.layer - before.layer)
        gain = gain + before.layer * (local.bandwidth - before.bandwidth)
        layer = np.maximum(local.layer, 1e-3)
        return coefficients, tr.bandwidth.feasible(gain / layer)


def program_layout(transcription: Transcription, variables: Variables) -> Layout:
    """The costs of a program: they couple no more than what acts on one piece."""
    tr, v = transcription, variables
    m, S, N = tr.outputs, v.num_states * tr.outputs, tr.intervals
    moves = len(v.kinked)
    # Width, stride and number of the windows.
    costs = {
        "coefficients": ((tr.degree + 1) * m, m, N),
        "bandwidth": (m, m, N + 1),
        "moves": (moves, moves, N + 1),
        "rotation": (v.tangents, v.tangents, v.num_planes),
    }
    if tr.problem.bandwidth_cost.charges_rate:
        costs[RATE] = (2 * m, m, N)
    if tr.problem.model.error_bound_varies:
        costs["states"] = (2 * S, S, N)
    windows = [
        (name, Window(v.blocks[BLOCKS.get(name, name)].start, *shape))
        for name, shape in costs.items()
        if all(shape)
    ]
    return Layout(v.size, tuple(windows))


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
