"""From any file or text to plain values, with bounds on all that may grow.

A scenario is small, and what reads it must not be led into gigabytes or an endless
recursion: the size of the file, the depth and the number of its values are bounded,
the latter also where an alias repeats them.
"""

from __future__ import annotations

import dataclasses
import os
import stat
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import ComposerError

from dtmpc_drake.errors import ScenarioError, join, require

MOST_BYTES = 256 * 1024
"""Of a file: five thousand obstacles."""
MOST_VALUES = 50_000
"""Values, names, lists and mappings in a file, each as often as it is repeated."""
DEEPEST = 16
"""Values within each other; a scenario has six."""
LONGEST = 1000
"""Characters of one value."""
_REST = 10_000
"""Pieces of a text that are looked at after one that is wrong."""

_YAML = "tag:yaml.org,2002:"


class Section(dict[str, Any]):
    """A mapping of a file, and its tag, such as ``!Cylinder``, if it has one."""

    tag: str | None = None


class Text(str):
    """A text of a file, perhaps a number: YAML takes 1e-3 for a text."""


def read_text(path: str | Path) -> str:
    """The text of a file, if it is a small and regular one.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is something else; the message says what.
    """
    # Others may have no end, or wait for a writer for ever.
    with open(path, "rb", opener=_open_at_once) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise ValueError("not a regular file")
        data = file.read(MOST_BYTES + 1) or b""
    if len(data) > MOST_BYTES:
        raise ValueError(f"more than {MOST_BYTES // 1024} KiB")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError("not a text file") from None


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)


def read_yaml(text: str) -> Any:
    """Sections, lists, texts, numbers, booleans and None, from YAML text.

    Fields of the outermost section that begin with an underscore are left out, as
    Drake does: they may hold what aliases repeat.

    Raises:
        ScenarioError: if it is no valid YAML, or too much of it.
    """
    size = f"{len(text)} characters"
    require("the file", size, len(text) <= MOST_BYTES, f"at most {MOST_BYTES}")
    try:
        data = _read(text)
    except ScenarioError:
        raise
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}" if mark else "the file"
        what = getattr(error, "problem", None) or getattr(error, "reason", None)
        raise ScenarioError(where, what or str(error), "valid YAML") from None
    if isinstance(data, Section):
        for name in [name for name in data if name.startswith("_")]:
            del data[name]
    return data


def _read(text: str) -> Any:
    reader = _Reader(text)
    try:
        return reader.read()
    except ScenarioError:
        # If the rest is no YAML, the text was not meant as it was taken.
        reader.finish()
        raise


@dataclasses.dataclass
class _Anchored:
    """What aliases repeat: the value, or the text of a scalar, and its size.

    While it is being read it is deeper than anything may be: nothing holds itself.
    """

    value: Any = None
    text: str | None = None
    count: int = 0
    depth: int = DEEPEST + 1


