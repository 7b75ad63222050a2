"""The figure of several plans of one scenario, one below the other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures.view import (
    WIDTH,
    View,
    add_color_bar,
    add_legend,
    joint_window,
)


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
    among = [panel.plan for panel in panels]
    views = [View.of(scenario, plan, "bandwidth", among=among) for plan in among]
    window = joint_window(views)
    width, height = window[1] - window[0]
    rise = float(np.clip(0.835 * WIDTH * height / width, 1.0, 4.0))
    below = 0.18 * len(note.splitlines())
    size = (WIDTH, 0.9 + (rise + 0.4) * len(panels) + below)
    figure = Figure(figsize=size, dpi=150)
    figure.set_layout_engine("compressed")  # for axes of equal scales
    grid = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
    for axes, panel, view in zip(grid, panels, views, strict=True):
        view.draw(axes, window)
        axes.set_title(panel.title, fontsize=10, loc="left")
        if axes is not grid[-1]:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
    figure.supxlabel(note, fontsize=9, x=0.05, ha="left")
    add_color_bar(figure, grid, views[-1].coloring)
    fenced = bool(views[-1].fences(window))
    add_legend(figure, scenario, views[-1].coloring, fenced=fenced)
    return figure
