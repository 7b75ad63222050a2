"""The figure of one plan: from above and the side or, of one output, over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch, Rectangle

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles.drawing import intervals
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures.cloud import Cloud
from dtmpc_drake.visualization.figures.view import (
    PERIOD,
    WIDTH,
    View,
    Window,
    add_color_bar,
    add_legend,
    colored_line,
    draw_fence,
)
from dtmpc_drake.visualization.geometry import near_bounds, position_bounds
from dtmpc_drake.visualization.scale import decimals
from dtmpc_drake.visualization.style import (
    BLACK,
    EDGE,
    GREY,
    PALE_BLUE,
    ColorBy,
    Coloring,
    drawn_period,
)

_INSET_RATIO = 0.42  # height by width
_TALLEST = 6.0  # look, in inches


def plot_plan(
    *,
    scenario: Scenario,
    plan: Plan,
    position: FloatArray | Mapping[str, FloatArray] | None = None,
    time: FloatArray | None = None,
    color_by: ColorBy = "bandwidth",
) -> Figure:
    """The plan from above: coloured reference, black tube, grey obstacles.

    The tube is the exact outline of the box ±Ω that is swept along the
    reference.  Two insets show the narrowest passage and the place where the
    tube comes closest to an obstacle elsewhere.  Each obstacle is filled where
    the tube could meet it at its own altitude; where it is wider above or below,
    that part is a dashed outline.  Beyond the bounds of the position it is hatched;
    where a floor or a ceiling is near, there is a look from the side, too.  A single
    output is drawn over time instead.

    Args:
        scenario: gives the obstacles and bounds.
        plan: a plan, or an infeasible attempt.
        position: of the vehicle, ``(K, m)`` or, for several flights,
            ``(flights, K, m)``, in m; or several such clouds by name, of which
            the last is drawn on top.
        time: of the flights, ``(K,)``, in s; uniform over the plan if left out.
            Only a single output needs it.
        color_by: ``bandwidth`` or ``speed``.

    Returns:
        A figure, to be saved with ``savefig``.
    """
    clouds = Cloud.of(position)
    if plan.num_outputs == 1:
        return _plot_over_time(scenario, plan, clouds, time, color_by)
    return _plot_from_above(scenario, plan, clouds, color_by)


def _plot_from_above(
    scenario: Scenario, plan: Plan, clouds: list[Cloud], color_by: ColorBy
) -> Figure:
    view = View.of(scenario, plan, color_by, clouds=clouds)
    window = view.window()
    width = float(window[1][0] - window[0][0])
    # Insets pay where the tube is thin beside the whole picture.
    across = float(np.median(view.half[:, 1]))
    reach = min(0.15 * width, 60.0 * across) if across > 0 else 0.15 * width
    span = reach * np.array([1.0, _INSET_RATIO])
    spots = []
    if scenario.obstacles and 4.0 * across < span[1]:
        spots = _tight_spots(scenario, view, span[0] / 2)
    looks = [(view, window)]
    if _has_a_floor_near(view):
        side = view.from_the_side(scenario)
        looks.append((side, _over(window, side.window())))

    # Rows as tall as what they show at equal scales, labels apart.
    ratios = [float(high[1] - low[1]) / width for _, (low, high) in looks]
    across_the_page = min(WIDTH, _TALLEST / (0.835 * max(ratios)))
    rises = [max(0.835 * across_the_page * ratio, 1.0) for ratio in ratios]
    below = [0.38 * across_the_page * _INSET_RATIO] if spots else []
    extra = 0.9 + 0.5 * (len(looks) - 1) + 0.85 * len(below)
    figure = Figure(figsize=(across_the_page, sum(rises) + sum(below) + extra), dpi=150)
    figure.set_layout_engine("constrained" if len(looks) == 1 else "compressed")
    heights = [rises[0], *below, *rises[1:]]
    grid = figure.add_gridspec(len(heights), 4, height_ratios=heights)
    panels = []
    for row, (look, seen) in zip((0, -1), looks, strict=False):
        panels.append(figure.add_subplot(grid[row, :]))
        look.draw(panels[-1], seen)
    digits = decimals(width) + 2
    for i, (title, k, clearance) in enumerate(spots):
        column = 2 * i if len(spots) > 1 else 1
        panel = figure.add_subplot(grid[1, column : column + 2])
        corner = view.center[k] - span / 2
        view.draw(panel, (corner, corner + span), line_width=3.8)
        panel.set_title(
            f"{title}: tube {abs(clearance):.{digits}f}"
            f" {scenario.model.length_unit} "
            + ("from an obstacle" if clearance >= 0 else "inside an obstacle"),
            fontsize=9,
        )
        if i > 0:  # the one beside it has the same
            panel.set_ylabel("")
        _connect(figure, panels[0], panel)
        panels.append(panel)
    add_color_bar(figure, panels, view.coloring)
    fenced = any(look.fences(seen) for look, seen in looks)
    add_legend(figure, scenario, view.coloring, clouds, fenced=fenced)
    return figure


def _has_a_floor_near(view: View) -> bool:
    """Whether a look from the side shows a bound that one from above does not."""
    if len(view.bounds) < 3:
        return False
    center, half = view.samples["position"], view.samples["position_tube"]
    low, high = (center - half).min(axis=0), (center + half).max(axis=0)
    near = near_bounds(view.bounds[:3], low[:3], high[:3])
    return bool(np.isfinite(near[2]).any())


def _over(window: Window, other: Window) -> Window:
    """Another window as wide as the first one."""
    (low, high), (below, above) = window, other
    return np.array([low[0], below[1]]), np.array([high[0], above[1]])


def _connect(figure: Figure, main: Axes, panel: Axes) -> None:
    """Frames a panel's window in the main axes and leads down to the panel."""
    (left, right), (bottom, top) = panel.get_xlim(), panel.get_ylim()
    style: dict[str, Any] = {"ec": BLACK, "lw": 0.7, "alpha": 0.6}
    main.add_patch(
        Rectangle(
            (left, bottom), right - left, top - bottom, fill=False, zorder=6, **style
        )
    )
    for x, side in ((left, 0.0), (right, 1.0)):
        leader = ConnectionPatch(
            (x, bottom), (side, 1.0), main.transData, panel.transAxes, **style
        )
        leader.set_in_layout(False)
        figure.add_artist(leader)


