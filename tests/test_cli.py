"""The command line: what it writes, says and returns."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import dtmpc_drake
from dtmpc_drake.__main__ import app
from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.experiments.simulate import ATTEMPT, OUTPUTS, run
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import (
    Limits,
    Planner,
    Scenario,
    Waypoint,
    load_scenario,
    shipped_scenarios,
    to_yaml,
)

SHORT = Scenario(
    name="short",
    goal=Waypoint(position=[0.0, 3.0, 0.0]),
    duration=4.0,
    obstacles=[Cylinder([0.55, 1.5], 0.4)],
    planner=Planner(intervals=16),
)


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def written(path: Path, scenario: Scenario) -> Path:
    path.write_text(to_yaml(scenario), encoding="utf-8")
    return path


def read_summary(directory: Path) -> dict[str, Any]:
    def refuse(name: str) -> None:
        raise ValueError(f"{name} is not JSON")

    text = (directory / "summary.json").read_text(encoding="utf-8")
    summary: dict[str, Any] = json.loads(text, parse_constant=refuse)
    return summary


# A certified scenario.


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """One real run of the command, in a process and a directory of its own."""
    directory = tmp_path_factory.mktemp("flown")
    written(directory / "mine.yaml", SHORT)
    process = subprocess.run(
        [sys.executable, "-m", "dtmpc_drake", "simulate", "mine.yaml", "--seed", "7"],
        cwd=directory,
        capture_output=True,
        text=True,
        timeout=60,
        env=environment(),
    )
    return process, directory / "out" / "short"


def environment() -> dict[str, str]:
    """The package need not be installed to be tested."""
    root = str(Path(__file__).parents[1])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def test_a_certified_scenario_ends_well(flown: tuple[Any, Path]) -> None:
    process, out = flown
    assert process.returncode == 0, process.stderr
    assert sorted(p.name for p in out.iterdir()) == sorted(OUTPUTS)
    lines = process.stdout.splitlines()
    assert "cost" in lines[1]  # the header of the iteration table
    assert "Solved" in lines[2]
    for word in ("certified", "margins", "obstacles", "planning time", "|ỹ|/Ω"):
        assert word in process.stdout
    for name in OUTPUTS:
        assert str(Path("out", "short", name)) in process.stdout


def test_the_files_say_what_happened(flown: tuple[Any, Path]) -> None:
    _, out = flown
    summary = read_summary(out)
    assert summary["status"] == "certified"
    assert summary["certified"] is True
    assert summary["scenario"] == "short"
    assert summary["backend"] == "clarabel"
    assert summary["seed"] == 7
    assert summary["iterations"] >= 1
    assert summary["cost"] > 0
    assert 0 < summary["times"]["certify"] < summary["plan_time_s"]
    assert summary["plan_time_s"] == summary["times"]["total"]
    for margin in summary["margins"].values():
        assert margin["value"] >= 0
        assert 0 <= margin["time"] <= 4.0
        assert isinstance(margin["where"], str)

    log, plan = Flight.load(out / "log.npz"), Plan.load(out / "plan.npz")
    assert summary["extremes"] == log.extremes()
    assert summary["extremes"]["worst_position_ratio"] <= 1.0
    np.testing.assert_allclose(log.reference, plan.reference(log.time), atol=1e-9)
    with np.load(out / "plan.npz") as samples:
        assert np.diff(samples["time"]).max() <= 0.005 + 1e-12
        for name in ("position", "velocity", "acceleration", "velocity_tube"):
            assert samples[name].shape == (len(samples["time"]), 3)

    replay = (out / "replay.html").read_text(encoding="utf-8")
    assert replay.rstrip().endswith("</html>")
    for name in ("figure.png", "histories.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def test_the_same_seed_gives_the_same_log(flown: tuple[Any, Path]) -> None:
    _, out = flown
    simulation = dataclasses.replace(SHORT.simulation, seed=7)
    again = dataclasses.replace(SHORT, simulation=simulation)
    log = Simulate(again, plan=Plan.load(out / "plan.npz"))
    np.testing.assert_array_equal(log.state, Flight.load(out / "log.npz").state)


# A scenario without a plan.


def test_an_infeasible_scenario_is_not_flown(tmp_path: Path) -> None:
    weak = dataclasses.replace(
        SHORT,
        limits=Limits(input=0.3),
        planner=Planner(intervals=16, max_iterations=3),
    )
    out = tmp_path / "out"
    out.mkdir()
    (out / "replay.html").write_text("of an earlier run")
    (out / "notes.txt").write_text("the user's own")
    result = invoke("simulate", written(tmp_path / "weak.yaml", weak), "--out", out)
    assert result.exit_code == 3
    assert "infeasible" in result.stdout
    assert "cannot keep input limit" in result.stdout
    names = {ATTEMPT, "summary.json", "notes.txt", "earlier"}
    assert {p.name for p in out.iterdir()} == names
    assert [p.name for p in (out / "earlier").iterdir()] == ["replay.html"]
    summary = read_summary(out)
    assert summary["status"] == "infeasible"
    assert summary["certified"] is False
    assert summary["extremes"] is None
    assert "cannot keep" in summary["message"]


def test_numbers_that_json_does_not_have_are_null(tmp_path: Path) -> None:
    """Without obstacles the clearance is infinite."""
    free = dataclasses.replace(SHORT, name="free", obstacles=[], duration=4.0)
    experiment = run(free, tmp_path)
    assert experiment.log is not None
    assert np.isinf(experiment.log.clearance).all()
    assert read_summary(tmp_path)["extremes"]["smallest_clearance"] is None
    assert experiment.summary() == read_summary(tmp_path)


# Bad input.


def assert_refused(result: Any, *words: str) -> None:
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in lines[0]
    for word in words:
        assert word in lines[0]


BAD = {
    "unknown field": ("duration: 4.0", "duration: 4.0\nwind: 3", ["wind", "3"]),
    "missing field": ("duration: 4.0", "", ["duration"]),
    "wrong type": ("duration: 4.0", "duration: soon", ["duration", "'soon'", "number"]),
    "wrong length": ("[2.0, 2.0, 2.0]", "[2.0]", ["controller.slope", "3"]),
    "nan": ("duration: 4.0", "duration: .nan", ["duration", "nan", "finite"]),
    "radius": ("radius: 0.4", "radius: -0.4", ["obstacles[0].radius", "-0.4"]),
    "start inside": ("[0.55, 1.5]", "[0.3, 0.1]", ["start.position", "obstacles[0]"]),
    "goal inside": ("[0.55, 1.5]", "[0.3, 3.0]", ["goal.position", "obstacles[0]"]),
    "layer": ("velocity: null", "velocity: [3, 0, 0]", ["initial_error"]),
    "bandwidth": ("max: 4.0", "max: 0.4", ["controller.bandwidth.min", "0.5"]),
    "start speed": ("[0.0, 0.5, 0.0]", "[0, 9, 0]", ["start.velocity", "2.5"]),
    "too short": ("duration: 4.0", "duration: 1.0", ["duration", "1.2 s"]),
    "backend": ("clarabel", "gurobi", ["planner.backend", "gurobi", "ipopt"]),
    "yaml": ("duration: 4.0", "duration: [", ["line"]),
}


@pytest.mark.parametrize("command", ["simulate", "check"])
@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_line(tmp_path: Path, case: str, command: str) -> None:
    text = """
