"""Nonlinear rows for IPOPT, a block of like ones at a time.

Drake hands a constraint its variables as `AutoDiffXd`, and a row of Python scalars
is slow; so a block takes their values alone, evaluates all its rows at once, and
gives back derivatives of a known sparsity.  Models are differentiated by central
differences, as for the convex programs.
"""

from __future__ import annotations

import abc
from collections.abc import Callable

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff
from pydrake.solvers import MathematicalProgram

from dtmpc_drake.limits import ConvexLimit
from dtmpc_drake.numerics import splines
from dtmpc_drake.numerics.arrays import Array, jacobian
from dtmpc_drake.obstacles.separation import Turning
from dtmpc_drake.planning.iterate import Iterate, Local
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.transcription import Transcription

ROUNDING = 0.02
"""Radius of what stands for a kink at rest, in units of the state.  At a kink the
quasi-Newton method never ends; a quarter of it costs a quarter more iterations."""
TURN_ROUNDING = 0.01
"""The same for a half-plane's normal along an axis."""


class NlpVariables(Variables):
    """The convex programs' z, with y*^(n) at the knots as a block of its own.

    The cost is nearly a sum of squares of these, which is what a quasi-Newton
    method wants to see; in spline coefficients it is stiff.

    Args:
        transcription: of the problem.
        planes: how many separating half-planes may turn.

    Attributes:
        highest_matrix: y*^(n) at a knot by the spline coefficients that it reads,
            ``(m, degree m)``.
    """

    def __init__(self, transcription: Transcription, *, planes: int) -> None:
        super().__init__(transcription, planes=planes, kinked=np.zeros(0, dtype=int))
        tr = transcription
        n, m, K = tr.order, tr.outputs, tr.intervals + 1
        columns = self.size + np.arange(K * m).reshape(K, m)
        self.blocks["highest"] = slice(self.size, self.size + K * m)
        self.size += K * m
        self.knot_columns = np.concatenate([self.knot_columns, columns], axis=1)
        self.local_matrix = np.pad(self.local_matrix, ((0, 0), (0, m)))
        highest = self.local_matrix[n * m : (n + 1) * m]
        self.highest_matrix = highest[:, : tr.degree * m].copy()
        highest[:] = 0.0
        highest[:, -m:] = np.eye(m)

    def pack(self, transcription: Transcription, iterate: Iterate) -> Array:
        """The z of an iterate, with its half-planes as they are."""
        z = np.zeros(self.size)
        for name, values in (
            ("coefficients", iterate.coefficients),
            ("bandwidth", iterate.bandwidth),
            ("states", transcription.tube_states(iterate)),
            ("highest", iterate.local.highest),
        ):
            z[self.blocks[name]] = values.ravel()
        return z


class NlpRows(abc.ABC):
    """Like rows, evaluated together.

    Attributes:
        columns: entries of z that each row reads, ``(R, E)``.
        reads: which of them it really does; broadcast to ``(R, E)``.
    """

    columns: Array
    reads: Array | bool = True

    @abc.abstractmethod
    def values(self, z: Array) -> Array:
        """All rows, ``(R,)``."""

    @abc.abstractmethod
    def slopes(self, z: Array) -> Array:
        """Their derivatives by the entries that they read, ``(R, E)``."""


def bound_rows(
    program: MathematicalProgram,
    rows: NlpRows,
    x: Array,
    *,
    scale: Array,
    shift: Array,
    low: Array | float,
    high: Array | float,
) -> None:
    """Adds ``low <= rows(z) <= high``, with the sparsity of the rows.

    Args:
        program: to add to.
        rows: to bound.
        x: the program's variables.
        scale: z is ``scale x + shift``.
        shift: see there.
        low: broadcast to ``(R,)``, as is the next.
        high: may be infinite.
    """
    used, place, values_of = _inputs(rows, scale, shift)
    count = len(rows.columns)
    row, entry = np.nonzero(np.broadcast_to(rows.reads, rows.columns.shape))
    column = place[row, entry]

    def evaluate(x: Array) -> Array:
        z = values_of(x)
        if x.dtype != object:
            return rows.values(z)
        gradient = np.zeros((count, len(used)))
        gradient[row, column] = rows.slopes(z)[row, entry] * scale[used][column]
        return InitializeAutoDiff(rows.values(z), gradient)

    constraint = program.AddConstraint(
        evaluate, np.broadcast_to(low, count), np.broadcast_to(high, count), x[used]
    )
    pattern = zip(row.tolist(), column.tolist(), strict=True)
    constraint.evaluator().SetGradientSparsityPattern(list(pattern))


