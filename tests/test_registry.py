"""Registered classes: known by name, answerable for themselves, never mistaken."""

from __future__ import annotations

import dataclasses
import math
import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from pydrake.systems.framework import OutputPort

from dtmpc_drake.checks import Setting
from dtmpc_drake.disturbances import (
    DISTURBANCES,
    Disturbance,
    MakeDisturbance,
    Parts,
    UniformHold,
    register_disturbance,
)
from dtmpc_drake.errors import require
from dtmpc_drake.models import (
    MODELS,
    DragDoubleIntegrator,
    IntegratorChain,
    Model,
    register_model,
)
from dtmpc_drake.obstacles import OBSTACLES, Obstacle, Sphere, register_obstacle
from dtmpc_drake.planning import plan
from dtmpc_drake.scenario import (
    Planner,
    Scenario,
    ScenarioError,
    Waypoint,
    parse_scenario,
    to_yaml,
    validate,
)

pytestmark = pytest.mark.usefixtures("own_registries")


def scenario(**fields: Any) -> Scenario:
    return Scenario(
        goal=Waypoint([0.0, 3.0, 0.0]),
        duration=6.0,
        planner=Planner(intervals=12),
        **fields,
    )


def refused(field: str, made: Scenario) -> str:
    """What validating and writing say, which is the same."""
    said = set()
    for judge in (validate, to_yaml):
        with pytest.raises(ScenarioError) as caught:
            judge(made)
        assert caught.value.field == field
        said.add(str(caught.value))
    (line,) = said
    return line


class Sled(DragDoubleIntegrator):
    pass


class Draught(UniformHold):
    pass


class Balloon(Sphere):
    pass


@pytest.mark.parametrize(
    ("field", "own", "decorator"),
    [
        ("model", Sled(), "register_model"),
        ("disturbance", Draught(), "register_disturbance"),
        ("obstacles[0]", Balloon([9.0, 9.0, 9.0]), "register_obstacle"),
    ],
)
def test_a_subclass_is_refused_until_it_is_registered_itself(
    field: str, own: Any, decorator: str
) -> None:
    part: Any = [own] if field.startswith("obstacles") else own
    made = scenario(**{field.split("[")[0]: part})
    name = type(own).__name__
    line = refused(field, made)
    assert line.startswith(f"{field}: got '{name}', but it must be one of ")
    assert line.endswith(f"registered with @{decorator}")
    registry = {"m": MODELS, "d": DISTURBANCES, "o": OBSTACLES}[field[0]]
    registry.register(type(own))
    try:
        validate(made)
    finally:
        delattr(type(own), "_dtmpc_registered")


def test_a_class_of_each_kind_is_what_the_lists_begin_with() -> None:
    assert MODELS.names[:2] == ("DragDoubleIntegrator", "IntegratorChain")
    assert OBSTACLES.names[:3] == ("Cylinder", "Sphere", "Ellipsoid")
    assert DISTURBANCES.names == (
        *("UniformHold", "Constant", "BangBang", "WorstCase", "ColoredWind", "Gust"),
    )
    assert MODELS.kind("IntegratorChain") is IntegratorChain
    assert MODELS.kind("Rocket") is None


def test_what_cannot_be_registered_says_why() -> None:
    with pytest.raises(TypeError, match="@register_model: int is no subclass of Model"):
        register_model(int)

    class Half(Disturbance):
        pass

    with pytest.raises(TypeError, match="@register_disturbance: Half lacks build"):
        register_disturbance(Half)


def test_two_classes_of_one_name_are_one_too_many() -> None:
    def make() -> type:
        class Kite(DragDoubleIntegrator):
            pass

        return Kite

    first = register_model(make())
    again = register_model(make())  # as a cell of a notebook that runs twice
    assert MODELS.kind("Kite") is again is not first

    class Kite(IntegratorChain):
        pass

    with pytest.raises(ValueError, match=r"Kite of .* has the name of"):
        register_model(Kite)
    assert MODELS.kind("Kite") is again
    # Another kind of thing may have the name.
    register_obstacle(type("Kite", (Sphere,), {}))


def test_a_class_that_is_no_dataclass_flies_and_is_not_written() -> None:
    @register_model
    class Own(DragDoubleIntegrator):
        def __init__(self) -> None:
            super().__init__(0.1, 0.0)

    made = scenario(model=Own())
    assert plan(made).certified
    with pytest.raises(ScenarioError, match=r"^model: got 'Own'.* a dataclass"):
        to_yaml(made)
    with pytest.raises(ScenarioError, match=r"^model: got '!Own'.* !DragDouble"):
        parse_scenario(to_yaml(scenario()).replace("!DragDoubleIntegrator", "!Own"))


@dataclasses.dataclass
class Pose:
    heading: float
    label: str = "north"


@dataclasses.dataclass
class Airship(IntegratorChain):
    """Fields of every type that a file can hold."""

    pose: Pose = dataclasses.field(default_factory=lambda: Pose(0.0))
    gains: dict[str, float] = dataclasses.field(default_factory=dict)
    table: list[list[float]] = dataclasses.field(default_factory=list)
    crew: int | None = 3
    manned: bool = True
    half: float = dataclasses.field(init=False, default=0.0)

    def __post_init__(self) -> None:
        if self.pose.label not in ("north", "south"):
            raise ValueError("no such label")
        self.half = self.pose.heading / 2

    def check(self, path: str, setting: Setting) -> None:
        super().check(path, setting)
        heading = self.pose.heading
        require(f"{path}.pose.heading", heading, abs(heading) <= math.pi, "in [-π, π]")


