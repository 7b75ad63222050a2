"""Classes of one kind by their names: what a scenario may be made of.

A registry belongs to an abstract class, such as `Model`, and its decorator is what
makes a class known:

    @register_model
    @dataclasses.dataclass
    class Hovercraft(Model):
        friction: float = 0.4

A scenario then takes objects of that class, and a file names it by a tag,
``!Hovercraft {friction: 0.5}``.  What is not registered is refused by name, a subclass
of a registered class included: nothing is ever taken for another kind.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any, Generic, TypeVar

from dtmpc_drake.errors import require

T = TypeVar("T")
Class = TypeVar("Class", bound=type)

_MARK = "_dtmpc_registered"
"""What a registered class carries itself.  A class that was pickled by its value, as
those of a notebook are, is known by it wherever it arrives."""
_OF: dict[type, Registry[Any]] = {}


class Registry(Generic[T]):
    """The registered classes of one kind, in the order in which they came.

    Args:
        base: the abstract class of them all.
        decorator: its name, for messages: what a user's class lacks.
    """

    def __init__(self, base: type, decorator: str) -> None:
        self.base, self.decorator = base, decorator
        self._classes: dict[str, Any] = {}
        _OF[base] = self

    def register(self, cls: Class) -> Class:
        """Makes a class known; to be used as a decorator, above all others.

        The same class once more, from a module or a cell that runs again, takes the
        place of the first.

        Raises:
            TypeError: if it is no class of this kind, or lacks something.
            ValueError: if there is another one of its name.
        """
        name, what = cls.__name__, f"@{self.decorator}: {cls.__name__}"
        if not issubclass(cls, self.base):
            raise TypeError(f"{what} is no subclass of {self.base.__name__}")
        if inspect.isabstract(cls):
            lacks = ", ".join(sorted(getattr(cls, "__abstractmethods__", ())))
            raise TypeError(f"{what} lacks {lacks}")
        other = self._classes.get(name)
        if other is not None and _origin(other) != _origin(cls):
            here, there = ".".join(_origin(cls)), ".".join(_origin(other))
            raise ValueError(f"{what} of {here} has the name of {there}")
        # Of its own: what equals that of a base would not be pickled.
        setattr(cls, _MARK, ".".join(_origin(cls)))
        self._classes[name] = cls
        return cls

    @property
    def names(self) -> tuple[str, ...]:
        """Of all classes; a section of a file without a tag is of the first."""
        return tuple(self._classes)

    def kind(self, name: str) -> type[T] | None:
        """The class of a name, or None."""
        return self._classes.get(name)

    def __iter__(self) -> Iterator[type[T]]:
        """All classes."""
        return iter(self._classes.values())

    def require(self, field: str, value: object) -> None:
        """Refuses what is of no registered class, a subclass of one included.

        Raises:
            ScenarioError: that names the class.
        """
        cls = type(value)
        known = isinstance(value, self.base) and is_registered(cls)
        allowed = f"one of {', '.join(self.names)}, or registered with @"
        require(field, cls.__name__, known, f"{allowed}{self.decorator}")


def is_registered(cls: type) -> bool:
    """Whether a class itself is registered, of whatever kind."""
    return _MARK in vars(cls)


def registry_of(base: object) -> Registry[Any] | None:
    """The registry of an abstract class; None of anything else."""
    return _OF.get(base) if isinstance(base, type) else None


def _origin(cls: type) -> tuple[str, str]:
    return cls.__module__, cls.__qualname__