def add_squares(
    program: MathematicalProgram,
    rows: NlpRows,
    x: Array,
    *,
    scale: Array,
    weights: Array,
) -> None:
    """Adds the cost ``Σ weight row(scale x)²``, the weights ``(R,)``."""
    used, place, values_of = _inputs(rows, scale, np.zeros(len(x)))

    def evaluate(x: Array) -> float | AutoDiffXd:
        z = values_of(x)
        values = rows.values(z)
        cost = float(weights @ values**2)
        if x.dtype != object:
            return cost
        slopes = 2 * (weights * values)[:, None] * rows.slopes(z)
        gradient = np.bincount(place.ravel(), slopes.ravel(), len(used))
        return AutoDiffXd(cost, gradient * scale[used])

    program.AddCost(evaluate, x[used])


def _inputs(
    rows: NlpRows, scale: Array, shift: Array
) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Entries of z that rows use, where each row's are among them, and z by x."""
    used, place = np.unique(rows.columns, return_inverse=True)

    def values_of(x: Array) -> Array:
        z = np.zeros(len(scale))
        exact = x if x.dtype != object else ExtractValue(x)[:, 0]
        z[used] = scale[used] * exact + shift[used]
        return z

    return used, place.reshape(rows.columns.shape), values_of


class Collocation(NlpRows):
    """The tube's differential equation dx/dt = f by Hermite-Simpson.

    ``x_1 - x_0 = h/6 (f_0 + 4 f(x_m) + f_1)`` on every piece with
    ``x_m = (x_0 + x_1)/2 + h/8 (f_0 - f_1)``, which therefore is no variable.

    Args:
        transcription: of the problem.
        layout: of z.
        pieces: to integrate over, ``(P,)``.
    """

    def __init__(
        self, transcription: Transcription, layout: NlpVariables, pieces: Array
    ) -> None:
        tr = transcription
        n, m = tr.order, tr.outputs
        S, c = layout.num_states * m, (tr.degree + 1) * m
        self._step, self._state = tr.step, n * m + m
        alpha = layout.blocks["bandwidth"].start + pieces[:, None] * m
        self._columns = np.concatenate(
            [
                layout.coefficient_columns(pieces, tr.degree + 1),
                alpha + np.arange(2 * m),
                layout.state_columns[pieces],
            ],
            axis=1,
        )
        self.columns = self._columns.repeat(S, axis=0)
        width = self._columns.shape[1]
        # From these to x*, α and the tube's states at both ends and in the middle.
        self._points = np.zeros((3, self._state + S, width))
        for points, t in zip(self._points, (0.0, 0.5, 1.0), strict=True):
            (basis,) = tr.splines.values(np.array([t]))
            points[: n * m, :c] = splines.over_axes(basis[:n], m)
            ends = np.array([[1 - t, t]])
            points[n * m : self._state, c : c + 2 * m] = np.kron(ends, np.eye(m))
            points[self._state :, c + 2 * m :] = np.kron(ends, np.eye(S))
        if not tr.problem.model.error_bound_varies:
            # The axes do not see each other, nor the reference.
            same = np.arange(width) % m == np.arange(S)[:, None] % m
            same[:, :c] = False
            self.reads = np.tile(same, (len(pieces), 1))

        def rates(flat: Array) -> Array:
            lead = flat.shape[:-1]
            rates = tr.tube_rates(
                flat[..., : n * m].reshape(*lead, n, m),
                flat[..., n * m : n * m + m],
                flat[..., n * m + m :].reshape(*lead, -1, m),
            )
            return rates.reshape(*lead, S)

        self._rates = rounded(rates, signed=n * m, size=self._state + S)

    def _evaluate(self, z: Array) -> tuple[Array, Array]:
        """x*, α and states at the three points, and rates at the ends."""
        points = z[self._columns] @ self._points.swapaxes(1, 2)
        ends = self._rates(points[::2])
        points[1, :, self._state :] += self._step / 8 * (ends[0] - ends[1])
        return points, ends

    def values(self, z: Array) -> Array:
        """See base class; in units of the tube."""
        points, ends = self._evaluate(z)
        states = points[:, :, self._state :]
        simpson = (ends[0] + 4 * self._rates(points[1]) + ends[1]) / 6
        return np.asarray(states[2] - states[0] - self._step * simpson).ravel()

    def slopes(self, z: Array) -> Array:
        """See base class."""
        points, _ = self._evaluate(z)
        flat = points.reshape(-1, points.shape[2])
        f = jacobian(self._rates, flat)
        f = f.reshape(*points.shape[:2], *f.shape[1:])
        by = f @ self._points[:, None]
        by[1] += self._step / 8 * f[1][:, :, self._state :] @ (by[0] - by[2])
        states = self._points[:, self._state :]
        simpson = (by[0] + 4 * by[1] + by[2]) / 6
        slopes = states[2] - states[0] - self._step * simpson
        return slopes.reshape(self.columns.shape)


