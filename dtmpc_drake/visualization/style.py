"""Colours that the replay and the figures share."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, LinearSegmentedColormap

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.records.plan import Plan

ColorBy = Literal["bandwidth", "speed"]

# Okabe and Ito's palette, which colour-blind readers can tell apart.
BLUE = "#0072B2"
VERMILION = "#D55E00"
PALE_BLUE = "#E4F0F8"
GREEN = "#009E73"
PALE_GREEN = "#8FD3BF"
PALER_GREEN = "#E2F4EE"
ORANGE = "#E69F00"
PURPLE = "#CC79A7"
SKY_BLUE = "#56B4E9"
BLACK = "#1A1A1A"
GREY = "#9A9A9A"
EDGE = "#555555"
LIGHT_GREY = "#D9D9D9"
FENCE = "#6B6FA8"  # of bounds of the position in a scene
GHOST = "#7FA8C9"  # of obstacles that are not known yet

# Clouds of flights: the last one is drawn on top, in the blue of a single one.
_CLOUDS = (SKY_BLUE, PURPLE, ORANGE, GREEN, BLUE)

# Both are perceptually uniform: dark blue to yellow, and dark to peach.
_RANGES = {"bandwidth": ("viridis", 0.12, 1.0), "speed": ("magma", 0.08, 0.86)}

_LEAST_SAMPLES = 100  # of a drawn plan: fewer would show corners
_MOST_SAMPLES = 4000  # more than any picture shows


def drawn_period(plan: Plan, period: float) -> float:
    """The period to draw a plan with, in s: a longer one where the plan is long.

    Else the time and the size of a picture would grow with a flight without end.  A
    shorter one where it is short.
    """
    duration = plan.end_time - plan.start_time
    return float(np.clip(period, duration / _MOST_SAMPLES, duration / _LEAST_SAMPLES))


@dataclasses.dataclass(frozen=True, eq=False)
class Coloring:
    """What the colours along a plan mean.

    Attributes:
        label: of the colour bar, without the unit.
        unit: of the values, for a reader.
        values: one per sample, ``(K,)``.
        low, high: values at both ends of the colour map.
        colormap: from `low` to `high`.
    """

    label: str
    unit: str
    values: FloatArray
    low: float
    high: float
    colormap: Colormap

    @classmethod
    def along(
        cls,
        plan: Plan,
        time: FloatArray,
        color_by: ColorBy,
        among: Sequence[Plan] = (),
        speed_unit: str = "",
    ) -> Coloring:
        """The colours of a plan at some times.

        Args:
            plan: gives the values and, over its whole length, their range.
            time: ``(K,)``, in s.
            color_by: ``bandwidth``, the largest α over the outputs, or
                ``speed``, the norm of the reference's velocity.
            among: plans whose ranges count instead of this one's.
            speed_unit: for a reader, as from `Model.derivative_unit`.

        Raises:
            ValueError: if `color_by` is neither.
        """
        if color_by == "bandwidth":
            label = "bandwidth"
            label += " (largest over the axes)" if plan.num_outputs > 1 else ""
            unit = "rad/s"
        elif color_by == "speed":
            label, unit = "speed", speed_unit
        else:
            raise ValueError(f"color_by: got {color_by!r}, not bandwidth or speed")
        every = np.concatenate(
            [cls._values(p, p.sample_times(), color_by) for p in among or (plan,)]
        )
        low, high = float(every.min()), float(every.max())
        if high - low < 0.02 * max(abs(high), 1e-3):  # constant: a bar needs a width
            margin = 0.1 * max(abs(high), 1e-3)
            low, high = low - margin, high + margin
        name, start, end = _RANGES[color_by]
        colors = colormaps[name](np.linspace(start, end, 256))
        return cls(
            label=label,
            unit=unit,
            values=cls._values(plan, time, color_by),
            low=low,
            high=high,
            colormap=LinearSegmentedColormap.from_list(f"dtmpc_{name}", colors),
        )

    @staticmethod
    def _values(plan: Plan, time: FloatArray, color_by: ColorBy) -> FloatArray:
        if color_by == "bandwidth":
            return plan.bandwidth(time).max(axis=-1)
        return np.linalg.norm(plan.derivatives(time)[:, 1], axis=-1)

    def rgb(self, values: FloatArray) -> FloatArray:
        """Colours of the values, shape ``(..., 3)``, in [0, 1]."""
        share = (values - self.low) / (self.high - self.low)
        return self.colormap(share)[..., :3]


def cloud_colors(names: Iterable[str]) -> dict[str, str]:
    """A colour for every cloud of flights, by its name."""
    listed = list(names)
    first = len(_CLOUDS) - len(listed)
    return {n: _CLOUDS[i % len(_CLOUDS)] for i, n in enumerate(listed, start=first)}
