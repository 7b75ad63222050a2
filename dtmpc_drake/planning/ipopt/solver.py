"""The same problem on IPOPT, with its bilinear constraints as they are.

Decisions, cost and constraints are those of the transcription, in the layout of the
convex programs; the tube obeys its differential equations by Hermite-Simpson
collocation, and the separating half-planes turn.  Drake's IPOPT has no exact
Hessian, and SPRAL as its only linear solver: what counts is how many rows and
variables there are, and that a quasi-Newton method sees no kinks (`nlp_rows`).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from pydrake.solvers import IpoptSolver, MathematicalProgram, SolverOptions

from dtmpc_drake.costs import Cost
from dtmpc_drake.limits import ConvexLimit, LinearLimit, SampledLimit
from dtmpc_drake.logs import muted
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.backend import (
    Backend,
    Effort,
    Report,
    Solution,
    register_backend,
)
from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.ipopt.rows import (
    AtControlPoints,
    AtKnots,
    Collocation,
    NlpRows,
    NlpVariables,
    Separation,
    add_squares,
    bound_rows,
)
from dtmpc_drake.planning.iterate import Decisions, Iterate, Local
from dtmpc_drake.planning.transcription import Transcription, size_of
from dtmpc_drake.records.result import Iteration

ROUNDS = 4
"""Solves at most: each adds the rows that its result shows to be missed and shifts
the tube by the rest of the collocation's error."""
BLOCK = 14
"""So many knots or pieces are evaluated together.  Drake gives every block
derivatives by all that it reads, so that cost grows with the square of this."""
STATE_SCALE = 3.0
"""Of the tube's states, in which the Lagrangian is less curved than in y*^(n)."""
OPTIONS: dict[str, float | int | str] = {
    "tol": 1e-4,
    "constr_viol_tol": 1e-5,
    # Without a Hessian the last digits of the dual take a third of the iterations; a
    # cost that stays is enough, since feasibility is measured on the exact tube.
    "acceptable_tol": 0.5,
    "acceptable_obj_change_tol": 1e-4,
    "acceptable_constr_viol_tol": 1e-4,
    "acceptable_compl_inf_tol": 1e-3,
    "acceptable_iter": 4,
    "mu_strategy": "adaptive",
    "max_iter": 1000,
    # By default SPRAL matches and orders anew for every matrix, with more fill.
    "spral_scaling": "none",
    # Smaller supernodes than SPRAL's own 32 suit rows that read so little.
    "spral_nemin": 8,
}

_ALONE = threading.Lock()
"""Rows in Python let other threads run in the middle of a solve; neither IPOPT nor
SPRAL promises that two of them may be under way at once."""


