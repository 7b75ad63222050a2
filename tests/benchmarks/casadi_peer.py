"""The peer: CasADi and IPOPT with an exact Hessian on the knots-only problem.

The same mathematics as ``dtmpc_drake.planning``, written as people write such
problems by hand: the acceleration is a first-order hold, so that the reference is
a cubic spline whose dynamics are eliminated; Φ, Ω, W and the cost go by the
trapezoid rule; every constraint is posed at the knots only.  What was tuned:

* The solver is built once, on expanded SX expressions; the start is a bound of
  the constraints, so that a re-plan builds nothing.
* `abs(v)` is an epigraph variable, obstacles and the input limit are squared,
  and the start is the plain straight line: 25 or 26 iterations from any start
  nearby.  With every norm as it is, smoothed at 1e-6, IPOPT takes from 22
  iterations to none that converge, for the tiniest reasons.
* α at the knots is the variable and κ = αΦ an expression; with κ as the variable
  a cold solve takes as many iterations and more time.
* MUMPS orders by AMD, without permutation and pivoting and without IPOPT's
  check of every step: half the time of the defaults.
* Warm: all multipliers, and ``mu_init`` and the pushes as small as they help.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from dtmpc_drake.costs import InputCost
from dtmpc_drake.models import DragDoubleIntegrator
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.plan import Plan

TOLERANCE = 1e-6
"""IPOPT's ``tol``."""
SMOOTHING = 1e-12
"""Under the root of every norm that is left."""
SAMPLES = 100
"""How often an interval is sampled for `Peer.depth`."""
OPTIONS: dict[str, Any] = {
    "expand": True,
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": TOLERANCE,
    "ipopt.max_iter": 500,
    "ipopt.linear_solver": "mumps",
    "ipopt.mumps_pivot_order": 0,
    "ipopt.mumps_permuting_scaling": 0,
    "ipopt.mumps_scaling": 3,
    "ipopt.mumps_pivtol": 0.0,
    "ipopt.fast_step_computation": "yes",
    "ipopt.mu_init": 1.0,
}
WARM_PUSH = 1e-6
WARM_OPTIONS: dict[str, Any] = OPTIONS | {
    "ipopt.mu_init": 1e-7,
    "ipopt.warm_start_init_point": "yes",
    "ipopt.warm_start_bound_push": WARM_PUSH,
    "ipopt.warm_start_bound_frac": WARM_PUSH,
    "ipopt.warm_start_slack_bound_push": WARM_PUSH,
    "ipopt.warm_start_slack_bound_frac": WARM_PUSH,
    "ipopt.warm_start_mult_bound_push": WARM_PUSH,
}


@dataclasses.dataclass(frozen=True)
class Solution:
    """What IPOPT found.

    Attributes:
        cost: of the plan.
        iterations: of IPOPT.
        solve_time: wall time of the call, in s.
        success: whether IPOPT converged, and the input limit holds unsquared.
        status: in IPOPT's words.
        coefficients: of the spline y*, ``(N + 3, 3)``.
        bandwidth: α at the knots, ``(N + 1, 3)``.
        raw: CasADi's result, to start from.
    """

    cost: float
    iterations: int
    solve_time: float
    success: bool
    status: str
    coefficients: Array
    bandwidth: Array
    raw: dict[str, Any]

    __hash__: ClassVar[None]  # type: ignore[assignment]


class _Program:
    """Collects variables and constraints with their bounds.

    Variables have one column for each knot; so have most constraints.
    """

    def __init__(self) -> None:
        self.variables: list[Any] = []
        self.variable_bounds: list[tuple[Array, ...]] = []
        self.constraints: list[Any] = []
        self.bounds: list[tuple[Array, ...]] = []

    def variable(
        self,
        name: str,
        shape: tuple[int, int],
        *,
        guess: Any,
        low: Any = -np.inf,
        high: Any = np.inf,
    ) -> Any:
        """A matrix of variables; what is given is broadcast to its shape."""
        x = ca.SX.sym(name, *shape)
        self.variables.append(x)
        self.variable_bounds.append(
            tuple(np.broadcast_to(b, shape).astype(float) for b in (low, high, guess))
        )
        return x

    def add(self, expression: Any, *, low: Any = -np.inf, high: Any = np.inf) -> None:
        """Bounds a matrix of expressions."""
        self.constraints.append(ca.vec(expression))
        self.bounds.append(
            tuple(
                np.broadcast_to(b, expression.shape).astype(float).ravel(order="F")
                for b in (low, high)
            )
        )

    def equal(self, expression: Any, value: Any = 0.0) -> None:
        """Fixes a matrix of expressions."""
        self.add(expression, low=value, high=value)


