"""The files of a flight with many plans show what happened."""

from __future__ import annotations

import dataclasses
import json
import re

import numpy as np
import pytest
from test_receding_horizon import corridor
from test_visualization import meshcat_commands

from dtmpc_drake.experiments.simulate import OUTPUTS, REPLANS, Experiment, run
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.obstacles import Cylinder, Ellipsoid
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import plans_in_force
from dtmpc_drake.scenario import Planner
from dtmpc_drake.visualization import plot_receding_horizon, plot_replans


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """A pole found on the way, then a wall across it."""
    scenario = corridor(
        name="pole_and_wall",
        model=IntegratorChain(2, 2),
        plant={},
        obstacles=[
            Cylinder([3.0, 3.0], 0.5),
            Cylinder([0.2, 5.0], 0.5, known_from=1.0),
            Ellipsoid([0.0, 10.0], [[0.0, 1.0]], 0.7, known_from=4.0),
        ],
        planner=Planner(intervals=40, replan_period=3.0),
    )
    return run(scenario, tmp_path_factory.mktemp("out"))


def log_of(experiment: Experiment) -> Flight:
    assert experiment.log is not None
    return experiment.log


def test_everything_is_written_and_the_summary_has_the_plans(
    experiment: Experiment,
) -> None:
    out = experiment.files[0].parent
    assert {p.name for p in out.iterdir()} == {*OUTPUTS, REPLANS}
    assert set(experiment.files) == set(out.iterdir())
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["known_since"] == [0.0, 1.0, 4.0]
    replans = summary["replans"]
    assert replans[0]["cause"] == "start"
    assert replans[0]["cost"] == pytest.approx(summary["cost"])
    causes = {tuple(r["revealed"]): r["status"] for r in replans if r["revealed"]}
    assert causes == {(1,): "certified", (2,): "braking"}
    assert all(r["solve_time"] > 0 and r["iterations"] >= 1 for r in replans)
    assert summary["extremes"]["smallest_clearance"] > 0
    text = repr(experiment)
    assert "revealed 2" in text and "braking" in text


def test_the_saved_plan_is_what_was_in_force(experiment: Experiment) -> None:
    out = experiment.files[0].parent
    flown, log = Plan.load(out / "plan.npz"), Flight.load(out / "log.npz")
    quiet = np.ones(len(log.time), dtype=bool)
    for shown in plans_in_force(log.replans):
        quiet &= np.abs(log.time - shown.start) > 1e-3
    np.testing.assert_allclose(
        flown.reference(log.time[quiet]), log.reference[quiet], atol=1e-9
    )


def test_the_replay_shows_ghosts_until_they_are_known_and_each_plan_in_turn(
    experiment: Experiment,
) -> None:
    page = experiment.files[0].read_text(encoding="utf-8")
    commands = meshcat_commands(page)
    for name in ("ghosts/1", "ghosts/2", "obstacles/0", "obstacles/1", "obstacles/2"):
        assert f"/dtmpc/{name}".encode() in commands
    assert b"/dtmpc/ghosts/0" not in commands  # it was known from the start
    shown = plans_in_force(log_of(experiment).replans)
    for i in range(len(shown)):
        assert f"/dtmpc/plans/{i}/in_force".encode() in commands
    assert f"/dtmpc/plans/{len(shown)}/".encode() not in commands
    found = re.search(r'id="dtmpc-data" type="application/json">(.*?)</script>', page)
    assert found is not None
    news = json.loads(found[1])["news"]
    assert [entry[0] for entry in news] == [round(s.start, 3) for s in shown]
    assert news[1][1] == "t = 1.2 s, obstacle 1 found: certified"
    assert any("obstacle 2 found: braking" in entry[1] for entry in news)
    assert "obstacle that is not known yet" in page


def test_the_figure_has_the_first_plan_and_one_for_each_discovery(
    experiment: Experiment,
) -> None:
    log = log_of(experiment)
    figure = plot_receding_horizon(scenario=experiment.scenario, flight=log)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:4] == [
        "the first plan",
        "t = 1.0 s, now with obstacle 1: certified",
        "t = 4.0 s, now with obstacle 2: braking",
        "flown, in the tubes that were in force",
    ]
    # All at the same place and scale, and equal scales along both axes.
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes[:4]}) == 1
    assert all(axes.get_aspect() == 1.0 for axes in figure.axes[:4])
    with pytest.raises(ValueError, match="needs two"):
        plot_receding_horizon(
            scenario=experiment.scenario,
            flight=dataclasses.replace(log, state=log.state[..., :1]),
        )


def test_the_time_line_has_every_plan(experiment: Experiment) -> None:
    log = log_of(experiment)
    figure = plot_replans(scenario=experiment.scenario, flight=log)
    top, middle, bottom = figure.axes
    labels = [label.get_text() for label in top.get_yticklabels()]
    assert labels[-1] == "certified" and "braking" in labels
    heights = [bar.get_height() for bar in middle.patches]
    assert heights == [r.iterations for r in log.replans]
    assert len(bottom.patches) == len(log.replans)
    assert [t.get_text() for t in top.texts] == ["obstacle 1", "obstacle 2"]
