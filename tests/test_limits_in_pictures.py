"""Pictures show the limits that are near, in the units of the model, at any scale."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from pydrake.geometry import Meshcat, MeshcatParams
from test_visualization import (
    flight_of,
    flown,
    legend,
    meshcat_commands,
    planned,
    texts,
)

from dtmpc_drake.limits import InputRange, NormLimit, PositionLimit
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.obstacles import Cylinder, ObstacleSet, Sphere
from dtmpc_drake.planning import plan as make_plan
from dtmpc_drake.planning.canonical import plan_in_units
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario, load_scenario
from dtmpc_drake.visualization import (
    ShownFlight,
    plot_histories,
    plot_plan,
    write_replay,
)
from dtmpc_drake.visualization.geometry import near_bounds, obstacle_sections, tube_box
from dtmpc_drake.visualization.scale import Scale, decimals
from dtmpc_drake.visualization.scene import (
    AFAR,
    ROOT,
    add_scene,
    field_corners,
    grid_spacing,
    vehicle_radius,
)
from dtmpc_drake.visualization.style import drawn_period
from tests.units_for_tests import in_other_units

NEAR = PositionLimit(min=[None, None, -1.1], max=[1.4, None, 1.2])
FAR = PositionLimit(min=[-40.0, None, -30.0], max=[None, 60.0, 70.0])


def fenced(limit: PositionLimit, outputs: int = 3) -> tuple[Scenario, Plan]:
    """A scenario of six metres with bounds, planned without them."""
    scenario, plan = planned(2, outputs)
    limits = dataclasses.replace(scenario.limits, position=limit)
    return dataclasses.replace(scenario, limits=limits), plan


def levels(axes: Axes) -> list[float]:
    """Where lines run straight across a panel."""
    lines = [np.asarray(line.get_ydata()) for line in axes.lines]
    return [float(y[0]) for y in lines if len(y) == 2 and y[0] == y[1]]


def scene(scenario: Scenario, plan: Plan) -> Meshcat:
    meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    add_scene(meshcat, scenario=scenario, plan=plan)
    return meshcat


def page_of(scenario: Scenario, plan: Plan, path: Path) -> tuple[str, dict[str, Any]]:
    """A replay's page, and the numbers that its script has."""
    time, state = flown(plan)
    write_replay(
        path, scenario=scenario, plan=plan, flight=ShownFlight(time, state[:, 0])
    )
    page = path.read_text(encoding="utf-8")
    found = re.search(r'id="dtmpc-data" type="application/json">(.*?)</script>', page)
    assert found is not None
    return page, json.loads(found[1])


# Near or far.


def test_a_bound_is_near_within_a_part_of_the_length_of_what_is_drawn() -> None:
    low, high = np.array([0.0, 0.0]), np.array([10.0, 2.0])
    bounds = np.array([[-1.4, 11.6], [-np.inf, 3.4]])
    near = near_bounds(bounds, low, high)
    np.testing.assert_array_equal(near, [[-1.4, np.inf], [-np.inf, 3.4]])


def test_a_fence_is_in_the_plan_where_it_is_near_and_not_where_it_is_far() -> None:
    scenario, plan = fenced(NEAR)
    figure = plot_plan(scenario=scenario, plan=plan)
    from_above, from_the_side = figure.axes[:2]
    assert "out of bounds" in legend(figure)
    assert from_above.get_ylabel() == "x (m)" and 1.4 in levels(from_above)
    assert 1.4 < from_above.get_ylim()[0] < 1.6  # and not far behind it
    assert from_the_side.get_ylabel() == "z (m)"
    assert {-1.1, 1.2} <= set(levels(from_the_side))
    assert from_the_side.get_xlim() == from_above.get_xlim()
    figure = plot_plan(scenario=fenced(FAR)[0], plan=plan)
    assert "out of bounds" not in legend(figure)
    free = plot_plan(scenario=planned(2, 3)[0], plan=plan)
    assert len(figure.axes) == len(free.axes)
    assert figure.axes[0].get_xlim() == free.axes[0].get_xlim()


