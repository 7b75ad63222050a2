"""What every check of a scenario says of bad input: one line."""

from __future__ import annotations

from typing import Any

import numpy as np

LONGEST = 200
"""Characters that are shown of a value or of a name."""


class ScenarioError(ValueError):
    """Bad input: one line that names the field, the value and what is allowed."""

    def __init__(self, field: str, value: Any, allowed: str) -> None:
        self.field, self.value, self.allowed = field, value, allowed
        line = f"{_short(field)}: got {show(value)}, but it must be {allowed}"
        # Names and values are anybody's: no second line, no terminal's commands.
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in line))

    def __reduce__(self) -> tuple[type, tuple[str, Any, str]]:
        """Comes back whole from another process."""
        return type(self), (self.field, self.value, self.allowed)


def require(field: str, value: Any, ok: bool, allowed: str) -> None:
    """Raises a `ScenarioError` unless a value is good."""
    if not ok:
        raise ScenarioError(field, value, allowed)


def join(path: str, name: str) -> str:
    """The path of a field in a section."""
    name = _short(name) or "''"
    return f"{path}.{name}" if path else name


def show(value: Any) -> str:
    """A value as one short text, whatever it is."""
    try:
        return _short(_text(value))
    except (ValueError, RecursionError):  # more digits than Python writes, or a loop
        return f"an endless {type(value).__name__}"


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, (list, tuple)):
        # As many entries as could be shown.
        return "[" + ", ".join(_text(v) for v in value[:LONGEST]) + "]"
    return repr(value)


def _short(text: str) -> str:
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
