"""Sequential convex programming on Clarabel (the paper's section VII).

Each iteration linearises everything around an exactly propagated iterate,
solves one convex quadratic program with an exact penalty on a shared slack, and
walks along the step as far as the merit function (exact cost plus exact
penalty on the worst true violation) keeps its promise.  Bandwidth bounds and
rate limit are convex in the decisions, so every iterate obeys them.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions

from dtmpc_drake.models import Array, jacobian
from dtmpc_drake.planning.sensitivity import transitions
from dtmpc_drake.planning.splines import Sparse
from dtmpc_drake.planning.transcription import (
    Halfplanes,
    Iterate,
    Local,
    Transcription,
)
from dtmpc_drake.planning.variables import Variables

PENALTY = 1e3
"""First weight of the slack; raised while a converged plan still needs slack."""
MAX_PENALTY = 1e6
BACKOFF = 3e-4
"""How much the programs ask for beyond every limit, in m, m/s and m/s², so that
an iterate that is feasible to this tolerance keeps the limit itself."""
ROTATION = 1.0
"""Weight of a half-plane's rotation, in place of its second-order loss."""
SECANT = 0.1
"""Half-width of the differences along the state, in its units.  Model errors
often have a kink at rest; a derivative would not see it, a secant does."""
SHORTEST = 0.02
"""Steps are not walked by less than this fraction."""
RATE_REACH = 0.5
"""Bandwidth rates below this part of their limit are left to the projection."""
REACH = 1.0
"""Constraints with more margin than this are left out of a program."""


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One row of the history.

    Attributes:
        intervals: of the grid that was used.
        cost: of the iterate that the step led to.
        violation: worst true constraint violation there, in m, m/s or m/s².
        slack: that the convex program needed.
        defect: largest difference between the program's tube and the exact
            tube at the new iterate, in m.
        step: largest change of the reference, in m.
        fraction: of the program's step that was walked.
        proximity: weight of the proximal term (the soft trust region).
        predicted: decrease of the merit function that the program promised.
        update_time, solve_time, evaluate_time: in s.
        status: of the convex solver.
    """

    intervals: int
    cost: float
    violation: float
    slack: float
    defect: float
    step: float
    fraction: float
    proximity: float
    predicted: float
    update_time: float
    solve_time: float
    evaluate_time: float
    status: str


class Program:
    """The convex program, built once; every iteration updates coefficients."""

    def __init__(self, transcription: Transcription) -> None:
        self.transcription = transcription
        self.variables = Variables.of(transcription)
        v = self.variables
        self._constant_rows = self._make_constant_rows()
        self.program = MathematicalProgram()
        z = self.program.NewContinuousVariables(v.size, "z")
        one_row = sp.csc_array(([1.0], ([0], [v.size - 1])), shape=(1, v.size))
        self._rows = self.program.AddLinearConstraint(
            sp.csc_matrix(one_row), np.zeros(1), np.full(1, np.inf), z
        )
        # The cost is quadratic in coefficients and bandwidth, linear elsewhere.
        self._costs = {}
        for name in ("coefficients", "bandwidth", "rotation"):
            block = z[v.blocks[name]]
            if not len(block):
                continue
            self._costs[name] = self.program.AddQuadraticCost(
                np.eye(len(block)), np.zeros(len(block)), block, is_convex=True
            )
        if "rotation" in self._costs:
            count = v.num_planes * v.tangents
            self._costs["rotation"].evaluator().UpdateCoefficients(
                2 * ROTATION * np.eye(count), np.zeros(count), 0.0, is_convex=True
            )
        self._slack_cost = self.program.AddLinearCost(np.ones(1), z[-1:])
        self._z = z
        self._options = SolverOptions()
        for name, value in {
            "iterative_refinement_enable": 0,
            "tol_gap_abs": 1e-4,
            "tol_gap_rel": 1e-4,
            "tol_feas": 1e-5,
        }.items():
            self._options.SetOption(ClarabelSolver.id(), name, value)
        self._solver = ClarabelSolver()

    def _make_constant_rows(self) -> Sparse:
        """Rows of the equalities that never change: both ends."""
        v, tr = self.variables, self.transcription
        m = tr.outputs
        first, last = slice(0, m), slice(tr.intervals * m, None)
        rows = [op[first] for op in v.derivatives[: tr.order]]
        rows += [op[last] for op in v.derivatives[: tr.order]]
        if tr.problem.start_highest is not None:
            rows.append(v.derivatives[tr.order][first])
        if tr.problem.start_bandwidth is not None:
            rows.append(v.bandwidth[first])
        rows += [op[first] for op in v.states]
        return sp.vstack(rows, format="csr")

    def _transition_rows(self, iterate: Iterate, secant: float) -> Sparse:
        """Rows that vanish where the tube follows the decisions."""
        tr, v = self.transcription, self.variables
        m, N = tr.outputs, tr.intervals
        S = v.num_states * m
        sensitivity = transitions(tr, iterate, secant=secant)
        start = np.arange(N)[:, None]
        columns = np.concatenate(
            [
                v.blocks["states"].start + start * S + np.arange(2 * S),
                v.blocks["bandwidth"].start + start * m + np.arange(2 * m),
                v.blocks["coefficients"].start
                + start * m
                + np.arange((tr.degree + 1) * m),
            ],
            axis=1,
        )
        values = np.concatenate(
            [
                -sensitivity[:, :, :S],
                np.broadcast_to(np.eye(S), (N, S, S)),
                -sensitivity[:, :, S:],
            ],
            axis=-1,
        )
        values = np.where(np.abs(values) < 1e-9, 0.0, values)
        rows = _csr(values.reshape(N * S, -1), columns.repeat(S, axis=0), v.size)
        rows.eliminate_zeros()
        return rows

    def _constant_right_side(self, iterate: Iterate) -> Array:
        p = self.transcription.problem
        ends = [p.start - iterate.local.state[0], p.goal - iterate.local.state[-1]]
        if p.start_highest is not None:
            ends.append(p.start_highest - iterate.local.highest[0])
        values = np.concatenate([e.ravel() for e in ends])
        right = np.zeros(self._constant_rows.shape[0])
        right[: len(values)] = values
        return right

    def update(
        self, iterate: Iterate, penalty: float, proximity: float, secant: float
    ) -> None:
        """Linearises around an iterate; z is the deviation from it."""
        tr, v, p = self.transcription, self.variables, self.transcription.problem
        n, m, K = tr.order, tr.outputs, tr.intervals + 1
        flat = iterate.local.pack()

        def outputs(x: Array) -> Array:
            local = Local.unpack(x, n, m)
            parts = [tr.feedforward(local), tr.used_input(local)[..., None]]
            if n == 1:
                parts.append(tr.used_rate(local))
            return np.concatenate(parts, axis=-1)

        step = np.full(flat.shape[1], 1e-6)
        step[: n * m] = secant
        derivative = jacobian(outputs, flat, step)

        def operator(first: int, count: int) -> Sparse:
            """The linearised outputs as an operator on z, knot-major."""
            block = derivative[:, first : first + count]
            indices = np.broadcast_to(
                np.arange(K * flat.shape[1]).reshape(K, 1, -1), block.shape
            )
            indptr = np.arange(K * count + 1) * flat.shape[1]
            local = sp.csr_array(
                (block.ravel(), indices.ravel(), indptr),
                shape=(K * count, K * flat.shape[1]),
            )
            return local @ v.local

        alpha = iterate.bandwidth
        rows, low, high = [self._constant_rows], [], []
        low.append(self._constant_right_side(iterate))
        high.append(low[0])

        def add(matrix: Sparse, lower: Array | float, upper: Array | float) -> None:
            rows.append(matrix)
            low.append(np.broadcast_to(lower, matrix.shape[0]))
            high.append(np.broadcast_to(upper, matrix.shape[0]))

        add(self._transition_rows(iterate, secant), 0.0, 0.0)
        if p.bandwidth_is_fixed:
            add(v.bandwidth, 0.0, 0.0)
        else:
            low_alpha, high_alpha = tr.bandwidth_low - alpha, tr.bandwidth_high - alpha
            add(v.bandwidth, low_alpha.ravel(), high_alpha.ravel())
            # Where the rate is far from its limit the projection will do.
            change, limit = np.diff(alpha, axis=0).ravel(), tr.bandwidth_change
            fast = np.flatnonzero(np.abs(change) > RATE_REACH * limit)
            rates = v.bandwidth[fast + m] - v.bandwidth[fast]
            add(rates, -limit - change[fast], limit - change[fast])
        self._add_hard_rows(iterate, operator, add)
        slack = sp.csr_array(([1.0], ([0], [v.size - 1])), shape=(1, v.size))
        add(slack, 0.0, np.inf)

        matrix = sp.vstack(rows, format="csc")
        self._low = np.concatenate(low)
        self._hard_rows = slice(-1 - self._hard.shape[0], -1)
        self._rows.evaluator().UpdateCoefficients(
            sp.csc_matrix(matrix), self._low, np.concatenate(high)
        )
        self._update_cost(iterate, operator(0, m), penalty, proximity)

    def _add_hard_rows(
        self,
        iterate: Iterate,
        operator: Callable[[int, int], Sparse],
        add: Callable[[Sparse, Array | float, Array | float], None],
    ) -> None:
        """Input, speed and obstacles, each relaxed by the shared slack."""
        tr, v = self.transcription, self.variables
        n, m, N = tr.order, tr.outputs, tr.intervals
        near = np.flatnonzero(iterate.input_margin < 2 * REACH)
        speeds = np.nonzero(iterate.speed_margin < REACH)
        planes = tr.halfplanes(iterate, REACH)

        def margins(at: Iterate) -> Array:
            """Of the same rows at another iterate."""
            same = tr.margins(at, planes.piece, planes.obstacle, planes.normal)
            return np.concatenate(
                [at.input_margin[near], at.speed_margin[speeds], same.margin.ravel()]
            )

        piece, control, axis, sign = speeds
        count = tr.speed_basis.shape[1]
        columns = (piece[:, None] + np.arange(count)) * m + axis[:, None]
        values = tr.speed_basis[control] * np.where(sign, 1.0, -1.0)[:, None]
        rate = operator(m + 1, m) if n == 1 else v.error_bound[1]
        weight = control / n
        chord = (
            sp.diags_array(1 - weight) @ rate[piece * m + axis]
            + sp.diags_array(weight) @ rate[(piece + 1) * m + axis]
        )
        hard = sp.vstack(
            [
                -operator(m, 1)[near],
                _csr(values, columns, v.size) - chord,
                self._halfplane_rows(planes, m, N),
            ],
            format="csr",
        )
        self._hard, self._hard_margins = hard, margins
        self._hard_margin = margins(iterate)
        slack = _csr(
            np.ones((hard.shape[0], 1)),
            np.full((hard.shape[0], 1), v.size - 1),
            v.size,
        )
        add(hard + slack, BACKOFF - self._hard_margin, np.inf)

    def _halfplane_rows(self, planes: Halfplanes, m: int, N: int) -> Sparse:
        tr, v = self.transcription, self.variables
        controls, count = tr.position_basis.shape
        # In the space of y the normal is H' ν.
        H = tr.problem.obstacles.shape[planes.obstacle]
        normal = np.einsum("pij,pi->pj", H, planes.normal)
        values = (
            tr.position_basis[None, :, :, None] * normal[:, None, None, :]
        ).reshape(len(normal) * controls, count * m)
        columns = (
            (planes.piece[:, None] + np.arange(count))[:, :, None] * m + np.arange(m)
        ).reshape(len(normal), count * m)
        position = _csr(values, columns.repeat(controls, axis=0), v.size)
        # The tube at the same control points.
        points = (planes.piece[:, None] * controls + np.arange(controls)).ravel()
        gradient = planes.tube_gradient.reshape(len(points), m)
        select = _csr(
            gradient,
            points[:, None] * m + np.arange(m),
            N * controls * m,
        )
        rows = position - select @ v.tube_controls
        if not v.tangents:
            return rows
        # Turning the normal along its tangents, for as many planes as have room.
        free = min(len(normal), v.num_planes)
        tangents = tangent_space(planes.normal[:free])
        turn = np.einsum("pci,pti->pct", planes.hull[:free], tangents)
        columns = v.blocks["rotation"].start + np.arange(free * v.tangents).reshape(
            free, 1, v.tangents
        )
        columns = np.broadcast_to(columns, turn.shape)
        indices = np.arange(free * controls).repeat(v.tangents)
        rotation = sp.coo_array(
            (turn.ravel(), (indices, columns.ravel())), shape=rows.shape
        )
        return rows + rotation.tocsr()

    def _update_cost(
        self,
        iterate: Iterate,
        feedforward: Sparse,
        penalty: float,
        proximity: float,
    ) -> None:
        """Gauss-Newton model of the cost, exact where it is quadratic."""
        tr, v, p = self.transcription, self.variables, self.transcription.problem
        weights = np.repeat(tr.weights, tr.outputs)
        u = tr.feedforward(iterate.local).ravel()
        excess = (iterate.bandwidth - p.bandwidth_floor).ravel()
        scale_u = np.sqrt(p.input_weight * weights)
        scale_a = np.sqrt(p.bandwidth_weight * weights)
        coefficients = v.blocks["coefficients"]
        self._residual_rows = sp.diags_array(scale_u) @ feedforward[:, coefficients]
        self._residual = scale_u * u
        rows = self._residual_rows.toarray()
        quadratic = rows.T @ rows
        quadratic[np.diag_indices(len(quadratic))] += proximity + 1e-9
        self._costs["coefficients"].evaluator().UpdateCoefficients(
            2 * quadratic, 2 * (rows.T @ self._residual), 0.0, is_convex=True
        )
        self._weight = scale_a**2
        self._excess = excess
        self._costs["bandwidth"].evaluator().UpdateCoefficients(
            np.diag(2 * (self._weight + proximity)),
            2 * self._weight * excess,
            0.0,
            is_convex=True,
        )
        self._slack_cost.evaluator().UpdateCoefficients(np.full(1, penalty))

    def solve(self) -> tuple[Array | None, str]:
        """The step z, or None, and the solver's status."""
        status = ""
        # Fast options first; Clarabel's own where they are not good enough.
        for options in (self._options, None):
            result = self._solver.Solve(self.program, None, options)
            status = str(result.get_solver_details().status)
            # A step of almost solved programs is still checked by the merit.
            if status in ("Solved", "AlmostSolved"):
                return np.asarray(result.get_x_val()), status
        return None, status

    def correct(self, z: Array, reached: Iterate) -> None:
        """Shifts the hard rows to what a step really led to (second order)."""
        error = self._hard_margins(reached) - self._hard_margin - self._hard @ z
        low = self._low.copy()
        low[self._hard_rows] -= error
        self._rows.evaluator().UpdateLowerBound(low)

    def model_cost(self, z: Array) -> float:
        """The program's idea of the cost after a step."""
        blocks = self.variables.blocks
        u = self._residual + self._residual_rows @ z[blocks["coefficients"]]
        excess = self._excess + z[blocks["bandwidth"]]
        return float(u @ u + self._weight @ excess**2)

    def decisions(self, iterate: Iterate, z: Array) -> tuple[Array, Array]:
        """Coefficients and bandwidth after a whole step."""
        tr, v = self.transcription, self.variables
        coefficients = iterate.coefficients + z[v.blocks["coefficients"]].reshape(
            -1, tr.outputs
        )
        if tr.problem.bandwidth_is_fixed:
            return coefficients, iterate.bandwidth
        flat = iterate.local.pack().ravel() + v.local @ z
        local = Local.unpack(flat.reshape(tr.intervals + 1, -1), tr.order, tr.outputs)
        # The bandwidth that makes the program's layer, so that its constraints
        # hold, rather than the program's own, whose layer is only first order.
        before = iterate.local
        gain = before.bandwidth * before.layer
        gain = gain + before.bandwidth * (local.layer - before.layer)
        gain = gain + before.layer * (local.bandwidth - before.bandwidth)
        layer = np.maximum(local.layer, 1e-3)
        return coefficients, tr.feasible_bandwidth(gain / layer)