def test_a_look_from_the_side_shows_tube_and_obstacles_at_their_height() -> None:
    scenario, plan = fenced(NEAR)
    side = plot_plan(scenario=scenario, plan=plan).axes[1]
    outlines = [p.get_xy() for p in side.patches if isinstance(p, Polygon)]
    ball = outlines[-1]  # the pillar has no end
    np.testing.assert_allclose(ball.min(axis=0), [3.5, 1.0], atol=1e-3)
    np.testing.assert_allclose(ball.max(axis=0), [4.5, 2.0], atol=1e-3)
    bottom, up = side.get_ylim()
    assert bottom < up
    low, high = tube_box(plan)
    assert bottom < low[2] and high[2] < up


def test_a_single_output_has_its_bounds_over_time() -> None:
    scenario, plan = fenced(PositionLimit(min=[-40.0], max=[6.9]), outputs=1)
    figure = plot_plan(scenario=scenario, plan=plan)
    assert levels(figure.axes[0]) == [6.9]
    assert figure.axes[0].get_ylim()[0] > -2.0
    assert "out of bounds" in legend(figure)


def test_histories_show_height_and_the_floor_before_and_after_tightening() -> None:
    scenario, plan = fenced(NEAR)
    figure = plot_histories(scenario=scenario, plan=plan, flight=flight_of(plan))
    position = {a.get_title(): a for a in figure.axes if a.get_title()}
    assert list(position) == ["along x", "along y", "along z"]
    height = position["along z"]
    assert levels(height) == [-1.1, 1.2] and levels(position["along y"]) == []
    time = plan.sample_times(0.025)
    drawn = [np.asarray(line.get_ydata(), float) for line in height.lines]
    half = plan.position_tube(time)[:, 2]
    center = plan.reference(time)[:, 0, 2]
    for curve in (center, center - half, center + half, -1.1 + half, 1.2 - half):
        assert any(d.shape == curve.shape and np.allclose(d, curve) for d in drawn)
    assert any(d.shape != center.shape and len(d) > 2 for d in drawn)  # the flight
    far = plot_histories(scenario=fenced(FAR)[0], plan=plan)
    assert not any(levels(a) for a in far.axes if a.get_title().startswith("along"))


def test_histories_show_each_input_in_its_bounds_and_what_is_left_of_norms() -> None:
    scenario, plan = planned(2, 3)
    limits = dataclasses.replace(
        scenario.limits,
        inputs=InputRange(min=[-6.0, None, -7.0], max=[6.0, 6.5, None]),
        norms=[NormLimit("acceleration", 9.0), NormLimit("input", 11.0)],
    )
    scenario = dataclasses.replace(scenario, limits=limits)
    figure = plot_histories(scenario=scenario, plan=plan, flight=flight_of(plan))
    inputs = {a.get_title(loc="left"): a for a in figure.axes}
    assert levels(inputs["u0"]) == [-6.0, 6.0]
    assert levels(inputs["u1"]) == [6.5] and levels(inputs["u2"]) == [-7.0]
    left = inputs["what is left of limits.norms[0], ‖ÿ‖ ≤ 9 m/s²"]
    assert left.get_ylabel() == "left\n(m/s²)"
    tube, reference = (np.asarray(line.get_ydata()) for line in left.lines[1:3])
    highest = np.linalg.norm(plan.reference(plan.sample_times(0.025))[:, 2], axis=-1)
    np.testing.assert_allclose(reference, 9.0 - highest)
    assert (tube < reference).all()
    assert "what is left of limits.norms[1], ‖u‖ ≤ 11 m/s²" in inputs