class AtKnots(NlpRows):
    """Any function of what enters at one instant, at some knots.

    Args:
        transcription: of the problem.
        layout: of z.
        knots: where, ``(P,)``.
        function: to ``(..., r)``; there are P r rows.
    """

    def __init__(
        self,
        transcription: Transcription,
        layout: NlpVariables,
        knots: Array,
        function: Callable[[Local], Array],
    ) -> None:
        n, m = transcription.order, transcription.outputs
        self._columns = layout.knot_columns[knots]
        self._matrix = layout.local_matrix
        size = len(self._matrix)

        def flat(values: Array) -> Array:
            return function(Local.unpack(values, n, m))

        self._function = rounded(flat, signed=n * m, size=size)
        self.columns = self._columns.repeat(flat(np.ones(size)).size, axis=0)

    def _local(self, z: Array) -> Array:
        return z[self._columns] @ self._matrix.T

    def values(self, z: Array) -> Array:
        """See base class."""
        return self._function(self._local(z)).ravel()

    def slopes(self, z: Array) -> Array:
        """See base class."""
        slopes = jacobian(self._function, self._local(z)) @ self._matrix
        return slopes.reshape(self.columns.shape)


class AtControlPoints(NlpRows):
    """What is left of a convex limit at control points of its derivative.

    Args:
        transcription: of the problem.
        layout: of z.
        guess: gives what bounds the deviation beyond the chord of its knots.
        number: of the limit among `Problem.convex`.
        which: piece, control point and column of each row, ``(R, 3)``.
    """

    def __init__(
        self,
        transcription: Transcription,
        layout: NlpVariables,
        guess: Iterate,
        number: int,
        which: Array,
    ) -> None:
        tr = transcription
        self._limit: ConvexLimit = tr.problem.convex[number]
        piece, control, self._column = which.T
        basis = tr.convex_bases[number]
        self.columns = np.concatenate(
            [
                layout.coefficient_columns(piece, basis.shape[1]),
                layout.state_columns[piece],
            ],
            axis=1,
        )
        m = tr.outputs
        self._split = basis.shape[1] * m
        self._value = np.stack([splines.over_axes(row[None], m) for row in basis])
        self._value = self._value[control]
        later = (control / (len(basis) - 1))[:, None, None]
        bound = layout.bounds[self._limit.derivative]
        self._spread = np.concatenate([(1 - later) * bound, later * bound], axis=2)
        states = layout.pack(tr, guess)[self.columns[:, self._split :]]
        chord = np.einsum("rms,rs->rm", self._spread, states)
        self._above = guess.convex_points[number][1][piece, control] - chord

    def _points(self, z: Array) -> tuple[Array, Array]:
        """Control points, and those of what bounds the deviation, ``(R, m)`` each."""
        read = z[self.columns]
        value = np.einsum("rmc,rc->rm", self._value, read[:, : self._split])
        spread = np.einsum("rms,rs->rm", self._spread, read[:, self._split :])
        return value, spread + self._above

    def values(self, z: Array) -> Array:
        """See base class."""
        left = self._limit.left(*self._points(z))
        return left[np.arange(len(left)), self._column]

    def slopes(self, z: Array) -> Array:
        """See base class."""
        row = np.arange(len(self._column))
        by_value, by_spread = (
            each[row, self._column][:, None]
            for each in self._limit.left_slopes(*self._points(z))
        )
        slopes = [by_value @ self._value, by_spread @ self._spread]
        return np.concatenate(slopes, axis=2)[:, 0]


