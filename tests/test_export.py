"""What is exported is the plan, for whoever reads the format as its makers do."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from typer.testing import CliRunner

from dtmpc_drake.__main__ import app
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.models import IntegratorChain, Model
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.records.export import to_quadrotor_csv
from dtmpc_drake.records.plan import Plan, join
from tests.models_for_tests import name_of, one_model_of_each_order
from tests.test_plan import a_plan, seeds

AXES = ("x", "y", "z", "yaw")


def read(text: str) -> list[dict[str, float]]:
    """Each piece by the names of the header."""
    rows = csv.DictReader(io.StringIO(text), strict=True)
    return [{name: float(value) for name, value in row.items()} for row in rows]


def evaluated(pieces: list[dict[str, float]], time: float) -> Array:
    """x, y, z and yaw, a time after the start: the first piece that is not over."""
    for piece in pieces:
        if time < piece["duration"] or piece is pieces[-1]:
            break
        time -= piece["duration"]
    return np.array([sum(piece[f"{a}^{k}"] * time**k for k in range(8)) for a in AXES])


@pytest.mark.parametrize(
    "model",
    [
        *one_model_of_each_order(),
        IntegratorChain(2, 2),
        IntegratorChain(1, 4),
        IntegratorChain(3, 6),
    ],
    ids=name_of,
)
@given(seed=seeds)
def test_what_is_read_back_is_the_plan(model: Model, seed: int) -> None:
    plan = a_plan(model, seed)
    joined = join([plan, a_plan(model, seed + 1)], [plan.start_time, 4.7])
    for exported in (plan, joined):
        pieces = read(to_quadrotor_csv(exported))
        assert len(pieces) == len(exported.knots) - 1
        duration = sum(piece["duration"] for piece in pieces)
        assert duration == pytest.approx(exported.end_time - exported.start_time)
        m = exported.num_outputs
        for time in np.linspace(0, duration, 500).tolist():
            # Not where a hand-over would be on either side, for rounding.
            if abs(exported.start_time + time - 4.7) < 1e-9:
                continue
            there = evaluated(pieces, time)
            reference = exported.reference(exported.start_time + time)[0]
            assert there[:m] == pytest.approx(reference, rel=1e-9, abs=1e-9)
            assert (there[m:] == 0).all()


def test_the_file_is_what_its_readers_take() -> None:
    """One header, 33 columns, no comma at the end of a line."""
    plan = a_plan(IntegratorChain(3, 2))
    text = to_quadrotor_csv(plan)
    head = text.splitlines()[0].split(",")
    assert head[:3] == ["duration", "x^0", "x^1"] and head[-1] == "yaw^7"
    assert head[9] == "y^0" and head[17] == "z^0" and head[25] == "yaw^0"
    data = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=1, usecols=range(33))
    assert (data[:, 0] == np.diff(plan.knots)).all()
    for i in range(3):  # to the last bit
        assert (data[:, 1 + 8 * i : 5 + 8 * i] == plan.coefficients[:, :, i]).all()
    assert all(line.count(",") == 32 for line in text.splitlines())


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (IntegratorChain(4, 2), r"plan\.num_outputs: got 4, .* at most 3"),
        (IntegratorChain(2, 7), r"plan\.order: got 7, .* at most 6"),
    ],
    ids=["outputs", "order"],
)
def test_what_does_not_fit_is_refused(model: Any, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        to_quadrotor_csv(a_plan(model))


# The command.


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    a_plan(IntegratorChain(3, 2)).save(tmp_path / "plan.npz")
    return tmp_path / "plan.npz"


def test_a_plan_is_written_to_a_file_or_to_the_terminal(saved: Path) -> None:
    text = to_quadrotor_csv(Plan.load(saved))
    printed = invoke(saved)
    assert (printed.exit_code, printed.stdout, printed.stderr) == (0, text, "")
    out = saved.parent / "new" / "mine.csv"
    told = invoke(saved, "--format", "csv", "--out", out)
    assert told.exit_code == 0
    assert told.stdout == f"{out}: 9 pieces, 6 s\n"
    assert out.read_text(encoding="utf-8") == text


def test_bad_input_gets_one_line_and_no_file(saved: Path) -> None:
    away, text = saved.parent / "away.npz", saved.parent / "mine.yaml"
    text.write_text("name: mine\n")
    wide = saved.parent / "wide.npz"
    a_plan(IntegratorChain(4, 2)).save(wide)
    out = saved.parent / "mine.csv"
    for arguments, words in (
        ((away,), ["plan: ", "away.npz", "No such file"]),
        ((saved.parent,), ["plan: ", "Is a directory"]),
        ((text,), ["mine.yaml", "not a saved plan"]),
        ((wide,), ["plan.num_outputs", "4", "at most 3"]),
        ((saved, "--format", "json"), ["--format: got 'json'", "csv"]),
    ):
        refused(invoke(*arguments, "--out", out), words)
        assert not out.exists()


def test_nothing_that_cannot_be_replaced_is_written_over(saved: Path) -> None:
    before = saved.read_bytes()
    refused(invoke(saved, "--out", saved), ["--out", "plan.npz", "another file"])
    assert saved.read_bytes() == before
    refused(invoke(saved, "--out", saved.parent), ["--out", "Is a directory"])
    refused(invoke(saved, "--out", saved / "below"), ["--out", "writable"])


def refused(result: Any, words: list[str]) -> None:
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert "Traceback" not in line
    for word in words:
        assert word in line