def _csr(values: Array, columns: Array, width: int) -> Sparse:
    """Rows with equally many entries each."""
    count = values.shape[1]
    return sp.csr_array(
        (values.ravel(), columns.ravel(), np.arange(len(values) + 1) * count),
        shape=(len(values), width),
    )


def tangent_space(normal: Array) -> Array:
    """An orthonormal basis of what is square to each unit vector.

    Args:
        normal: ``(P, rows)``.

    Returns:
        ``(P, rows - 1, rows)``.
    """
    rows = normal.shape[1]
    if rows == 2:
        return np.stack([-normal[:, 1], normal[:, 0]], axis=1)[:, None]
    # A reflection that maps the first axis to the normal.
    sign = np.where(normal[:, 0] >= 0, 1.0, -1.0)
    mirror = normal.copy()
    mirror[:, 0] += sign
    outer = mirror[:, :, None] * mirror[:, None, :]
    size = (mirror**2).sum(1)[:, None, None]
    return np.asarray((np.eye(rows) - 2 * outer / size)[:, 1:])


def violation(transcription: Transcription, iterate: Iterate) -> float:
    """The worst violation of obstacles, speed and input, in their units.

    Measured from the backed-off limits: at most `BACKOFF` is feasible.
    """
    margins = [iterate.speed_margin.min(), iterate.input_margin.min()]
    planes = transcription.halfplanes(iterate, 0.5).margin
    if planes.size:
        margins.append(planes.min())
    return float(max(0.0, BACKOFF - min(margins)))