name: bad
start: {position: [0, 0, 0], velocity: [0.0, 0.5, 0.0]}
goal: {position: [0, 3, 0]}
initial_error: {position: [0, 0, 0], velocity: null}
duration: 4.0
controller:
  slope: [2.0, 2.0, 2.0]
  bandwidth: {min: 0.5, max: 4.0}
obstacles: [!Cylinder {center: [0.55, 1.5], radius: 0.4}]
planner: {backend: clarabel}
"""
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    if command == "check":
        assert invoke("check", file).exit_code == 0
    old, new, words = BAD[case]
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))
    out = ["--out", tmp_path / "out"] if command == "simulate" else []
    assert_refused(invoke(command, file, *out), *words)
    assert [p.name for p in tmp_path.iterdir()] == ["bad.yaml"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--backend", "gurobi"], ["planner.backend", "'gurobi'", "clarabel, ipopt"]),
        (["--seed", "lucky"], ["--seed", "'lucky'", "a whole number"]),
        (["--seed", "1.5"], ["--seed", "'1.5'"]),
        (["--seed", "-1"], ["simulation.seed", "-1"]),
    ],
)
def test_bad_options_get_one_line(
    tmp_path: Path, options: list[str], words: list[str]
) -> None:
    file = written(tmp_path / "short.yaml", SHORT)
    out = tmp_path / "out"
    assert_refused(invoke("simulate", file, *options, "--out", out), *words)
    assert not out.exists()


def test_an_unknown_scenario_is_told_the_known_ones() -> None:
    for command in ("simulate", "show", "check"):
        assert_refused(invoke(command, "nowhere"), "'nowhere'", "known_environment")


def test_a_directory_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    file = written(tmp_path / "short.yaml", SHORT)
    result = invoke("simulate", file, "--out", file / "below")
    assert result.exit_code == 2
    assert "--out" in result.stderr
    assert "Traceback" not in result.stderr


def test_run_validates_before_it_writes(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="duration"):
        run(dataclasses.replace(SHORT, duration=0.1), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# The other commands.


def test_list_names_and_describes_what_is_shipped() -> None:
    lines = invoke("list").stdout.splitlines()
    assert [line.split()[0] for line in lines] == shipped_scenarios()
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("name", shipped_scenarios())
def test_show_prints_a_file_that_can_be_used(name: str, tmp_path: Path) -> None:
    result = invoke("show", name)
    assert result.exit_code == 0
    copy = tmp_path / "copy.yaml"
    copy.write_text(result.stdout, encoding="utf-8")
    assert load_scenario(copy) == load_scenario(name)
    assert load_scenario(copy) is not load_scenario(name)
    assert invoke("check", copy).stdout.startswith("valid: Scenario(")
    assert invoke("show", copy).exit_code == 0


# Its name.


def test_help_names_the_command_as_it_was_called() -> None:
    for arguments, name in (
        (["-m", "dtmpc_drake"], "python -m dtmpc_drake"),
        (["-c", CONSOLE_SCRIPT], "dtmpc"),
    ):
        process = subprocess.run(
            [sys.executable, *arguments, "--help"],
            capture_output=True,
            text=True,
            timeout=60,
            env=environment(),
        )
        assert process.stdout.startswith(f"Usage: {name} [OPTIONS] COMMAND")
        assert "monte-carlo" in process.stdout


CONSOLE_SCRIPT = """
import sys
sys.argv[0] = "/somewhere/bin/dtmpc"
from dtmpc_drake.__main__ import main
main()
"""
"""What an installed ``dtmpc`` does."""


def test_the_version_is_that_of_the_package() -> None:
    result = invoke("--version")
    assert result.exit_code == 0
    assert result.stdout == f"dtmpc_drake {dtmpc_drake.__version__}\n"