class Separation(NlpRows):
    """Margins of half-planes that part pieces from obstacles, and may turn.

    Each normal is `turned` from the guess's, so that its length needs no row.

    Args:
        transcription: of the problem.
        layout: of z.
        guess: gives the half-planes, and what the exact tube has above the cubic
            that its states at the knots give.
        which: half-planes, ``(P,)``.
    """

    def __init__(
        self,
        transcription: Transcription,
        layout: NlpVariables,
        guess: Iterate,
        which: Array,
    ) -> None:
        tr = transcription
        piece = guess.planes.piece[which]
        self._turning = Turning(guess.planes, which, TURN_ROUNDING)
        self._position, self._tube = tr.position_basis, layout.tube_matrix
        states = layout.state_columns[piece]
        seen = self._cubic(layout.pack(tr, guess)[states])
        self._above = guess.tube_controls[piece] - seen
        turns = which[:, None] * layout.tangents + np.arange(layout.tangents)
        self._columns = np.concatenate(
            [
                layout.coefficient_columns(piece, tr.degree + 1),
                states,
                layout.blocks["rotation"].start + turns,
            ],
            axis=1,
        )
        self._split = np.cumsum([(tr.degree + 1) * tr.outputs, states.shape[1]])
        self.columns = self._columns.repeat(len(tr.position_basis), axis=0)

    def _cubic(self, states: Array) -> Array:
        return np.einsum("cjs,ps->pcj", self._tube, states)

    def _evaluate(self, z: Array) -> tuple[Array, Array, Array]:
        """Control points, those of the tube, and the normals' turning."""
        coefficients, states, t = np.split(z[self._columns], self._split, axis=1)
        windows = coefficients.reshape(len(t), -1, self._tube.shape[1])
        position = splines.applied(self._position, windows)
        return position, self._cubic(states) + self._above, t

    def values(self, z: Array) -> Array:
        """See base class; one for every control point, in m."""
        return self._turning.margins(*self._evaluate(z)).ravel()

    def slopes(self, z: Array) -> Array:
        """See base class."""
        by_position, by_tube, turn = self._turning.slopes(*self._evaluate(z))
        position = self._position * by_position[:, None, None]
        states = np.einsum("pcj,cjs->pcs", by_tube, self._tube)
        P, c = turn.shape[:2]
        slopes = np.concatenate([position.reshape(P, c, -1), states, turn], axis=2)
        return slopes.reshape(self.columns.shape)


def rounded(
    function: Callable[[Array], Array], *, signed: int, size: int
) -> Callable[[Array], Array]:
    """A function with its kinks at rest rounded off.

    A kink such as that of |v| is where v changes sign in a function that is even in
    it.  There v gives way to sqrt(v² + ρ²); odd functions are left as they are.

    Args:
        function: of ``(..., size)``.
        signed: so many coordinates, the first, may change sign.
        size: of its argument.
    """
    samples = np.random.default_rng(0).uniform(0.5, 1.5, (4, size))
    values = function(samples)
    square = np.zeros(size)
    for i in range(signed):
        mirror = np.where(np.arange(size) == i, -1.0, 1.0)
        if np.allclose(function(mirror * samples), values, rtol=1e-9, atol=1e-12):
            square[i] = ROUNDING**2
    even = square > 0

    def smooth(x: Array) -> Array:
        return function(np.where(even, np.sqrt(x * x + square), x))

    return smooth
