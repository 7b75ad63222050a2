"""A plan from above or from the side: what several figures draw, and how."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.path import Path

from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles.drawing import Outline
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures.cloud import Cloud
from dtmpc_drake.visualization.geometry import (
    NEAR,
    near_bounds,
    obstacle_sections,
    position_bounds,
    swept_boxes,
)
from dtmpc_drake.visualization.style import (
    BLACK,
    EDGE,
    GREEN,
    GREY,
    PALE_BLUE,
    ColorBy,
    Coloring,
    drawn_period,
)

PERIOD = 0.025
"""Between two samples of a drawn plan, in s."""
WIDTH = 10.0
"""Of a figure, in inches."""

_GOAL: dict[str, Any] = {
    "ls": "",
    "marker": "X",
    "ms": 8.0,
    "color": GREEN,
    "mec": "white",
    "zorder": 5,
}

_OUT_OF_BOUNDS: dict[str, Any] = {"fc": "white", "ec": GREY, "hatch": "////", "lw": 0}

_MANY_DIGITS = 1e5

Window = tuple[FloatArray, FloatArray]
"""Two corners of what is seen, ``(2,)`` each, in m."""


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """What a look along an axis shows, in any window.

    Attributes:
        samples: of the plan, as from `Plan.sample`.
        order: the outputs along the horizontal and the vertical axis.
        labels: of both axes.
        coloring: of the samples.
        obstacles: sections (None if passed before or behind) and silhouettes, as they
            are seen.
        bounds: the least and the largest position, ``(m, 2)``; infinite for none.
        clouds: flights, in the vehicle's own order of axes.
        goal: its position, ``(m,)``, where a plan need not end there.
    """

    samples: dict[str, FloatArray]
    order: tuple[int, int]
    labels: tuple[str, str]
    coloring: Coloring
    obstacles: list[tuple[Outline | None, Outline]]
    bounds: FloatArray
    clouds: Sequence[Cloud] = ()
    goal: FloatArray | None = None

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        plan: Plan,
        color_by: ColorBy,
        *,
        among: Sequence[Plan] = (),
        clouds: Sequence[Cloud] = (),
        period: float = PERIOD,
    ) -> View:
        """A look from above at a plan with two outputs or more.

        The longer one of the first two goes to the right.

        Args:
            scenario: gives the obstacles, bounds, and a goal that is soft.
            plan: a plan, or an infeasible attempt.
            color_by: ``bandwidth`` or ``speed``.
            among: plans that share their colours.
            clouds: flights to draw with it.
            period: between two samples, in s, at least.
        """
        samples = plan.sample(drawn_period(plan, period))
        position, tube = samples["position"], samples["position_tube"]
        along_y = np.ptp(position[:, 1]) >= np.ptp(position[:, 0])
        order = (1, 0) if along_y else (0, 1)
        model = scenario.model
        return cls(
            samples=samples,
            order=order,
            labels=_labels(model, order),
            coloring=Coloring.along(
                plan, samples["time"], color_by, among, model.derivative_unit(1)
            ),
            obstacles=obstacle_sections(scenario.obstacle_set(), position, tube, order),
            bounds=position_bounds(scenario.limits.position, plan.num_outputs),
            clouds=clouds,
            goal=scenario.goal_state()[0] if scenario.goal_is_soft else None,
        )

    def from_the_side(self, scenario: Scenario) -> View:
        """The same with the third output upwards, of a plan that has one."""
        order = (self.order[0], 2)
        position, tube = self.samples["position"], self.samples["position_tube"]
        obstacles = scenario.obstacle_set()
        return dataclasses.replace(
            self,
            order=order,
            labels=_labels(scenario.model, order),
            obstacles=obstacle_sections(obstacles, position, tube, order),
        )

    @property
    def center(self) -> FloatArray:
        """y* as it is seen, ``(K, 2)``."""
        return self.seen(self.samples["position"])

    @property
    def half(self) -> FloatArray:
        """Ω as it is seen, ``(K, 2)``."""
        return self.seen(self.samples["position_tube"])

    def seen(self, points: FloatArray) -> FloatArray:
        """The coordinates of points that are seen, ``(..., m)`` to ``(..., 2)``."""
        return points[..., list(self.order)]

    def window(self) -> Window:
        """Corners that hold the tube, and the obstacles and fences beside it."""
        low, high = self.center - self.half, self.center + self.half
        low, high = low.min(axis=0), high.max(axis=0)
        reach = NEAR * float((high - low).max())
        fences = near_bounds(self.bounds[list(self.order)], low, high).T
        near = np.isfinite(fences)
        first, last = np.where(near, fences, [low, high])
        lows, highs = [low, first], [high, last]
        # There is no need to see far beyond them.
        least, largest = np.where(near, fences, [low - reach, high + reach])
        for _, silhouette in self.obstacles:
            outline = silhouette.outline()
            a, b = outline.min(axis=0), outline.max(axis=0)
            if (a < high + reach).all() and (b > low - reach).all():
                lows.append(np.maximum(a, least))
                highs.append(np.minimum(b, largest))
        if self.goal is not None:
            goal = self.seen(self.goal)
            if (goal < high + reach).all() and (goal > low - reach).all():
                lows.append(goal)
                highs.append(goal)
        low, high = np.min(lows, axis=0), np.max(highs, axis=0)
        margin = 0.012 * float((high - low).max())
        return low - margin, high + margin

    def fences(self, window: Window) -> list[tuple[int, float, float]]:
        """The bounds in a window: axis of the picture, where it is, which way is out.

        Args:
            window: that is seen.
        """
        bounds = self.bounds[list(self.order)]
        return [
            (axis, float(bounds[axis, side]), out)
            for axis in (0, 1)
            for side, out in enumerate((-1.0, 1.0))
            if window[0][axis] < bounds[axis, side] < window[1][axis]
        ]

    def draw(
        self,
        axes: Axes,
        window: Window,
        *,
        line_width: float = 2.6,
        colored: bool = True,
    ) -> None:
        """Draws the part in a window; the reference in colours or black."""
        low, high = window
        alike = 4e-5 * float((high - low).max())
        for section, silhouette in self.obstacles:
            outline = silhouette.outline()
            filled = outline if section is None else section.outline()
            same = filled.shape == outline.shape and np.allclose(
                filled, outline, atol=alike
            )
            if section is None or not same:
                axes.add_patch(
                    Polygon(outline, fill=False, ec=GREY, lw=0.8, ls="--", zorder=3)
                )
            if section is not None:
                axes.add_patch(Polygon(filled, fc=GREY, ec="none", zorder=1))
                # Above the tube, so that an attempt shows what it cuts into.
                axes.add_patch(Polygon(filled, fill=False, ec=EDGE, lw=0.8, zorder=3))
        for axis, bound, out in self.fences(window):
            far = bound + out * float(high[axis] - low[axis])
            draw_fence(axes, axis, bound, far)
        # Stroke all boxes, then fill them: what stays black is the outline.
        boxes = swept_boxes(self.center - self.half, self.center + self.half)
        tube = Path.make_compound_path_from_polys(boxes)
        # (As artists, since patches would be measured, curve by curve.)
        axes.add_artist(
            PathPatch(tube, fc="none", ec=BLACK, lw=2.0, joinstyle="round", zorder=2)
        )
        axes.add_artist(PathPatch(tube, fc=PALE_BLUE, ec="none", zorder=2.1))
        for cloud in self.clouds:
            cloud.draw(axes, self.seen(cloud.paths), line_width)
        many = any(len(cloud.paths) > 1 for cloud in self.clouds)
        width = 0.2 * line_width if many else line_width
        if colored:
            colored_line(axes, self.center, self.coloring, width)
        else:
            axes.plot(*self.center.T, color=BLACK, lw=width, zorder=4)
        if self.goal is not None:
            axes.plot(*self.seen(self.goal), **_GOAL)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        if self.order == (1, 0):
            axes.invert_yaxis()  # with y to the right, x points down
        if np.abs(window).max() >= _MANY_DIGITS:  # else labels would meet
            axes.locator_params(axis="x", nbins=5)
        axes.set_xlabel(self.labels[0])
        axes.set_ylabel(self.labels[1])


def _labels(model: Model, order: tuple[int, int]) -> tuple[str, str]:
    units, names = model.output_units, model.output_names
    right, up = (f"{names[i]} ({units[i]})" for i in order)
    return right, up


def joint_window(views: Iterable[View]) -> Window:
    """Corners that hold what each of several views shows."""
    lows, highs = zip(*(view.window() for view in views), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def colored_line(
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


def add_color_bar(figure: Figure, axes: Sequence[Axes], coloring: Coloring) -> None:
    """What the colours mean, beside all of these axes."""
    mappable = ScalarMappable(Normalize(coloring.low, coloring.high), coloring.colormap)
    bar = figure.colorbar(mappable, ax=list(axes), pad=0.015, fraction=0.03, aspect=28)
    bar.set_label(f"{coloring.label} ({coloring.unit})", fontsize=9)


def draw_fence(axes: Axes, axis: int, bound: float, far: float) -> None:
    """A bound of the position, and what is out of bounds.

    Args:
        axes: to draw into.
        axis: of the picture, 0 or 1.
        bound: where it is along that axis.
        far: how far it is hatched.
    """
    span = axes.axhspan if axis else axes.axvspan
    line = axes.axhline if axis else axes.axvline
    span(*sorted((bound, far)), zorder=0.5, **_OUT_OF_BOUNDS)
    line(bound, color=EDGE, lw=1.2, zorder=3)


def fence_handles(fenced: bool) -> list[Artist]:
    """For the legend of a picture in which bounds of the position may be seen."""
    return [Patch(label="out of bounds", **_OUT_OF_BOUNDS)] if fenced else []


def add_legend(
    figure: Figure,
    scenario: Scenario,
    coloring: Coloring,
    clouds: Sequence[Cloud] = (),
    *,
    fenced: bool = False,
) -> None:
    """What a plan, its tube, flights and obstacles look like, above the figure."""
    handles: list[Artist] = [
        Line2D([], [], color=coloring.colormap(0.55), lw=3.8, label="reference"),
        Patch(fc=PALE_BLUE, ec=BLACK, label="tube"),
    ]
    handles += [cloud.handle() for cloud in clouds]
    if scenario.obstacles:
        handles.append(Patch(fc=GREY, ec=EDGE, label="obstacle"))
    handles += fence_handles(fenced)
    if scenario.goal_is_soft:
        handles.append(Line2D([], [], label="soft goal", **_GOAL))
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
