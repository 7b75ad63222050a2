"""The same problem on IPOPT, with its bilinear constraints as they are.

Decisions, cost and constraints are those of the transcription; the tube obeys
its differential equations by Hermite-Simpson collocation, and the normals of the
separating half-planes are variables.  Every row is a scalar symbolic expression,
which Drake evaluates in C++ (a quadratic one as such), because its IPOPT has no
exact Hessian and therefore evaluates often.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from pydrake.solvers import IpoptSolver, MathematicalProgram, SolverOptions

from dtmpc_drake.models import Array
from dtmpc_drake.planning import splines
from dtmpc_drake.planning.deadline import NEVER, Deadline
from dtmpc_drake.planning.scp import BACKOFF, Iteration, Result, violation
from dtmpc_drake.planning.transcription import (
    Iterate,
    Local,
    Transcription,
    hermite_controls,
)
from dtmpc_drake.tube import cascade_bound

ROUNDS = 4
"""Solves at most: each adds the half-planes that its result shows to be missed
and shifts the tube by the rest of the collocation's error."""


class _Program:
    """One nonlinear program around an iterate."""

    def __init__(
        self, transcription: Transcription, guess: Iterate, correction: Array
    ) -> None:
        tr, p = transcription, transcription.problem
        n, m, K = tr.order, tr.outputs, tr.intervals + 1
        self.transcription = tr
        self.program = MathematicalProgram()
        new = self.program.NewContinuousVariables
        self.coefficients = new(K - 1 + tr.degree, m, "q")
        # The cost is nearly a sum of squares of these, which is what a
        # quasi-Newton method wants to see; in coefficients it is stiff.
        self.highest = new(K, m, "highest")
        # Scaled so that cost weighs all decisions alike.
        self.scale = np.sqrt(p.input_weight / max(p.bandwidth_weight, 1e-6))
        self.scaled_alpha = new(K, m, "alpha")
        self.alpha = self.scale * self.scaled_alpha
        rows = n + 1 if tr.has_velocity_state else n
        self.states = new(K * rows, m, "state").reshape(K, rows, m)
        self.middles = new((K - 1) * rows, m, "middle").reshape(K - 1, rows, m)
        self._set_guess(guess)
        knots = [
            splines.knot_operator(K - 1, tr.degree, k, tr.step).toarray()
            @ self.coefficients
            for k in range(n + 1)
        ]
        self._rows(knots[n] - self.highest, 0.0, 0.0)
        knots[n] = self.highest
        state = np.stack(knots[:n], axis=1)
        for k in range(n):
            self._rows(knots[k][0] - p.start[k], 0.0, 0.0)
            if np.isfinite(p.goal[k]).all():
                self._rows(knots[k][-1] - p.goal[k], 0.0, 0.0)
        if p.start_highest is not None:
            self._rows(knots[n][0] - p.start_highest, 0.0, 0.0)
        if p.start_bandwidth is not None:
            self._rows(self.alpha[0] - p.start_bandwidth, 0.0, 0.0)
        first = tr.tube_states(guess)[0]
        self._rows((self.states[0] - first).ravel(), 0.0, 0.0)
        low, high = tr.bandwidth_low, tr.bandwidth_high
        self.program.AddBoundingBoxConstraint(
            np.tile(low / self.scale, (K, 1)),
            np.tile(high / self.scale, (K, 1)),
            self.scaled_alpha,
        )
        self._rows(
            (self.alpha[1:] - self.alpha[:-1]).ravel(),
            -tr.bandwidth_change,
            tr.bandwidth_change,
        )
        self._collocate(state)
        # The exact tube is the collocated one and a correction.
        exact = self.states + correction
        self._hard(state, knots[n], exact, guess)

    def _rows(self, expressions: Array, lower: float, upper: float) -> None:
        for expression in np.ravel(expressions):
            self.program.AddConstraint(expression, lower, upper)

    def _set_guess(self, guess: Iterate) -> None:
        values = self.transcription.tube_states(guess)
        half = self.transcription.tube_steps // 2
        middle = self.transcription.tube_states(guess, half)[1::2]
        for variables, value in (
            (self.coefficients, guess.coefficients),
            (self.highest, guess.local.highest),
            (self.scaled_alpha, guess.bandwidth / self.scale),
            (self.states, values),
            (self.middles, middle),
        ):
            self.program.SetInitialGuess(
                variables.reshape(len(variables), -1),
                value.reshape(len(value), -1),
            )

    def _collocate(self, state: Array) -> None:
        """Hermite-Simpson on the tube's own differential equation."""
        tr = self.transcription
        h = tr.step
        basis = [
            splines.basis(tr.degree, k, np.array([0.5]), h)[0] for k in range(tr.order)
        ]
        index = np.arange(tr.intervals)[:, None] + np.arange(tr.degree + 1)
        windows = self.coefficients[index]
        middle_state = np.stack(
            [np.einsum("c,ncm->nm", b, windows) for b in basis], axis=1
        )
        middle_alpha = (self.alpha[:-1] + self.alpha[1:]) / 2

        x, f = self.states, tr.tube_rates(state, self.alpha, self.states)
        f_middle = tr.tube_rates(middle_state, middle_alpha, self.middles)
        average, change = (x[:-1] + x[1:]) / 2, x[1:] - x[:-1]
        self._rows(self.middles - average - h / 8 * (f[:-1] - f[1:]), 0.0, 0.0)
        self._rows(change - h / 6 * (f[:-1] + 4 * f_middle + f[1:]), 0.0, 0.0)
        self.tube_rate = f

    def _hard(
        self, state: Array, highest: Array, states: Array, guess: Iterate
    ) -> None:
        """Input, speed, obstacles, and the cost."""
        tr, p = self.transcription, self.transcription.problem
        n, m = tr.order, tr.outputs
        stages = states[:, :n]
        bounds = [cascade_bound(stages, p.slope, k) for k in range(n)]
        if tr.has_velocity_state:
            bounds[-1] = states[:, n]
        local = Local(
            state=state,
            highest=highest,
            layer=stages[:, n - 1],
            bandwidth=self.alpha,
            error_bound=np.stack(bounds, axis=1),
        )
        # What the pieces on both sides need beyond a knot, as seen at the guess.
        margin = guess.input_margin
        worst = tr.pieces(margin).min(axis=1)
        least = np.minimum(np.append(worst, np.inf), np.append(np.inf, worst))
        seen = tr.used_input(guess.local)
        bulge = p.input_limit - seen - np.minimum(margin[:: tr.tube_steps], least)
        for row, extra in zip(tr.used_input(local), bulge, strict=True):
            self.program.AddConstraint(row, -np.inf, p.input_limit - extra - BACKOFF)
        trusted = tr.error_margin(local.state, local.error_bound)
        if trusted.size:
            self._rows(BACKOFF - trusted, -np.inf, 0.0)
        rate, weight = tr.used_rate(local), np.linspace(0, 1, n + 1)[:, None]
        chord = rate[:-1, None] * (1 - weight) + rate[1:, None] * weight
        seen_rate = tr.used_rate(guess.local)
        seen_chord = seen_rate[:-1, None] * (1 - weight) + seen_rate[1:, None] * weight
        index = np.arange(tr.intervals)[:, None] + np.arange(tr.degree + 1)
        windows = self.coefficients[index]
        speed = np.einsum("ic,ncm->nim", tr.speed_basis, windows)
        seen_speed = tr.speed_basis @ guess.coefficients[index]
        bulge = p.speed_limit - seen_chord - seen_speed - guess.speed_margin[..., 0]
        room = p.speed_limit - bulge - BACKOFF
        self._rows(speed + chord - room, -np.inf, 0.0)
        self._rows(chord - speed - room, -np.inf, 0.0)
        self._obstacles(windows, stages, guess)

        u = tr.feedforward(local)
        for w, row, a in zip(tr.weights, u, self.alpha, strict=True):
            cost = p.input_weight * (row**2).sum()
            cost = cost + p.bandwidth_weight * ((a - p.bandwidth_floor) ** 2).sum()
            self.program.AddCost(w * cost)
        del m

    def _obstacles(self, windows: Array, stages: Array, guess: Iterate) -> None:
        tr, p = self.transcription, self.transcription.problem
        planes, obstacles = guess.planes, p.obstacles
        if not len(planes.piece):
            return
        controls = np.einsum("ic,ncm->nim", tr.position_basis, windows)
        value = stages[:, 0]
        rate = self.tube_rate[:, 0]
        elevate = splines.elevation(3, tr.control_degree)
        points = hermite_controls(value, rate, tr.step)
        tubes = np.einsum("ij,njm->nim", elevate, points)
        # What the exact tube has above these curves, as seen at the guess.
        seen = hermite_controls(
            guess.tube.error_bound[:: tr.tube_steps, 0],
            guess.tube.error_bound_rate[:: tr.tube_steps, 0],
            tr.step,
        )
        tubes = tubes + (guess.tube_controls - elevate @ seen)
        for row, (k, o) in enumerate(zip(planes.piece, planes.obstacle, strict=True)):
            H, center = obstacles.shape[o], obstacles.center[o]
            used = np.flatnonzero(np.any(H != 0, axis=1))
            normal = self.program.NewContinuousVariables(len(used), "normal")
            self.program.SetInitialGuess(normal, planes.normal[row, used])
            self.program.AddConstraint((normal**2).sum(), 0.0, 1.0)
            boxes = tubes[k] @ np.abs(H[used]).T
            offset = controls[k] @ H[used].T - center[used]
            for i in range(len(offset)):
                if p.tube_margin == "norm":
                    size = self.program.NewContinuousVariables(1, "size")[0]
                    here = guess.tube_controls[k, i] @ np.abs(H[used]).T
                    self.program.SetInitialGuess(size, np.linalg.norm(here))
                    self.program.AddBoundingBoxConstraint(0.0, np.inf, size)
                    self.program.AddConstraint(
                        (boxes[i] ** 2).sum() - size**2, -np.inf, 0.0
                    )
                else:
                    signs = np.sign(planes.normal[row, used])
                    size = (signs * normal * boxes[i]).sum()
                along = (normal * offset[i]).sum()
                self.program.AddConstraint(
                    along - size, obstacles.radius[o] + BACKOFF, np.inf
                )

    def solve(self, deadline: Deadline) -> tuple[Array, Array, Array, bool, str]:
        """Coefficients, bandwidth, tube states, success and status."""
        options = SolverOptions()
        for name, value in {
            "tol": 1e-4,
            "constr_viol_tol": 1e-5,
            "acceptable_tol": 1e-3,
            "acceptable_constr_viol_tol": 1e-5,
            "acceptable_iter": 10,
            "mu_strategy": "adaptive",
            "max_iter": 1000,
        }.items():
            options.SetOption(IpoptSolver.id(), name, value)
        if np.isfinite(deadline.left):
            # IPOPT takes no limit of zero.
            seconds = max(deadline.left, 1e-3)
            options.SetOption(IpoptSolver.id(), "max_wall_time", seconds)
        result = IpoptSolver().Solve(self.program, None, options)
        details = result.get_solver_details()
        values = [
            np.asarray(result.GetSolution(v.reshape(len(v), -1))).reshape(v.shape)
            for v in (self.coefficients, self.scaled_alpha, self.states)
        ]
        values[1] *= self.scale
        return (*values, result.is_success(), details.ConvertStatusToString())


