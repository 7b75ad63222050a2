"""The figure of how much of the tube many flights of one plan use."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.visualization.style import BLACK, BLUE, LIGHT_GREY, VERMILION

_BANDS = ((0.0, 1.0, 0.18), (0.05, 0.95, 0.3), (0.25, 0.75, 0.5))


def plot_quantiles(*, time: FloatArray, ratios: Mapping[str, FloatArray]) -> Figure:
    """How much of the position tube many flights use over time, and at most.

    One row a disturbance.  Left: |ỹ|/Ω over time as bands of quantiles.  Right:
    how many flights used which largest share.

    Args:
        time: ``(K,)``, in s.
        ratios: |ỹ|/Ω of the worst axis by the name of the disturbance,
            ``(flights, K)``.

    Returns:
        A figure, to be saved with ``savefig``.
    """
    rows = len(ratios)
    figure = Figure(figsize=(10.0, 0.8 + 1.7 * rows), dpi=150, layout="constrained")
    axes = figure.subplots(
        rows, 2, squeeze=False, sharex="col", sharey=True, width_ratios=(4, 1)
    )
    bins = np.linspace(0.0, 1.0, 51)
    for (left, right), (name, every) in zip(axes, ratios.items(), strict=True):
        ratio = every[np.isfinite(every).all(axis=1)]
        lost = len(every) - len(ratio)
        if not len(ratio):  # nothing to draw but the tube
            ratio = np.zeros((1, len(time)))
        for low, high, alpha in _BANDS:
            edges = np.quantile(ratio, (low, high), axis=0)
            label = "all" if high == 1 else f"{low:.0%} to {high:.0%}"
            left.fill_between(
                time, *edges, fc=BLUE, alpha=alpha, ec="none", label=label
            )
        left.plot(
            time, np.median(ratio, axis=0), color=BLACK, lw=1.0, label="median flight"
        )
        largest = ratio.max(axis=1)
        right.hist(largest, bins=bins, orientation="horizontal", color=BLUE, alpha=0.7)
        note = f"largest {largest.max():.3f}"
        right.text(0.95, 0.06, note, transform=right.transAxes, ha="right", fontsize=9)
        for panel in (left, right):
            panel.axhline(1.0, color=VERMILION, lw=1.2, label="the tube")
            panel.grid(True, color=LIGHT_GREY, lw=0.5)
            panel.set_axisbelow(True)
            panel.set_ylim(0.0, max(1.08, 1.05 * float(largest.max())))
        title = f"{name}: {len(every)} flights"
        title += f", of which {lost} not finite and not drawn" if lost else ""
        left.set_title(title, fontsize=10, loc="left")
        left.set_ylabel("|ỹ| / Ω")
    axes[0, 1].set_title("largest of each flight", fontsize=10)
    axes[-1, 0].set_xlabel("time (s)")
    axes[-1, 0].set_xlim(time[0], time[-1])
    axes[-1, 1].set_xlabel("flights")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False
    )
    return figure
