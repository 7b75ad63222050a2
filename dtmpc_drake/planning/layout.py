"""Where everything lives in the vector of a program, for every backend.

The vector z stacks, knot-major with the axes fastest: the spline coefficients of
y*; the bandwidth at the knots; the tube's states at the knots (the cascade's
stages, aligned at Φ, and, for the comparison bound, W); bounds of how far those
coordinates of x* have moved at the knots in which the model has kinks; the rotations
of the separating half-planes; and one slack.

On a uniform grid every knot, and every piece, reads its own few entries of z in
the same way: `knot_columns` and `piece_columns` say which, and small constant
matrices say how.
"""

from __future__ import annotations

import numpy as np

from dtmpc_drake.numerics import splines
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.transcription import Transcription, hermite_controls


class Variables:
    """Layout of z for one transcription.

    Args:
        transcription: of the problem.
        planes: how many separating half-planes may turn.
        kinked: coordinates of x*, flattened, in which the model has kinks.

    Attributes:
        blocks: slices of z by name.
        size: of z.
        num_states: S, of the tube at a knot.
        knot_columns: entries that one knot reads, ``(K, C)``.
        alpha_columns: the bandwidth at a knot, ``(K, m)``.
        local_matrix: from these to `Local.pack`, ``(L, C)``.
        kinked: as given.
        move_columns: the moves' bounds at a knot, ``(K, len(kinked))``.
        state_columns: the tube's states at both ends of a piece, ``(N, 2 S m)``.
        piece_columns: what acts along a piece: the tube's states at its start, the
            bandwidth at both ends, its spline coefficients, and the moves' bounds at
            both ends, ``(N, S m + 2 m + (degree + 1) m + 2 len(kinked))``.
        piece_parts: where bandwidth, coefficients and moves are among them.
        bounds: from the states at a knot to R_0 ... R_(n-1), each ``(m, S m)``.
        tube_matrix: from the states at both ends of a piece to the Bézier
            points of Ω, ``(control_degree + 1, m, 2 S m)``.
    """

    def __init__(
        self, transcription: Transcription, *, planes: int, kinked: Array
    ) -> None:
        tr = transcription
        n, m, N = tr.order, tr.outputs, tr.intervals
        self.outputs = m
        self.num_states = n + 1 if tr.has_velocity_state else n
        # Each separating half-plane may turn, along each tangent of its normal.
        self.tangents = tr.problem.obstacles.tangents
        self.num_planes = planes
        self.blocks: dict[str, slice] = {}
        self.size = 0
        for name, count in (
            ("coefficients", (N + tr.degree) * m),
            ("bandwidth", (N + 1) * m),
            ("states", (N + 1) * self.num_states * m),
            ("moves", (N + 1) * len(kinked)),
            ("rotation", self.num_planes * self.tangents),
            ("slack", 1),
        ):
            self.blocks[name] = slice(self.size, self.size + count)
            self.size += count

        S = self.num_states * m
        knots = np.arange(N + 1)[:, None]
        self.alpha_columns = self.blocks["bandwidth"].start + knots * m + np.arange(m)
        self.knot_columns = np.concatenate(
            [
                self.coefficient_columns(np.arange(N + 1), tr.degree),
                self.alpha_columns,
                self.blocks["states"].start + knots * S + np.arange(S),
            ],
            axis=1,
        )
        self.kinked = kinked
        self.move_columns = (
            self.blocks["moves"].start + knots * len(kinked) + np.arange(len(kinked))
        )
        states = self.blocks["states"].start
        self.state_columns = states + knots[:-1] * S + np.arange(2 * S)
        parts = [
            self.state_columns[:, :S],
            self.alpha_columns[:-1],
            self.alpha_columns[1:],
            self.coefficient_columns(np.arange(N), tr.degree + 1),
            self.move_columns[:-1],
            self.move_columns[1:],
        ]
        self.piece_columns = np.concatenate(parts, axis=1)
        ends = np.cumsum([part.shape[1] for part in parts])
        self.piece_parts = (
            slice(ends[0], ends[2]),
            slice(ends[2], ends[3]),
            slice(ends[3], ends[5]),
        )
        self.bounds = bounds = tr.state_bounds
        self.local_matrix = self._local_matrix(transcription, bounds)
        self.tube_matrix = self._tube_matrix(transcription)

    def coefficient_columns(self, first: Array, count: int) -> Array:
        """The columns of `count` spline coefficients each, ``(P, count m)``."""
        return first[:, None] * self.outputs + np.arange(count * self.outputs)

    def _local_matrix(self, tr: Transcription, bounds: list[Array]) -> Array:
        n, m, S = tr.order, tr.outputs, self.num_states
        coefficients, alpha = tr.degree * m, slice(tr.degree * m, tr.degree * m + m)
        columns = self.knot_columns.shape[1]
        rows = []
        (start,) = tr.splines.values(np.zeros(1))
        for k in range(n + 1):
            row = np.zeros((m, columns))
            row[:, :coefficients] = splines.over_axes(start[k : k + 1, : tr.degree], m)
            rows.append(row)
        layer, bandwidth = np.zeros((2, m, columns))
        layer[:, alpha.stop + (n - 1) * m : alpha.stop + n * m] = np.eye(m)
        bandwidth[:, alpha] = np.eye(m)
        rows += [layer, bandwidth]
        for bound in bounds:
            row = np.zeros((m, columns))
            row[:, alpha.stop : alpha.stop + S * m] = bound
            rows.append(row)
        return np.concatenate(rows)

    def _tube_matrix(self, tr: Transcription) -> Array:
        n, m, S = tr.order, tr.outputs, self.num_states
        unit = np.eye(2 * S * m).reshape(2 * S * m, 2, S, m)
        stages = tr.chains.from_first(unit[:, :, :n])
        value = stages[:, :, 0]
        rate = stages[:, :, min(1, n - 1)] - tr.problem.law.slope * value
        # Where Ω is Φ, its rate is no linear function; a chord serves.
        chord = ((value[:, 1] - value[:, 0]) / tr.step)[:, None].repeat(2, axis=1)
        rate = np.where(tr.chains.each > 1, rate, chord)
        points = hermite_controls(value.swapaxes(0, 1), rate.swapaxes(0, 1), tr.step)[0]
        # (4, 2 S m, m) to (control_degree + 1, m, 2 S m)
        elevate = splines.elevation(3, tr.control_degree)
        return np.einsum("ij,jsm->ims", elevate, points)

    def local(self, z: Array) -> Array:
        """`Local.pack` of a deviation at every knot, ``(K, L)``."""
        return z[self.knot_columns] @ self.local_matrix.T
