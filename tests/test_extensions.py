"""Things of a user's own, in `tests/extensions`: as good as the library's."""

from __future__ import annotations

import dataclasses
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
from dtmpc_drake.disturbances import Gust, MakeDisturbance
from dtmpc_drake.experiments import compare, monte_carlo
from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.planning import Problem, certify, plan
from dtmpc_drake.planning.starts import from_plan
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.plugins import load_plugin
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import (
    Costs,
    Limits,
    Scenario,
    ScenarioError,
    load_scenario,
    parse_scenario,
    to_yaml,
)

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

        for name in extensions.__all__:
            module = getattr(extensions, name)
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


@pytest.fixture(scope="module")
def planned(harbour: Scenario) -> PlanningResult:
    return plan(harbour)


def test_a_limit_of_ones_own_is_proven_for_all_times(
    harbour: Scenario, planned: PlanningResult
) -> None:
    assert planned.certified and planned.plan is not None
    certified = planned.certificate.margins["power"]
    limit, law = harbour.limits.own[0], harbour.sliding_law()
    time = np.linspace(0.0, harbour.duration, 20_001)
    y = planned.plan.reference(time)
    layer_rate = planned.plan.boundary_layer_rate(time)
    at = Instant(
        state=y[:, :2],
        highest=y[:, 2],
        gain=law.gain(y[:, :2], layer_rate),
        error_bound=planned.plan.error_bound(time),
    )
    dense = float(limit.margins(law, at).min())
    assert 0 <= certified.value <= dense + 1e-6
    assert dense - certified.value < 0.05  # and no wild bound
    # It binds, and whoever asks for more than is kept is refused by its name.
    stricter = dataclasses.replace(limit, bound=limit.bound - dense - 0.01)
    problem = Problem.from_scenario(harbour)
    wrong = certify(
        planned.plan, dataclasses.replace(problem, other_limits=(stricter,))
    )
    assert not wrong.certified and wrong.broken == ("power",)
    free = dataclasses.replace(harbour, limits=Limits(input=8.0, speed=2.5))
    assert plan(free).cost < planned.cost - 1e-3


def test_no_adversary_breaks_a_limit_of_ones_own(
    harbour: Scenario, planned: PlanningResult
) -> None:
    """And one that a flight does break is named."""
    pushed = dataclasses.replace(
        harbour, disturbance=Gust(bound=[0.1, 0.1], model_error=True)
    )
    flight = Simulate(pushed, plan=planned.plan)
    assert flight.breaches(pushed) == ()
    power = np.abs((flight.control * flight.state[:, 1]).sum(axis=1)).max()
    assert power < 2.8
    limits = dataclasses.replace(
        pushed.limits, own=[type(harbour.limits.own[0])(0.8 * float(power))]
    )
    strict = dataclasses.replace(pushed, limits=limits)
    (broken,) = Simulate(strict, plan=planned.plan).breaches(strict)
    assert broken.what == "other_limits" and "the power limit was broken" in str(broken)


def test_a_cost_of_ones_own_is_charged(
    harbour: Scenario, planned: PlanningResult
) -> None:
    without = dataclasses.replace(harbour, cost=Costs())
    other = plan(without)
    assert planned.plan is not None and other.plan is not None
    time = planned.plan.knots
    x, free = (each.plan.reference(time)[:, 0, 0] for each in (planned, other))
    assert (x**2).sum() < (free**2).sum()
    tr = Transcription(Problem.from_scenario(harbour), 16)
    iterate = tr.evaluate(*from_plan(tr, planned.plan))
    lane = 0.5 * float(tr.weights @ iterate.local.state[:, 0, 0] ** 2)
    alone = Transcription(Problem.from_scenario(without), 16)
    paid = iterate.cost - alone.evaluate(*iterate.decisions).cost
    assert paid == pytest.approx(lane)


@pytest.mark.slow
def test_both_backends_take_them(harbour: Scenario, planned: PlanningResult) -> None:
    settings = dataclasses.replace(harbour.planner, backend="ipopt", time_limit=300.0)
    result = plan(dataclasses.replace(harbour, planner=settings))
    assert result.certified, result.message
    # A product of norms is hard on a quasi-Newton method: it ends near, not there.
    assert result.cost == pytest.approx(planned.cost, rel=0.1)


def test_they_survive_a_file(harbour: Scenario) -> None:
    text = to_yaml(harbour)
    assert "model: !Boat\n  damping: [0.1, 0.4]\n" in text
    assert parse_scenario(text) == harbour


def test_their_fields_are_checked_by_themselves(harbour: Scenario) -> None:
    text = to_yaml(harbour)
    for good, bad, field, allowed in (
        ("damping: [0.1, 0.4]", "damping: [0.1]", "model.damping", "2 numbers"),
        ("share: 0.2", "share: -0.2", "model.share", "at least 0"),
        ("share: 0.2", "share: some", "model.share", "a number"),
        ("share: 0.2", "spare: 0.2", "model.spare", "damping, share, mass"),
        ("period: 2.0", "period: 0", "disturbance.period", "greater than 0 s"),
        ("bound: 2.8", "bound: 0", "limits.own[0].bound", "greater than 0"),
        ("!PowerLimit", "!Power", "limits.own[0]", "one of !PowerLimit"),
        ("normal: [1.0, 0.0]", "normal: [1.0]", "cost.own[0].normal", "2 numbers"),
        ("!Lane", "!Road", "cost.own[0]", "one of !Lane"),
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


@pytest.mark.slow
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
        pytest.param(
            name, marks=[pytest.mark.slow] * (name in ("compare", "monte-carlo"))
        )
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
    with pytest.raises(ScenarioError, match=r"Lane of .* has the name of tests"):
        load_plugin(PLUGIN)


USE = """
from dtmpc_drake import Scenario, plan
from dtmpc_drake.scenario import Costs, Limits
from tests.extensions.cost import Lane
from tests.extensions.disturbance import Waves
from tests.extensions.limit import PowerLimit
from tests.extensions.model import Boat
from tests.extensions.obstacle import Box

scenario = Scenario(
    model=Boat(),
    disturbance=Waves(),
    obstacles=[Box([0.0, 1.0], [0.1, 0.1])],
    limits=Limits(own=[PowerLimit(3.0)]),
    cost=Costs(own=[Lane([1.0, 0.0])]),
)
reveal_type(plan(scenario).certified)
"""


@pytest.mark.slow
def test_a_type_checker_takes_them_where_the_library_s_own_are_taken(
    tmp_path: Path,
) -> None:
    (tmp_path / "use.py").write_text(USE)
    root = PLUGIN.parents[2]
    ended = subprocess.run(
        [
            *(sys.executable, "-m", "mypy", "--namespace-packages"),
            *("--config-file", str(root / "pyproject.toml")),
            *("--explicit-package-bases", str(tmp_path / "use.py")),
        ],
        capture_output=True,
        text=True,
        env={**os.environ, "MYPYPATH": str(root)},
        cwd=root,
    )
    assert ended.returncode == 0, ended.stdout
    (revealed,) = [line for line in ended.stdout.splitlines() if "Revealed" in line]
    assert "bool" in revealed
