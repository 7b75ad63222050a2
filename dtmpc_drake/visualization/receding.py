"""Pictures of a flight with more plans than one: figures, and parts of a replay."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import MaxNLocator

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import Replan, flown_plan, plans_in_force
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures import Cloud, View, color_bar
from dtmpc_drake.visualization.style import (
    BLACK,
    BLUE,
    EDGE,
    GREEN,
    GREY,
    LIGHT_GREY,
    PALE_BLUE,
    VERMILION,
    ColorBy,
    Coloring,
    drawn_period,
)

_PERIOD = 0.025  # between two samples of a drawn plan, in s
_WIDTH = 10.0  # of a figure, in inches
_UNKNOWN: dict[str, Any] = {"ec": EDGE, "ls": ":", "lw": 0.9}
_PANELS = 5  # of the figure of plans, at most
_STATUSES = ("certified", "kept", "braking", "unsafe")
_CAUSES = {
    "start": (BLACK, "s", "start"),
    "period": (BLUE, "o", "period"),
    "revealed": (VERMILION, "D", "new obstacle"),
    "retry": (GREEN, "^", "next try"),
}


def plot_receding_horizon(
    *,
    scenario: Scenario,
    replans: Sequence[Replan],
    time: FloatArray,
    position: FloatArray,
    known_since: FloatArray,
    color_by: ColorBy = "bandwidth",
) -> Figure:
    """The first plan, and each one that a new obstacle caused, from above.

    Every panel shows what was known (dark grey) and unknown (light grey) when that
    plan was made, the plan from its hand-over on, and what had been flown by then.
    The last panel shows the whole flight in all the tubes that were in force.

    Args:
        scenario: gives the obstacles; a vehicle with two outputs or more.
        replans: every time that was planned, the start first.
        time: of the flight, ``(K,)``, in s.
        position: y of the vehicle, ``(K, m)``, in m.
        known_since: of each obstacle, ``(o,)``, in s.
        color_by: ``bandwidth`` or ``speed``.

    Returns:
        A figure, to be saved with ``savefig``.

    Raises:
        ValueError: if the vehicle has one output only.
    """
    if position.shape[1] < 2:
        raise ValueError("position: got one output, but a look from above needs two")
    shown = plans_in_force(replans)
    chosen = [s for s in shown if s.replan.cause != "period"][: _PANELS - 1]
    whole = flown_plan(replans)
    plans = [s.plan for s in shown]
    views = [
        _look(scenario, plan, plans, color_by)
        for plan in [*(s.plan for s in chosen), whole]
    ]
    windows = [view.window() for view in views]
    low = np.min([w[0] for w in windows], axis=0)
    high = np.max([w[1] for w in windows], axis=0)
    width, height = high - low
    rise = float(np.clip(0.88 * _WIDTH * height / width, 1.0, 6.0))
    figure = Figure(figsize=(_WIDTH, len(views) * (rise + 0.2) + 1.0), dpi=150)
    figure.set_layout_engine("compressed")
    panels: list[Axes] = []
    for i, view in enumerate(views):
        axes = figure.add_subplot(len(views), 1, i + 1)
        panels.append(axes)
        until = chosen[i].start if i < len(chosen) else np.inf
        known = np.isfinite(known_since) & (known_since <= until)
        obstacles = [o for o, k in zip(view.obstacles, known, strict=True) if k]
        flown = position[time <= until]
        dataclasses.replace(view, obstacles=obstacles, clouds=Cloud.of(flown)).draw(
            axes, low, high, 2.6
        )
        for (_, silhouette), is_known in zip(view.obstacles, known, strict=True):
            if not is_known:
                outline = silhouette.outline()[:, list(view.order)]
                axes.add_patch(Polygon(outline, fc=LIGHT_GREY, ec="none", zorder=1))
                # Above the tube: the plan does not know what it cuts into.
                axes.add_patch(Polygon(outline, fill=False, zorder=3, **_UNKNOWN))
        if i < len(chosen):
            axes.plot(
                *flown[-1, list(view.order)],
                "o",
                ms=5,
                color=VERMILION,
                mec=BLACK,
                zorder=7,
            )
        title = "flown, in the tubes that were in force"
        if i < len(chosen):
            title = _title(chosen[i].replan)
        axes.set_title(title, fontsize=9.5, loc="left")
        if i < len(views) - 1:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
    color_bar(figure, panels, views[0].coloring)
    handles: list[Artist] = [
        Line2D([], [], color=views[0].coloring.colormap(0.55), lw=3.8, label="plan"),
        Patch(fc=PALE_BLUE, ec=BLACK, label="tube"),
        Line2D([], [], color=VERMILION, lw=1.2, label="flown"),
        Patch(fc=GREY, ec=EDGE, label="known obstacle"),
        Patch(fc=LIGHT_GREY, label="not known yet", **_UNKNOWN),
    ]
    figure.legend(
        handles=handles, loc="outside upper center", ncols=len(handles), frameon=False
    )
    return figure


def _look(
    scenario: Scenario, plan: Plan, plans: Sequence[Plan], color_by: ColorBy
) -> View:
    """A plan from above, in colours that all plans share."""
    samples = plan.sample(drawn_period(plan, _PERIOD))
    coloring = Coloring.along(plan, samples["time"], color_by, among=plans)
    return View.from_above(scenario, samples, coloring)


def _title(replan: Replan) -> str:
    if replan.cause == "start":
        return "the first plan"
    news = f"now with {_named(replan.revealed)}" if replan.revealed else "on again"
    return f"t = {replan.time:.1f} s, {news}: {replan.status}"


def _named(obstacles: Sequence[int]) -> str:
    """The obstacles in words."""
    plural = "s" if len(obstacles) > 1 else ""
    return f"obstacle{plural} " + ", ".join(map(str, obstacles))


def plot_replans(
    *, scenario: Scenario, replans: Sequence[Replan], known_since: FloatArray
) -> Figure:
    """When was planned, why, what came of it, and what it took.

    Args:
        scenario: gives the duration and the compute delay.
        replans: every time that was planned.
        known_since: of each obstacle, ``(o,)``, in s.

    Returns:
        A figure, to be saved with ``savefig``.
    """
    seen = [s for s in _STATUSES if any(r.status == s for r in replans)]
    others = sorted({r.status for r in replans} - set(seen))
    rows = {status: i for i, status in enumerate([*others, *reversed(seen)])}
    tall = 0.6 + 0.35 * len(rows)
    figure = Figure(figsize=(_WIDTH, tall + 3.9), dpi=150, layout="constrained")
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
        label = _named(np.flatnonzero(known_since == since).tolist())
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
