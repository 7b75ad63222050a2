"""Flights that are drawn alike, over or under a plan."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.visualization.style import VERMILION, cloud_colors


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