def test_a_dataclass_is_checked_typed_and_written_like_the_shipped_ones() -> None:
    register_model(Airship)
    ship = Airship(
        pose=Pose(np.float64(1), "south"),
        gains={"lift": 2},
        table=np.eye(2),  # type: ignore[arg-type]
        crew=None,
    )
    text = to_yaml(scenario(model=ship))
    assert "  crew: null\n" in text and "half" not in text
    again = parse_scenario(text).model
    assert isinstance(again, Airship)
    assert again.pose == Pose(1.0, "south") and again.half == 0.5
    assert again.gains == {"lift": 2.0} and type(again.gains["lift"]) is float
    assert again.table == [[1.0, 0.0], [0.0, 1.0]] and again.crew is None
    for good, bad, field, allowed in (
        ("heading: 1.0", "heading: 4.0", "model.pose.heading", "in [-π, π]"),
        ("heading: 1.0", "heading: .inf", "model.pose.heading", "a finite number"),
        ("    heading: 1.0\n", "", "model.pose.heading", "given: it is missing"),
        ("manned: true", "manned: 1", "model.manned", "true/false"),
        ("label: south", "label: west", "model", "valid (no such label)"),
        ("error_bound: 0.0", "error_bound: -1.0", "model.error_bound", "at least 0"),
    ):
        assert good in text
        with pytest.raises(ScenarioError) as caught:
            parse_scenario(text.replace(good, bad))
        assert caught.value.field == field and allowed in str(caught.value)


def test_a_field_that_no_file_can_hold_says_so() -> None:
    @register_model
    @dataclasses.dataclass
    class Tabulated(IntegratorChain):
        table: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(2))

    line = refused("model.table", scenario(model=Tabulated()))
    assert "annotated as float, int, str, bool, list" in line


@dataclasses.dataclass
class Jet(Disturbance):
    """A constant push that says more of itself than it needs to."""

    bound: list[float] = dataclasses.field(default_factory=lambda: [0.2] * 3)
    pulse: float = 1.0
    stiffness: float = 10.0

    def build(self, parts: Parts) -> OutputPort:
        return parts.constant(parts.bound)

    def periods(self) -> dict[str, float]:
        return {"pulse": self.pulse}

    def rates(self) -> dict[str, float]:
        return {f"stiffness = {self.stiffness:g} 1/s": self.stiffness}


def test_a_disturbance_says_how_fast_and_how_often_it_acts() -> None:
    from dtmpc_drake.scenario import require_stable_simulation

    register_disturbance(Jet)
    made = scenario(disturbance=Jet())
    validate(made)
    require_stable_simulation(made)
    made.disturbance = Jet(stiffness=1e4)
    with pytest.raises(ScenarioError, match=r"disturbance\.stiffness = 10000 1/s"):
        require_stable_simulation(made)
    made.disturbance = Jet(pulse=1e-7)
    with pytest.raises(ScenarioError, match=r"^disturbance\.pulse: .* the duration"):
        validate(made)
    push = MakeDisturbance(Jet(), model=IntegratorChain(), slope=np.full(3, 2.0))
    context = push.CreateDefaultContext()
    assert push.GetOutputPort("disturbance").Eval(context).tolist() == [0.2] * 3


@dataclasses.dataclass
class Buoy(Sphere):
    """An obstacle of one's own, with a field more."""

    colour: str = "red"


def test_an_obstacle_of_one_s_own_is_flown_around_and_written() -> None:
    register_obstacle(Buoy)
    made = scenario(obstacles=[Buoy([0.2, 1.5, 0.0], 0.3, colour="green")])
    result = plan(made)
    assert result.certified
    middle = result.plan.reference(np.linspace(0, 6, 99))[:, 0]
    assert np.linalg.norm(middle - [0.2, 1.5, 0.0], axis=1).min() > 0.3
    assert parse_scenario(to_yaml(made)) == made
    text = to_yaml(made).replace("  radius: 0.3\n", "")
    with pytest.raises(ScenarioError, match=r"^obstacles\[0\]\.radius: .* missing"):
        parse_scenario(text)


IN_MAIN = """
import dataclasses, sys, cloudpickle
from dtmpc_drake.models import DragDoubleIntegrator, register_model
from dtmpc_drake.scenario import Scenario

@register_model
@dataclasses.dataclass
class Homemade(DragDoubleIntegrator):
    pass

sys.stdout.buffer.write(cloudpickle.dumps(Scenario(model=Homemade())))
"""


def test_a_registered_class_of_a_notebook_is_known_where_it_arrives() -> None:
    """As Dask sends it to its workers: by value, since none can import it."""
    sent = subprocess.run(
        [sys.executable, "-c", IN_MAIN], capture_output=True, check=True
    ).stdout
    arrived = pickle.loads(sent)
    assert type(arrived.model).__name__ == "Homemade"
    validate(arrived)


def test_names_and_units_of_a_model_have_defaults() -> None:
    model: Model = IntegratorChain(num_outputs=2, order=3)
    assert model.output_names == ("x", "y") and model.input_names == ("u0", "u1")
    units = [model.derivative_unit(k) for k in range(4)]
    assert units == ["m", "m/s", "m/s²", "m/s³"]
    assert IntegratorChain(num_outputs=4).output_names == ("0", "1", "2", "3")


def test_obstacles_have_one_base() -> None:
    assert all(issubclass(kind, Obstacle) for kind in OBSTACLES)
