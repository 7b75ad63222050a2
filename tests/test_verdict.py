"""A flight is well only if it kept everything, at every step, in finite numbers."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import (
    ConstantValueSource,
    ConstantVectorSource,
    Integrator,
)
from typer.testing import CliRunner

from dtmpc_drake.__main__ import app
from dtmpc_drake.diagrams import FlyTrials, Simulate, draw_trials
from dtmpc_drake.diagrams.recorder import Recorder
from dtmpc_drake.experiments.monte_carlo import MonteCarlo, draw
from dtmpc_drake.experiments.simulate import run
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain, register_model
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import plan
from dtmpc_drake.records import verdict
from dtmpc_drake.records.flights import Flights
from dtmpc_drake.scenario import Limits, Planner, Scenario, Waypoint, to_yaml
from dtmpc_drake.systems import TubeMonitor

SHORT = Scenario(
    name="short",
    goal=Waypoint(position=[0.0, 3.0, 0.0]),
    duration=4.0,
    obstacles=[Cylinder([0.55, 1.5], 0.4)],
    planner=Planner(intervals=16),
)


@pytest.fixture(scope="module")
def short_plan():
    result = plan(SHORT)
    assert result.certified
    return result.plan


# The record.

LIMITS = Limits(input=5.0, speed=2.0)
KEPT = np.array([0.0, 0.5, 0.5, 0.5, -0.1, 1.0, 1.0, -np.inf])


def looks(values) -> np.ndarray:
    """The record of some looks, a second apart."""
    record = verdict.empty_record()
    for time, value in enumerate(values):
        record = verdict.look(
            record,
            time=float(time),
            value=np.array(value, dtype=float),
            where=lambda: np.zeros(8),
            largest=verdict.largest_kept(LIMITS),
        )
    return record


def words(values) -> str:
    found = verdict.breaches(looks(values), limits=LIMITS, model=DragDoubleIntegrator())
    return verdict.in_one_line(found) if found else ""


def with_(index: int, value: float) -> np.ndarray:
    changed = KEPT.copy()
    changed[index] = value
    return changed


def test_a_flight_that_keeps_everything_has_no_breach():
    assert words([KEPT, KEPT]) == ""
    assert not verdict.broken(looks([KEPT])).any()


@pytest.mark.parametrize(
    ("index", "value", "said"),
    [
        (verdict.LAYER, 1.0001, "|s|/Φ 1.0001"),
        (verdict.POSITION, 1.5, "|ỹ|/Ω 1.5"),
        (verdict.VELOCITY, 2.0, "|dỹ/dt|/W 2"),
        (verdict.OBSTACLES, 0.0, "clearance -0 m"),
        (verdict.OBSTACLES, 0.02, "clearance -0.02 m"),
        (verdict.INPUT, 5.1, "‖u‖ 5.1 m/s², but it must be at most 5 m/s²"),
        (verdict.SPEED, 2.1, "speed 2.1 m/s, but it must be at most 2 m/s"),
        (verdict.FINITE, 1.0, "not finite from t = 1.000 s on"),
    ],
)
def test_what_breaks_is_said_with_its_time_and_value(index, value, said):
    line = words([KEPT, with_(index, value), KEPT])
    assert said in line and "t = 1.000 s" in line


def test_what_broke_first_comes_first_and_the_worst_is_said_too():
    line = words(
        [
            KEPT,
            with_(verdict.INPUT, 6.0),
            with_(verdict.LAYER, 3.0),
            with_(verdict.INPUT, 9.0),
        ]
    )
    assert line.startswith("the input limit was broken at t = 1.000 s")
    assert "9 m/s² at t = 3.000 s" in line
    assert line.endswith("then layer (t = 2.000 s)")


@given(
    index=st.integers(1, 6),
    before=st.floats(-1, 10),
    after=st.lists(st.floats(-1, 10), max_size=4),
)
def test_no_later_look_hides_what_is_no_number(index, before, after):
    values = [with_(index, v) for v in (before, np.nan, *after)]
    record = looks(values)
    assert verdict.broken(record)[index]
    assert record[verdict.WORST, index] == np.inf


@given(values=st.lists(st.floats(-2, 2) | st.just(np.nan), min_size=1, max_size=6))
def test_a_break_is_never_forgotten_and_never_invented(values):
    record = looks([with_(verdict.LAYER, v) for v in values])
    assert verdict.broken(record)[verdict.LAYER] == any(not v <= 1 for v in values)


def test_what_nobody_looked_at_is_not_kept():
    assert verdict.broken(verdict.empty_record()).all()
    assert words([]) == "nobody looked at the flight"


# The monitor.


class Jump(LeafSystem):
    """The state of a plan's reference, but for a displacement in a short time."""

    def __init__(self, plan, start: float, end: float, value: float) -> None:
        LeafSystem.__init__(self)

        def calc(context, output):
            t = context.get_time()
            state = plan.reference(t)[:2].copy()
            if start <= t <= end:
                state[0, 0] += value
            output.SetFromVector(state.ravel())

        self.DeclareVectorOutputPort("state", 6, calc, {self.time_ticket()})
        self.DeclareVectorOutputPort(
            "control", 3, lambda c, o: o.SetZero(), {self.nothing_ticket()}
        )


