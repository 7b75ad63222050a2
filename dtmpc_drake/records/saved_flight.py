"""What `Flight.load` asks of a file, field by field."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import get_args

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.records import verdict
from dtmpc_drake.records.archive import read_array
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import Replan, ReplanStatus
from dtmpc_drake.records.result import Status

_TEXTS = ("status", "replans")
_STATUSES = {*get_args(Status), *get_args(ReplanStatus), "not planned yet"}
_NUMBER = (int, float)
_REPLAN: dict[str, tuple[type, ...]] = {
    "time": _NUMBER,
    "hand_over": _NUMBER,
    "cause": (str,),
    "revealed": (list,),
    "status": (str,),
    "message": (str,),
    "iterations": (int,),
    "cost": (*_NUMBER, type(None)),
    "solve_time": _NUMBER,
}
"""What JSON makes of each field of a `Replan` but its plan."""


def check_arrays(arrays: Mapping[str, Array]) -> None:
    """Types and shapes of all arrays but the texts.

    Raises:
        ValueError: that begins with the field.
    """
    for name, array in arrays.items():
        if name not in _TEXTS and array.dtype.kind != "f":
            raise ValueError(f"{name} must hold real numbers, not {array.dtype}")
    # Whose shapes say what those of all others must be.
    for name, axes in {"time": 1, "state": 3, "known_since": 1}.items():
        shape = arrays[name].shape
        if len(shape) != axes or (not arrays[name].size and name != "known_since"):
            raise ValueError(f"{name} has shape {shape}, not {axes} axes")
    time, state = arrays["time"], arrays["state"]
    K, (n, m) = len(time), state.shape[1:]
    obstacles = len(arrays["known_since"])
    shapes = {
        "time": (K,),
        "state": (K, n, m),
        "control": (K, m),
        "reference": (K, n + 1, m),
        "disturbance": (K, m),
        "tube_ratios": (K, 3, m),
        "clearance": (K, max(1, obstacles)),
        "record": (len(verdict.COLUMNS), len(verdict.QUANTITIES)),
        "known_since": (obstacles,),
    }
    for name, shape in shapes.items():
        found = arrays[name].shape
        if found != shape:
            raise ValueError(f"{name} has shape {found}, not {shape}, at {K} times")
    if not np.isfinite(time).all() or not (np.diff(time) > 0).all():
        raise ValueError("time must be finite and increase")
    if np.isnan(arrays["known_since"]).any():
        raise ValueError("known_since must be times, infinite if never")


def _text(array: Array) -> str:
    if array.dtype.kind != "U" or array.shape:
        raise ValueError(f"must be a text, not {array.dtype} of shape {array.shape}")
    return str(array)


def read_status(array: Array) -> str:
    """What a planner says of itself.

    Raises:
        ValueError: if that is no text, or one that no planner says.
    """
    status = _text(array)
    _require_known(status)
    return status


def _require_known(status: str) -> None:
    """A planner says one word, and perhaps why."""
    if status.split(":")[0] not in _STATUSES:
        allowed = ", ".join(sorted(_STATUSES))
        raise ValueError(f"{status[:40]!r} is none of {allowed}")


def read_replans(array: Array, data: Mapping[str, Array]) -> tuple[Replan, ...]:
    """What `Flight.save` wrote of every replan, and their plans.

    Raises:
        ValueError: if anything is wrong with one of them.
    """
    plan_fields = [field.name for field in dataclasses.fields(Plan)]
    listed = json.loads(_text(array))
    if not isinstance(listed, list):
        raise ValueError("must be a list")
    replans = []
    for i, fields in enumerate(listed):
        if not isinstance(fields, dict) or set(fields) != set(_REPLAN):
            raise ValueError(f"number {i} must have the fields {', '.join(_REPLAN)}")
        for name, types in _REPLAN.items():
            value = fields[name]
            if type(value) not in types:  # a bool is no number
                kind = type(value).__name__
                raise ValueError(f"{name} of number {i} must not be of type {kind}")
            if types is _NUMBER and not np.isfinite(value):
                raise ValueError(f"{name} of number {i} must be finite")
        _require_known(fields["status"])
        if any(type(obstacle) is not int for obstacle in fields["revealed"]):
            raise ValueError(f"revealed of number {i} must be indices of obstacles")
        plan = None
        if any(f"plan{i}_{name}" in data for name in plan_fields):
            arrays = {
                name: read_array(data, f"plan{i}_{name}")
                for name in plan_fields
                # What older files do not say: their plans' outputs are alike.
                if name != "orders" or f"plan{i}_orders" in data
            }
            plan = Plan.from_arrays(arrays, where=f"plan {i}")
        fields["revealed"] = tuple(fields["revealed"])
        replans.append(Replan(**fields, plan=plan))
    return tuple(replans)
