"""Files: an earlier run's are lost to nothing, and damaged ones are named."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from diagrams import experiment
from diagrams.__main__ import app
from diagrams.closed_loop import Log, Simulate
from diagrams.experiment import run
from diagrams.outputs import replacing
from dtmpc_drake.scenario import Cylinder, Limits, Planner, Scenario, Waypoint

NAMES = ("a.txt", "b.txt", "c.txt")
SHORT = Scenario(
    name="short",
    goal=Waypoint(position=[0.0, 3.0, 0.0]),
    duration=4.0,
    obstacles=[Cylinder([0.55, 1.5], 0.4)],
    planner=Planner(intervals=16),
)


def contents(directory: Path) -> dict[str, str]:
    return {
        str(path.relative_to(directory)): path.read_text()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def used(tmp_path: Path) -> Path:
    """A directory with an earlier run's files and one of the user's own."""
    for name in ("a.txt", "b.txt", "notes.txt"):
        (tmp_path / name).write_text("earlier")
    return tmp_path


def test_outputs_take_their_places_and_others_are_set_aside(used: Path) -> None:
    for number in ("new", "newer"):
        with replacing(used, NAMES) as work:
            (work / "b.txt").write_text(number)
        (used / "a.txt").write_text(f"before {number}")
    assert contents(used) == {
        "b.txt": "newer",
        "notes.txt": "earlier",
        "a.txt": "before newer",
        "earlier/a.txt": "earlier",
        "earlier-2/a.txt": "before new",
    }


@pytest.mark.parametrize("error", [OSError, ValueError, KeyboardInterrupt, SystemExit])
def test_whatever_goes_wrong_all_is_as_it_was(used: Path, error) -> None:
    before = contents(used)
    with pytest.raises(error), replacing(used, NAMES) as work:
        (work / "a.txt").write_text("half")
        raise error
    assert contents(used) == before
    assert {path.name for path in used.iterdir()} == {"a.txt", "b.txt", "notes.txt"}


def test_a_directory_that_was_made_for_nothing_is_gone(tmp_path: Path) -> None:
    out = tmp_path / "some" / "where"
    with pytest.raises(ValueError), replacing(out, NAMES) as work:
        (work / "a.txt").write_text("half")
        raise ValueError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("moves", range(5))
def test_files_that_cannot_all_take_their_places_take_none(
    used: Path, monkeypatch, error, moves: int
) -> None:
    """Five moves: one file is set aside, one makes room, and three take places."""
    before, replace, left = contents(used), os.replace, [moves]

    def some(source: Path, target: Path) -> None:
        left[0] -= 1
        if left[0] == -1:
            raise error
        replace(source, target)

    monkeypatch.setattr("diagrams.outputs.os.replace", some)
    with pytest.raises(error), replacing(used, (*NAMES, "d.txt")) as work:
        for name in ("b.txt", "c.txt", "d.txt"):
            (work / name).write_text("new")
    assert contents(used) == before
    assert {path.name for path in used.iterdir()} == {"a.txt", "b.txt", "notes.txt"}


def test_a_directory_in_the_place_of_an_output_is_set_aside(used: Path) -> None:
    (used / "c.txt").mkdir()
    (used / "c.txt" / "mine.txt").write_text("the user's own")
    with replacing(used, NAMES) as work:
        (work / "c.txt").write_text("new")
    assert contents(used)["c.txt"] == "new"
    assert contents(used)["earlier/c.txt/mine.txt"] == "the user's own"


def test_a_link_to_nothing_is_in_the_way_as_any_file(used: Path) -> None:
    (used / "earlier").symlink_to("nowhere")
    (used / "c.txt").symlink_to("nowhere")
    with replacing(used, NAMES):
        pass
    assert (used / "earlier").is_symlink()
    assert (used / "earlier-2" / "c.txt").is_symlink()
    assert (used / "earlier-2" / "a.txt").read_text() == "earlier"


def test_directories_above_one_that_cannot_be_made_are_gone(tmp_path: Path) -> None:
    with pytest.raises(OSError), replacing(tmp_path / "some" / ("n" * 300), NAMES):
        pytest.fail("nothing should be done")
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_way_is_found_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError), replacing(tmp_path / "file" / "below", NAMES):
        pytest.fail("nothing should be done")


def test_a_run_that_fails_in_the_middle_deletes_nothing(
    tmp_path: Path, monkeypatch
) -> None:
    run(SHORT, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(experiment, "write_json", full)
    with pytest.raises(OSError):
        run(SHORT, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("command", ["simulate", "monte-carlo"])
def test_an_infeasible_run_deletes_nothing(tmp_path: Path, command: str) -> None:
    weak = dataclasses.replace(
        SHORT, limits=Limits(input=0.3), planner=Planner(intervals=16, max_iterations=3)
    )
    file, out = tmp_path / "weak.yaml", tmp_path / "out"
    file.write_text(weak.to_yaml(), encoding="utf-8")
    out.mkdir()
    (out / "replay.html").write_text("the user's own")
    result = CliRunner().invoke(app, [command, str(file), "--out", str(out)])
    assert result.exit_code == 3
    assert (out / "earlier" / "replay.html").read_text() == "the user's own"
    assert not (out / "replay.html").exists()
    assert (out / "summary.json").exists()


@pytest.mark.parametrize(
    "address",
    [
        "nobody://127.0.0.1:1",
        pytest.param("tcp://127.0.0.1:1", marks=pytest.mark.slow),  # waits for it
    ],
)
def test_a_scheduler_that_nobody_runs_costs_nothing(
    tmp_path: Path, address: str
) -> None:
    file, out = tmp_path / "short.yaml", tmp_path / "out"
    file.write_text(SHORT.to_yaml(), encoding="utf-8")
    out.mkdir()
    (out / "cloud.png").write_text("of an earlier run")
    arguments = ["--scheduler", address, "--trials", "4"]
    result = CliRunner().invoke(
        app, ["monte-carlo", str(file), "--out", str(out), *arguments]
    )
    assert result.exit_code == 2
    assert contents(out) == {"cloud.png": "of an earlier run"}


def test_more_flights_than_there_is_memory_for_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "short.yaml"
    file.write_text(SHORT.to_yaml(), encoding="utf-8")
    arguments = ["--trials", "1000000000000", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, ["monte-carlo", str(file), *arguments])
    assert result.exit_code == 2
    assert result.stderr.startswith("--trials: got 1000000000000")


# Logs.


@pytest.fixture(scope="module")
def log() -> Log:
    found = dataclasses.replace(
        SHORT, planner=dataclasses.replace(SHORT.planner, replan_period=1.0)
    )
    return Simulate(found)


def test_a_saved_log_is_loaded_exactly(log: Log, tmp_path: Path) -> None:
    log.save(tmp_path / "log.npz")
    loaded = Log.load(tmp_path / "log.npz")
    for field in dataclasses.fields(Log):
        before, after = getattr(log, field.name), getattr(loaded, field.name)
        if isinstance(before, np.ndarray):
            np.testing.assert_array_equal(before, after)
        else:
            assert before == after
    assert len(loaded.replans) > 2 and loaded.extremes() == log.extremes()


def test_a_flight_that_diverged_is_loaded_as_it_was(log: Log, tmp_path: Path) -> None:
    state = log.state.copy()
    state[5:] = np.nan
    dataclasses.replace(log, state=state).save(tmp_path / "log.npz")
    assert np.isnan(Log.load(tmp_path / "log.npz").state[5:]).all()


DAMAGE = {
    "time": np.zeros(7),
    "state": np.zeros((3, 2, 3)),
    "control": np.zeros((3, 3), dtype=complex),
    "tube_ratios": np.array([{}], dtype=object),
    "reference": np.array("text"),
    "record": np.zeros((7, 6)),
    "clearance": np.zeros(0),
    "status": np.zeros(3),
    "replans": np.array("{not json"),
    "plan1_layer_coefficients": np.zeros((2, 2, 2)),
}


@pytest.mark.parametrize("field", DAMAGE)
def test_a_damaged_log_is_refused_with_its_field(
    log: Log, field: str, tmp_path: Path
) -> None:
    file = tmp_path / "log.npz"
    log.save(file)
    with np.load(file) as data:
        arrays = {name: data[name] for name in data.files} | {field: DAMAGE[field]}
    with open(file, "wb") as target:
        np.savez(target, **arrays)
    word = "plan 1" if field.startswith("plan1") else field
    with pytest.raises(ValueError, match=rf"log\.npz: not a saved log.*{word}"):
        Log.load(file)


@pytest.mark.parametrize(
    "text",
    ["{}", "[1]", '[{"time": 0}]', "[[]]", "null"],
)
def test_replans_that_are_none_are_refused(log: Log, text: str, tmp_path: Path) -> None:
    file = tmp_path / "log.npz"
    log.save(file)
    with np.load(file) as data:
        arrays = {name: data[name] for name in data.files}
    with open(file, "wb") as target:
        np.savez(target, **(arrays | {"replans": np.array(text)}))
    with pytest.raises(ValueError, match=r"log\.npz: not a saved log \(replans"):
        Log.load(file)


@given(seed=st.integers(0, 2**31))
def test_damaged_bytes_are_a_value_error_or_a_log(
    log: Log, seed: int, tmp_path_factory
) -> None:
    file = tmp_path_factory.mktemp("bytes") / "log.npz"
    log.save(file)
    data = bytearray(file.read_bytes())
    g = np.random.default_rng(seed)
    for place in g.integers(0, len(data), g.integers(1, 20)):
        data[place] = g.integers(0, 256)
    file.write_bytes(data[: g.integers(len(data) // 2, len(data) + 1)])
    try:
        Log.load(file)
    except ValueError as error:
        assert str(error).startswith(f"{file}: not a saved log")