class Peer:
    """The knots-only problem, built once, solved from any start state.

    Args:
        problem: of a `DragDoubleIntegrator`, with the comparison velocity bound
            and the paper's tube margin.
        intervals: N.

    Raises:
        ValueError: if the problem has anything that the peer cannot express.
    """

    def __init__(self, problem: Problem, intervals: int) -> None:
        if not isinstance(problem.model, DragDoubleIntegrator):
            raise ValueError("the peer knows the drag model only")
        if problem.velocity_bound != "comparison" or problem.tube_margin != "norm":
            raise ValueError("the peer knows comparison and norm only")
        if problem.start_highest is not None or problem.start_bandwidth is not None:
            raise ValueError("the peer plans from a start state only")
        self.problem, self.intervals = problem, intervals
        self.transcription = Transcription(problem, intervals)
        started = time.perf_counter()
        self._build()
        self.build_time = time.perf_counter() - started

    def _build(self) -> None:
        p, N, K, m = self.problem, self.intervals, self.intervals + 1, 3
        model: Any = p.model
        h = self.transcription.step
        program = _Program()
        # Greville abscissae: the straight line at constant speed.
        along = (np.arange(N + 3)[:, None] - 1) / N
        line = p.start[0] + along * (p.goal[0] - p.start[0])
        speed = np.abs(line[1:2] - line[:1]) / h
        alpha_first = np.broadcast_to(p.bandwidth.high, (K, m))
        first = self.transcription.evaluate(line, alpha_first).local

        # y* is a uniform cubic B-spline.
        c = program.variable("c", (m, N + 3), guess=line.T)
        r = (c[:, :-2] + 4 * c[:, 1:-1] + c[:, 2:]) / 6
        v = (c[:, 2:] - c[:, :-2]) / (2 * h)
        a = (c[:, :-2] - 2 * c[:, 1:-1] + c[:, 2:]) / h**2
        program.equal(ca.horzcat(r[:, 0], v[:, 0]), p.start.T)
        program.equal(ca.horzcat(r[:, -1], v[:, -1]), p.goal.T)
        alpha = program.variable(
            "alpha",
            (m, K),
            guess=alpha_first.T,
            low=p.bandwidth.low[:, None],
            high=p.bandwidth.high[:, None],
        )
        phi, omega, w = (
            program.variable(name, (m, K), guess=guess.T, **_from(fixed, K))
            for name, guess, fixed in (
                ("Phi", first.layer, p.tube_start.layer),
                ("Omega", first.error_bound[:, 0], p.tube_start.stages[0]),
                ("W", first.error_bound[:, 1], p.tube_start.highest),
            )
        )
        s = program.variable("s", (m, K), guess=speed.T + 1e-2)
        program.add(s - v, low=0.0)
        program.add(s + v, low=0.0)

        # The tube, by the trapezoid rule.
        slope, D = _columns(p.law.slope, K), _columns(p.law.disturbance_bound, K)
        largest = s + w
        error = model.drag_error_bound
        known = error * _rows(_norm(v)) * s
        worst = error * _rows(_norm(largest)) * largest
        gain = alpha * phi

        def trapezoid(x: Any, rate: Any) -> None:
            program.equal(x[:, 1:] - x[:, :-1] - h / 2 * (rate[:, 1:] + rate[:, :-1]))

        trapezoid(phi, -gain + known + D + p.law.reaching_rate)
        trapezoid(omega, phi - slope * omega)
        trapezoid(
            w, -(alpha + slope) * w + alpha * slope * omega + D + 2 * worst - known
        )

        # The limits, at the knots.
        if not p.bandwidth.is_fixed:
            change = h * p.bandwidth.rate
            program.add(alpha[:, 1:] - alpha[:, :-1], low=-change, high=change)
        program.add(largest, high=p.speed.bound)
        drag = model.drag_estimate
        feedback = _norm(
            drag * _rows(_norm(largest)) * largest + slope * w + gain + worst - known
        )
        # Its other branch, feedback above the limit, is excluded in `solve`.
        program.add(ca.sum1(a * a) - (p.input.bound - feedback) ** 2, high=0.0)
        inside = slice(1, N)  # nothing can be done about the ends
        obstacles = p.obstacles
        inflation = ca.SX.sym("inflation")  # a parameter: nothing is built anew
        for H, center, radius in zip(
            obstacles.shape, obstacles.center, obstacles.radius, strict=True
        ):
            offset = ca.DM(H) @ r[:, inside] - _columns(center, N - 1)
            reach = radius + inflation + _norm(ca.DM(np.abs(H)) @ omega[:, inside])
            program.add(ca.sum1(offset**2) - reach**2, low=0.0)

        u = a + drag * _rows(_norm(v)) * v
        weights = [c.weight for c in p.costs if isinstance(c, InputCost)]
        running = sum(float(np.asarray(w)) for w in weights) * ca.sum1(u**2)
        excess = alpha - p.bandwidth_cost.floor
        running += float(np.asarray(p.bandwidth_cost.weight)) * ca.sum1(excess**2)
        cost = running @ ca.DM(self.transcription.weights)

        self._finish(program, cost, inflation, [c.T, alpha.T, feedback])

    def _finish(
        self, program: _Program, cost: Any, inflation: Any, outputs: list[Any]
    ) -> None:
        """Orders the variables knot by knot and makes both solvers."""
        coefficients, *rest = program.variables
        x = ca.vertcat(ca.vec(coefficients), ca.vec(ca.vertcat(*rest)))
        low, high, guess = (
            np.concatenate(
                [first.ravel(order="F"), np.concatenate(others).ravel(order="F")]
            )
            for first, *others in zip(*program.variable_bounds, strict=True)
        )
        g = ca.vertcat(*program.constraints)
        nlp = {"x": x, "f": cost, "g": g, "p": inflation}
        self._cold = ca.nlpsol("cold", "ipopt", nlp, OPTIONS)
        self._warm = ca.nlpsol("warm", "ipopt", nlp, WARM_OPTIONS)
        self._read = ca.Function("read", [x], outputs)
        self._guess = guess
        self._bounds = {
            "lbx": low,
            "ubx": high,
            "lbg": np.concatenate([b[0] for b in program.bounds]),
            "ubg": np.concatenate([b[1] for b in program.bounds]),
        }
        self.num_variables, self.num_constraints = x.shape[0], g.shape[0]

    def solve(
        self,
        *,
        start: Array | None = None,
        previous: Solution | None = None,
        inflation: float = 0.0,
    ) -> Solution:
        """Solves from the straight line, or from an earlier solution.

        Args:
            start: x*(t0), ``(2, 3)``, if not the problem's.
            previous: to start from.
            inflation: of all radii, in m, to make up for what is not looked at
                between knots.
        """
        bounds = self._bounds
        if start is not None:
            state = np.asarray(start, float).ravel()
            bounds = bounds | {
                side: np.concatenate([state, bounds[side][state.size :]])
                for side in ("lbg", "ubg")
            }
        solver, first = self._cold, {"x0": self._guess}
        if previous is not None:
            solver = self._warm
            first = {
                "x0": previous.raw["x"],
                "lam_x0": previous.raw["lam_x"],
                "lam_g0": previous.raw["lam_g"],
            }
        started = time.perf_counter()
        raw = solver(**first, **bounds, p=inflation)
        elapsed = time.perf_counter() - started
        stats = solver.stats()
        c, alpha, feedback = (np.asarray(e) for e in self._read(raw["x"]))
        in_branch = bool(feedback.max() <= self.problem.input.bound)
        return Solution(
            cost=float(raw["f"]),
            iterations=int(stats["iter_count"]),
            solve_time=elapsed,
            success=bool(stats["success"]) and in_branch,
            status=str(stats["return_status"]),
            coefficients=c,
            bandwidth=alpha,
            raw=raw,
        )

    def plan(self, solution: Solution) -> Plan:
        """The solution with the exact tube that follows from it."""
        iterate = self.transcription.evaluate(solution.coefficients, solution.bandwidth)
        return self.transcription.plan(iterate)

    def depth(self, solution: Solution) -> tuple[float, float]:
        """How deep the tube cuts into an obstacle: at the knots, and anywhere.

        Both in m, zero if clear, with the exact tube rather than the peer's
        trapezoids, which account for what is left at the knots.  Every interval is
        sampled `SAMPLES` times.
        """
        plan = self.plan(solution)
        fine = np.linspace(plan.start_time, plan.end_time, SAMPLES * self.intervals + 1)
        deepest = []
        for times in (plan.knots, fine):
            clearance = self.problem.obstacles.clearance(
                plan.reference(times)[:, 0], plan.position_tube(times)
            )
            deepest.append(float(max(0.0, -clearance.min())))
        return deepest[0], deepest[1]


def _norm(x: Any) -> Any:
    """The smoothed 2-norm of every column, a row."""
    return ca.sqrt(ca.sum1(x**2) + SMOOTHING)


def _rows(x: Any) -> Any:
    return ca.repmat(x, 3, 1)


def _columns(values: Array, count: int) -> Any:
    return ca.repmat(ca.DM(np.asarray(values, float)), 1, count)


def _from(first: Array, knots: int) -> dict[str, Array]:
    """Bounds that fix the first knot only."""
    low = np.full((3, knots), -np.inf)
    low[:, 0] = first
    return {"low": low, "high": np.where(np.isinf(low), np.inf, low)}
