"""The variables of the programs and the sparse operators on them.

A program's vector z stacks, all knot-major with the axes fastest: the spline
coefficients of y*; the bandwidth at the knots; the tube's states at the knots
(the cascade's stages Y_0 ... Y_(n-1) = Φ and, for the comparison bound, W); the
rotations of the separating half-planes; and one slack.  Operators are sparse
matrices on z.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np
import scipy.sparse as sp

from dtmpc_drake.planning import splines
from dtmpc_drake.planning.splines import Sparse
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.tube import cascade_bound


@dataclasses.dataclass(frozen=True)
class Shape:
    """All that the operators depend on.

    Attributes:
        order: n.
        outputs: m.
        intervals: N.
        step: between knots, in s.
        slope: λ.
        has_velocity_state: whether W is a state.
        obstacles: their number.
        rows: of their shape matrices.
    """

    order: int
    outputs: int
    intervals: int
    step: float
    slope: tuple[float, ...]
    has_velocity_state: bool
    obstacles: int
    rows: int

    @classmethod
    def of(cls, transcription: Transcription) -> Shape:
        """The shape of a transcription."""
        problem = transcription.problem
        return cls(
            order=transcription.order,
            outputs=transcription.outputs,
            intervals=transcription.intervals,
            step=transcription.step,
            slope=tuple(problem.slope.tolist()),
            has_velocity_state=transcription.has_velocity_state,
            obstacles=len(problem.obstacles),
            rows=problem.obstacles.shape.shape[1],
        )


class Variables:
    """Layout of z and the operators that read it."""

    def __init__(self, shape: Shape) -> None:
        """Lays out z; see `of` for the one of a transcription."""
        self.shape = shape
        n, m, N, h = shape.order, shape.outputs, shape.intervals, shape.step
        self.degree = n + 1
        self.blocks: dict[str, slice] = {}
        self.size = 0
        self._add("coefficients", (N + self.degree) * m)
        self._add("bandwidth", (N + 1) * m)
        self.num_states = n + 1 if shape.has_velocity_state else n
        self._add("states", (N + 1) * self.num_states * m)
        # Each separating half-plane may turn, along each tangent of its normal.
        self.tangents = shape.rows - 1
        self.num_planes = N * min(2, shape.obstacles)
        self._add("rotation", self.num_planes * self.tangents)
        self._add("slack", 1)

        self.derivatives = [
            self._kron(splines.knot_operator(N, self.degree, k, h), "coefficients")
            for k in range(n + 1)
        ]
        identity = sp.eye_array(N + 1, format="csr")
        self.bandwidth = self._kron(identity, "bandwidth")
        self.states = [self._state(j) for j in range(self.num_states)]
        self.stages = self.states[:n]
        self.error_bound = [self._cascade(k) for k in range(n)]
        if shape.has_velocity_state:
            self.error_bound[-1] = self.states[-1]
        self.local = self._local()
        self.tube_controls = self._tube_controls()

    @classmethod
    def of(cls, transcription: Transcription) -> Variables:
        """The variables of a transcription; grids that come again are kept."""
        return _variables(Shape.of(transcription))

    def _add(self, name: str, count: int) -> None:
        self.blocks[name] = slice(self.size, self.size + count)
        self.size += count

    def _state(self, index: int) -> Sparse:
        """One of the tube's states at all knots."""
        m, K = self.shape.outputs, self.shape.intervals + 1
        knots, axes = np.divmod(np.arange(K * m), m)
        columns = (knots * self.num_states + index) * m + axes
        columns = columns + self.blocks["states"].start
        return sp.csr_array(
            (np.ones(K * m), columns, np.arange(K * m + 1)), shape=(K * m, self.size)
        )

    def _kron(self, scalar: Sparse, block: str) -> Sparse:
        """A per-axis operator on one block, placed in the columns of z."""
        m = self.shape.outputs
        matrix = sp.kron(scalar, sp.eye_array(m), format="coo")
        return sp.coo_array(
            (matrix.data, (matrix.row, matrix.col + self.blocks[block].start)),
            shape=(matrix.shape[0], self.size),
        ).tocsr()

    def _cascade(self, derivative: int) -> Sparse:
        shape, slope = self.shape, np.array(self.shape.slope)
        # `cascade_bound` is linear: its coefficient of stage j is what it gives
        # for a unit stage.
        total: Sparse = None
        for j in range(derivative + 1):
            unit = np.zeros((shape.order, shape.outputs))
            unit[j] = 1.0
            factor = cascade_bound(unit, slope, derivative)
            term = sp.diags_array(np.tile(factor, shape.intervals + 1)) @ self.stages[j]
            total = term if total is None else total + term
        return total.tocsr()

    def _local(self) -> Sparse:
        """The operator whose rows are `Local.pack` at each knot."""
        n, m, K = (
            self.shape.order,
            self.shape.outputs,
            self.shape.intervals + 1,
        )
        parts = [
            *self.derivatives[: n + 1],
            self.stages[-1],
            self.bandwidth,
            *self.error_bound,
        ]
        stacked = sp.vstack(parts, format="csr")
        rows = np.arange(len(parts) * K * m).reshape(len(parts), K, m)
        return stacked[rows.swapaxes(0, 1).ravel()]

    def _tube_controls(self) -> Sparse:
        """Bézier points of Ω, rows ``(N, control_degree + 1, m)``."""
        shape, slope = self.shape, np.array(self.shape.slope)
        m, N = shape.outputs, shape.intervals
        value, third = self.stages[0], shape.step / 3
        first, last = slice(0, N * m), slice(m, (N + 1) * m)
        if shape.order > 1:
            decay = sp.diags_array(np.tile(slope, N + 1))
            rate = self.stages[1] - decay @ value
            inner = value[first] + third * rate[first], value[last] - third * rate[last]
        else:  # Ω is Φ, whose rate is no linear function; a chord serves
            step = value[last] - value[first]
            inner = value[first] + step / 3, value[last] - step / 3
        points = [value[first], *inner, value[last]]
        elevate = splines.elevation(3, max(shape.order + 1, 3))
        rows = [
            sum(e * p for e, p in zip(row, points, strict=True) if e != 0)
            for row in elevate
        ]
        stacked = sp.vstack(rows, format="csr")
        order = np.arange(len(rows) * N * m).reshape(len(rows), N, m)
        return stacked[order.swapaxes(0, 1).ravel()]


@lru_cache(maxsize=16)
def _variables(shape: Shape) -> Variables:
    return Variables(shape)