class _Reader(yaml.SafeLoader):
    """Reads a text in one pass, but not more than a scenario can need."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._count = self._depth = self._deepest = 0
        self._is_bounded = True
        self._anchored: dict[str, _Anchored] = {}

    def read(self) -> Any:
        """What the only document says; None if there is none."""
        value = None
        self._next()  # the start of the stream
        if not isinstance(self._peek(), yaml.StreamEndEvent):
            self._next()
            value = self._value("")
            self._next()
        if not isinstance(other := self._peek(), yaml.StreamEndEvent):
            problem = "but found another document"
            raise ComposerError(None, None, problem, other.start_mark)
        return value

    def finish(self) -> None:
        """Looks at what is left, unless there is too much of it."""
        for _ in range(_REST):
            if not self._is_bounded or self._peek() is None:
                break
            self._next()

    def _peek(self) -> Any:
        return self.peek_event()  # type: ignore[no-untyped-call]

    def _next(self) -> Any:
        return self.get_event()  # type: ignore[no-untyped-call]

    def _add(self, event: Any, count: int = 1, depth: int = 1) -> None:
        """Counts what is read or repeated."""
        self._count += count
        deepest = self._depth + depth
        self._deepest = max(self._deepest, deepest)
        self._is_bounded = self._count <= MOST_VALUES and deepest <= DEEPEST
        where, most = f"line {event.start_mark.line + 1}", f"at most {MOST_VALUES}"
        many = f"{self._count} values"
        require(where, many, self._count <= MOST_VALUES, f"{most}, repeated ones too")
        deep = f"{deepest} values in each other"
        require(where, deep, deepest <= DEEPEST, f"at most {DEEPEST}")

    def _alias(self, event: Any) -> _Anchored:
        """What an alias repeats."""
        if event.anchor not in self._anchored:
            problem = f"found undefined alias {event.anchor!r}"
            raise ComposerError(None, None, problem, event.start_mark)
        anchored = self._anchored[event.anchor]
        self._add(event, anchored.count, anchored.depth)
        return anchored

    def _value(self, path: str) -> Any:
        event = self._next()
        if isinstance(event, yaml.AliasEvent):
            return self._alias(event).value
        anchored = self._anchor(event)
        before, above, self._deepest = self._count, self._deepest, self._depth
        self._add(event)
        self._depth += 1
        if isinstance(event, yaml.MappingStartEvent):
            anchored.value = self._section(event, path)
        elif isinstance(event, yaml.SequenceStartEvent):
            anchored.value = self._list(event, path)
        else:
            anchored.value, anchored.text = self._scalar(event, path), event.value
        self._depth -= 1
        anchored.count = self._count - before
        anchored.depth = self._deepest - self._depth
        self._deepest = max(above, self._deepest)
        return anchored.value

    def _anchor(self, event: Any) -> _Anchored:
        """Where to keep what may be repeated."""
        if event.anchor is None:
            return _Anchored()
        if event.anchor in self._anchored:
            problem = f"found duplicate anchor {event.anchor!r}"
            raise ComposerError(None, None, problem, event.start_mark)
        anchored = self._anchored[event.anchor] = _Anchored()
        return anchored

    def _list(self, event: Any, path: str) -> list[Any]:
        plain = event.tag in (None, "!", f"{_YAML}seq")
        require(path or "scenario", event.tag, plain, "a list without a tag")
        items: list[Any] = []
        while not isinstance(self._peek(), yaml.SequenceEndEvent):
            items.append(self._value(f"{path}[{len(items)}]"))
        self._next()
        return items

    def _section(self, event: Any, path: str) -> Section:
        section = Section()
        if event.tag not in (None, "!", f"{_YAML}map"):
            section.tag = event.tag
        while not isinstance(self._peek(), yaml.MappingEndEvent):
            key, where = self._key()
            name = join(path, key)
            # YAML keeps the last of two fields of one name, and says nothing.
            require(name, f"a second one on {where}", key not in section, "given once")
            section[key] = self._value(name)
        self._next()
        return section

    def _key(self) -> tuple[str, str]:
        """A field's name, and its line."""
        event = self._next()
        where = f"line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            key = self._alias(event).text
        elif isinstance(event, yaml.ScalarEvent):
            self._add(event)
            anchored = self._anchor(event)
            key = anchored.text = event.value
            anchored.value, anchored.count, anchored.depth = Text(key), 1, 1
        else:
            key = None
        if key is None:
            raise ScenarioError(where, "a list or mapping", "a name, before a colon")
        return key, where

    def _scalar(self, event: Any, path: str) -> Any:
        text, tag, path = event.value, event.tag, path or "scenario"
        short = f"at most {LONGEST} characters"
        require(path, text, len(text) <= LONGEST, short)
        if tag in (None, "!"):
            tag = self.resolve(yaml.ScalarNode, text, event.implicit)  # type: ignore[no-untyped-call]
        kind = tag.removeprefix(_YAML)
        # A date is a text, too, and so are the signs that YAML itself gives a meaning.
        if kind in ("str", "timestamp", "value", "merge"):
            return Text(text)
        readers = {
            "null": self.construct_yaml_null,
            "bool": self.construct_yaml_bool,
            "int": self.construct_yaml_int,
            "float": self.construct_yaml_float,
        }
        require(path, tag, kind in readers, "a value without a tag")
        try:
            return readers[kind](yaml.ScalarNode(tag, text))
        except (ValueError, LookupError):
            raise ScenarioError(path, text, f"what its tag says: {kind}") from None