def solve_nlp(
    transcription: Transcription,
    decisions: tuple[Array, Array],
    *,
    report: Callable[[Iteration], None],
    deadline: Deadline = NEVER,
) -> Result:
    """Solves the nonlinear program, again where its result shows more is needed.

    Where a solve ends worse than it began, as one that diverges does, the best
    iterate is what counts.

    Args:
        transcription: of the problem.
        decisions: coefficients and bandwidth to start from.
        report: is given every solve.
        deadline: after which IPOPT is stopped.
    """
    tr = transcription
    clock = time.perf_counter
    current = best = tr.evaluate(*decisions)
    correction = np.zeros_like(tr.tube_states(current))
    worst = least = violation(current)
    if not np.isfinite([worst, current.cost]).all():
        return Result(current, False, np.inf)
    status: str | None = None
    for _ in range(ROUNDS):
        if deadline.passed:
            return Result(best, False, least, out_of_time=True)
        t0 = clock()
        # numpy warns of invalid values whenever it meets a symbolic expression.
        with np.errstate(invalid="ignore"):
            program = _Program(tr, current, correction)
        t1 = clock()
        coefficients, alpha, states, success, status = program.solve(deadline)
        t2 = clock()
        if not all(np.isfinite(x).all() for x in (coefficients, alpha, states)):
            return Result(best, False, least, _words(status))
        before = current
        with np.errstate(all="ignore"):  # an iterate that diverges may overflow
            current = tr.evaluate(coefficients, tr.feasible_bandwidth(alpha))
            worst = violation(current)
        if worst < least or (worst <= BACKOFF and current.cost < best.cost):
            best, least = current, worst
        exact = tr.tube_states(current)
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
        if worst <= BACKOFF:
            return Result(best, success, least, None if success else _words(status))
        if deadline.passed:
            return Result(best, False, least, out_of_time=True)
        if not success and "nfeasible" in status:
            return Result(best, False, least)
        if not success and "iverg" in status:
            return Result(best, False, least, _words(status))
    return Result(best, False, least, None if success else _words(str(status)))


def _words(status: str) -> str:
    """IPOPT's status as part of a sentence."""
    return f"IPOPT's {status!r}"
