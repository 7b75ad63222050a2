"""The figure of all times that were planned: when, why, and what came of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dtmpc_drake.records.flight import Flight
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures.view import WIDTH
from dtmpc_drake.visualization.style import BLACK, BLUE, GREEN, LIGHT_GREY, VERMILION

_STATUSES = ("certified", "kept", "braking", "unsafe")
_CAUSES = {
    "start": (BLACK, "s", "start"),
    "period": (BLUE, "o", "period"),
    "revealed": (VERMILION, "D", "new obstacle"),
    "retry": (GREEN, "^", "next try"),
}


def plot_replans(*, scenario: Scenario, flight: Flight) -> Figure:
    """When was planned, why, what came of it, and what it took.

    Args:
        scenario: gives the duration and the compute delay.
        flight: with all that was planned on the way.

    Returns:
        A figure, to be saved with ``savefig``.
    """
    replans, known_since = flight.replans, flight.known_since
    seen = [s for s in _STATUSES if any(r.status == s for r in replans)]
    others = sorted({r.status for r in replans} - set(seen))
    rows = {status: i for i, status in enumerate([*others, *reversed(seen)])}
    tall = 0.6 + 0.35 * len(rows)
    figure = Figure(figsize=(WIDTH, tall + 3.9), dpi=150, layout="constrained")
    top, middle, bottom = figure.subplots(
        3, 1, sharex=True, height_ratios=[tall, 1.6, 1.6]
    )
    time = np.array([r.time for r in replans])
    color = [_CAUSES[r.cause][0] for r in replans]
    for r in replans:
        shade, marker, _ = _CAUSES[r.cause]
        top.plot(r.time, rows[r.status], marker, color=shade, ms=6.5, mec="white")
    top.set_yticks(list(rows.values()), list(rows))
    top.set_ylim(-0.6, len(rows) - 0.4)
    for since in np.unique(known_since[(known_since > 0) & np.isfinite(known_since)]):
        label = named(np.flatnonzero(known_since == since).tolist())
        for axes in (top, middle, bottom):
            axes.axvline(since, color=VERMILION, lw=0.8, ls=":", zorder=0)
        top.annotate(
            label,
            (since, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            ha="center",
            textcoords="offset points",
            fontsize=8.5,
            color=VERMILION,
            annotation_clip=False,
        )
    width = 0.011 * scenario.duration
    middle.bar(time, [r.iterations for r in replans], width=width, color=color)
    middle.set_ylabel("convex\nprograms")
    middle.yaxis.set_major_locator(MaxNLocator(integer=True))
    bottom.bar(time, [1e3 * r.solve_time for r in replans], width=width, color=color)
    bottom.axhline(1e3 * scenario.planner.compute_delay, color=BLACK, lw=1.0, ls="--")
    bottom.set_ylabel("solve time (ms)")
    bottom.set_xlabel("time of the measurement (s)")
    bottom.set_xlim(-0.02 * scenario.duration, scenario.duration)
    for axes in (top, middle, bottom):
        axes.grid(True, axis="x" if axes is top else "both", color=LIGHT_GREY, lw=0.5)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.align_ylabels()
    handles: list[Artist] = [
        Line2D([], [], ls="", marker=marker, color=shade, label=label)
        for cause, (shade, marker, label) in _CAUSES.items()
        if any(r.cause == cause for r in replans)
    ]
    handles.append(Line2D([], [], color=BLACK, lw=1.0, ls="--", label="compute delay"))
    figure.legend(
        handles=handles, loc="outside upper center", ncols=len(handles), frameon=False
    )
    return figure


def named(obstacles: Sequence[int]) -> str:
    """The obstacles in words."""
    plural = "s" if len(obstacles) > 1 else ""
    return f"obstacle{plural} " + ", ".join(map(str, obstacles))
