"""Figures for print: the plan from above, and time histories of a flight."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import ConnectionPatch, Patch, PathPatch, Polygon, Rectangle
from matplotlib.path import Path

from dtmpc_drake.method.sliding import sliding_variable, switching_gain
from dtmpc_drake.method.tightening import input_bound, rate_bound
from dtmpc_drake.numerics.arrays import Array, FloatArray
from dtmpc_drake.obstacles.drawing import Outline, intervals
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.geometry import (
    obstacle_sections,
    swept_boxes,
)
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
    axis_name,
    cloud_colors,
    drawn_period,
    unit_of,
)

_PERIOD = 0.025  # between two samples of a drawn plan, in s
_WIDTH = 10.0  # of a figure, in inches
_INSET_RATIO = 0.42  # height by width

_PLANNED: dict[str, Any] = {"color": BLUE, "lw": 1.5}
_FLOWN: dict[str, Any] = {"color": VERMILION, "lw": 0.8, "zorder": 3}
_LIMIT: dict[str, Any] = {"color": BLACK, "lw": 1.0, "ls": "--"}
_TIGHTENED: dict[str, Any] = {"color": GREEN, "lw": 1.3, "ls": "-."}


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
    that part is a dashed outline.  A single output is drawn over time instead.

    Args:
        scenario: gives the obstacles.
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


@dataclasses.dataclass(frozen=True, eq=False)
class Cloud:
    """Flights that are drawn alike.

    Attributes:
        label: for the legend.
        color: of the lines.
        width: of the lines, relative to the reference's.
        alpha: of each line.
        paths: ``(flights, K, m)``.
    """

    label: str
    color: str
    width: float
    alpha: float
    paths: FloatArray

    @classmethod
    def of(cls, position: FloatArray | Mapping[str, FloatArray] | None) -> list[Cloud]:
        """One cloud, several, or none."""
        if position is None:
            return []
        if not isinstance(position, Mapping):
            paths = np.reshape(position, (-1, *np.shape(position)[-2:]))
            if len(paths) == 1:
                return [cls("flown", VERMILION, 0.25, 1.0, paths)]
            position = {f"{len(paths)} flights": paths}
        colors = cloud_colors(position)
        return [
            # So faint that many flights still show where most of them are.
            cls(name, colors[name], 0.15, float(np.clip(50 / len(p), 0.03, 0.5)), p)
            for name, p in position.items()
        ]

    def draw(self, axes: Axes, paths: FloatArray, line_width: float) -> None:
        """Draws its flights, seen from somewhere.

        Args:
            axes: to draw into.
            paths: the two coordinates seen, ``(flights, K, 2)``.
            line_width: of the reference, in points.
        """
        # Below the reference if they are many, else they would hide it.
        style: dict[str, Any] = {"alpha": self.alpha, "lw": self.width * line_width}
        zorder = 5 if len(paths) == 1 else 3.5
        lines = LineCollection(list(paths), color=self.color, zorder=zorder, **style)
        axes.add_collection(lines, autolim=False)

    def handle(self) -> Artist:
        """For the legend."""
        return Line2D([], [], color=self.color, lw=1.2, label=self.label)


# From above.


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """What a look from above shows, in any window.

    Attributes:
        order: the outputs along the horizontal and the vertical axis.
        center: y*, ``(K, 2)``, in that order, as all that follows.
        half: Ω, ``(K, 2)``.
        clouds: flights, in the vehicle's own order of axes.
        obstacles: sections (None if passed above or below) and silhouettes.
        coloring: of the reference.
    """

    order: tuple[int, int]
    center: FloatArray
    half: FloatArray
    clouds: Sequence[Cloud]
    obstacles: list[tuple[Outline | None, Outline]]
    coloring: Coloring

    @classmethod
    def from_above(
        cls,
        scenario: Scenario,
        samples: dict[str, FloatArray],
        coloring: Coloring,
        clouds: Sequence[Cloud] = (),
    ) -> View:
        """A look at a plan; the longer of the first two outputs goes to the right.

        Args:
            scenario: gives the obstacles; a vehicle with two outputs or more.
            samples: of the plan, as from `Plan.sample`.
            coloring: of the samples.
            clouds: flights to draw with it.
        """
        position, tube = samples["position"], samples["position_tube"]
        along_y = np.ptp(position[:, 1]) >= np.ptp(position[:, 0])
        order = (1, 0) if along_y else (0, 1)
        columns = list(order)
        return cls(
            order=order,
            center=position[:, columns],
            half=tube[:, columns],
            clouds=clouds,
            obstacles=obstacle_sections(scenario.obstacle_set(), position, tube),
            coloring=coloring,
        )

    def window(self) -> tuple[FloatArray, FloatArray]:
        """Corners that hold the tube and the obstacles beside it."""
        low = (self.center - self.half).min(axis=0)
        high = (self.center + self.half).max(axis=0)
        reach = 0.12 * float((high - low).max())
        lows, highs = [low], [high]
        for _, silhouette in self.obstacles:
            outline = silhouette.outline()[:, list(self.order)]
            a, b = outline.min(axis=0), outline.max(axis=0)
            if (a < high + reach).all() and (b > low - reach).all():
                lows.append(np.maximum(a, low - reach))
                highs.append(np.minimum(b, high + reach))
        low, high = np.min(lows, axis=0), np.max(highs, axis=0)
        margin = 0.012 * float((high - low).max())
        return low - margin, high + margin

    def draw(
        self,
        axes: Axes,
        low: FloatArray,
        high: FloatArray,
        line_width: float,
        *,
        colored: bool = True,
    ) -> None:
        """Draws the part between two corners; the reference in colours or black."""
        order = list(self.order)
        for section, silhouette in self.obstacles:
            outline = silhouette.outline()[:, order]
            filled = outline if section is None else section.outline()[:, order]
            same = filled.shape == outline.shape and np.allclose(
                filled, outline, atol=1e-3
            )
            if section is None or not same:
                axes.add_patch(
                    Polygon(outline, fill=False, ec=GREY, lw=0.8, ls="--", zorder=3)
                )
            if section is not None:
                axes.add_patch(Polygon(filled, fc=GREY, ec="none", zorder=1))
                # Above the tube, so that an attempt shows what it cuts into.
                axes.add_patch(Polygon(filled, fill=False, ec=EDGE, lw=0.8, zorder=3))
        # Stroke all boxes, then fill them: what stays black is the outline.
        boxes = swept_boxes(self.center - self.half, self.center + self.half)
        tube = Path.make_compound_path_from_polys(boxes)
        axes.add_patch(
            PathPatch(tube, fc="none", ec=BLACK, lw=2.0, joinstyle="round", zorder=2)
        )
        axes.add_patch(PathPatch(tube, fc=PALE_BLUE, ec="none", zorder=2.1))
        for cloud in self.clouds:
            cloud.draw(axes, cloud.paths[..., order], line_width)
        many = any(len(cloud.paths) > 1 for cloud in self.clouds)
        width = 0.2 * line_width if many else line_width
        if colored:
            _colored_line(axes, self.center, self.coloring, width)
        else:
            axes.plot(*self.center.T, color=BLACK, lw=width, zorder=4)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        if self.order == (1, 0):
            axes.invert_yaxis()  # with y to the right, x points down
        names = [axis_name(i, max(self.order) + 1) for i in self.order]
        axes.set_xlabel(f"{names[0]} (m)")
        axes.set_ylabel(f"{names[1]} (m)")


def _plot_from_above(
    scenario: Scenario, plan: Plan, clouds: list[Cloud], color_by: ColorBy
) -> Figure:
    samples = plan.sample(drawn_period(plan, _PERIOD))
    position, tube = samples["position"], samples["position_tube"]
    obstacles = scenario.obstacle_set()
    coloring = Coloring.along(plan, samples["time"], color_by)
    view = View.from_above(scenario, samples, coloring, clouds)
    low, high = view.window()
    width, height = high - low
    # Insets pay where the tube is thin beside the whole picture.
    span = 0.15 * width * np.array([1.0, _INSET_RATIO])
    spots = []
    if len(obstacles) and 4.0 * np.median(view.half[:, 1]) < span[1]:
        spots = _tight_spots(scenario, position, tube, span[0] / 2)

    # Rows as tall as what they show at equal scales, labels apart.
    rise = float(np.clip(0.835 * _WIDTH * height / width, 1.0, 6.0))
    below = 0.38 * _WIDTH * _INSET_RATIO if spots else 0.0
    extra = 0.9 + (0.85 if spots else 0.0)
    figure = Figure(figsize=(_WIDTH, rise + below + extra), dpi=150)
    figure.set_layout_engine("constrained")
    grid = figure.add_gridspec(
        2 if spots else 1,
        4,
        height_ratios=[rise, below] if spots else [rise],
    )
    main = figure.add_subplot(grid[0, :])
    view.draw(main, low, high, 2.6)
    panels = [main]
    for i, (title, k, clearance) in enumerate(spots):
        column = 2 * i if len(spots) > 1 else 1
        panel = figure.add_subplot(grid[1, column : column + 2])
        corner = view.center[k] - span / 2
        view.draw(panel, corner, corner + span, 3.8)
        panel.set_title(
            f"{title}: tube {abs(clearance):.3f} m "
            + ("from an obstacle" if clearance >= 0 else "inside an obstacle"),
            fontsize=9,
        )
        _connect(figure, main, panel)
        panels.append(panel)
    color_bar(figure, panels, view.coloring)
    _legend(figure, scenario, view.coloring, clouds)
    return figure


@dataclasses.dataclass(frozen=True, eq=False)
class Panel:
    """One of several plans in a figure.

    Attributes:
        title: above it.
        plan: a plan, or an infeasible attempt.
    """

    title: str
    plan: Plan


def plot_plans(
    *, scenario: Scenario, panels: Sequence[Panel], note: str = ""
) -> Figure:
    """Several plans of one scenario from above, one below the other.

    All are coloured by bandwidth on the same scale.

    Args:
        scenario: gives the obstacles.
        panels: at least one; their plans have at least two outputs.
        note: below all of them.

    Returns:
        A figure, to be saved with ``savefig``.
    """
    views = []
    for panel in panels:
        samples = panel.plan.sample(drawn_period(panel.plan, _PERIOD))
        coloring = Coloring.along(
            panel.plan, samples["time"], "bandwidth", among=[p.plan for p in panels]
        )
        views.append(View.from_above(scenario, samples, coloring))
    corners = np.array([view.window() for view in views])
    bottom, top = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    width, height = top - bottom
    rise = float(np.clip(0.835 * _WIDTH * height / width, 1.0, 4.0))
    below = 0.18 * len(note.splitlines())
    size = (_WIDTH, 0.9 + (rise + 0.4) * len(panels) + below)
    figure = Figure(figsize=size, dpi=150)
    figure.set_layout_engine("compressed")  # for axes of equal scales
    grid = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
    for axes, panel, view in zip(grid, panels, views, strict=True):
        view.draw(axes, bottom, top, 2.6)
        axes.set_title(panel.title, fontsize=10, loc="left")
        if axes is not grid[-1]:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
    figure.supxlabel(note, fontsize=9, x=0.05, ha="left")
    color_bar(figure, list(grid), coloring)
    _legend(figure, scenario, coloring, [])
    return figure


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
    scenario: Scenario, position: FloatArray, tube: FloatArray, reach: float
) -> list[tuple[str, int, float]]:
    """Where to look closer.

    Args:
        scenario: gives the obstacles, at least one.
        position: y*, ``(K, m)``.
        tube: Ω, ``(K, m)``.
        reach: how far a look goes, in m.

    Returns:
        Title, sample, and the smallest clearance of the drawn tube in reach.
    """
    obstacles = scenario.obstacle_set()
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
        near = np.flatnonzero(away & (clearance < clearance[away].min() + 0.01))
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
    samples = plan.sample(drawn_period(plan, _PERIOD))
    now, center = samples["time"], samples["position"][:, 0]
    half = samples["position_tube"][:, 0]
    coloring = Coloring.along(plan, now, color_by)
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
    _colored_line(axes, line, coloring, 0.8 if many else 3.0)
    axes.margins(x=0.02)
    bottom, top = axes.get_ylim()
    for low, high in intervals(scenario.obstacle_set()):
        axes.axhspan(low, high, fc=GREY, ec=EDGE, lw=0.8, zorder=1)
        if low < 2 * top - bottom and high > 2 * bottom - top:
            bottom, top = min(bottom, low), max(top, high)
    axes.set_ylim(bottom, top)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("position y (m)")
    color_bar(figure, [axes], coloring)
    _legend(figure, scenario, coloring, clouds)
    return figure


def _colored_line(
    axes: Axes, points: FloatArray, coloring: Coloring, width: float
) -> None:
    """The reference; a dark edge keeps its light end visible."""
    edge = min(0.8, width)
    axes.plot(*points.T, color=EDGE, lw=width + edge, zorder=4, solid_capstyle="round")
    line = LineCollection(
        np.stack([points[:-1], points[1:]], axis=1),
        cmap=coloring.colormap,
        norm=Normalize(coloring.low, coloring.high),
        lw=width,
        capstyle="round",
        zorder=4.1,
    )
    line.set_array((coloring.values[:-1] + coloring.values[1:]) / 2)
    axes.add_collection(line, autolim=False)


def color_bar(figure: Figure, axes: list[Axes], coloring: Coloring) -> None:
    """What the colours mean, beside all of these axes."""
    mappable = ScalarMappable(Normalize(coloring.low, coloring.high), coloring.colormap)
    bar = figure.colorbar(mappable, ax=axes, pad=0.015, fraction=0.03, aspect=28)
    bar.set_label(f"{coloring.label} ({coloring.unit})", fontsize=9)


def _legend(
    figure: Figure, scenario: Scenario, coloring: Coloring, clouds: list[Cloud]
) -> None:
    handles: list[Artist] = [
        Line2D([], [], color=coloring.colormap(0.55), lw=3.8, label="reference"),
        Patch(fc=PALE_BLUE, ec=BLACK, label="tube"),
    ]
    handles += [cloud.handle() for cloud in clouds]
    if scenario.obstacles:
        handles.append(Patch(fc=GREY, ec=EDGE, label="obstacle"))
    # As many in a row as the figure is wide; several rows are alike.
    rows = math.ceil(len(handles) / int(0.7 * figure.get_figwidth()))
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=math.ceil(len(handles) / rows),
        frameon=False,
        columnspacing=1.4 if len(handles) > 5 else 2.0,
        handlelength=1.4 if len(handles) > 5 else 2.0,
    )


# Over time.


def plot_histories(
    *,
    scenario: Scenario,
    plan: Plan,
    time: FloatArray | None = None,
    state: FloatArray | None = None,
    control: FloatArray | None = None,
) -> Figure:
    """Errors, bandwidth, speed and input over time, each with its bounds.

    One column for every output: tracking error inside ±Ω, sliding variable
    inside ±Φ, bandwidth α and its limits, speed and its limit before and after
    tightening (limit - W).  Below, the norm of the input: what the plan asks
    for, with the feedback's bound on top, and the limit.

    Args:
        scenario: gives limits, model and controller.
        plan: a plan, or an infeasible attempt.
        time: of a flight, ``(K,)``, in s.
        state: x of the flight, ``(K, n, m)`` or ``(K, n m)`` with the
            derivatives one after the other.
        control: u of the flight, ``(K, m)``.

    Returns:
        A figure, to be saved with ``savefig``.

    Raises:
        ValueError: if `state` or `control` comes without `time`.
    """
    if time is None and (state is not None or control is not None):
        raise ValueError("time: missing, but state or control is given")
    n, m = plan.order, plan.num_outputs
    model, slope = scenario.planning_model(), scenario.slope()
    now = plan.sample_times(drawn_period(plan, _PERIOD))
    reference, bound = plan.reference(now), plan.error_bound(now)
    layer, layer_rate = plan.layer(now)
    gain = switching_gain(
        model_error_bound=model.model_error_bound(reference[:, :n]),
        disturbance_bound=scenario.disturbance_bound(),
        reaching_rate=scenario.controller.reaching_rate,
        boundary_layer_rate=layer_rate,
    )
    speed_bound = rate_bound(
        model=model,
        reference=reference[:, :n],
        error_bound=bound,
        gain=gain,
        disturbance_bound=scenario.disturbance_bound(),
    )
    flown: Array | None = None
    if state is not None and time is not None:
        flown = np.reshape(state, (len(time), n, m))
        error = flown - plan.reference(time)[:, :n]

    rows = ["error", "sliding", "bandwidth", "speed"]
    if n == 1:
        rows.remove("sliding")  # s is the error itself
    figure = Figure(
        figsize=(max(6.0, 1.5 + 2.9 * m), 1.75 * (len(rows) + 1) + 0.5),
        dpi=150,
        layout="constrained",
    )
    grid = figure.add_gridspec(len(rows) + 1, m)
    bottom = figure.add_subplot(grid[-1, :])
    panels: dict[tuple[str, int], Axes] = {}
    for row, name in enumerate(rows):
        for i in range(m):
            panels[name, i] = figure.add_subplot(
                grid[row, i], sharex=bottom, sharey=panels.get((name, 0))
            )
            panels[name, i].tick_params(labelbottom=False, labelleft=i == 0)
    for i in range(m):
        panel = panels["error", i]
        panel.set_title(f"along {axis_name(i, m)}" if m > 1 else "", fontsize=10)
        _band(panel, now, bound[:, 0, i])
        if flown is not None:
            panel.plot(time, error[:, 0, i], **_FLOWN)
        if n > 1:
            panel = panels["sliding", i]
            _band(panel, now, layer[:, i])
            if flown is not None:
                s = sliding_variable(error, slope)
                panel.plot(time, s[:, i], **_FLOWN)
        panel = panels["bandwidth", i]
        allowed = scenario.controller.bandwidth
        if allowed.fixed is None:
            panel.axhline(allowed.min, **_LIMIT)
            panel.axhline(allowed.max, **_LIMIT)
        panel.plot(now, plan.bandwidth(now)[:, i], **_PLANNED)
        panel.set_ylim(0.0, 1.12 * allowed.max)
        panel = panels["speed", i]
        panel.axhline(scenario.limits.speed, **_LIMIT)
        panel.plot(now, scenario.limits.speed - speed_bound[:, i], **_TIGHTENED)
        panel.plot(now, np.abs(reference[:, 1, i]), **_PLANNED)
        if flown is not None and n > 1:
            panel.plot(time, np.abs(flown[:, 1, i]), **_FLOWN)
        panel.set_ylim(bottom=0.0)
    labels = {
        "error": "tracking\nerror ỹ (m)",
        "sliding": f"sliding\nvariable s ({unit_of(n - 1)})",
        "bandwidth": "bandwidth α\n(rad/s)",
        "speed": f"speed |ẏ|\n({unit_of(1)})",
    }
    if n == 1:
        labels["error"] = "tracking\nerror ỹ = s (m)"
    for name in rows:
        panels[name, 0].set_ylabel(labels[name])

    inverse = model.inverse_input_matrix(reference[:, :n])
    planned = (inverse * reference[:, n, None, :]).sum(axis=-1)
    largest = input_bound(
        model=model,
        reference=reference[:, :n],
        highest=reference[:, n],
        error_bound=bound,
        gain=gain,
        slope=slope,
    )
    bottom.axhline(scenario.limits.input, **_LIMIT)
    bottom.plot(now, largest, **_TIGHTENED)
    bottom.plot(now, np.linalg.norm(planned, axis=1), **_PLANNED)
    if control is not None and time is not None:
        norm = np.linalg.norm(np.reshape(control, (len(time), m)), axis=1)
        bottom.plot(time, norm, **_FLOWN)
    bottom.set_ylim(0.0, 1.08 * max(scenario.limits.input, float(largest.max())))
    bottom.set_ylabel(f"input norm ‖u‖\n({unit_of(n)})")
    bottom.set_xlabel("time (s)")
    bottom.set_xlim(now[0], now[-1])
    for axes in figure.axes:
        axes.grid(True, color=LIGHT_GREY, lw=0.5)
        axes.set_axisbelow(True)
    figure.align_ylabels()
    handles: list[Artist] = [
        Patch(fc=PALE_BLUE, ec=BLACK, label="tube ±Ω" + (", ±Φ" if n > 1 else "")),
        Line2D([], [], label="planned", **_PLANNED),
        Line2D([], [], label="limit", **_LIMIT),
        Line2D([], [], label="tightened speed limit; bound of ‖u‖", **_TIGHTENED),
    ]
    if flown is not None or control is not None:
        handles.insert(2, Line2D([], [], label="flown", **_FLOWN))
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles) if m > 2 else 3,
        frameon=False,
    )
    return figure


def _band(axes: Axes, time: FloatArray, half: FloatArray) -> None:
    axes.fill_between(time, -half, half, fc=PALE_BLUE, ec="none", zorder=1)
    for edge in (-half, half):
        axes.plot(time, edge, color=BLACK, lw=0.9, zorder=2)