def _tight_spots(
    scenario: Scenario, view: View, reach: float
) -> list[tuple[str, int, float]]:
    """Where to look closer.

    Args:
        scenario: gives the obstacles, at least one.
        view: of the plan.
        reach: how far a look goes.

    Returns:
        Title, sample, and the smallest clearance of the drawn tube in reach.
    """
    obstacles = scenario.obstacle_set()
    position, tube = view.samples["position"], view.samples["position_tube"]
    clearance = obstacles.clearance(position, tube, "support").min(axis=1)
    samples = []
    titles = ["narrowest passage", "closest elsewhere"]
    if len(obstacles) > 1:
        distance = np.sort(obstacles.clearance(position), axis=1)
        samples.append(int(distance[:, :2].sum(axis=1).argmin()))
    else:
        titles = ["closest"]
    away = np.ones(len(position), dtype=bool)
    for k in samples:
        away &= np.linalg.norm(position - position[k], axis=1) > 2 * reach
    if away.any():
        # Of several equally close places, the one in the middle.
        equally = clearance[away].min() + 0.005 * reach
        near = np.flatnonzero(away & (clearance < equally))
        samples.append(int(near[len(near) // 2]))
    spots = []
    for title, k in zip(titles, samples, strict=False):
        seen = np.linalg.norm(position - position[k], axis=1) <= reach
        spots.append((title, k, float(clearance[seen].min())))
    return spots


def _plot_over_time(
    scenario: Scenario,
    plan: Plan,
    clouds: list[Cloud],
    time: FloatArray | None,
    color_by: ColorBy,
) -> Figure:
    samples = plan.sample(drawn_period(plan, PERIOD))
    now, center = samples["time"], samples["position"][:, 0]
    half = samples["position_tube"][:, 0]
    model = scenario.model
    coloring = Coloring.along(plan, now, color_by, speed_unit=model.derivative_unit(1))
    figure = Figure(figsize=(7.0, 3.6), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.fill_between(now, center - half, center + half, fc=PALE_BLUE, ec="none")
    for edge in (center - half, center + half):
        axes.plot(now, edge, color=BLACK, lw=1.0)
    for cloud in clouds:
        paths = cloud.paths[..., 0]
        when = time
        if when is None:
            when = np.linspace(plan.start_time, plan.end_time, paths.shape[1])
        seen = np.stack([np.broadcast_to(when, paths.shape), paths], axis=-1)
        cloud.draw(axes, seen, 5.0)
    many = any(len(cloud.paths) > 1 for cloud in clouds)
    line = np.stack([now, center], axis=1)
    colored_line(axes, line, coloring, 0.8 if many else 3.0)
    axes.margins(x=0.02)
    bottom, top = axes.get_ylim()
    for low, high in intervals(scenario.obstacle_set()):
        axes.axhspan(low, high, fc=GREY, ec=EDGE, lw=0.8, zorder=1)
        if low < 2 * top - bottom and high > 2 * bottom - top:
            bottom, top = min(bottom, low), max(top, high)
    bounds = position_bounds(scenario.limits.position, 1)
    tube = np.array([np.min(center - half)]), np.array([np.max(center + half)])
    fences = near_bounds(bounds, *tube)[0]
    for fence, out in zip(fences, (-1.0, 1.0), strict=True):
        if np.isfinite(fence):
            margin = 0.04 * (top - bottom)
            bottom, top = min(bottom, fence - margin), max(top, fence + margin)
            draw_fence(axes, 1, fence, fence + out * 2 * (top - bottom))
    axes.set_ylim(bottom, top)
    axes.set_xlabel("time (s)")
    axes.set_ylabel(f"position {model.output_names[0]} ({model.output_units[0]})")
    add_color_bar(figure, [axes], coloring)
    fenced = bool(np.isfinite(fences).any())
    add_legend(figure, scenario, coloring, clouds, fenced=fenced)
    return figure
