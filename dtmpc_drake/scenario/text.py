"""From any file or text to plain values, with bounds on all that may grow.

A scenario is small, and what reads it must not be led into gigabytes or an endless
recursion: the size of the file, the depth and the number of its values are bounded,
the latter also where an alias repeats them.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from dtmpc_drake.scenario.error import ScenarioError, join, require

MOST_BYTES = 256 * 1024
"""Of a file: five thousand obstacles."""
MOST_VALUES = 50_000
"""Values, names, lists and mappings in a file, each as often as it is repeated."""
DEEPEST = 16
"""Values within each other; a scenario has six."""
LONGEST = 1000
"""Characters of one value."""

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
        loader = _Loader(text)
        node = loader.get_single_node()
    except ScenarioError:
        raise
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}" if mark else "the file"
        what = getattr(error, "problem", None) or getattr(error, "reason", None)
        raise ScenarioError(where, what or str(error), "valid YAML") from None
    data = loader.read(node)
    if isinstance(data, Section):
        for name in [name for name in data if name.startswith("_")]:
            del data[name]
    return data


class _Loader(yaml.SafeLoader):
    """Composes and reads nodes, but not more than a scenario can need."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._count = self._depth = 0

    @contextmanager
    def _counted(self, line: int) -> Iterator[None]:
        """Counts a node, and how deep it is, while it is worked on."""
        self._count += 1
        self._depth += 1
        where = f"line {line + 1}"
        many, most = (
            f"{self._count} values",
            f"at most {MOST_VALUES}, repeated ones too",
        )
        require(where, many, self._count <= MOST_VALUES, most)
        deep, most = f"{self._depth} values in each other", f"at most {DEEPEST}"
        require(where, deep, self._depth <= DEEPEST, most)
        yield
        self._depth -= 1

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """See base class."""
        event = self.peek_event()  # type: ignore[no-untyped-call]
        with self._counted(event.start_mark.line):
            node: yaml.Node | None = super().compose_node(parent, index)
        return node

    def read(self, node: yaml.Node | None) -> Any:
        """What a composed file says; its aliases are counted once more."""
        self._count = self._depth = 0
        return None if node is None else self._value(node, "")

    def _value(self, node: yaml.Node, path: str) -> Any:
        with self._counted(node.start_mark.line):
            if isinstance(node, yaml.MappingNode):
                return self._section(node, path)
            if isinstance(node, yaml.SequenceNode):
                plain = node.tag == f"{_YAML}seq"
                require(path or "scenario", node.tag, plain, "a list without a tag")
                return [
                    self._value(v, f"{path}[{i}]") for i, v in enumerate(node.value)
                ]
            return self._scalar(node, path)

    def _section(self, node: yaml.MappingNode, path: str) -> Section:
        section = Section()
        if node.tag != f"{_YAML}map":
            section.tag = node.tag
        for key, value in node.value:
            where = f"line {key.start_mark.line + 1}"
            plain = isinstance(key, yaml.ScalarNode)
            require(where, "a list or mapping", plain, "a name, before a colon")
            name = join(path, key.value)
            # YAML keeps the last of two fields of one name, and says nothing.
            once = key.value not in section
            require(name, f"a second one on {where}", once, "given once")
            section[key.value] = self._value(value, name)
        return section

    def _scalar(self, node: Any, path: str) -> Any:
        text, path = node.value, path or "scenario"
        short = f"at most {LONGEST} characters"
        require(path, text, len(text) <= LONGEST, short)
        kind = node.tag.removeprefix(_YAML)
        # A date is a text, too, and so are the signs that YAML itself gives a meaning.
        if kind in ("str", "timestamp", "value", "merge"):
            return Text(text)
        readers = {
            "null": self.construct_yaml_null,
            "bool": self.construct_yaml_bool,
            "int": self.construct_yaml_int,
            "float": self.construct_yaml_float,
        }
        require(path, node.tag, kind in readers, "a value without a tag")
        try:
            return readers[kind](node)
        except (ValueError, LookupError):
            raise ScenarioError(path, text, f"what its tag says: {kind}") from None
