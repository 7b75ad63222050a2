"""Files: an earlier run's are lost to nothing, and damaged ones are named."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from dtmpc_drake.__main__ import app
from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.experiments import simulate as experiment
from dtmpc_drake.experiments.outputs import replacing
from dtmpc_drake.experiments.simulate import run
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import Replan
from dtmpc_drake.scenario import Limits, Planner, Scenario, Waypoint, to_yaml

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

    monkeypatch.setattr("dtmpc_drake.experiments.outputs.os.replace", some)
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
    file.write_text(to_yaml(weak), encoding="utf-8")
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
    file.write_text(to_yaml(SHORT), encoding="utf-8")
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
    file.write_text(to_yaml(SHORT), encoding="utf-8")
    arguments = ["--trials", "1000000000000", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, ["monte-carlo", str(file), *arguments])
    assert result.exit_code == 2
    assert result.stderr.startswith("--trials: got 1000000000000")


# Logs.


@pytest.fixture(scope="module")
def log() -> Flight:
    found = dataclasses.replace(
        SHORT, planner=dataclasses.replace(SHORT.planner, replan_period=1.0)
    )
    return Simulate(found)


@pytest.fixture(scope="module")
def single() -> Flight:
    """Of a flight with one plan, and so without replans."""
    return Simulate(SHORT)


def test_a_single_flights_log_is_loaded_exactly(single: Flight, tmp_path: Path) -> None:
    single.save(tmp_path / "log.npz")
    loaded = Flight.load(tmp_path / "log.npz")
    np.testing.assert_array_equal(loaded.state, single.state)
    assert loaded.replans == single.replans == ()
    assert loaded.status == single.status


def test_a_saved_log_is_loaded_exactly(log: Flight, tmp_path: Path) -> None:
    log.save(tmp_path / "log.npz")
    loaded = Flight.load(tmp_path / "log.npz")
    for field in dataclasses.fields(Flight):
        before, after = getattr(log, field.name), getattr(loaded, field.name)
        if isinstance(before, np.ndarray):
            np.testing.assert_array_equal(before, after)
        else:
            assert before == after
    assert len(loaded.replans) > 2 and loaded.extremes() == log.extremes()


def test_a_flight_that_diverged_is_loaded_as_it_was(
    log: Flight, tmp_path: Path
) -> None:
    state = log.state.copy()
    state[5:] = np.nan
    dataclasses.replace(log, state=state).save(tmp_path / "log.npz")
    assert np.isnan(Flight.load(tmp_path / "log.npz").state[5:]).all()


def saved_with(log: Flight, path: Path, **changes: object) -> None:
    """A log's file with some of its arrays replaced, or left out if None."""
    log.save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files} | changes
    with open(path, "wb") as file:
        np.savez(file, **{n: a for n, a in arrays.items() if a is not None})


ARRAYS = [
    f.name for f in dataclasses.fields(Flight) if f.name not in ("status", "replans")
]


@pytest.mark.parametrize("field", [*ARRAYS, "status", "replans"])
@pytest.mark.parametrize(
    "array",
    [
        np.array([{}], dtype=object),
        np.zeros(3, dtype=complex),
        np.array(["a"]),
        np.array("text"),
        np.zeros((0, 2)),
        np.zeros(()),
        np.zeros((2, 2, 2, 2)),
        np.arange(5),
        None,
    ],
    ids=[
        "pickle",
        "complex",
        "texts",
        "text",
        "empty",
        "scalar",
        "axes",
        "whole",
        "missing",
    ],
)
def test_no_other_array_is_taken_for_a_logs(
    log: Flight, field: str, array: np.ndarray | None, tmp_path: Path
) -> None:
    file = tmp_path / "log.npz"
    saved_with(log, file, **{field: array})
    with pytest.raises(ValueError) as error:
        Flight.load(file)
    words = str(error.value)
    assert words.startswith(f"{file}: not a saved log ({field}") and "\n" not in words


DAMAGE = {
    "times that do not increase": ({"time": {3: 0.0}}, "time must be finite and inc"),
    "an infinite time": ({"time": {-1: np.inf}}, "time must be finite"),
    "an obstacle known at no time": ({"known_since": {0: np.nan}}, "known_since must"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_log_is_refused_with_its_field(
    log: Flight, damage: str, tmp_path: Path
) -> None:
    changes, words = DAMAGE[damage]
    for field, rows in changes.items():
        array = getattr(log, field).copy()
        for row, value in rows.items():
            array[row] = value
        saved_with(log, tmp_path / "log.npz", **{field: array})
    with pytest.raises(ValueError, match=rf"log\.npz: not a saved log \({words}"):
        Flight.load(tmp_path / "log.npz")


def test_a_status_that_no_planner_says_is_refused(log: Flight, tmp_path: Path) -> None:
    saved_with(log, tmp_path / "log.npz", status=np.array("splendid"))
    with pytest.raises(ValueError, match=r"\(status: 'splendid' is none of .*kept"):
        Flight.load(tmp_path / "log.npz")


@pytest.mark.parametrize("status", ["given", "kept: old plan", "infeasible: a: b"])
def test_a_status_and_its_reason_are_loaded(
    log: Flight, status: str, tmp_path: Path
) -> None:
    dataclasses.replace(log, status=status).save(tmp_path / "log.npz")
    assert Flight.load(tmp_path / "log.npz").status == status


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(Plan)])
@pytest.mark.parametrize("array", [None, np.zeros(()), np.array(["a"])])
def test_a_plan_that_lost_an_array_is_not_taken_for_none(
    log: Flight, field: str, array: np.ndarray | None, tmp_path: Path
) -> None:
    saved_with(log, tmp_path / "log.npz", **{f"plan1_{field}": array})
    if (field, array) == ("orders", None):  # as in files of before there were any
        assert Flight.load(tmp_path / "log.npz").replans[1].plan.chains.are_alike
        return
    words = rf"plan1_{field}" if array is None else "plan 1: not a saved plan"
    with pytest.raises(ValueError, match=rf"log\.npz: not a saved log .*{words}"):
        Flight.load(tmp_path / "log.npz")