class _Program:
    """One nonlinear program around an iterate.

    Args:
        transcription: of the problem.
        guess: to start from.
        correction: by which the exact tube is above the program's, as the guess has
            it, shaped as `Transcription.tube_states`.
    """

    def __init__(
        self, transcription: Transcription, guess: Iterate, correction: Array
    ) -> None:
        tr = transcription
        self.transcription, self._guess = tr, guess
        self.layout = layout = NlpVariables(tr, planes=len(guess.planes.piece))
        self.program = MathematicalProgram()
        self.x = self.program.NewContinuousVariables(layout.size, "x")
        self.scale = np.ones(layout.size)
        self.scale[layout.blocks["states"]] = STATE_SCALE
        self.scale[layout.blocks["bandwidth"]] = self._alike()
        self._exact = layout.pack(tr, guess)
        self._none, self._shift = np.zeros((2, layout.size))
        self._shift[layout.blocks["states"]] = correction.ravel()
        self.program.SetInitialGuess(self.x, self._exact / self.scale)
        self._add_bounds()
        self._add_ends()
        self._add_reference()
        self._add_bandwidth_rate()
        for pieces in _blocks(np.arange(tr.intervals)):
            self._bound(Collocation(tr, layout, pieces), self._none, 0.0, 0.0)
        self._add_sampled()
        self._add_convex()
        # In the order of the pieces, so that those of a block read the same.
        for which in _blocks(np.argsort(guess.planes.piece, kind="stable")):
            rows = Separation(tr, layout, guess, which)
            self._bound(rows, self._shift, tr.options.backoff, np.inf)
        self._add_cost()

    def _bound(
        self, rows: NlpRows, shift: Array, low: Array | float, high: Array | float
    ) -> None:
        bound_rows(
            self.program,
            rows,
            self.x,
            scale=self.scale,
            shift=shift,
            low=low,
            high=high,
        )

    def _add_limit(
        self, knots: Array, function: Callable[[Local], Array], margin: Array
    ) -> None:
        """A function may grow by its margin at the guess, both ``(knots, r)``."""
        for some in _blocks(knots):
            rows = AtKnots(self.transcription, self.layout, some, function)
            high = rows.values(self._exact) + margin[some].ravel()
            high = high - self.transcription.options.backoff
            self._bound(rows, self._shift, -np.inf, high)

    def _add_row(self, columns: Array, values: Array, low: float, high: float) -> None:
        """One linear row; of a matrix Drake does not tell IPOPT the sparsity."""
        used = values != 0
        columns = columns[used]
        row = values[used] * self.scale[columns]
        self.program.AddLinearConstraint(row, low, high, self.x[columns])

    def _add_box(self, columns: Array, low: Array, high: Array) -> None:
        scale = self.scale[columns]
        self.program.AddBoundingBoxConstraint(
            low / scale, high / scale, self.x[columns]
        )

    def _add_bounds(self) -> None:
        """Of the bandwidth; and what is given, which IPOPT leaves out."""
        tr, p, blocks = (
            self.transcription,
            self.transcription.problem,
            self.layout.blocks,
        )
        m = tr.outputs
        low, high = (
            np.tile(bound, (tr.intervals + 1, 1))
            for bound in (tr.bandwidth.low, tr.bandwidth.high)
        )
        if p.start_bandwidth is not None:
            low[0] = high[0] = p.start_bandwidth
        index = np.arange(self.layout.size)
        self._add_box(index[blocks["bandwidth"]], low.ravel(), high.ravel())
        first = index[blocks["states"]][: self.layout.num_states * m]
        unused = tr.splines.unused(tr.intervals)
        for columns in (first, index[blocks["slack"]], unused):
            self._add_box(columns, self._exact[columns], self._exact[columns])
        if p.start_highest is not None:
            columns = index[blocks["highest"]][:m]
            self._add_box(columns, p.start_highest, p.start_highest)

    def _add_ends(self) -> None:
        tr, p, layout = self.transcription, self.transcription.problem, self.layout
        m = tr.outputs
        ends = [(0, k, p.start[k]) for k in range(tr.order)]
        ends += [(-1, k, p.goal[k]) for k in p.goal_rows]
        for knot, k, wanted in ends:
            for i in np.flatnonzero(tr.chains.exists[k]):
                row = layout.local_matrix[k * m + i]
                self._add_row(layout.knot_columns[knot], row, wanted[i], wanted[i])

    def _add_reference(self) -> None:
        """y*^(n) at the knots is what the coefficients say."""
        m, matrix = self.transcription.outputs, self.layout.highest_matrix
        for columns in self.layout.knot_columns:
            read = columns[: matrix.shape[1]]
            for row, highest in zip(matrix, columns[-m:], strict=True):
                self._add_row(np.append(read, highest), np.append(row, -1.0), 0.0, 0.0)

    def _add_bandwidth_rate(self) -> None:
        tr = self.transcription
        if tr.problem.bandwidth.is_fixed:
            return
        block, limit = self.layout.blocks["bandwidth"], tr.bandwidth.change
        pair = np.array([-1.0, 1.0])
        for column in range(block.start, block.stop - tr.outputs):
            self._add_row(np.array([column, column + tr.outputs]), pair, -limit, limit)

    def _add_sampled(self) -> None:
        """Limits on functions of one instant, at the knots."""
        tr, law = self.transcription, self.transcription.problem.law
        knots = np.arange(tr.intervals + 1)
        for limit, margin in zip(tr.problem.sampled, self._guess.sampled, strict=True):
            least = margin[:: tr.tube_steps]
            if limit.between_knots:  # a knot answers for what is nearest to it
                pieces, half = tr.pieces(margin), tr.tube_steps // 2
                none = np.full_like(least[:1], np.inf)
                after = np.concatenate([pieces[:, : half + 1].min(axis=1), none])
                before = np.concatenate([none, pieces[:, half:].min(axis=1)])
                least = np.minimum(after, before)

            def used(local: Local, limit: SampledLimit = limit) -> Array:
                return -limit.margins(law, local.instant)

            self._add_limit(knots, used, least)

    def _add_convex(self) -> None:
        """Where they come near; later rounds see where else."""
        tr, law = self.transcription, self.transcription.problem.law
        near = tr.near_convex(self._guess)
        for number, limit in enumerate(tr.problem.convex):
            margin = self._guess.convex[number]
            if limit.derivative not in tr.chains.orders:
                self._add_convex_rows(number, near[number])
                continue

            def used(local: Local, limit: ConvexLimit = limit) -> Array:
                return -limit.margins(law, local.instant)

            # y_i*^(n_i) at the knots, and a bound that is no state.
            at_knots = _at_knots(margin)
            reach = tr.reach * tr.options.convex_reach * size_of(limit)
            close = np.flatnonzero((at_knots < reach).any(axis=1))
            self._add_limit(close, used, at_knots)

    def _add_convex_rows(self, number: int, near: Array) -> None:
        tr, layout = self.transcription, self.layout
        limit, basis = tr.problem.convex[number], tr.convex_bases[number]
        margin, count = self._guess.convex[number], basis.shape[1]
        if not isinstance(limit, LinearLimit):
            for some in _blocks(np.argwhere(near)):
                rows = AtControlPoints(tr, layout, self._guess, number, some)
                least = rows.values(self._exact) - margin[tuple(some.T)]
                low = least + tr.options.backoff
                self._bound(rows, self._shift, low, np.inf)
            return
        normals = limit.normals(tr.outputs)
        wide = np.abs(normals) @ layout.bounds[limit.derivative]
        first = np.arange(tr.intervals)
        reads = np.concatenate(
            [layout.coefficient_columns(first, count), layout.state_columns], axis=1
        )
        for piece, control, column in zip(*np.nonzero(near), strict=True):
            own = (basis[control] * normals[column]).ravel()
            rate, later = wide[column], control / (len(basis) - 1)
            row = np.concatenate([own, (1 - later) * rate, later * rate])
            columns = reads[piece]
            high = row @ (self._exact - self._shift)[columns]
            high += margin[piece, control, column] - tr.options.backoff
            self._add_row(columns, row, -np.inf, high)

    def _alike(self) -> float:
        """A unit of bandwidth, for the cost to weigh all decisions alike."""
        tr, p = self.transcription, self.transcription.problem
        slopes = tr.residual_slopes(self._guess.local, p.costs, tr.options.secant)
        by_highest = slopes[:, :, tr.order * tr.outputs :]
        of_highest = 2 * (by_highest**2).sum(axis=1).mean()
        of_rate = p.bandwidth_cost.rate_hessian(tr.outputs, tr.step) / tr.step
        of_bandwidth = np.diag(p.bandwidth_cost.hessian(tr.outputs)).mean()
        of_bandwidth += np.diag(of_rate).mean()
        if min(of_highest, of_bandwidth) > 0:
            return float(np.sqrt(of_highest / of_bandwidth))
        return 1.0

    def _add_cost(self) -> None:
        tr, p = self.transcription, self.transcription.problem
        everywhere = np.arange(tr.intervals + 1)
        self._add_squares(p.costs, everywhere, tr.weights)
        if p.terminal:
            self._add_squares(p.terminal, everywhere[-1:], np.ones(1))
        m, cost = tr.outputs, p.bandwidth_cost
        floor = np.full(m, cost.floor)
        for k, weight in enumerate(tr.weights):
            columns = self.layout.alpha_columns[k]
            self._add_quadratic(columns, weight * cost.hessian(m), floor)
        if cost.charges_rate:
            alpha, hessian = self.layout.alpha_columns, cost.rate_hessian(m, tr.step)
            for columns in np.concatenate([alpha[:-1], alpha[1:]], axis=1):
                self._add_quadratic(columns, hessian, np.zeros(2 * m))

    def _add_squares(self, costs: Sequence[Cost], knots: Array, weights: Array) -> None:
        """Of the residuals of some costs at some knots."""
        tr = self.transcription

        def residuals(local: Local) -> Array:
            return tr.residuals(local, costs)

        for some in _blocks(np.arange(len(knots))):
            rows = AtKnots(tr, self.layout, knots[some], residuals)
            count = len(rows.columns) // len(some)
            add_squares(
                self.program,
                rows,
                self.x,
                scale=self.scale,
                weights=weights[some].repeat(count),
            )

    def _add_quadratic(self, columns: Array, hessian: Array, middle: Array) -> None:
        """``½ (z - middle)'H (z - middle)``."""
        scale = self.scale[columns]
        self.program.AddQuadraticErrorCost(
            scale[:, None] * hessian / 2 * scale, middle / scale, self.x[columns]
        )

    def solve(self, deadline: Deadline) -> tuple[Array, bool, str]:
        """Solves for z; success and status."""
        options = SolverOptions()
        for name, value in OPTIONS.items():
            options.SetOption(IpoptSolver.id(), name, value)
        # On the way it may try anything.
        with _ALONE, np.errstate(all="ignore"):
            if np.isfinite(deadline.left):
                # IPOPT takes no limit of zero.
                seconds = max(deadline.left, 1e-3)
                options.SetOption(IpoptSolver.id(), "max_wall_time", seconds)
            with muted("drake", "IPOPT "):  # what it says is in the history
                result = IpoptSolver().Solve(self.program, None, options)
        z = self.scale * np.asarray(result.GetSolution(self.x))
        status = result.get_solver_details().ConvertStatusToString()
        return z, result.is_success(), status

    def evaluate(self, z: Array) -> Iterate:
        """The iterate of z, with its half-planes where they are better.

        They part the tube exactly, where those that an evaluation finds by itself
        are only nearly the best for `tube_margin: support`.
        """
        tr = self.transcription
        coefficients, alpha = (
            self._block(z, name) for name in ("coefficients", "bandwidth")
        )
        hint, blocks = self._guess.planes, self.layout.blocks
        if len(hint):
            rotation = z[blocks["rotation"]].reshape(len(hint.piece), -1)
            hint = hint.turned(rotation)
        with np.errstate(all="ignore"):  # an iterate that diverges may overflow
            return tr.evaluate(coefficients, tr.bandwidth.feasible(alpha), hint=hint)

    def states(self, z: Array) -> Array:
        """The tube's, shaped as `Transcription.tube_states`."""
        m = self.transcription.outputs
        states = self._block(z, "states")
        return states.reshape(-1, self.layout.num_states, m)

    def _block(self, z: Array, name: str) -> Array:
        """A block of z, ``(..., m)``."""
        block = z[self.layout.blocks[name]]
        return block.reshape(-1, self.transcription.outputs)


