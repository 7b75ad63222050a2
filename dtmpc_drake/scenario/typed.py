"""Values as the dataclasses of a scenario want them, wherever they come from.

Drake's reader builds typed dataclasses, too, but its errors do not say where they
are, what is built in Python does not pass it, and it knows no registered classes.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from numbers import Integral, Real
from typing import Any, Union

import numpy as np

from dtmpc_drake.errors import ScenarioError, join, require
from dtmpc_drake.registry import Registry, registry_of
from dtmpc_drake.scenario.text import Section, Text

# Without these a scenario would say too little to be anybody's intention.
_REQUIRED = {
    "": ("start", "goal", "duration"),
    "start": ("position",),
    "goal": ("position",),
}
_SCALARS: dict[Any, tuple[Any, str]] = {
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
    str: (str, "text"),
    bool: (bool, "true/false"),
}
_MANY = {float: "numbers", str: "names"}
"""What the entries of a list are called."""


def typed(schema: Any, value: Any, path: str) -> Any:
    """A copy of a value with every part of the type that its schema names.

    Args:
        schema: a type, as in the annotation of a dataclass.  One that has a registry
            stands for all of its classes.
        value: sections, lists and scalars of a file, or what was built in Python:
            dataclasses, and lists or arrays of any numbers.
        path: of the field, for errors.

    Raises:
        ScenarioError: if any part is of another type, missing or unknown, or a number
            that is not finite.
    """
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (Union, types.UnionType):
        options = [a for a in args if a is not type(None)]
        if value is None and len(options) < len(args):
            return None
        return typed(_fitting(options, value, path), value, path)
    elif origin is list and args:
        items = value.tolist() if isinstance(value, np.ndarray) else value
        if not isinstance(items, (list, tuple)):
            raise ScenarioError(path, value, "a list")
        return [typed(args[0], v, f"{path}[{i}]") for i, v in enumerate(items)]
    elif origin is dict and args:
        if not isinstance(value, Mapping):
            raise ScenarioError(path, value, "a mapping of names to values")
        _refuse_tag(value, path)
        return {
            typed(str, k, path): typed(args[1], v, join(path, str(k)))
            for k, v in value.items()
        }
    elif (registry := registry_of(schema)) is not None:
        return _registered(registry, value, path)
    elif dataclasses.is_dataclass(schema):
        _refuse_tag(value, path)
        return _filled(schema, value, path)
    elif schema in _SCALARS:
        return _scalar(schema, value, path)
    known = "float, int, str, bool, list[...], dict[str, ...], or a dataclass of these"
    raise ScenarioError(path, schema, f"annotated as {known}, or some of them | None")


def _fitting(options: list[Any], value: Any, path: str) -> Any:
    """The one of some types that a value is meant to be: a number, a list, a matrix."""
    if len(options) == 1:
        return options[0]
    by_depth = {_depth(option): option for option in options}
    option = by_depth.get(_depth_of(value))
    if option is None or (option is bool and not isinstance(value, bool)):
        known = " or ".join(_called(by_depth[depth]) for depth in sorted(by_depth))
        raise ScenarioError(path, value, known)
    return option


def _called(schema: Any) -> str:
    """What one of these types is called, by how deep its lists are nested."""
    entry = schema
    while typing.get_origin(entry) is list:
        (entry,) = typing.get_args(entry)
    each = f"a list of {_MANY.get(entry, 'entries')}"
    return (_SCALARS[entry][1], each, "a matrix: a list of its rows")[_depth(schema)]


def _depth(schema: Any) -> int:
    """How deep lists are nested in a type."""
    nested = typing.get_origin(schema) is list
    return 1 + _depth(typing.get_args(schema)[0]) if nested else 0


def _depth_of(value: Any) -> int:
    """The same of a value."""
    if isinstance(value, np.ndarray):
        return value.ndim
    if not isinstance(value, (list, tuple)):
        return 0
    return 1 + (_depth_of(value[0]) if len(value) else 0)


def is_writable(cls: type) -> bool:
    """Whether a file can hold objects of a class: whether it is a dataclass itself."""
    return "__dataclass_fields__" in vars(cls)


def _scalar(schema: Any, value: Any, path: str) -> Any:
    if schema is float and isinstance(value, Text):
        with suppress(ValueError):
            value = float(value)
    kind, name = _SCALARS[schema]
    if not isinstance(value, kind) or (isinstance(value, bool) and schema is not bool):
        raise ScenarioError(path, value, name)
    try:
        result = schema(value)
    except OverflowError:
        raise ScenarioError(path, value, "a finite number") from None
    if schema is float:
        require(path, value, math.isfinite(result), "a finite number")
    return result


def _refuse_tag(value: Any, path: str) -> None:
    if isinstance(value, Section) and value.tag is not None:
        raise ScenarioError(path or "scenario", value.tag, "without a tag")


def _registered(registry: Registry[Any], value: Any, path: str) -> Any:
    """An object of a registered class."""
    known = [cls for cls in registry if is_writable(cls)]
    names = ", ".join(f"!{cls.__name__}" for cls in known)
    if isinstance(value, Section):
        if value.tag is None and not known:
            raise ScenarioError(path, dict(value), "left out: no class is registered")
        tag = f"!{known[0].__name__}" if value.tag is None else value.tag
        cls = registry.kind(tag.removeprefix("!"))
        if not tag.startswith("!") or cls not in known:
            raise ScenarioError(path, tag, f"one of {names}")
        return _filled(cls, value, path)
    if isinstance(value, (str, Real, list)):
        raise ScenarioError(path, value, f"one of {names}, with its fields")
    registry.require(path, value)
    # Of others nobody knows the fields.
    return _filled(type(value), value, path) if is_writable(type(value)) else value


def _filled(schema: Any, value: Any, path: str) -> Any:
    """A dataclass, from a section of a file or from another one."""
    fields = _fields(schema)
    if isinstance(value, schema):
        given = {name: getattr(value, name) for name in fields}
    elif isinstance(value, Section):
        _check_names(schema, value, path)
        given = value
    else:
        raise ScenarioError(path or "scenario", value, "a mapping of fields")
    values = {k: typed(fields[k], v, join(path, k)) for k, v in given.items()}
    try:
        return schema(**values)
    except (TypeError, ValueError) as error:  # of a class of a user's own
        raise ScenarioError(path, f"!{schema.__name__}", f"valid ({error})") from error


def _check_names(schema: Any, section: Section, path: str) -> None:
    """Refuses fields of a file that are unknown or missing."""
    fields = _fields(schema)
    for name, item in section.items():
        if name not in fields:
            allowed = ", ".join(fields) or "empty"
            raise ScenarioError(
                join(path, name), item, f"left out; the fields here are {allowed}"
            )
    for name in (*_REQUIRED.get(path, ()), *_required(schema)):
        if name not in section:
            raise ScenarioError(join(path, name), None, "given: it is missing")


@lru_cache
def _fields(schema: Any) -> dict[str, Any]:
    """The types of a dataclass' fields by their names."""
    hints = typing.get_type_hints(schema)
    return {f.name: hints[f.name] for f in dataclasses.fields(schema) if f.init}


@lru_cache
def _required(schema: Any) -> tuple[str, ...]:
    """Fields without a default, and those that the class says are required."""
    own = [
        field.name
        for field in dataclasses.fields(schema)
        if field.init
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    return (*own, *getattr(schema, "required", ()))
