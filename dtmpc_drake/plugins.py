"""Python files of a user's own, whose classes register themselves when they run.

A scenario file never names code to load: a plugin is named on the command line, or
loaded by whoever calls this.
"""

from __future__ import annotations

import importlib.util
import sys
import zlib
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from dtmpc_drake.errors import ScenarioError

_LOADED: dict[str, ModuleType] = {}


def load_plugin(path: str | Path) -> ModuleType:
    """Runs a Python file as a module, once in a process.

    The name of the module follows from the path alone, so that other processes that
    load it, too, can be sent objects of its classes.  The ``__init__.py`` of a package
    will do as well, and may import its neighbours by relative imports.

    Args:
        path: of the file.

    Returns:
        The module, which is in `sys.modules`.

    Raises:
        ScenarioError: naming ``plugin``, if it cannot be read or run.
    """
    file = Path(path).resolve()
    if str(file) in _LOADED:
        return _LOADED[str(file)]
    if file.suffix != ".py" or not file.is_file():
        raise ScenarioError("plugin", str(path), "a Python file, *.py, that is there")
    stem = file.parent.name if file.stem == "__init__" else file.stem
    name = f"dtmpc_plugin_{stem}_{zlib.crc32(str(file).encode()):08x}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None  # it ends in .py
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        why = f"{type(error).__name__}: {error}"
        raise ScenarioError("plugin", str(path), f"one that runs ({why})") from error
    _LOADED[str(file)] = module
    return module


def load_plugins(paths: Iterable[str | Path]) -> None:
    """Loads plugins in their order; see `load_plugin`."""
    for path in paths:
        load_plugin(path)


def loaded_plugins() -> tuple[str, ...]:
    """The paths of all that are loaded, in order: what another process must load."""
    return tuple(_LOADED)