def monitored(short_plan, *, start, end, value, until=1.0, step=0.0015):
    """The record of a plant that the integrator takes to its end in small steps."""
    builder = DiagramBuilder()
    # Without a continuous state the simulator would take one step to the end.
    clock = builder.AddSystem(Integrator(1))
    builder.Connect(
        builder.AddSystem(ConstantVectorSource([1.0])).get_output_port(),
        clock.get_input_port(),
    )
    jump = builder.AddSystem(Jump(short_plan, start, end, value))
    source = builder.AddSystem(ConstantValueSource(Value[object](short_plan)))
    monitor = TubeMonitor.AddToBuilder(
        builder=builder,
        scenario=SHORT,
        state=jump.GetOutputPort("state"),
        plan=source.get_output_port(),
        control=jump.GetOutputPort("control"),
    )
    simulator = Simulator(builder.Build())
    simulator.get_mutable_integrator().set_maximum_step_size(step)
    simulator.Initialize()
    simulator.AdvanceTo(until)
    context = monitor.GetMyContextFromRoot(simulator.get_context())
    return monitor.GetOutputPort("record").Eval(context).reshape(6, 8)


def test_a_peak_between_two_samples_of_a_log_is_seen(short_plan):
    record = monitored(short_plan, start=0.503, end=0.507, value=5.0)
    assert verdict.broken(record)[verdict.LAYER]
    assert 0.503 <= record[verdict.SINCE, verdict.LAYER] <= 0.507
    assert not verdict.broken(
        monitored(short_plan, start=0.503, end=0.507, value=0.0)
    ).any()


def test_the_last_instant_is_seen(short_plan):
    record = monitored(short_plan, start=1.0, end=1.0, value=5.0)
    assert record[verdict.SINCE, verdict.POSITION] == 1.0


def test_a_state_that_was_not_a_number_once_stays_so(short_plan):
    record = monitored(short_plan, start=0.5, end=0.51, value=np.nan)
    found = verdict.breaches(record, limits=LIMITS, model=DragDoubleIntegrator())
    assert found[0].what == "not_finite"
    assert verdict.extremes(record)["worst_position_ratio"] == np.inf


# Flights.


@register_model
class Hidden(DragDoubleIntegrator):
    """A plant that does what its model does not allow for."""

    def __init__(self, push: float) -> None:
        super().__init__(0.1, 0.0)
        self._push = push

    def drift(self, x):
        return super().true_drift(x, {"drag": self.drag_estimate})

    def true_drift(self, x, parameters):
        drift = super().true_drift(x, parameters)
        far = np.clip(x[..., 0, 1:2] - 1.0, 0.0, None)
        return drift + self._push * far * np.array([1.0, 0.0, 0.0])


def test_a_flight_that_leaves_its_tube_is_not_called_well(short_plan, tmp_path):
    log = Simulate(dataclasses.replace(SHORT, model=Hidden(5.0)), plan=short_plan)
    found = log.breaches(SHORT)
    assert found and found[0].what in ("layer", "position", "velocity")
    assert log.extremes()["worst_layer_ratio"] > 1


def test_a_flight_that_keeps_all_is(short_plan):
    assert Simulate(SHORT, plan=short_plan).breaches(SHORT) == ()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_flights_that_are_not_finite_are_counted_drawn_and_not_safe(
    short_plan, tmp_path
):
    """One of four blows up; the figures show the others."""
    wild = dataclasses.replace(SHORT, model=Hidden(0.0))
    trials = draw_trials(wild, range(4))
    good = FlyTrials(wild, plan=short_plan, trials=trials)
    assert good.safe
    record = good.record.copy()
    recorder = Recorder(wild, trials)
    # As the monitor of a flight that blows up after 3 s has them.
    record[1] = looks([KEPT, np.full(8, np.nan)])
    for row, time in enumerate(good.time):
        position, seen = good.position[:, row].copy(), np.tile(KEPT, (4, 1))
        seen[:, verdict.POSITION] = good.position_ratio[:, row]
        if time >= 3:
            position[1], seen[1] = np.nan, np.nan
        recorder.look(time, seen)
        recorder.sample(position)
    bad = recorder.flights(record.swapaxes(0, 1))
    assert np.isinf(bad.position_ratio[1, good.time >= 3]).all()
    assert not bad.safe
    assert bad.violations["not_finite"] == 1 and bad.outside == 1
    assert bad.hardest != 1
    json.dumps(bad.summary())
    result = plan(SHORT)
    ended = MonteCarlo(SHORT, result, {"a": good, "b": bad}, ())
    assert not ended.safe and "inf" in ended.table()
    assert "b: of 4 flights broke: not finite 1, layer 1" in repr(ended)
    draw(SHORT, short_plan, {"a": good, "b": bad}, tmp_path)
    assert (tmp_path / "quantiles.png").exists()