def _excess(violation: float) -> float:
    """The part of a violation that the merit function counts."""
    return max(violation - BACKOFF / 2, 0.0)


@dataclasses.dataclass
class Result:
    """What the iterations ended with.

    Attributes:
        iterate: the best found.
        converged: whether the merit function cannot fall by more than the
            tolerance any more.
        violation: of the iterate.
        failure: the solver's status, if it is what ended the iterations.
    """

    iterate: Iterate
    converged: bool
    violation: float
    failure: str | None = None


def _walk(
    program: Program,
    current: Iterate,
    z: Array,
    merit: float,
    predicted: float,
    penalty: float,
) -> tuple[Array, Iterate, float, float]:
    """Walks along a step as far as the merit function keeps its promise.

    Returns:
        The step, the iterate that it leads to, the violation there, and the
        fraction of the step; the fraction is zero where nothing was gained.
    """
    tr = program.transcription

    def tried(z: Array) -> tuple[Iterate, float]:
        iterate = tr.evaluate(*program.decisions(current, z))
        return iterate, violation(tr, iterate)

    def kept(iterate: Iterate, worst: float, fraction: float) -> bool:
        reached = iterate.cost + penalty * _excess(worst)
        return merit - reached >= 0.1 * fraction * predicted

    trial, worst = tried(z)
    if kept(trial, worst, 1.0):
        return z, trial, worst, 1.0
    program.correct(z, trial)
    corrected, _ = program.solve()
    if corrected is not None:
        trial, worst = tried(corrected)
        if kept(trial, worst, 1.0):
            return corrected, trial, worst, 1.0
    fraction = 0.5
    while fraction > SHORTEST:
        trial, worst = tried(fraction * z)
        if kept(trial, worst, fraction):
            return z, trial, worst, fraction
        fraction /= 2
    return z, current, violation(tr, current), 0.0