def test_the_scene_has_floor_ceiling_and_walls_where_they_are_near(
    tmp_path: Path,
) -> None:
    meshcat = scene(*fenced(NEAR))
    for name, there in {
        "xmin": False, "xmax": True, "ymin": False, "ymax": False, "zmin": True,
        "zmax": True,
    }.items():  # fmt: skip
        assert meshcat.HasPath(f"{ROOT}/fences/{name}/sheet") == there
    low, high = field_corners(*fenced(NEAR))
    assert low[2] <= -1.1 and high[0] >= 1.4
    assert not scene(*fenced(FAR)).HasPath(f"{ROOT}/fences")
    entry = re.compile(r"<li (hidden)?><i [^>]*></i>bounds of the\s+position")
    near, _ = page_of(*fenced(NEAR), tmp_path / "near.html")
    far, _ = page_of(*fenced(FAR), tmp_path / "far.html")
    shown, hidden = entry.search(near), entry.search(far)
    assert shown is not None and shown[1] is None
    assert hidden is not None and hidden[1] == "hidden"


# Units and names of the model.


@pytest.mark.parametrize("outputs", [1, 2, 3])
def test_axes_have_the_units_and_names_of_the_model(
    outputs: int, tmp_path: Path
) -> None:
    scenario, plan = planned(2, outputs)
    names, inputs = ["east", "north", "up"][:outputs], ["a", "b", "c"][:outputs]
    model = IntegratorChain(
        outputs, 2, 0.1, length_unit="mm", outputs=names, inputs=inputs
    )
    sides = InputRange(max=[8.0] * outputs)
    limits = dataclasses.replace(scenario.limits, inputs=sides)
    scenario = dataclasses.replace(scenario, model=model, limits=limits)
    histories = plot_histories(scenario=scenario, plan=plan)
    figure = plot_plan(scenario=scenario, plan=plan, color_by="speed")
    seen = texts(histories) + texts(figure)
    for unit in ("(mm)", "(mm/s)", "(mm/s²)", "speed (mm/s)"):
        assert unit in seen
    assert not re.search(r"\bm\b(?!ax)", seen)
    assert names[0] in seen
    titles = [a.get_title() + a.get_title(loc="left") for a in histories.axes]
    for name in names if outputs > 1 else []:
        assert f"along {name}" in titles
    for name in inputs:
        assert name in titles
    page, _ = page_of(scenario, plan, tmp_path / "replay.html")
    assert re.search(r"\(grid: \d+ mm\)", page)


def test_outputs_of_different_order_have_each_their_unit_above_their_panel() -> None:
    scenario = load_scenario("actuator_lag")
    found = make_plan(scenario).plan
    assert found is not None
    figure = plot_histories(scenario=scenario, plan=found)
    names = [axes.get_ylabel() for axes in figure.axes]
    above = [axes.get_title(loc="left") for axes in figure.axes]
    for name, units in {
        "tracking\nerror ỹ": ["(m)", "(m)", "(m)", "(rad)"],
        "sliding\nvariable s": ["(m/s²)", "(m/s²)", "(m/s)", "(rad)"],
    }.items():
        first = names.index(name)
        assert above[first : first + 4] == units


# Any size.


@pytest.mark.parametrize("length", [1e-3, 0.1, 30.0, 1e3, 1e6])
def test_a_scene_of_any_size_looks_alike(length: float, tmp_path: Path) -> None:
    """Between a few and some ten of its own units, and what is in it goes along."""
    scenario, plan = planned(2, 3)
    moved = in_other_units(scenario, length=length, time=1.0)
    scaled = plan_in_units(plan, Units(length=1 / length))
    scale, radius = Scale.of(scaled), vehicle_radius(moved, scaled)
    assert scale.field != 1.0
    low, high = field_corners(moved, scaled)
    assert 7.0 < float((high - low).max()) / scale.field < 40.0
    assert not scale.tube_is_thin
    assert 0.1 * scale.field <= radius <= 0.25 * scale.field
    page, data = page_of(moved, scaled, tmp_path / "replay.html")
    assert data["width"] == pytest.approx(2 * radius / scale.field, rel=1e-4)
    assert f"(grid: {grid_spacing(high - low, scale):g} m)" in page
    # Sizes in the figures that are neither the plan's nor the obstacles'.
    figures = [
        plot_plan(scenario=s, plan=p) for s, p in ((scenario, plan), (moved, scaled))
    ]
    small, large = (np.array(f.axes[0].get_xlim()) for f in figures)
    np.testing.assert_allclose(large, length * small, rtol=1e-6)
    assert len(figures[0].axes) == len(figures[1].axes)


