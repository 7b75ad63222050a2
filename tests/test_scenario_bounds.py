"""Whatever is written into a scenario: one line, before memory or time is spent."""

from __future__ import annotations

import dataclasses
import math
import os
import pickle
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtmpc_drake.disturbances import BangBang, UniformHold
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain, register_model
from dtmpc_drake.obstacles import Cylinder, Ellipsoid, Sphere
from dtmpc_drake.planning import plan
from dtmpc_drake.planning.canonical import canonical
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.certify import INTERVALS, certify
from dtmpc_drake.planning.proof.enclosure import enclose
from dtmpc_drake.planning.scp.linearise import kinked_coordinates
from dtmpc_drake.planning.scp.sensitivity import transitions
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.records.flights import REPORT_PERIOD
from dtmpc_drake.scenario import (
    Bandwidth,
    Controller,
    Limits,
    Planner,
    Scenario,
    Sensing,
    Simulation,
    Waypoint,
    load_scenario,
    parse_scenario,
    require_trials,
    size,
    to_yaml,
    validate,
)
from dtmpc_drake.scenario.text import DEEPEST, MOST_BYTES, MOST_VALUES, read_yaml

LEAST = """
start: {position: [0, 0, 0]}
goal: {position: [0, 10, 0]}
duration: 10
"""


def complaint(text: str) -> ScenarioError:
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(text)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 1000
    return caught.value


# Files and texts.


def test_a_file_of_aliases_is_refused_before_it_is_expanded() -> None:
    """Ten lines that stand for seven thousand million texts."""
    lines = ['a: &a ["lol", "lol"]']
    for before, name in zip("abcdefghi", "bcdefghij", strict=True):
        lines.append(f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]")
    tracemalloc.start()
    error = complaint("\n".join(lines))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "at most 50000" in str(error) and peak < 100e6


def test_a_file_that_holds_itself_is_refused() -> None:
    error = complaint(LEAST + "obstacles: &o [*o]")
    assert error.field == "line 5" and "at most 16" in str(error)


def test_an_alias_may_repeat_a_few_values() -> None:
    text = "_three: &three [0.1, 0.2, 0.3]\ndisturbance: {bound: *three}"
    assert parse_scenario(LEAST + text).disturbance.bound == [0.1, 0.2, 0.3]


@pytest.mark.parametrize("opening", ["[", "{a: ", "- ", "[{a: "])
@pytest.mark.parametrize("depth", [DEEPEST + 1, 400, 20_000])
def test_a_deep_text_is_refused_before_the_stack_ends(opening: str, depth: int) -> None:
    assert "at most 16" in str(complaint(opening * depth))
    assert "a name, before a colon" in str(complaint("? " * depth))


def test_a_long_text_is_refused_before_it_is_read() -> None:
    many = "[" + "1, " * MOST_VALUES + "1]"
    assert "at most 50000" in str(complaint(f"obstacles: {many}"))
    long = "#" * (MOST_BYTES + 1)
    assert complaint(long).field == "the file"
    assert "1000 characters" in str(complaint(f"name: {'a' * 1001}"))


def test_a_file_is_small_and_regular(tmp_path: Path) -> None:
    fifo, large, binary = (tmp_path / name for name in ("fifo", "large", "binary"))
    os.mkfifo(fifo)
    large.write_text("#" * (MOST_BYTES + 1))
    binary.write_bytes(b"\x7fELF\x02\x00\xff\xfe")
    for path, reason in (
        (fifo, "not a regular file"),
        ("/dev/zero", "not a regular file"),
        ("/dev/urandom", "not a regular file"),
        (tmp_path, "Is a directory"),
        (large, "more than 256 KiB"),
        (binary, "not a text file"),
        ("x" * 5000, "File name too long"),
        ("a\0b", "null"),
    ):
        with pytest.raises(ScenarioError, match=reason) as caught:
            load_scenario(path)
        assert str(caught.value).isprintable()


