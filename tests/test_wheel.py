"""The wheel: what is in it, and that it lives beside the package called `diagrams`.

A package of that name is on the index, and this repository has a folder of that name.
Both packages are truly installed, into an empty environment.  What they need is not:
ours sees the libraries of the environment that runs the tests, by a ``.pth`` file that
comes last on the path, and `diagrams` itself is never imported, but for its version.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Sequence
from email.parser import Parser
from pathlib import Path

import pytest

import dtmpc_drake
from dtmpc_drake.scenario import shipped_scenarios

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
THEIRS = "diagrams"
TIME = 300


def pip(python: str | Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Runs pip, away from this checkout: nothing here may be found by accident."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [str(python), "-m", "pip", *map(str, arguments)],
        cwd=Path(python).parent,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIME,
    )


def fetched(directory: Path, *arguments: str | Path) -> Path:
    """The one wheel that pip puts into a directory.

    Skips the test where the index cannot be reached, for which pip says that there is
    no such package; any other failure is one.
    """
    process = pip(sys.executable, *arguments)
    said = process.stdout + process.stderr
    if "No matching distribution found" in said:
        pytest.skip(f"the package index cannot be reached: {said.splitlines()[-1]}")
    assert process.returncode == 0, said
    (wheel,) = directory.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ours, built from a copy, so that building leaves nothing here."""
    source = tmp_path_factory.mktemp("source") / "checkout"
    litter = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "out")
    shutil.copytree(ROOT, source, ignore=litter)
    out = tmp_path_factory.mktemp("wheel")
    return fetched(out, "wheel", "--no-deps", "--wheel-dir", out, source)


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package `diagrams` of the index."""
    out = tmp_path_factory.mktemp("theirs")
    return fetched(out, "download", "--no-deps", "--dest", out, THEIRS)


def test_the_wheel_has_one_top_level_name_and_all_it_needs(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        info = f"dtmpc_drake-{dtmpc_drake.__version__}.dist-info"
        metadata = Parser().parsestr(archive.read(f"{info}/METADATA").decode())
        entry_points = archive.read(f"{info}/entry_points.txt").decode()
        licence = archive.read(f"{info}/licenses/LICENSE").decode()
    assert {name.split("/")[0] for name in names} == {"dtmpc_drake", info}
    own = {name for name in names if name.startswith("dtmpc_drake/")}
    files = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "dtmpc_drake").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert own == files  # nothing forgotten, nothing else taken along
    scenarios = {f"dtmpc_drake/scenario/{name}.yaml" for name in shipped_scenarios()}
    assert len(scenarios) >= 7
    data = {"dtmpc_drake/py.typed", "dtmpc_drake/visualization/overlay.html"}
    assert scenarios | data <= own
    assert "dtmpc = dtmpc_drake.__main__:main" in entry_points
    assert metadata["Name"] == "dtmpc_drake"
    assert metadata["Version"] == dtmpc_drake.__version__
    assert metadata["License-Expression"] == "BSD-3-Clause"
    assert metadata["Author"] == "the dtmpc_drake authors"
    assert licence == (ROOT / "LICENSE").read_text(encoding="utf-8")


class Environment:
    """A virtual environment that sees this one's libraries after its own."""

    def __init__(self, directory: Path) -> None:
        venv.create(directory, with_pip=True, symlinks=True)
        self.bin = directory / "bin"
        self.python = self.bin / "python"
        (self.site,) = directory.glob("lib/python*/site-packages")
        libraries = [path for path in sys.path if Path(path).name == "site-packages"]
        (self.site / "libraries.pth").write_text("\n".join(libraries))

    def install(self, *wheels: Path) -> None:
        # What the libraries beside have installed does not count as ours.
        options = ("--no-deps", "--no-index", "--ignore-installed", "--quiet")
        process = pip(self.python, "install", *options, *wheels)
        assert process.returncode == 0, process.stderr

    def uninstall(self, name: str) -> None:
        process = pip(self.python, "uninstall", "--yes", "--quiet", name)
        assert process.returncode == 0, process.stderr

    def files(self, wheel: Path) -> list[str]:
        """The files of a wheel that are here as they are in it."""
        with zipfile.ZipFile(wheel) as archive:
            return [
                name
                for name in archive.namelist()
                if not name.endswith("/RECORD")
                and (self.site / name).is_file()
                and (self.site / name).read_bytes() == archive.read(name)
            ]

    def run(self, command: Sequence[str | Path], cwd: Path) -> str:
        process = subprocess.run(
            [str(part) for part in command],
            cwd=cwd,
            env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
            capture_output=True,
            text=True,
            timeout=TIME,
        )
        assert process.returncode == 0, process.stderr
        return process.stdout


def whole(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        return [name for name in archive.namelist() if not name.endswith("/RECORD")]


@pytest.mark.parametrize("first", ["ours", "theirs"])
def test_either_of_two_packages_can_go_and_leaves_the_other_whole(
    tmp_path: Path, wheel: Path, theirs: Path, first: str
) -> None:
    environment = Environment(tmp_path / "environment")
    pair = {"dtmpc_drake": wheel, THEIRS: theirs}
    order = list(pair) if first == "ours" else list(pair)[::-1]
    for name in order:
        environment.install(pair[name])
    for gone, left in (order, order[::-1]):
        assert environment.files(pair[gone]) == whole(pair[gone])
        assert environment.files(pair[left]) == whole(pair[left])
        environment.uninstall(gone)
        assert environment.files(pair[gone]) == []
        assert environment.files(pair[left]) == whole(pair[left])
        environment.install(pair[gone])


def test_the_installed_command_flies_from_an_empty_folder(
    tmp_path: Path, wheel: Path, theirs: Path
) -> None:
    environment = Environment(tmp_path / "environment")
    environment.install(wheel, theirs)
    empty = tmp_path / "empty"
    empty.mkdir()
    code = "import dtmpc_drake; print(dtmpc_drake.__file__)"
    where = Path(environment.run([environment.python, "-c", code], empty).strip())
    assert where.is_relative_to(environment.site)  # and not this checkout
    command = environment.bin / "dtmpc"
    version = environment.run([command, "--version"], empty)
    assert version.strip() == f"dtmpc_drake {dtmpc_drake.__version__}"
    assert environment.run([command, "--help"], empty).startswith("Usage: dtmpc ")
    said = environment.run([command, "simulate", "known_environment"], empty)
    assert "certified" in said
    assert [path.name for path in empty.iterdir()] == ["out"]
    assert (empty / "out" / "known_environment" / "replay.html").stat().st_size > 1e6
