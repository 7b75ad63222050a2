"""The face of the package: its names are those of the rooms, and cost nothing else."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import dtmpc_drake

FACE = Path(dtmpc_drake.__file__)


def typed_imports() -> dict[str, tuple[str, str]]:
    """What the face tells a type checker: module and name there, by name."""
    (block,) = (n for n in ast.parse(FACE.read_text("utf-8")).body if type(n) is ast.If)
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    return {
        alias.asname or alias.name: (str(statement.module), alias.name)
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }


@pytest.mark.parametrize("name", sorted({*dtmpc_drake.__all__} - {"__version__"}))
def test_a_name_is_what_a_type_checker_is_told(name: str) -> None:
    module, there = typed_imports()[name]
    told = getattr(importlib.import_module(module), there)
    assert getattr(dtmpc_drake, name) is told
    assert name in dir(dtmpc_drake)


def test_what_a_type_checker_is_told_is_public() -> None:
    assert {*typed_imports(), "__version__"} == set(dtmpc_drake.__all__)
    assert dtmpc_drake.__all__ == sorted(dtmpc_drake.__all__)


def test_a_name_that_is_none_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        dtmpc_drake.Nothing  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'nothing'"):
        exec("from dtmpc_drake import nothing")


HEAVY = ("pydrake", "matplotlib", "scipy", "networkx", "distributed", "typer")


@pytest.mark.parametrize(
    ("statement", "loaded"),
    [
        ("import dtmpc_drake", set()),
        ("from dtmpc_drake import Plan", {"scipy"}),
        ("from dtmpc_drake import plan", {"pydrake", "scipy", "networkx"}),
        ("from dtmpc_drake import plot_plan", {"pydrake", "scipy", "matplotlib"}),
        ("import dtmpc_drake.__main__", {"pydrake", "scipy", "typer"}),
    ],
)
def test_an_import_loads_what_it_needs(statement: str, loaded: set[str]) -> None:
    """In a fresh process; less than this may be loaded, but nothing else."""
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    process = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        cwd=FACE.parents[1],
    )
    modules = process.stdout.split()
    assert "dtmpc_drake" in modules
    assert set(HEAVY) & set(modules) <= loaded