def test_a_byte_order_mark_and_windows_line_ends_are_no_part_of_a_text(
    tmp_path: Path,
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_bytes(b"\xef\xbb\xbf" + LEAST.replace("\n", "\r\n").encode())
    assert load_scenario(file) == parse_scenario(LEAST)


@pytest.mark.parametrize(
    ("text", "field", "allowed"),
    [
        ("name: !!binary aGk=", "name", "without a tag"),
        ("name: !!python/name:os.system x", "name", "without a tag"),
        ("duration: !!set {a}", "duration", "a number"),
        ("plant: !!set {drag}", "plant", "without a tag"),
        ("obstacles: !!omap [a: 1]", "obstacles", "a list without a tag"),
        ("duration: !!int x", "duration", "what its tag says: int"),
        ("duration: !!float ''", "duration", "what its tag says: float"),
        ("duration: !!bool 7", "duration", "what its tag says: bool"),
        ("duration: 1e400", "duration", "a finite number"),
        ("duration: 0x" + "f" * 900, "duration", "a finite number"),
        ("simulation: {seed: 0x" + "f" * 900 + "}", "simulation.seed", "[0, 2^32)"),
        ("duration: 2020-01-01", "duration", "a number"),
        ("? [1]\n: 2", "line 1", "a name"),
        ("? {a: 1}\n: 2", "line 1", "a name"),
        ("limits: {_tag: '!Limits'}", "limits._tag", "left out"),
        ("<<: {duration: 3}", "<<", "left out"),
        ('"a\\nb": 1', "a\nb", "left out"),
        ('"\\e[31m": 1', "\x1b[31m", "left out"),
        ("'': 1", "''", "left out"),
        ("plant: {'\\': 1}", "plant.\\", "one of: drag"),
        ('name: "\\ud800"', "name", "a file name"),
        ('name: "\\UFFFFFFFF"', "the file", "valid YAML"),
        ("name: \ud800", "the file", "valid YAML"),
        ("%YAML 1." + "9" * 5000, "the file", "valid YAML"),
        (f"name: {'é' * 101}", "name", "at most 200 bytes"),
    ],
)
def test_strange_yaml_gets_one_line(text: str, field: str, allowed: str) -> None:
    first = text.split(":")[0]
    rest = [line for line in LEAST.splitlines() if not line.startswith(first)]
    error = complaint("\n".join([text, *rest]) if text[0] != "%" else text)
    assert error.field == field
    assert allowed in str(error)


def test_unicode_names_are_names() -> None:
    assert parse_scenario(LEAST + "name: Überflug 無人機").name == "Überflug 無人機"


def test_a_text_that_looks_like_a_number_stays_a_name() -> None:
    for name in ("1e3", "2020-01-01", "nan"):
        scenario = parse_scenario(LEAST + f"name: {name}")
        assert scenario.name == name
        assert parse_scenario(to_yaml(scenario)) == scenario


def test_a_text_is_read_in_one_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    import yaml

    events = list(yaml.parse(LEAST))
    seen, get_event = [], yaml.SafeLoader.get_event

    def counting(loader: yaml.SafeLoader) -> yaml.Event:
        seen.append(get_event(loader))
        return seen[-1]

    monkeypatch.setattr(yaml.SafeLoader, "get_event", counting)
    parse_scenario(LEAST)
    assert [type(event) for event in seen] == [type(event) for event in events[:-1]]


def test_a_section_keeps_its_tag_and_a_list_has_none() -> None:
    data = read_yaml("a: !Cylinder {center: [1, 2.5], known_from: null}")
    assert data == {"a": {"center": [1, 2.5], "known_from": None}}
    assert (data.tag, data["a"].tag) == (None, "!Cylinder")


def test_an_error_comes_back_whole_from_another_process() -> None:
    error = ScenarioError("duration", -1.0, "greater than 0 s")
    again = pickle.loads(pickle.dumps(error))
    assert (again.field, again.value, str(again)) == ("duration", -1.0, str(error))


# Magnitudes.

SET: dict[str, Callable[[Scenario, float], Any]] = {
    "limits.speed": lambda s, x: setattr(s.limits, "speed", x),
    "limits.input": lambda s, x: setattr(s.limits, "input", x),
    "duration": lambda s, x: setattr(s, "duration", x),
    "cost.input": lambda s, x: setattr(s.cost, "input", x),
    "cost.bandwidth_rate": lambda s, x: setattr(s.cost, "bandwidth_rate", x),
    "start.position[0]": lambda s, x: s.start.position.__setitem__(0, x),
    "goal.position[1]": lambda s, x: s.goal.position.__setitem__(1, x),
    "disturbance.bound[2]": lambda s, x: s.disturbance.bound.__setitem__(2, x),
    "disturbance.hold": lambda s, x: setattr(s.disturbance, "hold", x),
    "controller.slope[0]": lambda s, x: s.controller.slope.__setitem__(0, x),
    "controller.reaching_rate": lambda s, x: setattr(s.controller, "reaching_rate", x),
    "controller.bandwidth.max": lambda s, x: setattr(s.controller.bandwidth, "max", x),
    "model.drag_estimate": lambda s, x: setattr(s.model, "drag_estimate", x),
    "simulation.max_step_size": lambda s, x: setattr(s.simulation, "max_step_size", x),
    "simulation.log_period": lambda s, x: setattr(s.simulation, "log_period", x),
    "sensing.period": lambda s, x: setattr(s.sensing, "period", x),
    "planner.time_budget": lambda s, x: setattr(s.planner, "time_budget", x),
    "planner.compute_delay": lambda s, x: setattr(s.planner, "compute_delay", x),
}


@pytest.mark.parametrize("field", SET)
@pytest.mark.parametrize("value", [1e200, 1e30, -1e200, np.inf, np.nan])
def test_no_number_is_larger_than_its_unit_allows(field: str, value: float) -> None:
    scenario = parse_scenario(LEAST)
    SET[field](scenario, value)
    with pytest.raises(ScenarioError) as caught:
        validate(scenario)
    assert caught.value.field == field
    assert f"got {value:g}, but" in str(caught.value)
    if np.isfinite(value):
        assert "in [" in str(caught.value)


@pytest.mark.parametrize(
    ("field", "unit"),
    [
        ("duration", "s"),
        ("limits.speed", "m/s"),
        ("limits.input", "m/s²"),
        ("controller.reaching_rate", "m/s²"),
        ("controller.slope[0]", "1/s"),
        ("disturbance.hold", "s"),
        ("simulation.max_step_size", "s"),
        ("simulation.log_period", "s"),
        ("sensing.period", "s"),
    ],
)
def test_what_must_not_be_zero_is_not_next_to_zero(field: str, unit: str) -> None:
    scenario = parse_scenario(LEAST)
    SET[field](scenario, 1e-30)
    with pytest.raises(ScenarioError, match=rf"greater than 0 {unit}, in \[") as caught:
        validate(scenario)
    assert caught.value.field == field


def test_next_to_zero_is_as_good_as_zero_where_that_is_allowed() -> None:
    scenario = parse_scenario(LEAST)
    for field in ("disturbance.bound[2]", "start.position[0]", "model.drag_estimate"):
        SET[field](scenario, 5e-324)
    scenario.plant["drag"] = 0.0
    validate(scenario)


def in_units(length: float, time: float) -> Scenario:
    """The first experiment with other units of length and time, in m and s."""
    s = load_scenario("known_environment")
    speed, push = time / length, time**2 / length
    s.start.position = [x / length for x in s.start.position]
    s.goal.position = [x / length for x in s.goal.position]
    for end in (s.start, s.goal):
        end.velocity = [x * speed for x in end.velocity or []]
    for obstacle in s.obstacles:
        obstacle.center = [x / length for x in obstacle.center]
        obstacle.radius /= length
    s.duration /= time
    s.disturbance = UniformHold([x * push for x in s.disturbance.bound], 0.05 / time)
    s.controller = Controller(
        slope=[2.0 * time] * 3,
        reaching_rate=0.1 * push,
        initial_boundary_layer=0.3 * speed,
        bandwidth=Bandwidth(0.5 * time, 4.0 * time, 2.0 * time**2),
    )
    s.limits = Limits(5.0 * push, 2.5 * speed)
    s.model = DragDoubleIntegrator(0.1 * length, 0.0)
    s.plant = {}
    s.sensing.period /= time
    s.simulation.max_step_size /= time
    return s


@pytest.mark.parametrize("length", [1e-3, 0.3048, 1.0, 1000.0])
@pytest.mark.parametrize("time", [1e-3, 0.5, 1.0, 60.0])
def test_other_peoples_units_pass(length: float, time: float) -> None:
    validate(in_units(length, time))


def descent() -> Scenario:
    """278 km at 260 m/s."""
    return Scenario(
        model=IntegratorChain(2, 2, 0.0),
        disturbance=UniformHold([0.3, 0.3], 5.0),
        controller=Controller([0.1, 0.1], 1e-6, 2.0, Bandwidth(0.1, 0.5, 0.1)),
        limits=Limits(3.0, 260.0),
        start=Waypoint([0.0, 10973.0], [236.6, 0.0]),
        goal=Waypoint([277800.0, 610.0], [72.0, 0.0]),
        duration=1600.0,
        obstacles=[Sphere([140000.0, 6000.0], 3000.0)],
        planner=Planner(intervals=100),
        simulation=Simulation(max_step_size=0.5),
    )


def test_a_long_flight_passes() -> None:
    validate(descent())
    require_trials(descent(), 300, 50)


# Memory and work.


@pytest.mark.parametrize(
    ("changes", "field", "named"),
    [
        ({"controller": Controller([1e6, 2, 2])}, "controller.slope", "duration"),
        (
            {"controller": Controller(bandwidth=Bandwidth(max=1e6))},
            "controller.bandwidth.max",
            "duration",
        ),
        (
            {
                "obstacles": [Cylinder([50.0, 50.0], 1.0)] * 5000,
                "planner": Planner(intervals=100),
            },
            "obstacles",
            "planner.intervals",
        ),
        ({"duration": 60_000.0}, "simulation.max_step_size", "duration"),
        (
            {"simulation": Simulation(max_step_size=1e-6)},
            "simulation.max_step_size",
            "duration",
        ),
        ({"sensing": Sensing(period=1e-6)}, "sensing.period", "duration"),
        ({"disturbance": BangBang(hold=1e-6)}, "disturbance.hold", "duration"),
        (
            {
                "planner": Planner(replan_period=2e-5, compute_delay=0.0),
                "sensing": Sensing(period=1e-5),
            },
            "planner.replan_period",
            "duration",
        ),
        (
            {
                "planner": Planner(initial_guess="best_side", time_budget=1e9),
                "obstacles": [Cylinder([5.0, float(y)], 1.0) for y in range(20)],
            },
            "planner.time_budget",
            "obstacles",
        ),
        (
            {
                "planner": Planner(initial_guess="best_side"),
                "obstacles": [Cylinder([5.0, 5.0], 1.0)] * 20,
                "goal": Waypoint([0.0, 9e8, 0.0]),
                "limits": Limits(5.0, 1e9),
            },
            "goal.position",
            "planner.time_budget",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_takes_too_much_is_refused_before_it_is_begun(
    changes: dict[str, Any], field: str, named: str
) -> None:
    scenario = dataclasses.replace(parse_scenario(LEAST), **changes)
    with pytest.raises(ScenarioError) as caught:
        validate(scenario)
    assert caught.value.field == field
    assert named in str(caught.value) and len(str(caught.value)) < 1000


@pytest.mark.parametrize("limit", [1e8, 1e300])
def test_a_limit_of_the_rate_beyond_the_whole_range_is_no_limit(limit: float) -> None:
    """Whatever its size, it is the same problem: the same plan to the last bit."""
    scenario = load_scenario("known_environment")
    scenario.controller.bandwidth.rate_max = limit
    result = plan(scenario)
    # From one end of the range to the other between two knots.
    scenario.controller.bandwidth.rate_max = 1000.0
    other = plan(scenario)
    assert result.certified and other.certified
    assert result.plan is not None and other.plan is not None
    for field in dataclasses.fields(result.plan):
        same = getattr(result.plan, field.name) == getattr(other.plan, field.name)
        assert np.all(same)


@pytest.mark.parametrize("order", [7, 8, 9, 10])
def test_chains_of_high_order_are_planned(order: int) -> None:
    scenario = parse_scenario(
        f"model: !IntegratorChain {{num_outputs: 2, order: {order}}}\n"
        "disturbance: !UniformHold {bound: [0.01, 0.01]}\n"
        "controller: {slope: [1.0, 1.0]}\n"
        "limits: {input: 1e6, speed: 100}\n"
        "start: {position: [0, 0]}\n"
        "goal: {position: [1, 1]}\n"
        "planner: {intervals: 28}\n"
        "duration: 20\n"
    )
    result = plan(scenario)
    assert result.certified and result.plan is not None
    # All derivatives that are states are continuous, as far as numbers go.
    coefficients = result.plan.coefficients
    step = result.plan.knots[1] - result.plan.knots[0]
    for k in range(order + 1):
        falling = np.array([math.perm(p, k) for p in range(order + 2)])
        terms = falling[k:, None] * coefficients[:, k:]
        ends = (terms * step ** np.arange(order + 2 - k)[:, None]).sum(axis=1)
        starts = terms[:, 0]
        jump = np.abs(ends[:-1] - starts[1:]).max()
        assert jump < 1e-6 * np.abs(starts).max()


def test_a_model_error_that_runs_away_ends_a_plan_and_not_the_process() -> None:
    """On coarse grids its linearisation grows beyond all numbers."""
    scenario = load_scenario("unknown_drag")
    scenario.model = DragDoubleIntegrator(0.1, 1261.0)
    with np.errstate(all="ignore"):
        result = plan(scenario)
    assert result.status == "failed"


def test_many_outputs_are_counted_too() -> None:
    m = 800
    scenario = Scenario(
        model=IntegratorChain(m, 2, 0.0),
        disturbance=UniformHold([0.1] * m),
        controller=Controller([2.0] * m),
        start=Waypoint([0.0] * m),
        goal=Waypoint([1.0] * m),
    )
    with pytest.raises(ScenarioError, match=r"^planner\.intervals: .* GiB"):
        validate(scenario)


def test_as_many_trials_as_there_is_memory_and_time_for() -> None:
    scenario = load_scenario("known_environment")
    require_trials(scenario, 1000)
    require_trials(scenario, 30_000)
    with pytest.raises(ScenarioError, match=r"^trials: got 100000, .*\(duration\)"):
        require_trials(scenario, 100_000)
    with pytest.raises(ScenarioError, match=r"^batch-size: got 1000000, .* memory"):
        require_trials(scenario, 1_000_000, 1_000_000)
    scenario.disturbance = UniformHold(hold=1e-5)
    with pytest.raises(ScenarioError, match=r"^batch-size"):
        require_trials(scenario, 1000)


def sized(
    order: int, outputs: int, intervals: int, slope: float, error: bool
) -> Scenario:
    drag = DragDoubleIntegrator(0.1, 0.1)
    return Scenario(
        model=drag if error else IntegratorChain(outputs, order, 0.0),
        disturbance=UniformHold([0.1] * outputs),
        controller=Controller([slope] * outputs),
        start=Waypoint([0.0] * outputs),
        goal=Waypoint([4.0] * outputs),
        limits=Limits(1000.0, 10.0),
        duration=14.0,
        planner=Planner(intervals=intervals),
    )


LARGE = pytest.mark.slow
SIZES = [
    pytest.param((2, 3, 56, 200.0, False), marks=LARGE),
    pytest.param((2, 3, 56, 50.0, True), marks=LARGE),
    (2, 3, 600, 2.0, False),
    (4, 1, 56, 50.0, False),
    pytest.param((8, 3, 50, 10.0, False), marks=LARGE),
    (1, 2, 56, 300.0, False),
]


@pytest.mark.parametrize("case", SIZES, ids=str)
def test_the_tube_has_the_steps_that_are_counted(
    case: tuple[int, int, int, float, bool],
) -> None:
    scenario = sized(*case)
    problem = canonical(Problem.from_scenario(scenario))
    transcription = Transcription(problem, scenario.planner.intervals)
    assert size.tube_steps(scenario) == (
        transcription.tube_steps,
        2 * transcription.substeps,
    )
    straight = transcription.plan(transcription.evaluate(*straight_line(transcription)))
    enclosure = enclose(
        straight, transcription.problem, longest=INTERVALS[-1], velocity_slack=2e-3
    )
    assert len(enclosure.layer.derivatives) == size.certificate_intervals(scenario)


def peak_of(work: Callable[[], Any]) -> float:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("case", SIZES, ids=str)
def test_the_estimate_of_memory_is_right_within_a_factor_of_two(
    case: tuple[int, int, int, float, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of what numpy takes; the dense matrices of the programs are Drake's."""
    scenario = sized(*case)
    problem = Problem.from_scenario(scenario)
    transcription = Transcription(problem, scenario.planner.intervals)
    decisions = straight_line(transcription)
    iterate = transcription.evaluate(*decisions)
    kinked = kinked_coordinates(transcription)

    evaluation = peak_of(lambda: transcription.evaluate(*decisions))
    slopes = peak_of(
        lambda: transitions(transcription, iterate, secant=0.1, kinked=kinked)
    )
    tube = size.planning(scenario)[0]
    assert 0.5 < 8 * tube.numbers / (evaluation + slopes) < 2

    straight = transcription.plan(iterate)
    monkeypatch.setattr(
        "dtmpc_drake.planning.proof.certify.INTERVALS", INTERVALS[-1:] * 2
    )
    finest = peak_of(lambda: certify(straight, problem))
    estimate = sum(part.numbers for part in size.certificate(scenario))
    assert 0.5 < 8 * estimate / finest < 2


def test_the_period_is_that_of_reports() -> None:
    assert size.REPORT_PERIOD == REPORT_PERIOD


# Built in Python.


class Squall:
    """No disturbance of ours."""

    bound = (0.5, 0.5, 0.5)


class Gentle(UniformHold):
    """Nor this."""


class Wall(Sphere):
    """And no obstacle of ours."""


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"duration": "10"}, "duration"),
        ({"duration": None}, "duration"),
        ({"duration": True}, "duration"),
        ({"duration": np.bool_(True)}, "duration"),
        ({"duration": 10**400}, "duration"),
        ({"duration": 10**5000}, "duration"),
        ({"duration": 1j}, "duration"),
        ({"duration": np.array([10.0])}, "duration"),
        ({"name": 3}, "name"),
        ({"name": None}, "name"),
        ({"name": "a" * 300}, "name"),
        ({"limits": None}, "limits"),
        ({"limits": {"input": 5.0, "speed": 2.5}}, "limits"),
        ({"limits": Limits(speed="fast")}, "limits.speed"),
        ({"limits": Planner()}, "limits"),
        ({"model": None}, "model"),
        ({"model": "drag"}, "model"),
        ({"model": IntegratorChain(order=2.0)}, "model.order"),
        ({"model": IntegratorChain(num_outputs="3")}, "model.num_outputs"),
        ({"model": IntegratorChain(num_outputs=10**400)}, "model.num_outputs"),
        ({"disturbance": Squall()}, "disturbance"),
        ({"disturbance": Gentle()}, "disturbance"),
        ({"obstacles": [Wall([5.0, 5.0, 5.0])]}, "obstacles[0]"),
        ({"disturbance": UniformHold(bound=0.5)}, "disturbance.bound"),
        ({"disturbance": UniformHold(bound=[0.5, None, 0.5])}, "disturbance.bound[1]"),
        ({"disturbance": UniformHold(bound=[0.5, "x", 0.5])}, "disturbance.bound[1]"),
        ({"disturbance": UniformHold(bound="abc")}, "disturbance.bound"),
        ({"controller": Controller(slope=[2, 2, -2])}, "controller.slope[2]"),
        ({"controller": Controller(slope=[2, 2, np.nan])}, "controller.slope[2]"),
        ({"controller": Controller(slope=[])}, "controller.slope"),
        ({"start": Waypoint([0, 0])}, "start.position"),
        ({"start": Waypoint(None)}, "start.position"),
        ({"start": Waypoint([[0, 0, 0]])}, "start.position[0]"),
        ({"start": [0, 0, 0]}, "start"),
        ({"start": Waypoint(np.array([0.0, np.inf, 0.0]))}, "start.position[1]"),
        ({"start": Waypoint(np.zeros((3, 1)))}, "start.position[0]"),
        ({"start": Waypoint(np.array(0.0))}, "start.position"),
        ({"obstacles": None}, "obstacles"),
        ({"obstacles": [None]}, "obstacles[0]"),
        ({"obstacles": [Waypoint()]}, "obstacles[0]"),
        ({"obstacles": [Cylinder([5.0, 5.0], None)]}, "obstacles[0].radius"),
        (
            {"obstacles": [Ellipsoid([5.0] * 3, [[1, 0], [0, 1, 0]])]},
            "obstacles[0].shape",
        ),
        (
            {"obstacles": [Ellipsoid([5.0] * 3, [[1, 0, 0]] * 101)]},
            "obstacles[0].shape",
        ),
        ({"obstacles": [Ellipsoid([5.0] * 3, 1.0)]}, "obstacles[0].shape"),
        ({"plant": None}, "plant"),
        ({"plant": {3: 0.1}}, "plant"),
        ({"plant": {"drag": "0.1"}}, "plant.drag"),
        ({"planner": Planner(intervals=56.0)}, "planner.intervals"),
        ({"planner": Planner(intervals=10**400)}, "planner.intervals"),
        ({"planner": Planner(max_iterations=10**9)}, "planner.max_iterations"),
        ({"planner": Planner(backend=None)}, "planner.backend"),
        ({"simulation": Simulation(seed=10**400)}, "simulation.seed"),
        ({"simulation": Simulation(seed=1.5)}, "simulation.seed"),
        ({"initial_error": 0.0}, "initial_error"),
        ({"sensing": Sensing(range="far")}, "sensing.range"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_wrong_in_python_gets_the_line_of_a_file(
    changes: dict[str, Any], field: str
) -> None:
    scenario = dataclasses.replace(parse_scenario(LEAST), **changes)
    with pytest.raises(ScenarioError) as caught:
        validate(scenario)
    assert caught.value.field == field
    assert str(caught.value).isprintable() and len(str(caught.value)) < 1000


def test_a_list_that_holds_itself_is_shown_without_an_end() -> None:
    scenario, loop = parse_scenario(LEAST), []
    loop.append(loop)
    scenario.duration = loop  # type: ignore[assignment]
    with pytest.raises(ScenarioError, match="an endless list"):
        validate(scenario)


def test_any_kind_of_number_and_list_will_do() -> None:
    """And comes back from the scenario's own file as plain numbers."""
    scenario = Scenario(
        start=Waypoint(np.array([0, 0, 1])),  # type: ignore[arg-type]
        goal=Waypoint((0, 10, np.float32(1))),  # type: ignore[arg-type]
        duration=np.float64(10),
        limits=Limits(5, 2),
        obstacles=(Sphere(np.full(3, 50.0), 1),),  # type: ignore[arg-type]
        planner=Planner(intervals=np.int64(56)),  # type: ignore[arg-type]
    )
    validate(scenario)
    again = parse_scenario(to_yaml(scenario))
    assert again.goal == Waypoint([0.0, 10.0, 1.0])
    assert {type(x) for x in again.start.position} == {float}
    assert type(again.planner.intervals) is int
    assert Problem.from_scenario(again).duration == 10


@pytest.mark.usefixtures("own_registries")
def test_a_model_of_ones_own_is_checked_where_all_models_are_alike() -> None:
    @register_model
    class Sluggish(DragDoubleIntegrator):
        order = None

    scenario = dataclasses.replace(parse_scenario(LEAST), model=Sluggish())
    with pytest.raises(ScenarioError, match=r"^model\.order: got None"):
        validate(scenario)


def test_a_stiff_surface_does_not_blow_up_the_smallest_tube() -> None:
    """In the end Ω = (D + η) / (αλ) = 0.375 mm for λ = 400 1/s."""
    obstacle = "obstacles: [!Sphere {center: [1.001, 10, 0], radius: 1}]"
    text = f"{LEAST}{obstacle}\nplanner: {{tube_margin: support}}\n"
    parse_scenario(text + "controller: {slope: [400, 400, 400]}")
    error = complaint(
        text.replace("1.001", "1.0003") + "controller: {slope: [400, 400, 400]}"
    )
    assert error.field == "goal.position"
