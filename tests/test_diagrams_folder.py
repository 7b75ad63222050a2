"""The scripts of the folder ``diagrams``: each runs and leaves what it promises."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = {path.stem: path for path in sorted((ROOT / "diagrams").glob("*.py"))}


def run(name: str, directory: Path) -> str:
    """What a script prints, run in a directory as a user runs it."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    process = subprocess.run(
        [sys.executable, str(SCRIPTS[name])],
        cwd=directory,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""
    return process.stdout


def written(directory: Path, name: str) -> bytes:
    """The one file that a script writes."""
    (path,) = (directory / "out" / "diagrams").iterdir()
    assert path.name == name
    return path.read_bytes()


def assert_replay(content: bytes) -> None:
    assert content.rstrip().endswith(b"</html>")
    assert len(content) > 1e6  # Meshcat and the animation are in it


def test_every_script_has_a_test_here() -> None:
    tested = {name.removeprefix("test_") for name in globals()}
    assert set(SCRIPTS) <= tested
    assert not (ROOT / "diagrams" / "__init__.py").exists()


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_is_short_and_says_how_it_is_run(name: str) -> None:
    text = SCRIPTS[name].read_text(encoding="utf-8")
    docstring = ast.get_docstring(ast.parse(text)) or ""
    assert f"python diagrams/{name}.py" in docstring
    assert len(text.splitlines()) <= 70


def test_known_environment(tmp_path: Path) -> None:
    said = run("known_environment", tmp_path)
    used = re.search(r"used (\d+)% of the tube at most", said)
    assert used and 80 < int(used.group(1)) <= 100
    assert_replay(written(tmp_path, "known_environment.html"))


def test_multibody_plant(tmp_path: Path) -> None:
    said = run("multibody_plant", tmp_path)
    told = re.search(r"used (\d+)% of the tube at most, (\S+) m clear", said)
    assert told and 20 < int(told.group(1)) <= 100
    assert float(told.group(2)) > 0


def test_receding_horizon(tmp_path: Path) -> None:
    said = run("receding_horizon", tmp_path)
    rows = said.splitlines()[1:-1]
    assert len(rows) == 15
    assert all("certified" in row for row in rows)
    assert "revealed 2 3" in said and "revealed 4" in said
    assert_replay(written(tmp_path, "receding_horizon.html"))


def test_sensed_environment(tmp_path: Path) -> None:
    said = run("sensed_environment", tmp_path)
    for obstacle in (2, 3, 4):
        assert f"obstacle {obstacle} found: certified" in said
    passed = re.findall(r"obstacle \d: seen at +[\d.]+ s, passed at (.*) m", said)
    assert len(passed) == 5
    assert min(map(float, passed)) > 0


def test_state_dependent_uncertainty(tmp_path: Path) -> None:
    said = run("state_dependent_uncertainty", tmp_path)
    assert "certified" in said
    speeds = dict(re.findall(r"drag (\S+) 1/m: never faster than (\S+) m/s", said))
    assert set(speeds) == {"-0.1", "0.3"}
    assert float(speeds["0.3"]) < float(speeds["-0.1"]) < 2.5
    figure = written(tmp_path, "state_dependent_uncertainty.png")
    assert figure.startswith(b"\x89PNG")


def test_side_by_side(tmp_path: Path) -> None:
    said = run("side_by_side", tmp_path)
    used = re.search(r"100 flights used (\d+)% to (\d+)% of the tube", said)
    assert used
    least, most = map(int, used.groups())
    assert 0 < least < most <= 100
    assert written(tmp_path, "side_by_side.png").startswith(b"\x89PNG")


@pytest.mark.slow
def test_which_side(tmp_path: Path) -> None:
    said = run("which_side", tmp_path)
    costs = re.search(r"straight line (\S+), search (\S+)", said)
    assert costs and 0 < float(costs.group(2)) < float(costs.group(1))
    counts = re.search(r"certified +(\d+) of 30 +(\d+) of 30", said)
    assert counts and 5 < int(counts.group(1)) < int(counts.group(2))
    assert len(re.findall(r"^field ", said, re.MULTILINE)) == 30
    assert written(tmp_path, "which_side.png").startswith(b"\x89PNG")