WRONG = {
    "time": [None, True, "0", math.nan, math.inf],
    "hand_over": [None, True, "0", math.nan],
    "cause": [None, 1, []],
    "revealed": [None, 1, "0", {}, ["0"], [True], [[]]],
    "status": [None, 1, "splendid"],
    "message": [None, 1],
    "iterations": [None, True, 1.5, "1"],
    "cost": [True, "1", []],
    "solve_time": [None, True, math.nan, 10**400],
}


def test_every_field_of_a_replan_has_its_wrong_values() -> None:
    names = {field.name for field in dataclasses.fields(Replan)}
    assert set(WRONG) == names - {"plan"}


@pytest.mark.parametrize(
    ("field", "value"), [(field, v) for field, vs in WRONG.items() for v in vs]
)
def test_a_replan_with_a_wrong_value_is_refused(
    log: Flight, field: str, value: object, tmp_path: Path
) -> None:
    replans = [replan.summary() for replan in log.replans]
    replans[1][field] = value
    saved_with(log, tmp_path / "log.npz", replans=np.array(json.dumps(replans)))
    with pytest.raises(ValueError, match=r"log\.npz: not a saved log \(replans"):
        Flight.load(tmp_path / "log.npz")


def header(text: str) -> bytes:
    """An array's file with this header."""
    padded = text.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(padded).to_bytes(2, "little") + padded.encode()


NO_ARRAYS = {
    "another file": b"hello",
    "nothing": b"",
    "a header that ends early": header("{'descr': ('<f8'"),
    "a header of two lines": header("  x\n y"),
    "a header that is no dictionary": header("{[]: 1}"),
    "a size beyond all": header(
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({10**30},)}}"
    ),
}


@pytest.mark.parametrize("member", NO_ARRAYS)
@pytest.mark.parametrize("field", ["time", "status", "replans", "plan0_knots"])
def test_a_member_that_is_no_array_is_refused(
    log: Flight, field: str, member: str, tmp_path: Path
) -> None:
    file = tmp_path / "log.npz"
    log.save(file)
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in (members | {f"{field}.npy": NO_ARRAYS[member]}).items():
            archive.writestr(name, data)
    word = "replans" if field.startswith("plan") else field
    with pytest.raises(ValueError, match=rf"log\.npz: not a saved log \({word}"):
        Flight.load(file)


@pytest.mark.parametrize(
    "text",
    ["{}", "[1]", '[{"time": 0}]', "[[]]", "null"],
)
def test_replans_that_are_none_are_refused(
    log: Flight, text: str, tmp_path: Path
) -> None:
    file = tmp_path / "log.npz"
    log.save(file)
    with np.load(file) as data:
        arrays = {name: data[name] for name in data.files}
    with open(file, "wb") as target:
        np.savez(target, **(arrays | {"replans": np.array(text)}))
    with pytest.raises(ValueError, match=r"log\.npz: not a saved log \(replans"):
        Flight.load(file)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, 99])
def test_a_member_that_is_packed_otherwise_is_refused(
    log: Flight, method: int, tmp_path: Path
) -> None:
    file = tmp_path / "log.npz"
    log.save(file)
    data = bytearray(file.read_bytes())
    entry = data.index(b"PK\x01\x02")  # of the archive's directory
    data[entry + 10 : entry + 12] = method.to_bytes(2, "little")
    file.write_bytes(data)
    with pytest.raises(ValueError, match=r"log\.npz: not a saved log"):
        Flight.load(file)


@pytest.mark.parametrize("kind", ["log", "single"])
@given(seed=st.integers(0, 2**31))
def test_damaged_bytes_are_a_value_error_or_a_log(
    kind: str, request, seed: int, tmp_path_factory
) -> None:
    file = tmp_path_factory.mktemp("bytes") / "log.npz"
    request.getfixturevalue(kind).save(file)
    data = bytearray(file.read_bytes())
    g = np.random.default_rng(seed)
    for place in g.integers(0, len(data), g.integers(1, 20)):
        data[place] = g.integers(0, 256)
    file.write_bytes(data[: g.integers(len(data) // 2, len(data) + 1)])
    try:
        Flight.load(file)
    except ValueError as error:
        assert str(error).startswith(f"{file}: not a saved log")
