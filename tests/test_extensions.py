"""Things of a user's own, in `tests/extensions`: as good as the library's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import forgetting

from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.disturbances import MakeDisturbance
from dtmpc_drake.experiments import compare, monte_carlo
from dtmpc_drake.plugins import load_plugin
from dtmpc_drake.scenario import Scenario, ScenarioError, load_scenario, parse_scenario

OWN_KINDS = ("tests.extensions",)
PLUGIN = Path(__file__).parent / "extensions" / "__init__.py"
HARBOUR = PLUGIN.with_name("harbour.yaml")
COMMANDS = {
    "show": [],
    "check": [],
    "simulate": ["--quiet"],
    "monte-carlo": ["--trials=6", "--batch-size=2", "--disturbance=waves"],
    "compare": ["--trials=5"],
}


@pytest.fixture(scope="module")
def harbour() -> Iterator[Scenario]:
    """From Python: whoever imports the package has its classes."""
    with forgetting():
        from tests import extensions

        for module in (extensions.model, extensions.disturbance):
            assert module.__name__.startswith("tests.extensions.")
        yield load_scenario(HARBOUR)


def command(name: str, *options: str, out: Path | None = None) -> Any:
    """The command line in a process of its own, which knows no test."""
    arguments = [sys.executable, "-m", "dtmpc_drake", name, str(HARBOUR), *options]
    if out is not None:
        arguments.append(f"--out={out}")
    root = str(PLUGIN.parents[2])
    environment = {**os.environ, "PYTHONPATH": root, "COLUMNS": "200"}
    return subprocess.run(
        arguments, capture_output=True, text=True, env=environment, cwd="/"
    )


def test_they_are_planned_certified_and_flown(harbour: Scenario) -> None:
    flight = Simulate(harbour)
    assert flight.status == "certified"
    assert flight.tube_ratios.max() < 1 and flight.clearance.min() > 0
    # Waves, and no other push: each output swings between its bounds.
    assert np.abs(flight.disturbance).max(axis=0) == pytest.approx([0.1, 0.1], rel=0.01)


def test_they_survive_a_file(harbour: Scenario) -> None:
    text = harbour.to_yaml()
    assert "model: !Boat\n  damping: [0.1, 0.4]\n" in text
    assert parse_scenario(text) == harbour


def test_their_fields_are_checked_by_themselves(harbour: Scenario) -> None:
    text = harbour.to_yaml()
    for good, bad, field, allowed in (
        ("damping: [0.1, 0.4]", "damping: [0.1]", "model.damping", "2 numbers"),
        ("share: 0.2", "share: -0.2", "model.share", "at least 0"),
        ("share: 0.2", "share: some", "model.share", "a number"),
        ("share: 0.2", "spare: 0.2", "model.spare", "damping, share, mass"),
        ("period: 2.0", "period: 0", "disturbance.period", "greater than 0 s"),
    ):
        assert good in text
        with pytest.raises(ScenarioError, match=allowed) as caught:
            parse_scenario(text.replace(good, bad))
        assert caught.value.field == field


def test_the_phase_of_the_waves_is_the_seed_s(harbour: Scenario) -> None:
    from pydrake.common import RandomGenerator

    waves = MakeDisturbance(
        harbour.disturbance, model=harbour.model, slope=harbour.slope()
    )
    seen = set()
    for seed in (0, 1):
        context = waves.CreateDefaultContext()
        waves.SetRandomContext(context, RandomGenerator(seed))
        seen.add(tuple(waves.GetOutputPort("disturbance").Eval(context)))
    assert len(seen) == 2


def test_they_fly_through_monte_carlo_in_many_processes(
    harbour: Scenario, tmp_path: Path
) -> None:
    ended = monte_carlo.run(
        harbour, tmp_path, trials=6, batch_size=3, disturbance="waves"
    )
    assert ended.safe and list(ended.flights) == ["waves"]
    assert ended.flights["waves"].distinct == 6
    allowed = "worst_case, wind, gust, waves, all, scenario"
    with pytest.raises(ScenarioError, match=allowed):
        monte_carlo.choose_disturbances(harbour, "storm")


@pytest.mark.slow
def test_they_are_compared(harbour: Scenario, tmp_path: Path) -> None:
    ended = compare.run(harbour, tmp_path, trials=5)
    assert ended.safe and "waves" in ended.table()


def test_all_kinds_that_are_hard_have_theirs_among_them(harbour: Scenario) -> None:
    chosen = compare.chosen_disturbances(harbour)
    assert list(chosen) == ["bang_bang", "worst_case", "wind", "gust", "waves"]
    assert chosen["waves"] is harbour.disturbance


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name == "compare"))
        for name in COMMANDS
    ],
)
def test_the_command_line_takes_them_from_a_plugin(name: str, tmp_path: Path) -> None:
    out = None if name in ("show", "check") else tmp_path / "out"
    ended = command(name, f"--plugin={PLUGIN}", *COMMANDS[name], out=out)
    assert ended.returncode == 0, ended.stderr
    if name == "show":
        assert "!Boat" in ended.stdout and "!Waves" in ended.stdout
    if name == "monte-carlo":
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert summary["flights"]["waves"]["trials"] == 6
    if name == "compare":
        written = json.loads((tmp_path / "out" / "compare.json").read_text())
        assert "waves" in written["disturbances"]


def test_without_the_plugin_nobody_knows_them() -> None:
    ended = command("check")
    assert ended.returncode == 2
    assert ended.stderr.startswith("model: got '!Boat', but it must be one of !Drag")


def test_the_same_names_from_two_modules_are_refused(harbour: Scenario) -> None:
    """Imported, and loaded as a plugin: nobody could tell one Boat from the other."""
    with pytest.raises(ScenarioError, match=r"Waves of .* has the name of tests"):
        load_plugin(PLUGIN)
