"""Logs may be coarse: nothing is lost between two samples, and no flight is another."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from dtmpc_drake.__main__ import app
from dtmpc_drake.diagrams import FlyTrials, Simulate, SimulateTrials, draw_trials
from dtmpc_drake.disturbances import DISTURBANCES, BangBang
from dtmpc_drake.models import DragDoubleIntegrator
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.sampling import samples, step_times
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import hold_plan, plan
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Planner, Scenario, Simulation, Waypoint, to_yaml
from dtmpc_drake.visualization.style import drawn_period

KINDS = {
    kind.short_name: kind.hard
    for kind in DISTURBANCES
    if kind.short_name and kind.__module__.startswith("dtmpc_drake.")
}
SHORT = Scenario(
    name="short",
    disturbance=BangBang(hold=0.33),
    goal=Waypoint(position=[0.0, 3.0, 0.0]),
    duration=4.0,
    obstacles=[Cylinder([0.55, 1.5], 0.4)],
    planner=Planner(intervals=16),
)


@pytest.fixture(scope="module")
def short_plan() -> Plan:
    result = plan(SHORT)
    assert result.certified and result.plan is not None
    return result.plan


def simulated(scenario: Scenario, **fields: Any) -> Scenario:
    """The scenario with other fields of its simulation."""
    simulation = dataclasses.replace(scenario.simulation, **fields)
    return dataclasses.replace(scenario, simulation=simulation)


# When.


def test_a_flight_is_stepped_evenly_and_to_its_end() -> None:
    np.testing.assert_array_equal(step_times(1.0, 0.25), [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_array_equal(step_times(0.6, 0.25), [0, 0.25, 0.5, 0.6])
    np.testing.assert_array_equal(step_times(0.1, 0.25), [0, 0.1])
    # Rounding makes no step of its own.
    assert len(step_times(14.0, 0.01)) == len(step_times(14.0 + 1e-12, 0.01)) == 1401


def test_every_period_has_a_sample_and_so_has_the_end() -> None:
    np.testing.assert_array_equal(samples(step_times(1.0, 0.1), 0.3), [0, 3, 6, 9, 10])
    # Of steps that do not divide the period, the first in each.
    np.testing.assert_array_equal(samples(step_times(1.0, 0.2), 0.5), [0, 3, 5])
    np.testing.assert_array_equal(samples(step_times(1.0, 0.2), 1e-6), np.arange(6))
    np.testing.assert_array_equal(samples(step_times(1.0, 0.2), 1e6), [0, 5])


@given(
    st.floats(1e-3, 1e3), st.integers(1, 3000), st.floats(1e-3, 1), st.floats(0.1, 50)
)
def test_steps_and_samples_are_as_long_as_asked_for(
    step: float, count: int, part: float, periods: float
) -> None:
    duration = (count - 1 + part) * step
    times = step_times(duration, step)
    assert times[0] == 0.0 and times[-1] == duration
    assert (np.diff(times) > 0).all() and np.diff(times).max() <= step * (1 + 1e-5)
    kept = times[samples(times, periods * step)]
    assert kept[0] == 0.0 and kept[-1] == duration
    assert np.diff(kept).max() < (periods + 1) * step * (1 + 1e-5)


# What.


def test_a_coarse_log_is_of_the_same_flight_to_the_last_bit(short_plan: Plan) -> None:
    fine = Simulate(SHORT, plan=short_plan)
    coarse = Simulate(simulated(SHORT, log_period=0.7), plan=short_plan)
    rows = [*range(0, 400, 70), 400]
    np.testing.assert_array_equal(coarse.time, fine.time[rows])
    for name in ("state", "control", "reference", "disturbance", "tube_ratios"):
        np.testing.assert_array_equal(getattr(coarse, name), getattr(fine, name)[rows])


def test_no_peak_is_lost_between_the_samples_of_a_log(short_plan: Plan) -> None:
    fine = Simulate(SHORT, plan=short_plan)
    coarse = Simulate(simulated(SHORT, log_period=3.0), plan=short_plan)
    np.testing.assert_array_equal(coarse.record, fine.record)
    # There are peaks that only the record has.
    peaks = fine.tube_ratios.max(axis=(0, 2))
    assert (coarse.tube_ratios.max(axis=(0, 2)) < peaks).all()
    assert coarse.clearance.min() > fine.clearance.min() + 0.05
    seen = coarse.extremes()
    assert seen["worst_layer_ratio"] == peaks[0]
    assert seen["worst_position_ratio"] == peaks[1]
    assert seen["smallest_clearance"] == fine.clearance.min()


@pytest.mark.parametrize("disturbance", KINDS)
def test_nothing_is_lost_between_the_samples_of_many_flights(
    short_plan: Plan, disturbance: str
) -> None:
    pushed = dataclasses.replace(SHORT, disturbance=KINDS[disturbance]([0.5] * 3))
    trials = draw_trials(pushed, range(5))
    log = SimulateTrials(pushed, plan=short_plan, trials=trials)
    used = log.tube_ratios[:, :, 1].max(axis=-1)
    fine = FlyTrials(pushed, plan=short_plan, trials=trials)
    coarse = FlyTrials(
        simulated(pushed, log_period=1.5), plan=short_plan, trials=trials
    )
    assert fine.time.tolist() == log.time[::5].tolist()
    np.testing.assert_array_equal(coarse.time, [0, 1.5, 3, 4])
    for flights in (fine, coarse):
        np.testing.assert_array_equal(flights.record, log.record.swapaxes(0, 1))
        np.testing.assert_array_equal(flights.effort, fine.effort)
        ends = np.searchsorted(log.time, flights.time)
        np.testing.assert_array_equal(
            flights.position, log.position[ends].swapaxes(0, 1)
        )
        starts = [0, *(ends[:-1] + 1)]
        for k, (start, end) in enumerate(zip(starts, ends, strict=True)):
            peak, seen = used[start : end + 1].max(axis=0), flights.position_ratio[:, k]
            assert (peak <= seen).all()
            # A step may end within rounding of the sample before.
            assert (seen <= np.maximum(peak, used[max(start - 1, 0)]) + 1e-9).all()


def test_a_peak_between_two_steps_of_the_grid_is_seen_too(short_plan: Plan) -> None:
    """The wind changes every 0.33 s, which cuts steps of 0.25 s."""
    rough = simulated(SHORT, max_step_size=0.25)
    trials = draw_trials(rough, range(20))
    log = SimulateTrials(rough, plan=short_plan, trials=trials)
    flights = FlyTrials(rough, plan=short_plan, trials=trials)
    used = flights.worst_ratios[:, 1]
    np.testing.assert_array_equal(flights.position_ratio.max(axis=1), used)
    assert (log.tube_ratios[:, :, 1].max(axis=(0, 2)) < used).any()


# How much work.


class Counting(DragDoubleIntegrator):
    """Counts how often its plant is asked."""

    asked = 0

    def true_drift(self, x: Array, parameters: Mapping[str, Any]) -> Array:
        type(self).asked += 1
        return super().true_drift(x, parameters)


def asked(**fields: Any) -> tuple[int, Flight]:
    """How often a model is asked in a flight at rest, and its log."""
    scenario = Scenario(
        model=Counting(),
        disturbance=BangBang(hold=10.0),
        goal=Waypoint(position=[0.0] * 3),
        **fields,
    )
    resting = hold_plan(scenario)
    Counting.asked = 0
    log = Simulate(scenario, plan=resting)
    return Counting.asked, log


def test_a_flight_costs_its_steps_whatever_its_log_and_its_length() -> None:
    step = Simulation(max_step_size=0.25)
    short, _ = asked(duration=100.0, simulation=step)
    long, log = asked(duration=400.0, simulation=step)
    assert len(log.time) == 1601  # a log cannot have more samples than there are steps
    # Three stages for the plant, and as many for the controller.
    assert long <= 6 * 1600 * 1.1
    assert long == pytest.approx(4 * short, rel=0.01)
    often, _ = asked(duration=100.0, simulation=Simulation(max_step_size=0.25))
    rarely, log = asked(
        duration=100.0, simulation=Simulation(max_step_size=0.25, log_period=10.0)
    )
    assert often == rarely
    assert len(log.time) == 11


# What is said on the way.


def test_a_flight_says_how_far_it_is(short_plan: Plan) -> None:
    said: list[float] = []
    log = Simulate(SHORT, plan=short_plan, progress=said.append)
    np.testing.assert_array_equal(said, log.time[1:])


@pytest.mark.slow
def test_a_terminal_is_told_how_much_is_flown_and_nobody_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "short.yaml"
    file.write_text(to_yaml(SHORT), encoding="utf-8")

    def output(*options: str) -> str:
        arguments = ["simulate", str(file), "--out", str(tmp_path / "out"), *options]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        return result.output

    piped, quiet = output(), output("--quiet")
    monkeypatch.setenv("FORCE_COLOR", "1")  # as on a terminal
    shown, hushed = output(), output("--quiet")
    assert "of 4 s" in shown
    for text in (piped, quiet, hushed):
        assert "of 4 s" not in text
        assert "kept layer, tubes, limits and obstacles" in text
    # The iterations are progress, too.
    iterations = "violation"
    assert iterations in piped and iterations in shown
    assert iterations not in quiet and iterations not in hushed


def test_a_long_plan_is_drawn_with_no_more_samples_than_one_sees() -> None:
    scenario = Scenario(goal=Waypoint(position=[0.0] * 3), duration=1600.0)
    long = hold_plan(scenario)
    assert len(long.sample_times(drawn_period(long, 0.025))) == 4001
    short = long.between(0.0, 14.0)
    assert drawn_period(short, 0.025) == 0.025
