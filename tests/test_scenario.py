"""Scenario files: what is good comes back exactly, what is bad says so in a line."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtmpc_drake.disturbances import (
    BangBang,
    ColoredWind,
    Constant,
    Gust,
    UniformHold,
    WorstCase,
)
from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.models import (
    ConstantUncertainty,
    DragDoubleIntegrator,
    IntegratorChain,
    register_model,
)
from dtmpc_drake.obstacles import Cylinder, Ellipsoid, Sphere
from dtmpc_drake.scenario import (
    Bandwidth,
    Controller,
    Costs,
    Limits,
    Planner,
    Scenario,
    Simulation,
    SolverOptions,
    Waypoint,
    load_scenario,
    parse_scenario,
    shipped_scenarios,
    to_yaml,
    validate,
)

# The documented schema, with every field that it has.
FULL = """
name: known_environment
model: !DragDoubleIntegrator {drag_estimate: 0.1, drag_error_bound: 0.0}
plant: {drag: 0.1}
disturbance: !UniformHold {bound: [0.5, 0.5, 0.5], hold: 0.05}
controller:
  slope: [2.0, 2.0, 2.0]
  reaching_rate: 0.1
  initial_boundary_layer: 0.3
  bandwidth: {min: 0.5, max: 4.0, rate_max: 2.0, fixed: null}
limits: {input: 5.0, speed: 2.5}
cost: {input: 2.0, bandwidth: 0.1}
start: {position: [0, 0, 1], velocity: [0, 1, 0]}
goal: {position: [0, 25, 1], velocity: [0, 1, 0]}
duration: 14.0
obstacles:
  - !Cylinder {center: [-1.15, 7.0], radius: 1.0}
  - !Sphere {center: [0.0, 9.0, 3.0], radius: 0.5}
  - !Ellipsoid {center: [3, 9, 1], shape: [[1, 0, 0], [0, 2, 0.5]], radius: 0.5}
planner: {backend: clarabel, intervals: 56, tube_margin: norm,
          velocity_bound: comparison, uncertainty: state_dependent,
          options: {tolerance: 1e-3, max_failures: 5}}
