"""How large the numbers of a scenario may be: the ranges of their units.

The ranges are wide, for a scenario may be written in millimetres or kilometres, and
in milliseconds or hours.  They keep sums, squares and products of all that is in a
scenario far from the ends of a floating-point number.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np

from dtmpc_drake.scenario.error import join, require

RANGES = {
    "s": (1e-6, 1e9),
    "m": (1e-9, 1e9),
    "m/s": (1e-9, 1e9),
    "m/s²": (1e-12, 1e12),  # and m/s^n
    "1/s": (1e-6, 1e6),
    "rad/s": (1e-6, 1e6),
    "rad/s²": (1e-9, 1e300),  # as good as no limit: α stays in its own range
    "1/m": (1e-9, 1e9),
    "": (1e-9, 1e9),
}
"""By unit, the smallest number that is not zero and the largest magnitude.  The
smallest is only asked of what must not be zero."""

UNITS = {
    "start.position": "m",
    "start.velocity": "m/s",
    "start.acceleration": "m/s²",
    "goal.position": "m",
    "goal.velocity": "m/s",
    "goal.acceleration": "m/s²",
    "initial_error.position": "m",
    "initial_error.velocity": "m/s",
    "initial_error.acceleration": "m/s²",
    "disturbance.bound": "m/s²",
    "disturbance.intensity": "",
    "model.drag_estimate": "1/m",
    "model.drag_error_bound": "1/m",
    "model.error_bound": "m/s²",
    "cost.input": "",
    "cost.bandwidth": "",
    "controller.bandwidth.max": "rad/s",
    "planner.compute_delay": "s",
    "planner.replan_period": "s",
    "obstacles.center": "m",
    "obstacles.shape": "",
    "obstacles.known_from": "s",
}
"""Of the fields that may be zero or negative."""


def require_positive(field: str, value: float, unit: str) -> None:
    """Requires a number that is greater than zero and in the range of its unit."""
    low, high = RANGES[unit]
    allowed = f"greater than 0 {unit}".rstrip() + f", in [{low:g}, {high:g}]"
    require(field, value, low <= value <= high, allowed)


def require_magnitudes(value: Any, path: str = "") -> None:
    """Requires of every number in a scenario that it is finite and not too large.

    Raises:
        ScenarioError: at the first one that is not.
    """
    if isinstance(value, Real):
        number: Any = value
        finite = isinstance(value, Integral) or math.isfinite(number)
        require(path, value, finite, "a finite number")
        unit = UNITS.get(re.sub(r"\[\d+\]", "", path))
        if unit is not None:
            high = RANGES[unit][1]
            allowed = f"in [{-high:g}, {high:g}] {unit}".rstrip()
            require(path, value, abs(number) <= high, allowed)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            require_magnitudes(getattr(value, field.name), join(path, field.name))
    elif isinstance(value, Mapping):
        for key, item in value.items():
            require_magnitudes(item, join(path, str(key)))
    elif isinstance(value, (list, tuple, np.ndarray)):
        for i, item in enumerate(value):
            require_magnitudes(item, f"{path}[{i}]")
