"""Figures for print: the plan from above, and time histories of a flight."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.path import Path

from dtmpc_drake.models import magnitude
from dtmpc_drake.plan import FloatArray, Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.sliding import sliding_variable
from dtmpc_drake.tightening import input_bound, rate_bound
from dtmpc_drake.visualization.geometry import obstacle_sections, swept_boxes
from dtmpc_drake.visualization.style import (
    BLACK,
    BLUE,
    GREY,
    LIGHT_GREY,
    SKY,
    VERMILION,
    ColorBy,
    Coloring,
    axis_name,
    unit_of,
)

_TUBE_PERIOD = 0.025  # between two boxes of a drawn tube, in s
_WIDTH = 10.0  # of a figure, in inches


def plot_plan(
    *,
    scenario: Scenario,
    plan: Plan,
    position: FloatArray | None = None,
    time: FloatArray | None = None,
    color_by: ColorBy = "bandwidth",
) -> Figure:
    """The plan from above: coloured reference, black tube, grey obstacles.

    The tube is the exact outline of the box ±Ω swept along the reference.  Two
    insets show where the tube comes closest to an obstacle.  Obstacles that
    reach beyond the altitude at which they are passed are dashed outlines there.
    A single output is drawn over time instead.

    Args:
        scenario: gives the obstacles.
        plan: a plan, or an infeasible attempt.
        position: of the vehicle, ``(K, m)`` or, for several flights,
            ``(flights, K, m)``, in m.
        time: of the flight, ``(K,)``, in s; needed for a single output only.
        color_by: ``bandwidth`` or ``speed``.

    Returns:
        A figure, to be saved with `Figure.savefig`.

    Raises:
        ValueError: if a single output comes with `position` but no `time`.
    """
    flights = [] if position is None else np.asarray(position)
    flights = np.reshape(flights, (-1, *np.shape(flights)[-2:])) if len(flights) else []
    if plan.num_outputs == 1:
        return _plot_over_time(scenario, plan, flights, time, color_by)
    samples = plan.sample(_TUBE_PERIOD)
    center, half = samples["position"], samples["position_tube"]
    coloring = Coloring.along(plan, samples["time"], color_by)
    # True to a look from above: with y to the right, x points down.
    along_y = np.ptp(center[:, 1]) >= np.ptp(center[:, 0])
    order = [1, 0] if along_y else [0, 1]
    scene = _Scene(scenario, plan, coloring, center, half, flights, order)

    low, high = scene.window()
    width, height = (high - low)[order]
    spots = _closest_spots(scenario, plan)
    rise = float(np.clip(0.86 * _WIDTH * height / width, 1.1, 5.0))
    inset_height = 2.0 if spots else 0.0
    figure = Figure(figsize=(_WIDTH, rise + inset_height + 1.2), layout="constrained")
    grid = figure.add_gridspec(
        2 if spots else 1,
        max(len(spots), 1),
        height_ratios=[rise, inset_height] if spots else None,
    )
    main = figure.add_subplot(grid[0, :])
    scene.draw(main, low, high)
    main.set_title(scenario.name.replace("_", " "), loc="left", fontsize=11)
    for i, (spot, gap) in enumerate(spots):
        inset = figure.add_subplot(grid[1, i])
        span = np.zeros(plan.num_outputs)
        span[order] = np.array([4.2, 2.0]) / len(spots)
        scene.draw(inset, spot - span / 2, spot + span / 2)
        inset.set_title(
            f"clearance of the tube {gap:.3f} m", loc="left", fontsize=9
        )
        corners = np.stack([spot - span / 2, spot + span / 2])[:, order]
        main.indicate_inset(
            (*corners[0], *(corners[1] - corners[0])), inset, edgecolor=BLACK
        )
    _color_bar(figure, main, coloring)
    figure.legend(
        handles=scene.handles(), loc="outside upper right", ncols=5, frameon=False
    )
    return figure
