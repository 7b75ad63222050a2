"""Plugins: run once, before the scenario is read; what is wrong is one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dtmpc_drake.models import MODELS
from dtmpc_drake.plugins import load_plugin, loaded_plugins
from dtmpc_drake.scenario import ScenarioError

pytestmark = pytest.mark.usefixtures("own_registries")

SOURCE = """
import dataclasses
from dtmpc_drake.models import DragDoubleIntegrator, register_model

@register_model
@dataclasses.dataclass
class {name}(DragDoubleIntegrator):
    pass
"""
SCENARIO = (
    "model: !Glider {}\n"
    "start: {position: [0, 0, 0]}\n"
    "goal: {position: [0, 5, 0]}\n"
    "duration: 10\n"
)


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "dtmpc_drake", *arguments],
        capture_output=True,
        text=True,
    )


def test_a_plugin_is_a_module_that_runs_once(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(SOURCE.format(name="Once"))
    module = load_plugin(file)
    assert sys.modules[module.__name__] is module
    assert MODELS.kind("Once") is module.Once
    assert load_plugin(str(file)) is module
    assert str(file) in loaded_plugins()


def test_two_plugins_may_have_files_of_one_name(tmp_path: Path) -> None:
    files = [tmp_path / folder / "mine.py" for folder in ("a", "b")]
    for file, name in zip(files, ("First", "Second"), strict=True):
        file.parent.mkdir()
        file.write_text(SOURCE.format(name=name))
        load_plugin(file)
    assert MODELS.kind("First") is not None and MODELS.kind("Second") is not None


BROKEN = {
    "raises": ("1 / 0", "ZeroDivisionError: division by zero"),
    "syntax": ("def", "SyntaxError: invalid syntax"),
    "lacks": ("import nowhere", "ModuleNotFoundError: No module named 'nowhere'"),
    "leaves": ("raise SystemExit(0)", "SystemExit: 0"),
    "twice": (
        SOURCE.format(name="IntegratorChain"),
        "@register_model: IntegratorChain of ",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_plugin_that_does_not_run_is_refused_and_forgotten(
    case: str, tmp_path: Path
) -> None:
    text, why = BROKEN[case]
    file = tmp_path / "broken.py"
    file.write_text(text)
    for _ in range(2):
        with pytest.raises(ScenarioError) as caught:
            load_plugin(file)
        assert caught.value.field == "plugin" and why in str(caught.value)
    assert not any(name.startswith("dtmpc_plugin_broken") for name in sys.modules)


@pytest.mark.parametrize("name", ["nothing.py", "text.txt", "."])
def test_what_is_no_python_file_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "text.txt").write_text("pass")
    with pytest.raises(ScenarioError, match=r"^plugin: got .* a Python file, \*\.py"):
        load_plugin(tmp_path / name)


def test_the_command_line_takes_several_and_a_scenario_names_none(
    tmp_path: Path,
) -> None:
    files = [tmp_path / "one.py", tmp_path / "two.py"]
    for file, name in zip(files, ("Glider", "Other"), strict=True):
        file.write_text(SOURCE.format(name=name))
    scenario = tmp_path / "mine.yaml"
    scenario.write_text(SCENARIO)
    options = [f"--plugin={file}" for file in files]
    good = command("check", str(scenario), *options)
    assert good.returncode == 0, good.stderr
    assert "Glider" in good.stdout
    alone = command("check", str(scenario), options[1])
    assert alone.returncode == 2
    assert alone.stderr.startswith("model: got '!Glider'") and "!Other" in alone.stderr
    scenario.write_text(f"plugin: {files[0]}\n{SCENARIO}")
    named = command("check", str(scenario))
    assert named.returncode == 2
    assert named.stderr.startswith("plugin: got") and "left out" in named.stderr


@pytest.mark.parametrize(
    "name", ["simulate", "monte-carlo", "compare", "check", "show"]
)
def test_a_bad_plugin_is_one_line_of_the_command_line(
    name: str, tmp_path: Path
) -> None:
    ended = command(name, "known_environment", f"--plugin={tmp_path / 'no.py'}")
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert line.startswith("--plugin: got '") and "no.py', but it must be" in line
    assert not ended.stdout