simulation: {integration_scheme: runge_kutta3, max_step_size: 0.01, seed: 0}
"""

LEAST = """
start: {position: [0, 0, 0]}
goal: {position: [0, 10, 0]}
duration: 10
"""


def with_section(section: str, text: str | None) -> str:
    """The least file, with one section replaced, or left out if None."""
    lines = [line for line in LEAST.splitlines() if not line.startswith(section)]
    return "\n".join(lines + ([f"{section}: {text}"] if text is not None else []))


# What is good.


def test_every_field_of_the_schema_arrives() -> None:
    s = parse_scenario(FULL)
    assert s.name == "known_environment"
    assert s.model == DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.0)
    assert s.plant == {"drag": 0.1}
    assert s.disturbance == UniformHold(bound=[0.5] * 3, hold=0.05)
    assert s.controller == Controller(
        slope=[2.0] * 3,
        reaching_rate=0.1,
        initial_boundary_layer=0.3,
        bandwidth=Bandwidth(min=0.5, max=4.0, rate_max=2.0, fixed=None),
    )
    assert s.limits == Limits(input=5.0, speed=2.5)
    assert s.cost == Costs(input=2.0, bandwidth=0.1)
    assert s.start == Waypoint(position=[0, 0, 1], velocity=[0, 1, 0])
    assert s.goal == Waypoint(position=[0, 25, 1], velocity=[0, 1, 0])
    assert s.duration == 14.0
    assert s.obstacles == [
        Cylinder(center=[-1.15, 7.0], radius=1.0),
        Sphere(center=[0.0, 9.0, 3.0], radius=0.5),
        Ellipsoid([3.0, 9.0, 1.0], [[1.0, 0.0, 0.0], [0.0, 2.0, 0.5]], 0.5),
    ]
    assert s.planner == Planner(
        backend="clarabel",
        intervals=56,
        tube_margin="norm",
        velocity_bound="comparison",
        uncertainty="state_dependent",
        options=SolverOptions(tolerance=1e-3, max_failures=5),
    )
    assert s.simulation == Simulation("runge_kutta3", max_step_size=0.01, seed=0)


def test_a_file_needs_little_more_than_where_to_go() -> None:
    s = parse_scenario(LEAST)
    assert s == Scenario(
        start=Waypoint([0.0, 0.0, 0.0]), goal=Waypoint([0.0, 10.0, 0.0]), duration=10.0
    )
    assert (s.start_state() == np.zeros((2, 3))).all()
    assert (s.goal_state() == [[0, 10, 0], [0, 0, 0]]).all()
    assert (s.initial_error_state() == np.zeros((2, 3))).all()


def test_numbers_that_yaml_reads_as_text_or_as_whole_are_numbers() -> None:
    s = parse_scenario(with_section("simulation", "{max_step_size: 1e-3}"))
    assert s.simulation.max_step_size == 0.001
    assert s.simulation.log_period == 0.01
    s = parse_scenario(with_section("simulation", "{log_period: 2e-1}"))
    assert s.simulation.log_period == 0.2
    assert type(parse_scenario(LEAST).duration) is float
    assert {type(v) for v in parse_scenario(LEAST).goal.position} == {float}


@pytest.mark.parametrize("name", shipped_scenarios())
def test_a_shipped_scenario_survives_its_own_file(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    assert parse_scenario(to_yaml(scenario)) == scenario


def test_the_papers_experiment_is_shipped() -> None:
    assert "known_environment" in shipped_scenarios()
    s = load_scenario("known_environment")
    assert s.duration == 14.0 and len(s.obstacles) == 5
    assert s.limits == Limits(input=5.0, speed=2.5)


def test_a_scenario_is_loaded_from_any_path(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(FULL, encoding="utf-8")
    assert load_scenario(file) == load_scenario(str(file)) == parse_scenario(FULL)


positive = st.floats(1e-3, 1e3)
bounds = st.lists(st.floats(0, 10), min_size=3, max_size=3)
models = st.one_of(
    st.builds(
        DragDoubleIntegrator,
        drag_estimate=st.floats(0, 1),
        drag_error_bound=st.floats(0, 1),
    ),
    st.builds(
        IntegratorChain,
        num_outputs=st.just(3),
        order=st.integers(1, 4),
        error_bound=st.floats(0, 1),
    ),
)
disturbances = st.one_of(
    st.builds(UniformHold, bound=bounds, hold=positive),
    st.builds(Constant, bound=bounds, fraction=st.floats(-1, 1)),
    st.builds(BangBang, bound=bounds, hold=positive),
    st.builds(
        WorstCase,
        bound=bounds,
        hold=st.none() | positive,
        model_error=st.booleans(),
    ),
    st.builds(Gust, bound=bounds, hold=positive, model_error=st.booleans()),
    st.builds(
        ColoredWind, bound=bounds, correlation_time=positive, intensity=st.floats(0, 9)
    ),
)
away = st.floats(2e3, 1e6)
three_away = st.lists(away, min_size=3, max_size=3)
obstacles = st.one_of(
    st.builds(Cylinder, center=st.lists(away, min_size=2, max_size=2), radius=positive),
    st.builds(Sphere, center=three_away, radius=positive),
    st.builds(
        Ellipsoid,
        center=three_away,
        shape=st.just([[1.0, 0.0, 0.0], [0.0, 0.1, 1.0]]),
        radius=positive,
    ),
)
names = st.text(
    st.characters(categories=["L", "N", "P", "S", "Zs"], exclude_characters="/\\"),
    min_size=1,
    max_size=12,
).filter(lambda name: name not in (".", "..") and name.isprintable())


@given(
    name=names,
    model=models,
    disturbance=disturbances,
    slope=st.lists(st.floats(1e-3, 100), min_size=3, max_size=3),
    fixed=st.none() | st.floats(0.5, 4),
    velocity=st.none() | st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    obstacles=st.lists(obstacles, max_size=4),
    planner=st.builds(
        Planner,
        backend=st.sampled_from(["clarabel", "ipopt"]),
        intervals=st.integers(20, 1000),
        tube_margin=st.sampled_from(["norm", "support"]),
        velocity_bound=st.sampled_from(["comparison", "paper"]),
        uncertainty=st.sampled_from(["state_dependent", "constant"]),
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_scenario_survives_its_own_file(
    name: str,
    model: DragDoubleIntegrator | IntegratorChain,
    disturbance: UniformHold,
    slope: list[float],
    fixed: float | None,
    velocity: list[float] | None,
    obstacles: list[Cylinder],
    planner: Planner,
    seed: int,
) -> None:
    scenario = Scenario(
        name=name,
        model=model,
        disturbance=disturbance,
        controller=Controller(slope=slope, bandwidth=Bandwidth(fixed=fixed)),
        start=Waypoint([0.0, 0.0, 1.0], velocity if model.order > 1 else None),
        initial_error=Waypoint([1e-4, 0.0, -1e-5]) if model.order < 3 else None,
        obstacles=obstacles,
        planner=planner,
        simulation=Simulation(seed=seed),
    )
    validate(scenario)
    assert parse_scenario(to_yaml(scenario)) == scenario


def test_a_waypoint_of_a_third_order_model_has_an_acceleration() -> None:
    s = parse_scenario(
        "model: !IntegratorChain {num_outputs: 1, order: 3}\n"
        "disturbance: !WorstCase {bound: [0.1]}\n"
        "controller: {slope: [1.0]}\n"
        "start: {position: [1], acceleration: [3]}\n"
        "goal: {position: [2], velocity: [-1]}\n"
        "duration: 5\n"
    )
    assert s.start_state().tolist() == [[1.0], [0.0], [3.0]]
    assert s.goal_state().tolist() == [[2.0], [-1.0], [0.0]]


def test_constant_uncertainty_is_the_supremum_at_the_speed_limit() -> None:
    s = load_scenario("known_environment")
    s.model = DragDoubleIntegrator(drag_estimate=0.1, drag_error_bound=0.2)
    assert s.planning_model() is s.model
    s.planner.uncertainty = "constant"
    model = s.planning_model()
    assert isinstance(model, ConstantUncertainty)
    assert model.bound == pytest.approx([1.25] * 3)


def test_a_fixed_bandwidth_is_the_only_one_there_is() -> None:
    assert Bandwidth(min=0.5, max=4.0).interval() == (0.5, 4.0)
    assert Bandwidth(min=0.5, max=4.0, fixed=3.0).interval() == (3.0, 3.0)


def test_a_plant_that_is_not_described_is_what_the_model_expects() -> None:
    s = parse_scenario(LEAST)
    assert s.plant_parameters() == {"drag": pytest.approx(0.1)}
    s.plant = {"drag": 0.05}
    assert s.plant_parameters() == {"drag": 0.05}


def test_a_plant_may_be_at_either_end_of_what_the_model_allows() -> None:
    model = "model: !DragDoubleIntegrator {drag_estimate: 0.1, drag_error_bound: 0.1}"
    for drag in (0.0, 0.2):
        s = parse_scenario(f"{LEAST}{model}\nplant: {{drag: {drag}}}")
        assert s.plant_parameters() == {"drag": drag}


def test_the_goal_needs_room_for_the_smallest_tube_there_is() -> None:
    """In the end Ω = (D + η) / (αλ) = 0.075 m at the highest bandwidth."""

    def file(distance: float, margin: str) -> str:
        obstacle = f"!Cylinder {{center: [{distance}, 10], radius: 1}}"
        planner = f"planner: {{tube_margin: {margin}}}"
        return f"{LEAST}obstacles: [{obstacle}]\n{planner}"

    # The support margin sees one side of the box only.
    for margin, tube in (("norm", np.hypot(0.075, 0.075)), ("support", 0.075)):
        parse_scenario(file(1 + tube + 1e-3, margin))
        with pytest.raises(ScenarioError, match=r"^goal\.position: .* tube included"):
            parse_scenario(file(1 + tube - 1e-3, margin))


def test_the_start_needs_room_for_the_initial_error() -> None:
    text = LEAST + "obstacles: [!Cylinder {center: [1.05, 0], radius: 1}]"
    parse_scenario(text)
    with pytest.raises(ScenarioError, match=r"^start\.position: .* tube included"):
        parse_scenario(text + "\ninitial_error: {position: [-0.1, 0, 0]}")


def test_the_initial_layer_holds_s_and_not_each_error_alone() -> None:
    """|s| = |ẏ + 2 y| <= 0.3: a velocity may make up for a position."""
    error = "\ninitial_error: {{position: [0.2, 0, 0], velocity: [{}, 0, 0]}}"
    parse_scenario(LEAST + error.format(-0.4))
    parse_scenario(LEAST + error.format(-0.1001))
    with pytest.raises(ScenarioError, match=r"^initial_error"):
        parse_scenario(LEAST + error.format(-0.099))


def test_a_scenario_introduces_itself() -> None:
    text = repr(parse_scenario(FULL))
    for part in ("known_environment", "DragDoubleIntegrator", "3 obstacles", "14 s"):
        assert part in text


# What is bad: section, its text, then the field, the value and what is allowed.

BAD = {
    "unknown section": ("colour", "red", "colour", "'red'", "left out; the fields"),
    "unknown field": ("limits", "{sped: 2}", "limits.sped", "2", "input, speed"),
    "unknown field, deep": (
        "controller",
        "{bandwidth: {low: 1}}",
        "controller.bandwidth.low",
        "1",
        "left out; the fields here are min, max, rate_max, fixed",
    ),
    "field of another class": (
        "disturbance",
        "!WorstCase {intensity: 1}",
        "disturbance.intensity",
        "1",
        "left out; the fields here are bound, hold, model_error",
    ),
    "missing section": ("goal", None, "goal", "None", "missing"),
    "missing duration": ("duration", None, "duration", "None", "missing"),
    "missing field": ("start", "{}", "start.position", "None", "missing"),
    "missing radius": (
        "obstacles",
        "[!Cylinder {center: [5, 5]}]",
        "obstacles[0].radius",
        "None",
        "missing",
    ),
    "missing centre": (
        "obstacles",
        "[!Sphere {radius: 1}]",
        "obstacles[0].center",
        "None",
        "missing",
    ),
    "unknown model": (
        "model",
        "!Rocket {thrust: 1}",
        "model",
        "'!Rocket'",
        "!DragDoubleIntegrator, !IntegratorChain",
    ),
    "unknown disturbance": (
        "disturbance",
        "!Squall {bound: [1, 1, 1]}",
        "disturbance",
        "'!Squall'",
        "!UniformHold",
    ),
    "unknown obstacle": (
        "obstacles",
        "[!Cube {center: [5, 5, 5]}]",
        "obstacles[0]",
        "'!Cube'",
        "!Cylinder, !Sphere, !Ellipsoid",
    ),
    "tag where none belongs": (
        "limits",
        "!Foo {input: 5}",
        "limits",
        "'!Foo'",
        "without a tag",
    ),
    "text for a number": ("duration", "long", "duration", "'long'", "a number"),
    "null for a number": ("duration", "null", "duration", "None", "a number"),
    "list for a number": ("duration", "[10]", "duration", "[10]", "a number"),
    "date for a number": (
        "duration",
        "2020-01-01",
        "duration",
        "'2020-01-01'",
        "a number",
    ),
    "boolean for a number": ("duration", "true", "duration", "True", "a number"),
    "boolean in a list": (
        "start",
        "{position: [0, no, 0]}",
        "start.position[1]",
        "False",
        "a number",
    ),
    "boolean for a whole number": (
        "planner",
        "{intervals: true}",
        "planner.intervals",
        "True",
        "a whole number",
    ),
    "boolean for an optional number": (
        "controller",
        "{bandwidth: {fixed: true}}",
        "controller.bandwidth.fixed",
        "True",
        "a number",
    ),
    "boolean for a parameter": (
        "plant",
        "{drag: true}",
        "plant.drag",
        "True",
        "a number",
    ),
    "number for text": ("planner", "{backend: 3}", "planner.backend", "3", "text"),
    "number for a list": (
        "controller",
        "{slope: 2}",
        "controller.slope",
        "2",
        "a list",
    ),
    "number for a section": ("limits", "5", "limits", "5", "a mapping of fields"),
    "number for a model": (
        "model",
        "3",
        "model",
        "3",
        "one of !DragDoubleIntegrator, !IntegratorChain",
    ),
    "tag for the plant": ("plant", "!Drag {drag: 1}", "plant", "'!Drag'", "without"),
    "number for the plant": ("plant", "3", "plant", "3", "a mapping of names"),
    "mapping for a list": ("obstacles", "{a: 1}", "obstacles", "{'a': 1}", "a list"),
    "list for a waypoint": (
        "goal",
        "[0, 10, 0]",
        "goal",
        "[0, 10, 0]",
        "a mapping of fields",
    ),
    "null for a section": ("planner", "null", "planner", "None", "a mapping"),
    "short list": (
        "disturbance",
        "!UniformHold {bound: [0.5, 0.5]}",
        "disturbance.bound",
        "[0.5, 0.5]",
        "3 numbers",
    ),
    "long list": (
        "controller",
        "{slope: [2, 2, 2, 2]}",
        "controller.slope",
        "[2, 2, 2, 2]",
        "3 numbers",
    ),
    "short position": (
        "start",
        "{position: [0, 0]}",
        "start.position",
        "[0, 0]",
        "3 numbers",
    ),
    "short velocity": (
        "goal",
        "{position: [0, 10, 0], velocity: [0]}",
        "goal.velocity",
        "[0]",
        "3 numbers",
    ),
    "acceleration of a second-order model": (
        "start",
        "{position: [0, 0, 0], acceleration: [0, 0, 0]}",
        "start.acceleration",
        "[0, 0, 0]",
        "left out: the model is of order 2",
    ),
    "cylinder in three coordinates": (
        "obstacles",
        "[!Cylinder {center: [5, 5, 1], radius: 1}]",
        "obstacles[0].center",
        "[5, 5, 1]",
        "2 numbers",
    ),
    "sphere in two coordinates": (
        "obstacles",
        "[!Sphere {center: [5, 5], radius: 1}]",
        "obstacles[0].center",
        "[5, 5]",
        "3 numbers",
    ),
    "shape of the wrong width": (
        "obstacles",
        "[!Ellipsoid {center: [5, 5, 5], radius: 1, shape: [[1, 0], [0, 1]]}]",
        "obstacles[0].shape",
        "[[1, 0], [0, 1]]",
        "rows of 3 numbers",
    ),
    "shape that is no matrix": (
        "obstacles",
        "[!Ellipsoid {center: [5, 5, 5], radius: 1, shape: [1, 2, 3]}]",
        "obstacles[0].shape[0]",
        "1",
        "a list",
    ),
    "empty shape": (
        "obstacles",
        "[!Ellipsoid {center: [5, 5, 5], radius: 1, shape: []}]",
        "obstacles[0].shape",
        "[]",
        "rows of 3 numbers",
    ),
    "shape that sees nothing": (
        "obstacles",
        "[!Ellipsoid {center: [5, 5, 5], radius: 1, shape: [[0, 0, 0]]}]",
        "obstacles[0].shape",
        "[[0, 0, 0]]",
        "not zero",
    ),
    "nan": ("duration", ".nan", "duration", "nan", "a finite number"),
    "nan as text": ("duration", "nan", "duration", "nan", "a finite number"),
    "infinity": (
        "limits",
        "{input: .inf}",
        "limits.input",
        "inf",
        "a finite number",
    ),
    "minus infinity in a list": (
        "start",
        "{position: [0, -.inf, 0]}",
        "start.position[1]",
        "-inf",
        "a finite number",
    ),
    "nan in a shape": (
        "obstacles",
        "[!Ellipsoid {center: [5, 5, 5], radius: 1, shape: [[1, 0, .nan]]}]",
        "obstacles[0].shape[0][2]",
        "nan",
        "a finite number",
    ),
    "nan in the plant": ("plant", "{drag: .nan}", "plant.drag", "nan", "finite"),
    "nan in the initial error": (
        "initial_error",
        "{position: [.nan, 0, 0]}",
        "initial_error.position[0]",
        "nan",
        "finite",
    ),
    "more than any float": (
        "duration",
        "1" + "0" * 400,
        "duration",
        "1" + "0" * 198 + "…",
        "a finite number",
    ),
    "negative radius": (
        "obstacles",
        "[!Sphere {center: [5, 5, 5], radius: 1}, "
        "!Cylinder {center: [5, 5], radius: -1}]",
        "obstacles[1].radius",
        "-1",
        "greater than 0 m",
    ),
    "zero radius": (
        "obstacles",
        "[!Sphere {center: [5, 5, 5], radius: 0}]",
        "obstacles[0].radius",
        "0",
        "greater than 0 m",
    ),
    "start inside an obstacle": (
        "obstacles",
        "[!Cylinder {center: [5, 5], radius: 1}, "
        "!Cylinder {center: [0.5, 0], radius: 1}]",
        "start.position",
        "[0, 0, 0]",
        "outside obstacles[1], tube included: it is 0.5 m too close",
    ),
    "goal inside an obstacle": (
        "obstacles",
        "[!Sphere {center: [0, 10, 0.5], radius: 1}]",
        "goal.position",
        "[0, 10, 0]",
        "outside obstacles[0], tube included",
    ),
    "goal outside an obstacle, its tube inside": (
        "obstacles",
        "[!Cylinder {center: [1.05, 10], radius: 1}]",
        "goal.position",
        "[0, 10, 0]",
        "outside obstacles[0], tube included",
    ),
    "s beyond the layer": (
        "initial_error",
        "{position: [0, 0.1, 0], velocity: [0, 0.2, 0]}",
        "initial_error",
        "[0, 0.4, 0]",
        "at most the initial boundary layer, 0.3 m/s",
    ),
    "smallest bandwidth above the largest": (
        "controller",
        "{bandwidth: {min: 5, max: 4}}",
        "controller.bandwidth.min",
        "5",
        "at most controller.bandwidth.max = 4 rad/s",
    ),
    "fixed bandwidth too large": (
        "controller",
        "{bandwidth: {fixed: 9}}",
        "controller.bandwidth.fixed",
        "9",
        "in [0.5, 4] rad/s",
    ),
    "fixed bandwidth too small": (
        "controller",
        "{bandwidth: {fixed: 0.4}}",
        "controller.bandwidth.fixed",
        "0.4",
        "in [0.5, 4] rad/s",
    ),
    "no bandwidth": (
        "controller",
        "{bandwidth: {min: 0}}",
        "controller.bandwidth.min",
        "0",
        "greater than 0 rad/s",
    ),
    "no bandwidth rate": (
        "controller",
        "{bandwidth: {rate_max: 0}}",
        "controller.bandwidth.rate_max",
        "0",
        "greater than 0 rad/s²",
    ),
    "start too fast": (
        "start",
        "{position: [0, 0, 0], velocity: [0, -3, 0]}",
        "start.velocity",
        "[0, -3, 0]",
        "at most limits.speed = 2.5 m/s along every axis",
    ),
    "goal too fast": (
        "goal",
        "{position: [0, 10, 0], velocity: [0, 3, 0]}",
        "goal.velocity",
        "[0, 3, 0]",
        "at most limits.speed = 2.5 m/s along every axis",
    ),
    "too little time": ("duration", "3.9", "duration", "3.9", "at least 4 s"),
    "no time": ("duration", "0", "duration", "0", "greater than 0 s"),
    "negative time": ("duration", "-10", "duration", "-10", "greater than 0 s"),
    "unknown backend": (
        "planner",
        "{backend: snopt}",
        "planner.backend",
        "'snopt'",
        "one of clarabel, ipopt",
    ),
    "unknown tube margin": (
        "planner",
        "{tube_margin: wide}",
        "planner.tube_margin",
        "'wide'",
        "one of norm, support",
    ),
    "unknown velocity bound": (
        "planner",
        "{velocity_bound: mine}",
        "planner.velocity_bound",
        "'mine'",
        "one of comparison, paper",
    ),
    "unknown uncertainty": (
        "planner",
        "{uncertainty: none}",
        "planner.uncertainty",
        "'none'",
        "one of state_dependent, constant",
    ),
    "unknown integration scheme": (
        "simulation",
        "{integration_scheme: rk4}",
        "simulation.integration_scheme",
        "'rk4'",
        "runge_kutta3",
    ),
    "too few intervals": (
        "planner",
        "{intervals: 5}",
        "planner.intervals",
        "5",
        "a whole number in [6, 1000]",
    ),
    "fraction of an interval": (
        "planner",
        "{intervals: 10.5}",
        "planner.intervals",
        "10.5",
        "a whole number",
    ),
    "no iterations": (
        "planner",
        "{max_iterations: 0}",
        "planner.max_iterations",
        "0",
        "at least 1",
    ),
    "negative seed": ("simulation", "{seed: -1}", "simulation.seed", "-1", "[0, 2^32)"),
    "fraction of a seed": (
        "simulation",
        "{seed: 1.5}",
        "simulation.seed",
        "1.5",
        "a whole number",
    ),
    "no step": (
        "simulation",
        "{max_step_size: 0}",
        "simulation.max_step_size",
        "0",
        "greater than 0 s",
    ),
    "no time between two samples": (
        "simulation",
        "{log_period: -0.1}",
        "simulation.log_period",
        "-0.1",
        "greater than 0 s",
    ),
    "sampled now and then": (
        "simulation",
        "{log_period: often}",
        "simulation.log_period",
        "'often'",
        "a number",
    ),
    "parameter of another plant": ("plant", "{mass: 1}", "plant.mass", "1", "drag"),
    "plant that the model excludes": (
        "plant",
        "{drag: 0.2}",
        "plant.drag",
        "0.2",
        "in [0.1, 0.1], which the model's error bound covers",
    ),
    "plant below what the model allows": (
        "plant",
        "{drag: 0.05}",
        "plant.drag",
        "0.05",
        "in [0.1, 0.1]",
    ),
    "negative drag": (
        "model",
        "!DragDoubleIntegrator {drag_estimate: -0.1}",
        "model.drag_estimate",
        "-0.1",
        "at least 0",
    ),
    "negative error bound": (
        "model",
        "!DragDoubleIntegrator {drag_error_bound: -0.1}",
        "model.drag_error_bound",
        "-0.1",
        "at least 0",
    ),
    "no outputs": (
        "model",
        "!IntegratorChain {num_outputs: 0}",
        "model.num_outputs",
        "0",
        "at least 1",
    ),
    "no order": (
        "model",
        "!IntegratorChain {order: 0}",
        "model.order",
        "0",
        "in [1, 10]",
    ),
    "negative disturbance": (
        "disturbance",
        "!BangBang {bound: [0.5, -0.5, 0.5]}",
        "disturbance.bound[1]",
        "-0.5",
        "at least 0 m/s²",
    ),
    "no hold": (
        "disturbance",
        "!UniformHold {hold: 0}",
        "disturbance.hold",
        "0",
        "greater than 0 s",
    ),
    "no hold of a worst case": (
        "disturbance",
        "!WorstCase {hold: 0}",
        "disturbance.hold",
        "0",
        "greater than 0 s",
    ),
    "no model error": (
        "disturbance",
        "!Gust {model_error: 0.1}",
        "disturbance.model_error",
        "0.1",
        "true/false",
    ),
    "no correlation": (
        "disturbance",
        "!ColoredWind {correlation_time: 0}",
        "disturbance.correlation_time",
        "0",
        "greater than 0 s",
    ),
    "more than the disturbance": (
        "disturbance",
        "!Constant {fraction: -1.5}",
        "disturbance.fraction",
        "-1.5",
        "in [-1, 1]",
    ),
    "negative slope": (
        "controller",
        "{slope: [2, 2, -2]}",
        "controller.slope[2]",
        "-2",
        "greater than 0 1/s",
    ),
    "no reaching rate": (
        "controller",
        "{reaching_rate: 0}",
        "controller.reaching_rate",
        "0",
        "greater than 0 m/s²",
    ),
    "no layer": (
        "controller",
        "{initial_boundary_layer: 0}",
        "controller.initial_boundary_layer",
        "0",
        "greater than 0 m/s",
    ),
    "no speed": ("limits", "{speed: 0}", "limits.speed", "0", "greater than 0 m/s"),
    "negative input": (
        "limits",
        "{input: -5}",
        "limits.input",
        "-5",
        "greater than 0 m/s²",
    ),
    "negative cost": ("cost", "{input: -2}", "cost.input", "-2", "at least 0"),
    "no tolerance": (
        "planner",
        "{options: {tolerance: 0}}",
        "planner.options.tolerance",
        "0",
        "greater than 0",
    ),
    "a tolerance of text": (
        "planner",
        "{options: {tolerance: small}}",
        "planner.options.tolerance",
        "'small'",
        "a number",
    ),
    "empty name": ("name", "''", "name", "''", "a file name"),
    "name with a slash": ("name", "a/b", "name", "'a/b'", "without slashes"),
    "name of the directory above": ("name", "..", "name", "'..'", "a file name"),
    "name of two lines": ("name", '"a\\nb"', "name", "'a\\nb'", "a file name"),
}


@pytest.mark.parametrize("case", BAD.values(), ids=BAD.keys())
def test_bad_input_gets_one_line_with_field_value_and_what_is_allowed(
    case: tuple[str, str | None, str, str, str],
) -> None:
    section, text, field, value, allowed = case
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(with_section(section, text))
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{field}: got {value}, but it must be ")
    assert allowed in message.split(", but it must be ")[1]
    assert caught.value.field == field


def test_the_least_file_itself_is_good() -> None:
    """Else every bad file above would be bad for another reason."""
    assert parse_scenario(with_section("nothing", None)) == parse_scenario(LEAST)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "# nothing but a comment",
        "3",
        "just text",
        "[1, 2]",
        "start: [0",
        "\tstart: 1",
        "start: *nothing",
        "model: !DragDoubleIntegrator",
        "model: !IntegratorChain [3, 2]",
        "name: !!python/object:os.system x",
        "1: 2",
        "? [1, 2]\n: 3",
        "--- a\n--- b",
        "\x00",
        "name: 2020-13-45",
    ],
)
def test_what_is_no_scenario_at_all_gets_one_line(text: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(text)
    assert "\n" not in str(caught.value)


def test_what_is_no_yaml_further_on_is_not_taken_at_its_word() -> None:
    text = LEAST + "limits: {{speed: 1}: 2}\ncost: ]"
    with pytest.raises(ScenarioError, match=r"^line 5: .* a name, before a colon$"):
        parse_scenario(text.removesuffix("]") + "{}")
    with pytest.raises(ScenarioError, match=r"^line 6: .* valid YAML$"):
        parse_scenario(text)


def test_broken_yaml_is_located() -> None:
    with pytest.raises(ScenarioError, match=r"^line 3: .* valid YAML$"):
        parse_scenario("name: x\nstart: {position: [0, 0, 0]\ngoal: ]\n")


@pytest.mark.parametrize(
    ("text", "field"),
    [
        (LEAST + "duration: 20", "duration"),
        (LEAST + "limits: {speed: 1, input: 5, speed: 2}", "limits.speed"),
        (
            LEAST + "obstacles: [!Sphere {radius: 1, radius: 2, center: [5, 5, 5]}]",
            "obstacles[0].radius",
        ),
    ],
)
def test_a_field_given_twice_is_not_silently_the_last(text: str, field: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(text)
    assert caught.value.field == field
    assert "line 5" in str(caught.value) and "given once" in str(caught.value)


def test_a_file_that_is_not_there_lists_what_is(tmp_path: Path) -> None:
    for source in ("known_enviroment", tmp_path / "mine.yaml", tmp_path, "", "\0"):
        with pytest.raises(ScenarioError, match="known_environment") as caught:
            load_scenario(source)
        assert caught.value.field == "scenario"
        assert "\n" not in str(caught.value)


def test_a_file_that_is_no_text_says_so(tmp_path: Path) -> None:
    file = tmp_path / "picture.png"
    file.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ScenarioError, match="not a text file"):
        load_scenario(file)


def test_a_scenario_built_in_python_is_checked_like_a_file() -> None:
    good = parse_scenario(LEAST)
    validate(good)
    bad = dataclasses.replace(good, limits=Limits(speed=float("nan")))
    with pytest.raises(ScenarioError, match=r"^limits\.speed: got nan"):
        validate(bad)


@pytest.mark.usefixtures("own_registries")
def test_constant_uncertainty_needs_a_model_that_knows_a_constant() -> None:
    @register_model
    class Unsure(DragDoubleIntegrator):
        def constant_model_error_bound(self, speed: float) -> np.ndarray:
            raise NotImplementedError("nobody knows it")

    scenario = dataclasses.replace(
        parse_scenario(LEAST), model=Unsure(), planner=Planner(uncertainty="constant")
    )
    with pytest.raises(ScenarioError, match=r"^planner\.uncertainty: .* nobody knows"):
        validate(scenario)


@dataclasses.dataclass
class Squall(WorstCase):
    """A disturbance of a user's own."""


