"""Limits as linear rows around an iterate, each relaxed by the shared slack.

Every block of rows knows its margins at the iterate that it was made for, and at any
other one: that is what steps are corrected by.
"""

from __future__ import annotations

import abc

import numpy as np

from dtmpc_drake.limits import ConvexLimit, SampledLimit
from dtmpc_drake.limits.base import Facets
from dtmpc_drake.method.tightening import deviation_bound
from dtmpc_drake.numerics.arrays import Array, second_differences
from dtmpc_drake.numerics.differences import differences
from dtmpc_drake.obstacles.separation import Halfplanes
from dtmpc_drake.planning.iterate import Iterate, Local
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.scp.sensitivity import kinks
from dtmpc_drake.planning.transcription import Transcription

BETWEEN = 4
"""Parts of a piece at whose ends sampled limits are looked at, too."""
NOTHING = np.zeros((0, 1)), np.zeros((0, 1), dtype=int)


class Block(abc.ABC):
    """Rows of one limit.

    Attributes:
        values: slopes of the margins by the entries of z that they read, ``(R, E)``.
        columns: which entries these are, ``(R, E)``.
        margin: at the iterate, in units that weigh like metres, ``(R,)``.
        backoff: how much the program asks for beyond the limit.
    """

    values: Array
    columns: Array
    margin: Array
    backoff: float

    @abc.abstractmethod
    def margins(self, reached: Iterate, planes: Halfplanes) -> Array:
        """Of the same rows at another iterate, ``(R,)``.

        Args:
            reached: the other iterate.
            planes: the half-planes as a step has turned them.
        """


