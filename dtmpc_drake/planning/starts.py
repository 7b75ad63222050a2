"""Where iterations start from: a line, a path, or an earlier plan."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dtmpc_drake.numerics.arrays import Array, FloatArray
from dtmpc_drake.planning.iterate import Decisions
from dtmpc_drake.planning.transcription import Transcription


class Guess(Protocol):
    """What iterations may start from: an earlier plan, or what looks like one."""

    def reference(self, time: FloatArray | float) -> FloatArray:
        """See `Plan.reference`; only the position is looked at."""
        ...

    def bandwidth(self, time: FloatArray | float) -> FloatArray:
        """See `Plan.bandwidth`."""
        ...


def first_decisions(transcription: Transcription, guess: Guess | None) -> Decisions:
    """The straight line, or what is nearest to a guess."""
    if guess is None:
        return straight_line(transcription)
    return from_plan(transcription, guess)


def straight_line(transcription: Transcription) -> Decisions:
    """The paper's start: a straight line, at the highest bandwidth."""
    tr, p = transcription, transcription.problem
    count = tr.intervals + tr.degree
    # Greville abscissae reproduce linear functions exactly.
    greville = (np.arange(count)[:, None] - p.law.chains.each / 2) / tr.intervals
    way = np.nan_to_num(p.goal[0] - p.start[0])  # a free end stays where it is
    line = p.start[0] + greville * way
    return tr.ends.met_by(line), _highest(tr)


def along(transcription: Transcription, points: Array) -> Decisions:
    """At constant speed along a path, at the highest bandwidth.

    Args:
        transcription: of the problem.
        points: evenly spaced from start to goal, ``(any number, m)``.
    """
    tr = transcription
    share = np.linspace(0, 1, 2 * tr.intervals + 1)
    given = np.linspace(0, 1, len(points))
    wanted = np.stack([np.interp(share, given, x) for x in points.T], axis=1)
    return tr.ends.nearest_to(wanted), _highest(tr)


def from_plan(transcription: Transcription, plan: Guess) -> Decisions:
    """The decisions nearest to an earlier plan, from now to its end."""
    tr = transcription
    grid = tr.knots[0] + tr.step * np.arange(2 * tr.intervals + 1) / 2
    alpha = tr.bandwidth.feasible(plan.bandwidth(tr.knots))
    return tr.ends.nearest_to(plan.reference(grid)[:, 0]), alpha


def _highest(tr: Transcription) -> Array:
    alpha = np.broadcast_to(tr.bandwidth.high, (tr.intervals + 1, tr.outputs))
    return tr.bandwidth.feasible(alpha)
