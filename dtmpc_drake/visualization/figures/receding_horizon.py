"""The figure of a flight with more plans than one: what was known, and flown, when."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from dtmpc_drake.numerics.arrays import BoolArray, FloatArray
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.replan import Replan, flown_plan, plans_in_force
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures.cloud import Cloud
from dtmpc_drake.visualization.figures.replans import named
from dtmpc_drake.visualization.figures.view import (
    WIDTH,
    View,
    Window,
    add_color_bar,
    fence_handles,
    joint_window,
)
from dtmpc_drake.visualization.style import (
    BLACK,
    EDGE,
    GREY,
    LIGHT_GREY,
    PALE_BLUE,
    VERMILION,
    ColorBy,
)

_UNKNOWN: dict[str, Any] = {"ec": EDGE, "ls": ":", "lw": 0.9}
_PANELS = 5  # of the figure, at most


def plot_receding_horizon(
    *,
    scenario: Scenario,
    flight: Flight,
    color_by: ColorBy = "bandwidth",
) -> Figure:
    """The first plan, and each one that a new obstacle caused, from above.

    Every panel shows what was known (dark grey) and unknown (light grey) when that
    plan was made, the plan from its hand-over on, and what had been flown by then.
    The last panel shows the whole flight in all the tubes that were in force.

    Args:
        scenario: gives the obstacles; a vehicle with two outputs or more.
        flight: with all that was planned on the way, the start first.
        color_by: ``bandwidth`` or ``speed``.

    Returns:
        A figure, to be saved with ``savefig``.

    Raises:
        ValueError: if the vehicle has one output only.
    """
    if flight.position.shape[1] < 2:
        raise ValueError("flight: got one output, but a look from above needs two")
    shown = plans_in_force(flight.replans)
    chosen = [s for s in shown if s.replan.cause != "period"][: _PANELS - 1]
    plans = [s.plan for s in shown]
    views = [
        View.of(scenario, plan, color_by, among=plans)
        for plan in [*(s.plan for s in chosen), flown_plan(flight.replans)]
    ]
    window = joint_window(views)
    width, height = window[1] - window[0]
    rise = float(np.clip(0.88 * WIDTH * height / width, 1.0, 6.0))
    figure = Figure(figsize=(WIDTH, len(views) * (rise + 0.2) + 1.0), dpi=150)
    figure.set_layout_engine("compressed")
    panels: list[Axes] = []
    for i, view in enumerate(views):
        axes = figure.add_subplot(len(views), 1, i + 1)
        panels.append(axes)
        last = i == len(chosen)
        until = np.inf if last else chosen[i].start
        flown = flight.position[flight.time <= until]
        known = np.isfinite(flight.known_since) & (flight.known_since <= until)
        _draw_known(axes, view, window, known, flown)
        title = "flown, in the tubes that were in force"
        if not last:
            here = view.seen(flown[-1])
            axes.plot(*here, "o", ms=5, color=VERMILION, mec=BLACK, zorder=7)
            title = _title(chosen[i].replan)
        axes.set_title(title, fontsize=9.5, loc="left")
        if not last:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
    add_color_bar(figure, panels, views[0].coloring)
    handles: list[Artist] = [
        Line2D([], [], color=views[0].coloring.colormap(0.55), lw=3.8, label="plan"),
        Patch(fc=PALE_BLUE, ec=BLACK, label="tube"),
        Line2D([], [], color=VERMILION, lw=1.2, label="flown"),
        Patch(fc=GREY, ec=EDGE, label="known obstacle"),
        Patch(fc=LIGHT_GREY, label="not known yet", **_UNKNOWN),
        *fence_handles(bool(views[-1].fences(window))),
    ]
    figure.legend(
        handles=handles, loc="outside upper center", ncols=len(handles), frameon=False
    )
    return figure


def _draw_known(
    axes: Axes, view: View, window: Window, known: BoolArray, flown: FloatArray
) -> None:
    """Draws a plan among what was known; what was not, pale.

    Args:
        axes: to draw into.
        view: of the plan.
        window: that is shown.
        known: whether each obstacle was known, ``(o,)``.
        flown: positions up to then, ``(K, m)``.
    """
    obstacles = [o for o, k in zip(view.obstacles, known, strict=True) if k]
    with_flight = dataclasses.replace(view, obstacles=obstacles, clouds=Cloud.of(flown))
    with_flight.draw(axes, window)
    for (_, silhouette), is_known in zip(view.obstacles, known, strict=True):
        if not is_known:
            outline = silhouette.outline()
            axes.add_patch(Polygon(outline, fc=LIGHT_GREY, ec="none", zorder=1))
            # Above the tube: the plan does not know what it cuts into.
            axes.add_patch(Polygon(outline, fill=False, zorder=3, **_UNKNOWN))


def _title(replan: Replan) -> str:
    if replan.cause == "start":
        return "the first plan"
    news = f"now with {named(replan.revealed)}" if replan.revealed else "on again"
    return f"t = {replan.time:.1f} s, {news}: {replan.status}"
