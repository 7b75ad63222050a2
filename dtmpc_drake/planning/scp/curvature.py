"""What the programs linearise away, and give back as cost.

Two norms bend: that of y*^(n) in the input's limit, and that of the tube's box,
‖|H| Ω‖, in the obstacles' (the *size* that a half-plane must leave).  Both are convex,
so each row of a program promises too much, and where Δ varies, so that the tube may
trade one axis for another at no cost, steps promise what they do not keep.  The
remedy of sequential convex quadratic programming is the convex part of the
Lagrangian's Hessian: each norm's own, times the multiplier that its row had in the
program before (Messerer, Baumgärtner and Diehl, "Survey of sequential convex
programming and generalized Gauss-Newton methods", ESAIM: ProcS 71, 2021).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.obstacles.separation import Halfplanes
from dtmpc_drake.planning.iterate import Iterate
from dtmpc_drake.planning.layout import Variables
from dtmpc_drake.planning.transcription import Transcription

LOSS = 0.25
"""Part of what turning a half-plane loses that is priced."""


@dataclasses.dataclass(frozen=True, eq=False)
class Multipliers:
    """Prices of the limits whose rows bend.

    Attributes:
        planes: of every obstacle at every control point, ``(N, o, controls)``.
        sampled: of each of `Problem.sampled` at every node of the fine grid,
            ``(M + 1, q)``.
    """

    planes: Array
    sampled: tuple[Array, ...]

    @classmethod
    def none(cls, transcription: Transcription, iterate: Iterate) -> Multipliers:
        """Before the first program."""
        tr = transcription
        planes = tr.intervals, len(tr.problem.obstacles), tr.control_degree + 1
        sampled = tuple(np.zeros(margin.shape) for margin in iterate.sampled)
        return cls(np.zeros(planes), sampled)

    def refined(self, transcription: Transcription, iterate: Iterate) -> Multipliers:
        """The same prices, shared by the more rows of a finer grid."""
        zero = Multipliers.none(transcription, iterate)

        def shared(values: Array, count: int) -> Array:
            index = np.arange(count) * len(values) // count
            return values[index] * (len(values) / count)

        def at_nodes(values: Array, like: Array) -> Array:
            return np.concatenate([shared(values[:-1], len(like) - 1), like[:1]])

        return Multipliers(
            planes=shared(self.planes, len(zero.planes)),
            sampled=tuple(map(at_nodes, self.sampled, zero.sampled)),
        )


def sampled_curvature(
    transcription: Transcription, iterate: Iterate, multipliers: Multipliers
) -> Array:
    """Hessians of what bends in y*^(n), priced, by the coefficients of each piece.

    Returns:
        ``(N, (degree + 1) m, (degree + 1) m)``.
    """
    tr = transcription
    width = (tr.degree + 1) * tr.outputs
    result = np.zeros((tr.intervals, width, width))
    for limit, price in zip(tr.problem.sampled, multipliers.sampled, strict=True):
        nodes = np.flatnonzero(price[:-1].any(axis=1))
        if not len(nodes):
            continue
        hessian = limit.curvature(tr.local_at(iterate, nodes).instant)
        if hessian is None:
            continue
        hessian = hessian * price[nodes].sum(axis=1)[:, None, None]
        basis = tr.basis_at(nodes)[:, tr.order]
        if tr.chains.are_alike:
            basis = basis[..., 0]
            each = np.einsum("pc,pij,pd->pcidj", basis, hessian, basis, optimize=True)
        else:
            each = np.einsum("pci,pij,pdj->pcidj", basis, hessian, basis)
        np.add.at(result, nodes // tr.tube_steps, each.reshape(-1, width, width))
    return result


def tube_curvature(
    transcription: Transcription,
    iterate: Iterate,
    planes: Halfplanes,
    variables: Variables,
    multipliers: Multipliers,
) -> Array:
    """Hessians of ‖|H| Ω‖, priced, by the tube's states at both ends of each piece.

    Returns:
        ``(N, 2 S m, 2 S m)``.
    """
    tr, by = transcription, variables.tube_matrix
    result = np.zeros((tr.intervals, by.shape[2], by.shape[2]))
    # A support is linear in Ω.
    if tr.problem.tube_margin == "norm" and len(planes):
        price = multipliers.planes[planes.piece, planes.obstacle]
        p, c = np.nonzero(price)
        tube = iterate.tube_controls[planes.piece[p], c]
        hessian = planes.size_curvature(p, tube) * price[p, c, None, None]
        each = by[c].swapaxes(1, 2) @ hessian @ by[c]
        np.add.at(result, planes.piece[p], each)
    return result


def rotation_curvature(planes: Halfplanes, multipliers: Multipliers) -> Array:
    """What turning a half-plane loses to second order, priced, ``(P,)``.

    A unit normal ν that turns by θ gives up ``ν'z |θ|²/2`` of ``ν'z``.  But turning and
    moving together also gain, a product of both that is not convex and left out; so
    only a part of the loss is priced.
    """
    lost = np.maximum(planes.lost_by_turning(), 0.0)
    price = multipliers.planes[planes.piece, planes.obstacle]
    return LOSS * (price * lost).sum(axis=1)