def iterate_to_convergence(
    transcription: Transcription,
    decisions: tuple[Array, Array],
    *,
    tolerance: float,
    max_iterations: int,
    report: Callable[[Iteration], None],
    penalty: float = PENALTY,
) -> Result:
    """Runs the sequential convex program from a start.

    Args:
        transcription: of the problem.
        decisions: coefficients and bandwidth to start from.
        tolerance: stop when a program promises less than this fraction of the
            cost.
        max_iterations: at most so many convex programs.
        report: is given every iteration.
        penalty: first weight of the slack.
    """
    tr = transcription
    clock = time.perf_counter
    program = Program(tr)
    current = tr.evaluate(*decisions)
    worst = violation(tr, current)
    costs: list[float] = []
    stuck = 0
    proximity, secant = 0.0, SECANT
    for _ in range(max_iterations):
        t0 = clock()
        program.update(current, penalty, proximity, secant)
        t1 = clock()
        z, status = program.solve()
        t2 = clock()
        if z is None:
            return Result(current, False, worst, status)
        slack = max(float(z[-1]), 0.0)
        merit = current.cost + penalty * _excess(worst)
        predicted = merit - (program.model_cost(z) + penalty * _excess(slack))
        step = _walk(program, current, z, merit, predicted, penalty)
        z, trial, trial_worst, fraction = step
        flat = current.local.pack().ravel() + fraction * (program.variables.local @ z)
        defect = np.abs(flat.reshape(tr.intervals + 1, -1) - trial.local.pack())
        bound = slice(-tr.order * tr.outputs, None)
        t3 = clock()
        report(
            Iteration(
                intervals=tr.intervals,
                cost=trial.cost,
                violation=trial_worst,
                slack=slack,
                defect=float(defect[:, bound].max()),
                step=float(np.abs(trial.coefficients - current.coefficients).max()),
                fraction=fraction,
                proximity=proximity,
                predicted=predicted,
                update_time=t1 - t0,
                solve_time=t2 - t1,
                evaluate_time=t3 - t2,
                status=status,
            )
        )
        moved = np.abs(trial.local.state - current.local.state)[:, 1:].max(initial=0.0)
        secant = float(np.clip(moved, SECANT / 20, SECANT))
        costs.append(current.cost)
        current, worst = trial, trial_worst
        stuck = 0 if fraction else stuck + 1
        little = tolerance * max(current.cost, 1e-3)
        slow = len(costs) > 2 and costs[-3] - current.cost <= little
        done = predicted <= little or stuck > 3
        if worst <= BACKOFF and (done or (slow and not stuck)):
            return Result(current, True, worst)
        if done:
            if penalty >= MAX_PENALTY:
                return Result(current, False, worst)
            penalty, stuck = 10 * penalty, 0
        if fraction < 0.3:
            proximity = max(4 * proximity, 0.1)
        elif fraction == 1.0:
            proximity = proximity / 4
    return Result(current, False, worst)