def test_fields_of_some_ten_metres_are_drawn_in_metres() -> None:
    for outputs in (1, 2, 3):
        assert Scale.of(planned(2, outputs)[1]) == Scale()


def test_a_tube_too_thin_to_be_seen_is_drawn_wider_for_a_look_from_afar(
    tmp_path: Path,
) -> None:
    scenario, plan = planned(2, 3)
    assert not scene(scenario, plan).HasPath(AFAR)
    thin = dataclasses.replace(
        plan,
        bound_samples=2e-3 * plan.bound_samples,
        bound_rate_samples=2e-3 * plan.bound_rate_samples,
    )
    scale = Scale.of(thin)
    half = float(np.median(thin.position_tube(thin.sample_times())))
    assert scale.tube / 40 < half < scale.tube < scale.field == 1.0
    meshcat = scene(scenario, thin)
    for name in ("plan/tube/lower", "plan/reference"):
        assert meshcat.HasPath(f"{ROOT}/{name}") and meshcat.HasPath(f"{AFAR}/{name}")
    page, data = page_of(scenario, thin, tmp_path / "replay.html")
    assert "(widened from afar)" in page
    assert data["thin"] == pytest.approx(scale.tube)
    for name in ("trail/0", "trail/5"):  # both are seen from the same moment on
        assert f"{AFAR}/{name}".encode() in meshcat_commands(page)


@pytest.mark.parametrize(
    ("time", "faster"), [(1.0, 1.0), (200.0, 50.0), (1e-2, 2e-3), (10.0, 1.0)]
)
def test_a_replay_of_any_flight_takes_some_ten_seconds(
    time: float, faster: float, tmp_path: Path
) -> None:
    scenario, plan = planned(2, 3)
    moved = in_other_units(scenario, length=1.0, time=time)
    scaled = plan_in_units(plan, Units(time=1 / time))
    page, data = page_of(moved, scaled, tmp_path / "replay.html")
    assert data["faster"] == Scale.of(scaled).time == faster
    assert 5.0 < data["end"] / faster < 100.0
    pieces = set(re.findall(rb"/dtmpc/trail/(\d+)", meshcat_commands(page)))
    assert 30 < len(pieces) < 1000


def test_a_short_plan_has_no_corners_and_a_long_one_an_end() -> None:
    plan = planned(2, 3)[1]
    for time, count in ((1e-3, 100), (1e4, 4000)):
        scaled = plan_in_units(plan, Units(time=1 / time))
        assert len(scaled.sample_times(drawn_period(scaled, 0.025))) == count + 1


@pytest.mark.parametrize("length", [1e-3, 1e3, 1e6])
def test_obstacles_have_their_true_size_in_any_unit(length: float) -> None:
    ball = Sphere([0.0, 5.0 * length, 2.0 * length], 9.0 * length)
    across = Cylinder([0.0, 5.0 * length], 8.0 * length)
    obstacles = ObstacleSet.stack([ball, across], 3)
    position = length * np.array([[0.0, 0.0, 1.0], [0.0, 10.0, 1.0]])
    tube = np.full_like(position, 0.1 * length)
    for order in ((0, 1), (1, 2)):
        (_, silhouette), (_, pillar) = obstacle_sections(
            obstacles, position, tube, order
        )
        extent = np.ptp(silhouette.outline(), axis=0)
        np.testing.assert_allclose(extent, 18.0 * length, rtol=1e-3)
        assert np.ptp(pillar.outline(), axis=0)[0] == pytest.approx(16 * length)
    assert np.ptp(pillar.outline(), axis=0)[1] > 1000 * length  # it has no end


@pytest.mark.parametrize(
    ("size", "count"), [(25.0, 1), (3.7, 2), (0.6, 2), (0.013, 3), (2e5, 0)]
)
def test_numbers_have_as_many_digits_as_they_need(size: float, count: int) -> None:
    assert decimals(size) == count
