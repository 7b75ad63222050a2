"""The figure of a search over sides: the plan, and what else was tried."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from dtmpc_drake.records.candidate import Candidate
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures.view import WIDTH, View, fence_handles
from dtmpc_drake.visualization.style import (
    BLACK,
    EDGE,
    GREY,
    LIGHT_GREY,
    PALE_BLUE,
)

_MOST = 32  # candidates that have a bar
_LABELLED = 12  # more obstacles than this have no letters below the bars
_COSTS = LinearSegmentedColormap.from_list(
    "dtmpc_costs", colormaps["plasma"](np.linspace(0.0, 0.88, 256))
)


def plot_candidates(
    *, scenario: Scenario, plan: Plan, candidates: Sequence[Candidate]
) -> Figure:
    """The chosen plan with its tube, and the alternatives faintly with their costs.

    Below, every candidate has a bar as high as its cost and in the colour of its
    line; its sides stand beneath, one letter for each numbered obstacle.  A framed
    bar is a certified plan, another one a coarse solution.  A candidate that cannot
    keep the constraints has a dotted line and no bar.

    Args:
        scenario: gives the obstacles.
        plan: that was chosen, with at least two outputs.
        candidates: in any order.

    Returns:
        A figure, to be saved with ``savefig``.

    Raises:
        ValueError: if the plan has one output only: then there are no sides.
    """
    if plan.num_outputs < 2:
        raise ValueError("plan: one output only, so there are no sides to draw")
    view = View.of(scenario, plan, "bandwidth", period=0.005)
    good = sorted((c for c in candidates if _keeps(c)), key=_cost)
    costs = np.array([_cost(c) for c in good] or [1.0])
    colors = Normalize(np.log(costs.min()), np.log(1.05 * costs.max()))
    low, high = view.window()
    lines = [view.seen(c.path) for c in candidates]
    air = 0.008 * float((high - low).max())
    low = np.min([low, *(line.min(axis=0) - air for line in lines)], axis=0)
    high = np.max([high, *(line.max(axis=0) + air for line in lines)], axis=0)
    width, height = high - low
    rise = float(np.clip(0.9 * WIDTH * height / width, 1.0, 6.0))
    figure = Figure(figsize=(WIDTH, rise + 3.3), dpi=150, layout="constrained")
    field, bars = figure.subplots(2, 1, height_ratios=[rise, 2.0])
    view.draw(field, (low, high), colored=False)
    for candidate, line in zip(candidates, lines, strict=True):
        if candidate.chosen:
            continue
        if _keeps(candidate):
            color = _COSTS(colors(np.log(_cost(candidate))))
            field.plot(*line.T, color=color, lw=1.1, alpha=0.6, zorder=3.5)
        else:
            field.plot(*line.T, color=GREY, lw=0.8, ls=":", zorder=3.4)
    for number, (_, silhouette) in enumerate(view.obstacles):
        middle = silhouette.outline().mean(axis=0)
        if (middle > low).all() and (middle < high).all():
            field.annotate(f"{number}", middle, ha="center", va="center", color="white")
    _draw_bars(bars, good[:_MOST], colors)
    left_out = len(good) - len(good[:_MOST])
    blocked = len(candidates) - len(good)
    notes = ["framed bars are certified plans, the others coarse solutions"]
    notes += [f"{left_out} more are not shown"] if left_out else []
    notes += [f"{blocked} cannot keep the constraints"] if blocked else []
    bars.set_title("; ".join(notes), fontsize=9)
    handles: list[Artist] = [
        Line2D([], [], color=BLACK, lw=2.6, label="chosen reference"),
        Patch(fc=PALE_BLUE, ec=BLACK, label="its tube"),
        Line2D([], [], color=_COSTS(0.5), lw=1.2, alpha=0.7, label="alternatives"),
        Patch(fc=GREY, ec=EDGE, label="obstacle"),
        *fence_handles(bool(view.fences((low, high)))),
    ]
    figure.legend(
        handles=handles, loc="outside upper center", ncols=len(handles), frameon=False
    )
    return figure


def _draw_bars(axes: Axes, candidates: Sequence[Candidate], colors: Normalize) -> None:
    for k, candidate in enumerate(candidates):
        cost = _cost(candidate)
        planned = candidate.status == "certified"
        axes.bar(
            k,
            cost,
            width=0.78,
            color=_COSTS(colors(np.log(cost))),
            alpha=1.0 if candidate.chosen or planned else 0.6,
            ec=BLACK if planned else "none",
            lw=2.2 if candidate.chosen else 1.0,
        )
        axes.annotate(
            f"{cost:.3g}",
            (k, cost),
            (0, 2),
            textcoords="offset points",
            ha="center",
            fontsize=7.5,
            fontweight="bold" if candidate.chosen else "normal",
        )
    axes.set_xticks(range(len(candidates)), [_label(c) for c in candidates])
    axes.tick_params(axis="x", labelsize=7.5, length=0)
    for candidate, text in zip(candidates, axes.get_xticklabels(), strict=True):
        text.set_fontweight("bold" if candidate.chosen else "normal")
        text.set_rotation(90 if len(_label(candidate)) > 3 else 0)
    axes.set_xlim(-0.7, max(len(candidates), 8) - 0.3)
    axes.margins(y=0.14)
    axes.set_ylabel("cost")
    used = set("".join(c.sides for c in candidates))
    words = [w for w in ("Left", "Right", "Above", "Below") if w[0] in used]
    if words:
        named = ", ".join(f"{w[0]} {w.lower()}" for w in words)
        axes.set_xlabel(f"side on which each obstacle is passed: {named}", fontsize=9)
    axes.grid(True, axis="y", color=LIGHT_GREY, lw=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _label(candidate: Candidate) -> str:
    sides = candidate.sides if 0 < len(candidate.sides) <= _LABELLED else ""
    special = " " in candidate.start  # the straight line, or an earlier plan
    return f"{sides}\n{candidate.start}".strip() if special else sides


def _keeps(candidate: Candidate) -> bool:
    """Whether its solution keeps the constraints, nearly at least."""
    return candidate.status in ("certified", "not_certified", "not tried", "same")


def _cost(candidate: Candidate) -> float:
    cost = candidate.coarse_cost if candidate.cost is None else candidate.cost
    return max(cost or 0.0, 1e-9)