@dataclasses.dataclass
class Fence(Cylinder):
    """An obstacle of a user's own, which is lower than a cylinder."""

    height: float = 1.0


class Rocket(DragDoubleIntegrator):
    """A model of a user's own."""


class Wall:
    """Another one."""

    center, radius, known_from = (5.0, 5.0, 5.0), 1.0, None

    def shape_matrix(self, num_outputs: int) -> np.ndarray:
        return np.eye(1, num_outputs)


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        (
            "disturbance",
            Squall(),
            "disturbance: got 'Squall'.* one of UniformHold, Con",
        ),
        ("disturbance", None, "disturbance: got 'NoneType'.* one of UniformHold"),
        (
            "obstacles",
            [Fence([5, 5])],
            r"obstacles\[0\]: got 'Fence'.* one of Cylinder",
        ),
        (
            "obstacles",
            [Wall()],
            r"obstacles\[0\]: got 'Wall'.* one of Cylinder, Sphere",
        ),
        (
            "model",
            WorstCase(),
            "model: got 'WorstCase'.* or registered with @register_model",
        ),
        (
            "model",
            Rocket(),
            "model: got 'Rocket'.* one of DragDouble.* @register_model",
        ),
    ],
)
def test_a_class_that_is_not_known_is_refused_by_name(
    field: str, value: Any, text: str
) -> None:
    """Nothing is taken for the nearest class that is known."""
    scenario = dataclasses.replace(parse_scenario(LEAST), **{field: value})
    for judge in (validate, to_yaml):
        with pytest.raises(ScenarioError, match=f"^{text}"):
            judge(scenario)