def _at_knots(margin: Array) -> Array:
    """Margins at control points as those of the knots that they are nearest to.

    Args:
        margin: ``(N, c, q)``; with c = 2 all of them are at knots.

    Returns:
        ``(N + 1, q)``.
    """
    half = (margin.shape[1] + 1) // 2
    none = np.full_like(margin[:1, 0], np.inf)
    after = np.concatenate([margin[:, :half].min(axis=1), none])
    before = np.concatenate([none, margin[:, -half:].min(axis=1)])
    return np.minimum(after, before)


def _blocks(index: Array) -> list[Array]:
    """Indices in blocks of about `BLOCK`; none if there are none."""
    return np.array_split(index, -(-len(index) // BLOCK)) if len(index) else []


@register_backend
class Ipopt(Backend):
    """Solves the nonlinear program, again where its result shows more is needed.

    Where a solve ends worse than it began, as one that diverges does, the best
    iterate is what counts.
    """

    name = "ipopt"
    price = 20.0

    def refine(
        self,
        transcription: Transcription,
        decisions: Decisions,
        *,
        effort: Effort,
        report: Report,
        deadline: Deadline = NEVER,
    ) -> Solution:
        """See base class; of the effort nothing is looked at."""
        tr = transcription
        clock = time.perf_counter
        current = best = tr.evaluate(*decisions)
        correction = np.zeros_like(tr.tube_states(current))
        worst = least = tr.violation(current)
        if not np.isfinite([worst, current.cost]).all():
            return Solution(tr, current, np.inf)
        status: str | None = None
        for _ in range(ROUNDS):
            if deadline.passed:
                return Solution(tr, best, least, out_of_time=True)
            t0 = clock()
            program = _Program(tr, current, correction)
            t1 = clock()
            z, success, status = program.solve(deadline)
            t2 = clock()
            if not np.isfinite(z).all():
                return Solution(tr, best, least, failure=_words(status))
            before = current
            current = program.evaluate(z)
            worst = tr.violation(current)
            feasible = worst <= tr.options.backoff
            if worst < least or (feasible and current.cost < best.cost):
                best, least = current, worst
            states, exact = program.states(z), tr.tube_states(current)
            defect = exact - states - correction
            correction = exact - states
            t3 = clock()
            step = np.abs(current.coefficients - before.coefficients).max()
            report(
                Iteration(
                    intervals=tr.intervals,
                    cost=current.cost,
                    violation=worst,
                    slack=0.0,
                    defect=float(np.abs(defect).max()),
                    step=float(step),
                    fraction=1.0,
                    proximity=0.0,
                    predicted=before.cost - current.cost,
                    update_time=t1 - t0,
                    solve_time=t2 - t1,
                    evaluate_time=t3 - t2,
                    status=status,
                )
            )
            if worst <= tr.options.backoff:
                return Solution(
                    tr, best, least, success, None if success else _words(status)
                )
            if deadline.passed:
                return Solution(tr, best, least, out_of_time=True)
            if not success and "nfeasible" in status:
                return Solution(tr, best, least)
            if not success and "iverg" in status:
                return Solution(tr, best, least, failure=_words(status))
        return Solution(
            tr, best, least, failure=None if success else _words(str(status))
        )


def _words(status: str) -> str:
    """IPOPT's status as part of a sentence."""
    return f"IPOPT's {status!r}"