def test_no_flights_are_not_safe_ones(short_plan):
    trials = draw_trials(SHORT, range(2))
    flights = FlyTrials(SHORT, plan=short_plan, trials=trials)
    none = {
        f.name: getattr(flights, f.name)[:0]
        for f in dataclasses.fields(Flights)
        if f.name not in ("parameters", "time")
    }
    assert not Flights(time=flights.time, parameters={}, **none).safe
    assert not MonteCarlo(SHORT, plan(SHORT), {}, ()).safe


# Exit codes.


LATE = dataclasses.replace(
    SHORT,
    name="late",
    goal=Waypoint(position=[0.0, 6.0, 0.0]),
    obstacles=[Cylinder([0.0, 3.0], 0.6, known_from=1.6)],
)
"""It becomes known too near to stop or to turn aside."""


def test_a_flight_into_an_obstacle_ends_with_three_and_says_why(tmp_path):
    file = tmp_path / "late.yaml"
    file.write_text(to_yaml(LATE), encoding="utf-8")
    result = CliRunner().invoke(
        app, ["simulate", str(file), "--out", str(tmp_path / "out")]
    )
    assert result.exit_code == 3
    (line,) = result.stderr.splitlines()
    assert "an obstacle was hit at t = " in line and "(obstacle 0)" in line
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["certified"] is True
    assert summary["flight_ok"] is False
    assert "an obstacle was hit" in summary["flight"]
    assert {"obstacles", "decision"} <= {one["what"] for one in summary["breaches"]}


def test_a_flight_that_is_well_says_so(tmp_path):
    experiment = run(SHORT, tmp_path)
    assert experiment.safe
    assert experiment.summary()["flight_ok"] is True
    assert "kept layer, tubes, limits and obstacles" in repr(experiment)


@register_model
class Exploding(Hidden):
    """A plant that leaves all numbers behind within some steps."""

    def true_drift(self, x, parameters):
        drift = super().true_drift(x, parameters)
        y = np.clip(x[..., 0, 1:2], 0.0, 4.0)
        return drift + np.where(y > 1.0, np.exp(50 * y**2), 0.0)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_flight_that_blows_up_is_drawn_and_said(tmp_path):
    experiment = run(dataclasses.replace(SHORT, model=Exploding(0.0)), tmp_path)
    assert experiment.result.certified and not experiment.safe
    assert "not_finite" in {one.what for one in experiment.breaches}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["certified"] is True and summary["flight_ok"] is False
    assert summary["extremes"]["worst_layer_ratio"] is None  # no number
    assert {path.name for path in tmp_path.iterdir()} >= {"replay.html", "log.npz"}


def test_what_is_not_flown_is_neither(tmp_path):
    weak = dataclasses.replace(SHORT, limits=Limits(input=0.3))
    experiment = run(weak, tmp_path)
    assert experiment.summary()["flight_ok"] is None
    assert not experiment.safe


def test_the_speed_of_a_single_integrator_is_watched_from_step_to_step():
    scenario = Scenario(
        name="first_order",
        model=IntegratorChain(2, 1, 0.0),
        start=Waypoint([0.0, 0.0]),
        goal=Waypoint([0.0, 3.0]),
        duration=4.0,
        planner=Planner(intervals=16),
    )
    scenario.disturbance.bound = [0.1, 0.1]
    scenario.controller.slope = [2.0, 2.0]
    log = Simulate(scenario)
    assert log.breaches(scenario) == ()
    slow = dataclasses.replace(scenario, limits=Limits(speed=0.4))
    (found, *_) = log_with_limits(log, slow)
    assert found == "speed"


def log_with_limits(log, scenario) -> list[str]:
    """What a flight would have broken, had its limits been a scenario's."""
    again = Simulate(
        dataclasses.replace(scenario, planner=scenario.planner),
        plan=plan(dataclasses.replace(scenario, limits=Limits(speed=2.5))).plan,
    )
    return [one.what for one in again.breaches(scenario)]
