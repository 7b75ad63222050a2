"""Values as the dataclasses of a scenario want them, wherever they come from.

Drake's reader builds typed dataclasses, too, but its errors do not say where they
are, and what is built in Python does not pass it.
"""

from __future__ import annotations

import copy
import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from numbers import Integral, Real
from typing import Any, Union

import numpy as np

from dtmpc_drake.obstacles.base import KINDS, Obstacle
from dtmpc_drake.scenario.error import ScenarioError, join, require
from dtmpc_drake.scenario.text import Section, Text

# Without these a scenario would say too little to be anybody's intention.
_REQUIRED = {
    "": ("start", "goal", "duration"),
    "start": ("position",),
    "goal": ("position",),
}
_SCALARS = {
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
    str: (str, "text"),
    bool: (bool, "true/false"),
}


def typed(schema: Any, value: Any, path: str) -> Any:
    """A copy of a value with every part of the type that its schema names.

    Args:
        schema: a type, as in the annotation of a dataclass.
        value: sections, lists and scalars of a file, or what was built in Python:
            dataclasses, and lists or arrays of any numbers.
        path: of the field, for errors.

    Raises:
        ScenarioError: if any part is of another type, missing or unknown.
    """
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (Union, types.UnionType):
        options = [a for a in args if a is not type(None)]
        if value is None and len(options) < len(args):
            return None
        if len(options) > 1:
            return _one_of(options, value, path)
        return typed(options[0], value, path)
    if origin is list:
        items = value.tolist() if isinstance(value, np.ndarray) else value
        if not isinstance(items, (list, tuple)):
            raise ScenarioError(path, value, "a list")
        return [typed(args[0], v, f"{path}[{i}]") for i, v in enumerate(items)]
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ScenarioError(path, value, "a mapping of names to values")
        _refuse_tag(value, path)
        return {
            typed(str, k, path): typed(args[1], v, join(path, str(k)))
            for k, v in value.items()
        }
    if schema is Obstacle:
        return _one_of(KINDS, value, path)
    if dataclasses.is_dataclass(schema):
        _refuse_tag(value, path)
        return _filled(schema, value, path)
    if schema is float and isinstance(value, Text):
        with suppress(ValueError):
            value = float(value)
    kind, name = _SCALARS[schema]
    if not isinstance(value, kind) or (isinstance(value, bool) and schema is not bool):
        raise ScenarioError(path, value, name)
    try:
        return schema(value)
    except OverflowError:
        raise ScenarioError(path, value, "a finite number") from None


def require_kind(field: str, value: Any, kinds: Sequence[type]) -> None:
    """Refuses what is of none of some classes, a subclass included.

    Nobody could tell what a class that is not known here means.

    Raises:
        ScenarioError: that names the class.
    """
    names = ", ".join(kind.__name__ for kind in kinds)
    known = type(value) in kinds
    require(field, type(value).__name__, known, f"one of {names}")


def _refuse_tag(value: Any, path: str) -> None:
    if isinstance(value, Section) and value.tag is not None:
        raise ScenarioError(path or "scenario", value.tag, "without a tag")


def _one_of(options: list[Any], value: Any, path: str) -> Any:
    names = ", ".join(f"!{o.__name__}" for o in options)
    if isinstance(value, Section):
        tag = value.tag or f"!{options[0].__name__}"
        for option in options:
            if tag == f"!{option.__name__}":
                return _filled(option, value, path)
        raise ScenarioError(path, tag, f"one of {names}")
    if isinstance(value, (str, Real, list)):
        raise ScenarioError(path, value, f"one of {names}, with its fields")
    require_kind(path, value, options)
    return _filled(type(value), value, path)


def _filled(schema: Any, value: Any, path: str) -> Any:
    """A dataclass, from a section of a file or from another one."""
    fields = _fields(schema)
    if isinstance(value, schema):
        result = copy.copy(value)
        for name, kind in fields.items():
            setattr(result, name, typed(kind, getattr(value, name), join(path, name)))
        return result
    if not isinstance(value, Section):
        raise ScenarioError(path or "scenario", value, "a mapping of fields")
    for name, item in value.items():
        if name not in fields:
            allowed = ", ".join(fields) or "empty"
            raise ScenarioError(
                join(path, name), item, f"left out; the fields here are {allowed}"
            )
    required = _REQUIRED.get(path, ())
    if path.startswith("obstacles["):
        required = tuple(
            f.name
            for f in dataclasses.fields(schema)
            if f.name in ("center", "radius") or f.default is f.default_factory
        )
    for name in required:
        if name not in value:
            raise ScenarioError(join(path, name), None, "given: it is missing")
    return schema(**{k: typed(fields[k], v, join(path, k)) for k, v in value.items()})


@lru_cache
def _fields(schema: Any) -> dict[str, Any]:
    """The types of a dataclass' fields by their names."""
    hints = typing.get_type_hints(schema)
    return {field.name: hints[field.name] for field in dataclasses.fields(schema)}
