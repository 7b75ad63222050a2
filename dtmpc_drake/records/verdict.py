"""What a flight kept and what it broke: its running extremes, and a verdict on them.

Eight quantities are watched, `QUANTITIES`.  Each has a largest value that is kept
(`largest_kept`).  A value that is no number is as bad as can be: it counts as infinite,
so that nothing which comes later can hide it, and that a flight is not finite is a
quantity of its own, besides.

When a flight is looked at is up to who calls `look`: `TubeMonitor` does so at every
step of the integrator and at the end.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.records.replan import Replan
from dtmpc_drake.scenario import Limits

QUANTITIES = (
    "not_finite",
    "layer",
    "position",
    "velocity",
    "obstacles",
    "input",
    "speed",
    "other_limits",
)
"""Whether anything is no number (0 or 1), |s|/Φ, |ỹ|/Ω and |dỹ/dt|/W of the worst axis,
how deep the plant is inside the nearest obstacle (m), ‖u‖, the largest speed along an
axis (m/s; plus what the axis' own limit is below the largest one), and what is missing
of `Limits.others`.  Of those that break at
the same instant the first one here is named."""
FINITE, LAYER, POSITION, VELOCITY, OBSTACLES, INPUT, SPEED, OTHERS = range(
    len(QUANTITIES)
)

COLUMNS = ("worst", "worst_time", "worst_where", "first", "since", "first_where")
"""What a record has of each quantity: its largest value, when that was (s) and where
(index of the axis, obstacle or limit); and the same of the first value that broke the
limit, at an infinite time if none did."""
WORST, WORST_TIME, WORST_WHERE, FIRST, SINCE, FIRST_WHERE = range(len(COLUMNS))

DECIDED = ("certified", "kept", "braking", "given")
"""Statuses of a planner in flight with which something safe is flown."""


def largest_kept(limits: Limits) -> Array:
    """The largest value of every quantity that keeps its limit, ``(8,)``."""
    # To touch an obstacle is to hit it.
    apart = np.nextafter(0.0, -1.0)
    return np.array([0.0, 1.0, 1.0, 1.0, apart, limits.input, limits.fastest, 0.0])


def empty_record(lead: tuple[int, ...] = ()) -> Array:
    """The record of flights that nobody has looked at yet, ``(6, *lead, 8)``."""
    record = np.zeros((len(COLUMNS), *lead, len(QUANTITIES)))
    record[WORST] = -np.inf
    record[SINCE] = np.inf
    return record


def look(
    record: Array,
    *,
    time: float,
    value: Array,
    where: Callable[[], Array],
    largest: Array,
) -> Array:
    """The record after one more look.

    Args:
        record: of the looks before, ``(6, ..., 8)``.
        time: of this look, in s.
        value: of every quantity, ``(..., 8)``; what is no number is infinite.
        where: gives the axis or obstacle of each, ``(..., 8)``; called only if
            anything is worse than before.
        largest: from `largest_kept`, ``(8,)``.

    Returns:
        A new record, or the same one if nothing is worse than before.
    """
    worse = ~(value <= record[WORST])
    if not worse.any():
        return record
    value, place = np.where(np.isnan(value), np.inf, value), where()
    after = record.copy()
    _write(after, WORST, (value, time, place), worse)
    # A limit that breaks for the first time does so with the worst value so far.
    breaks = worse & (value > largest)
    if breaks.any():
        _write(after, FIRST, (value, time, place), breaks & np.isinf(record[SINCE]))
    return after


def _write(record: Array, column: int, entries: tuple[Any, ...], chosen: Array) -> None:
    """Writes columns that follow each other, where `chosen`, ``(..., 8)``, is true."""
    for i, entry in enumerate(entries, start=column):
        np.copyto(record[i], entry, where=chosen)


def broken(record: Array) -> Array:
    """Which quantities ever broke their limit, ``(..., 8)``.

    What nobody has looked at is not known to be kept, and counts as broken.
    """
    unseen = np.isneginf(record[WORST, ..., FINITE])[..., None]
    return unseen | ~np.isinf(record[SINCE])


def extremes(record: Array) -> dict[str, float]:
    """The worst of one flight or of several, by name.

    Ratios and limits are infinite where anything was no number, and the clearance
    is minus infinity then.

    Args:
        record: ``(6, ..., 8)``.
    """
    worst = record[WORST].reshape(-1, len(QUANTITIES)).max(axis=0)
    return {
        "worst_layer_ratio": float(worst[LAYER]),
        "worst_position_ratio": float(worst[POSITION]),
        "worst_velocity_ratio": float(worst[VELOCITY]),
        "smallest_clearance": -float(worst[OBSTACLES]),
        "largest_input": float(worst[INPUT]),
        "largest_speed": float(worst[SPEED]),
    }


@dataclasses.dataclass(frozen=True)
class Breach:
    """Something that a flight broke.

    Attributes:
        what: one of `QUANTITIES`, or ``decision``.
        time: when it broke first, in s.
        where: the axis or obstacle; empty if there is none to name.
        excess: by how much the limit was exceeded at most, in its unit; infinite
            where that is no number.
        message: all this in words.
    """

    what: str
    time: float
    where: str
    excess: float
    message: str

    def __str__(self) -> str:
        """The message."""
        return self.message


_WORDS = {
    "layer": ("the boundary layer was left", "|s|/Φ", "axis"),
    "position": ("the position tube was left", "|ỹ|/Ω", "axis"),
    "velocity": ("the velocity tube was left", "|dỹ/dt|/W", "axis"),
    "obstacles": ("an obstacle was hit", "clearance", "obstacle"),
    "input": ("the input limit was broken", "‖u‖", ""),
    "speed": ("the speed limit was broken", "speed", "axis"),
}


def breaches(
    record: Array,
    *,
    limits: Limits,
    model: Model,
    replans: Sequence[Replan] = (),
) -> tuple[Breach, ...]:
    """Everything that one flight broke, what broke first before all else.

    Args:
        record: of the flight, ``(6, 8)``.
        limits: that it had to keep.
        model: of the vehicle, for names and units.
        replans: the decisions on the way; one that left nothing safe to fly is
            a breach, too.
    """
    if np.isneginf(record[WORST, FINITE]):
        return (Breach("not_finite", 0.0, "", np.inf, "nobody looked at the flight"),)
    largest = largest_kept(limits)
    found = [
        _breach(record[:, k], float(largest[k]), QUANTITIES[k], model, limits)
        for k in np.flatnonzero(broken(record))
    ]
    found += [
        Breach(
            "decision",
            one.hand_over,
            "",
            np.inf,
            f"no safe decision at t = {one.hand_over:.3f} s"
            f" ({one.status}: {one.message})",
        )
        for one in replans
        if one.status not in DECIDED
    ]
    return tuple(sorted(found, key=lambda breach: breach.time))


def _breach(
    column: Array, largest: float, what: str, model: Model, limits: Limits
) -> Breach:
    """One quantity in words; `column` is what the record has of it, ``(6,)``."""
    since, first, worst = (float(column[c]) for c in (SINCE, FIRST, WORST))
    if what == "not_finite":
        message = f"the flight is not finite from t = {since:.3f} s on"
        return Breach(what, since, "", np.inf, message)
    if what == "other_limits":
        title = limits.others[int(column[FIRST_WHERE])].title
        message = f"the {title} was broken at t = {since:.3f} s: {first:.5g} too much"
        return Breach(what, since, title, worst, message)
    words, symbol, place = _WORDS[what]
    index, unit, where, sign = int(column[FIRST_WHERE]), "", "", 1.0
    if place:
        where = model.axes[index] if place == "axis" else f"{place} {index}"
    if what == "speed":
        # Axes with lower limits are watched as if theirs were the largest.
        slower = largest - limits.speed_along(index)
        largest, first, worst = (x - slower for x in (largest, first, worst))
        unit = f" {model.units_of(1)[index]}"
    elif what == "input":
        unit = f" {model.input_unit}"
    limit = f"at most {largest:g}{unit}"
    if what == "obstacles":
        unit, sign = f" {model.length_unit}", -1.0
        limit = f"more than 0{unit}"
    message = (
        f"{words} at t = {since:.3f} s{f' ({where})' if where else ''}:"
        f" {symbol} {sign * first:.5g}{unit}, but it must be {limit}"
    )
    if worst > first:
        later = float(column[WORST_TIME])
        message += f"; {sign * worst:.5g}{unit} at t = {later:.3f} s"
    return Breach(what, since, where, worst - largest, message)


def in_one_line(found: Sequence[Breach]) -> str:
    """What broke first, and the names of what broke after it, each once."""
    first, *others = found
    also: dict[str, str] = {}
    for one in others:
        if one.what != first.what:
            also.setdefault(one.what, f"{one.what} (t = {one.time:.3f} s)")
    return str(first) + (f"; then {', '.join(also.values())}" if also else "")