class SampledRows(Block):
    """A limit on a function of one instant, at nodes where it is near.

    The reference there is linear in its coefficients, and the tube's states answer as
    `transitions` says, between whose times they are interpolated.

    Args:
        transcription: of the problem.
        variables: of the program.
        number: of the limit among `Problem.sampled`.
        iterate: to linearise around.
        sensitivity: from `transitions`.
        secant: half-width of the differences along the state.
    """

    def __init__(
        self,
        transcription: Transcription,
        variables: Variables,
        number: int,
        iterate: Iterate,
        sensitivity: Array,
        secant: float,
    ) -> None:
        tr, options = transcription, transcription.options
        self._tr, self._number = tr, number
        self._limit: SampledLimit = tr.problem.sampled[number]
        self.backoff = options.backoff
        if self._limit.between_knots:
            self.backoff = options.sampled_backoff
        self._width = iterate.sampled[number].shape[1]
        self.nodes = self._chosen(iterate.sampled[number])
        self._facets = Facets(np.zeros(0, dtype=int), np.zeros((0, tr.outputs)))
        self.values, self.columns = NOTHING
        if len(self.nodes):
            local = tr.local_at(iterate, self.nodes)
            # Between knots y*^(n) is linear, and what is convex in it not the largest.
            facets = self._limit.facets(tr.problem.law, local.instant)
            at_knots = self.nodes[facets.place] % tr.tube_steps == 0
            self._facets = Facets(facets.place[at_knots], facets.direction[at_knots])
            self.values, self.columns = self._rows(
                variables, local, sensitivity, secant
            )
        self.margin = self._margins(iterate)

    def _chosen(self, margin: Array) -> Array:
        """Knots, some fixed nodes between them, and where the limit is nearest."""
        tr, options = self._tr, self._tr.options
        if not self._limit.between_knots:
            return np.arange(0, len(margin), tr.tube_steps)
        room = (margin / self._limit.size).min(axis=1)
        inner = tr.pieces(room)[:, 1:-1]
        chosen = np.zeros(inner.shape, dtype=bool)
        chosen[:, tr.tube_steps // BETWEEN - 1 :: tr.tube_steps // BETWEEN] = True
        chosen[np.arange(len(inner)), inner.argmin(axis=1)] = True
        piece, node = np.nonzero(chosen & (inner < tr.reach * options.between_reach))
        at_knots = room[:: tr.tube_steps]
        knots = np.flatnonzero(at_knots < tr.reach * options.sampled_reach)
        both = [knots * tr.tube_steps, piece * tr.tube_steps + node + 1]
        return np.concatenate(both)

    def _rows(
        self, v: Variables, local: Local, sensitivity: Array, secant: float
    ) -> tuple[Array, Array]:
        """Values and columns."""
        tr, limit, law = self._tr, self._limit, self._tr.problem.law
        n, m = tr.order, tr.outputs
        slopes = limit.slopes(law, local.instant, secant, self._facets)
        # Rows of all columns at each node, and then the facets.
        count = len(slopes.by_gain) - len(self._facets.place)
        each = np.arange(len(self.nodes)).repeat(count // len(self.nodes))
        each = np.concatenate([each, self._facets.place])
        slope = Local.unpack(
            by_local(
                local.at(each),
                slopes.by_model,
                slopes.by_highest,
                slopes.by_gain,
            ),
            n,
            m,
        )
        nodes = self.nodes[each]
        rows = np.concatenate([slope.state, slope.highest[:, None]], axis=1)
        basis = tr.basis_at(nodes)
        if tr.chains.are_alike:
            coefficients = np.einsum("pkc,pkm->pcm", basis[..., 0], rows)
        else:
            coefficients = np.einsum("pkcm,pkm->pcm", basis, rows)
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

            def used(x: Array) -> Array:
                return -limit.margins(law, Local.unpack(x, n, m).instant)

            second = second_differences(used, local.pack(), secant, v.kinked)
            second = kinks(second, secant)
            second = np.concatenate(
                [second.reshape(count, -1), second[self._facets.place, 0]]
            )
            values[:, of_moves] -= _at_ends(second, later)
        return values / limit.scale, v.piece_columns[piece]

    def _margins(self, at: Iterate) -> Array:
        limit, tr = self._limit, self._tr
        margins = at.sampled[self._number][self.nodes]
        rows = margins.ravel()
        if len(self._facets.place):
            instant = tr.local_at(at, self.nodes).instant
            law = tr.problem.law
            own = limit.facet_margins(law, instant, margins, self._facets)
            rows = np.concatenate([rows, own])
        return rows / limit.scale

    def margins(self, reached: Iterate, planes: Halfplanes) -> Array:
        """See base class."""
        return self._margins(reached)

    def prices(self, multipliers: Array) -> Array:
        """Multipliers of these rows, but for facets, at all nodes, ``(M + 1, q)``."""
        tr = self._tr
        own = multipliers[: len(multipliers) - len(self._facets.place)]
        found = np.zeros((tr.intervals * tr.tube_steps + 1, self._width))
        found[self.nodes] = own.reshape(-1, self._width) / self._limit.scale
        return found


class ConvexRows(Block):
    """A limit on a derivative of the output, at control points where it is near.

    Args:
        transcription: of the problem.
        variables: of the program.
        number: of the limit among `Problem.convex`.
        iterate: to linearise around.
        near: which control points, as `Iterate.convex`.
        secant: half-width of the differences along the state.
    """

    def __init__(
        self,
        transcription: Transcription,
        variables: Variables,
        number: int,
        iterate: Iterate,
        near: Array,
        secant: float,
    ) -> None:
        tr, v = transcription, variables
        self.backoff, self._number = tr.options.backoff, number
        limit: ConvexLimit = tr.problem.convex[number]
        basis = tr.convex_bases[number]
        self._which = piece, control, column = np.nonzero(near)
        value, spread = (each[piece, control] for each in iterate.convex_points[number])
        row = np.arange(len(piece))
        by_value, by_spread = (
            each[row, column] for each in limit.left_slopes(value, spread)
        )
        rate = _deviation_rows(tr, v, iterate, limit.derivative, secant)
        reads = np.concatenate([v.knot_columns, v.move_columns], axis=1)
        own = basis[control] * by_value[:, None]
        weight = (control / (basis.shape[0] - 1))[:, None]
        wide = by_spread[:, None]
        before, after = (wide @ rate[piece])[:, 0], (wide @ rate[piece + 1])[:, 0]
        values = [
            own.reshape(len(own), basis.shape[1] * tr.outputs),
            (1 - weight) * before,
            weight * after,
        ]
        columns = [v.coefficient_columns(piece, basis.shape[1])]
        columns += [reads[piece], reads[piece + 1]]
        self.values = np.concatenate(values, axis=1)
        self.columns = np.concatenate(columns, axis=1)
        self.margin = iterate.convex[number][self._which]

    def margins(self, reached: Iterate, planes: Halfplanes) -> Array:
        """See base class."""
        return reached.convex[self._number][self._which]


class PlaneRows(Block):
    """Every half-plane at every control point.

    Args:
        transcription: of the problem.
        variables: of the program.
        iterate: to linearise around.
        planes: of the iterate, those that enter.
    """

    def __init__(
        self,
        transcription: Transcription,
        variables: Variables,
        iterate: Iterate,
        planes: Halfplanes,
    ) -> None:
        tr, v = transcription, variables
        self.backoff, self.margin = tr.options.backoff, planes.margin.ravel()
        controls, count, _ = tr.position_basis.shape
        P, m = len(planes), tr.outputs
        position = tr.position_basis * planes.by_position()[:, None, None]
        tube = np.einsum("pcj,cjs->pcs", planes.by_tube, v.tube_matrix)
        # Turning the normal along its tangents, for as many planes as have room.
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
        self.values = values.reshape(P * controls, values.shape[2])
        self.columns = columns.repeat(controls, axis=0)

    def margins(self, reached: Iterate, planes: Halfplanes) -> Array:
        """See base class."""
        return planes.at(reached.controls, reached.tube_controls).margin.ravel()


def _deviation_rows(
    tr: Transcription, v: Variables, iterate: Iterate, derivative: int, secant: float
) -> Array:
    """The bound of ``|ỹ^(k)|`` by the entries of z that a knot and its moves read.

    Returns:
        ``(K, m, C + q)``.
    """
    n, m, K = tr.order, tr.outputs, tr.intervals + 1
    width, moves = v.local_matrix.shape[1], len(v.kinked)
    if derivative not in tr.chains.orders:
        rows = np.zeros((m, width + moves))
        rows[:, width - v.num_states * m : width] = v.bounds[derivative]
        return np.broadcast_to(rows, (K, *rows.shape))
    law, local = tr.problem.law, iterate.local

    def used(x: Array) -> Array:
        return deviation_bound(law, Local.unpack(x, n, m).instant, derivative)

    def of_box(state: Array, radius: Array) -> Array:
        whole = local.instant
        moved = type(whole)(state, whole.highest, whole.gain, radius)
        return deviation_bound(law, moved, derivative)

    by_model = differences(of_box, local.state, local.error_bound, secant).slope
    eye = np.broadcast_to(np.eye(m), (K, m, m))
    by = by_local(local, by_model, np.zeros_like(eye), eye) @ v.local_matrix
    second = np.zeros((K, m, moves))
    if moves:
        flat = local.pack()
        second = kinks(second_differences(used, flat, secant, v.kinked), secant)
    return np.concatenate([by, second], axis=2)


def by_local(local: Local, by_model: Array, by_highest: Array, by_gain: Array) -> Array:
    """From slopes by x* and R, y*^(n) and κ = αΦ to slopes by `Local.pack`.

    Args:
        local: at K instants.
        by_model: ``(K, ..., 2 n m)``.
        by_highest: ``(K, ..., m)``.
        by_gain: ``(K, ..., m)``.

    Returns:
        ``(K, ..., L)``.
    """
    split, lead = local.state[0].size, (1,) * (by_gain.ndim - 2)
    shape = (len(by_gain), *lead, by_gain.shape[-1])
    return np.concatenate(
        [
            by_model[..., :split],
            by_highest,
            by_gain * local.bandwidth.reshape(shape),
            by_gain * local.layer.reshape(shape),
            by_model[..., split:],
        ],
        axis=-1,
    )


def _at_ends(values: Array, later: Array) -> Array:
    """Slopes by what is linear along a piece, as slopes by its ends, ``(p, 2 q)``."""
    later = later[:, None]
    return np.concatenate([(1 - later) * values, later * values], axis=1)
