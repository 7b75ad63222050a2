"""What the pictures claim: every number in them is a plan's or a scenario's."""

from __future__ import annotations

import base64
import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon
from pydrake.geometry import Meshcat, MeshcatParams

from dtmpc_drake.disturbances import UniformHold
from dtmpc_drake.models import DragDoubleIntegrator, IntegratorChain
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles import Cylinder, Ellipsoid, Obstacle, ObstacleSet, Sphere
from dtmpc_drake.obstacles.drawing import intervals
from dtmpc_drake.planning import plan as make_plan
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.verdict import empty_record
from dtmpc_drake.scenario import (
    Controller,
    Limits,
    Planner,
    Scenario,
    Waypoint,
)
from dtmpc_drake.visualization import (
    ShownFlight,
    plot_histories,
    plot_plan,
    write_replay,
)
from dtmpc_drake.visualization.geometry import (
    embedding,
    obstacle_sections,
    obstacle_solids,
    swept_boxes,
    swept_mesh,
    travel_frames,
    tube_rings,
)
from dtmpc_drake.visualization.scene import ROOT, add_scene, field_corners
from dtmpc_drake.visualization.style import Coloring

OBSTACLES: dict[int, list[Obstacle]] = {
    1: [Sphere([7.5], 1.0)],
    2: [
        Cylinder([0.7, 3.0], 0.5),
        Ellipsoid([-1.0, 4.5], [[1.0, 0.5], [0.0, 2.0]], 0.6),
    ],
    3: [Cylinder([0.7, 3.0], 0.5), Sphere([0.0, 4.0, 1.5], 0.5)],
}
SHAPES = [(1, 1), (2, 1), (2, 2), (3, 2), (1, 3), (2, 3), (3, 3)]
_PLANS: dict[tuple[int, int], tuple[Scenario, Plan]] = {}


def planned(order: int, outputs: int) -> tuple[Scenario, Plan]:
    """A small scenario, and what the planner makes of it."""
    if (order, outputs) not in _PLANS:
        goal = [0.0] * outputs
        goal[min(1, outputs - 1)] = 6.0
        scenario = Scenario(
            name=f"chain_{order}_{outputs}",
            model=IntegratorChain(outputs, order, 0.1),
            disturbance=UniformHold([0.3] * outputs, 0.05),
            controller=Controller(slope=[2.0] * outputs),
            limits=Limits(12.0, 4.0),
            start=Waypoint([0.0] * outputs),
            goal=Waypoint(goal),
            duration=8.0,
            obstacles=OBSTACLES[outputs],
            planner=Planner(intervals=12, max_iterations=8),
        )
        result = make_plan(scenario)
        plan = result.plan or result.attempt
        assert plan is not None
        _PLANS[order, outputs] = scenario, plan
    return _PLANS[order, outputs]


def flown(plan: Plan, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Times and states somewhere in the tube."""
    time = plan.sample_times(0.02)
    generator = np.random.default_rng(seed)
    share = generator.uniform(-0.9, 0.9, (plan.order, plan.num_outputs))
    state = plan.reference(time)[:, : plan.order] + share * plan.error_bound(time)
    return time, state


def flight_of(plan: Plan) -> Flight:
    """A flight somewhere in the tube, with the plan's own highest derivative as u."""
    time, state = flown(plan)
    reference = plan.reference(time)
    return Flight(
        time=time,
        state=state,
        control=reference[:, -1],
        reference=reference,
        disturbance=np.zeros_like(reference[:, 0]),
        tube_ratios=np.zeros((len(time), 3, plan.num_outputs)),
        clearance=np.full((len(time), 1), np.inf),
        record=empty_record(),
        status="certified",
        known_since=np.zeros(0),
    )


def texts(figure: Figure) -> str:
    """All axis labels, colour bars included."""
    labels = [text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel())]
    return "\n".join(label.replace("\n", " ") for label in labels)


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


# Figures.


@pytest.mark.parametrize(("order", "outputs"), SHAPES)
def test_figures_work_for_every_order_and_size(order: int, outputs: int) -> None:
    scenario, plan = planned(order, outputs)
    figure = plot_plan(scenario=scenario, plan=plan, position=flown(plan)[1][:, 0])
    figure.draw_without_rendering()
    assert "rad/s" in texts(figure)
    assert "flown" in legend(figure)
    figure = plot_histories(scenario=scenario, plan=plan, flight=flight_of(plan))
    figure.draw_without_rendering()
    labels = texts(figure)
    unit = scenario.model.derivative_unit(order)
    for label in ("(m)", "(rad/s)", "(m/s)", "time (s)", f"({unit})"):
        assert label in labels
    assert len(figure.axes) == (4 if order == 1 else 5) * outputs + 1


def test_plan_is_seen_from_above_at_equal_scales() -> None:
    scenario, plan = planned(2, 3)
    axes = plot_plan(scenario=scenario, plan=plan).axes[0]
    assert axes.get_xlabel() == "y (m)"
    assert axes.get_ylabel() == "x (m)"
    assert axes.get_aspect() == 1.0
    bottom, top = axes.get_ylim()
    assert bottom > top  # with y to the right, x points down
    samples = plan.sample(0.02)
    edge = samples["position"] + samples["position_tube"]
    assert axes.get_xlim()[0] <= 0.0
    assert axes.get_xlim()[1] >= edge[:, 1].max()


def test_obstacles_have_their_true_radius() -> None:
    scenario, plan = planned(2, 3)
    axes = plot_plan(scenario=scenario, plan=plan).axes[0]
    outlines = [p.get_xy() for p in axes.patches if isinstance(p, Polygon)]
    for center, radius in (((3.0, 0.7), 0.5), ((4.0, 0.0), 0.5)):
        errors = [np.abs(np.linalg.norm(o - center, axis=1) - radius) for o in outlines]
        assert min(error.max() for error in errors) < 1e-9


def test_tube_is_drawn_where_it_is() -> None:
    scenario, plan = planned(2, 3)
    axes = plot_plan(scenario=scenario, plan=plan).axes[0]
    paths = [p.get_path() for p in axes.patches if isinstance(p, PathPatch)]
    drawn = paths[0].vertices
    samples = plan.sample(0.001)
    low = (samples["position"] - samples["position_tube"])[:, [1, 0]]
    high = (samples["position"] + samples["position_tube"])[:, [1, 0]]
    np.testing.assert_allclose(drawn.min(axis=0), low.min(axis=0), atol=1e-3)
    np.testing.assert_allclose(drawn.max(axis=0), high.max(axis=0), atol=1e-3)


@pytest.mark.parametrize("color_by", ["bandwidth", "speed"])
def test_colour_bar_says_what_the_colour_means(color_by: str) -> None:
    scenario, plan = planned(2, 3)
    figure = plot_plan(scenario=scenario, plan=plan, color_by=color_by)
    line = next(c for c in figure.axes[0].collections if isinstance(c, LineCollection))
    values = plan.bandwidth(plan.sample_times(0.001)).max(axis=1)
    if color_by == "speed":
        velocity = plan.reference(plan.sample_times(0.001))[:, 1]
        values = np.linalg.norm(velocity, axis=1)
    assert line.get_clim() == pytest.approx((values.min(), values.max()), abs=0.01)
    assert f"{color_by}" in texts(figure)
    assert ("rad/s" if color_by == "bandwidth" else "m/s") in texts(figure)


def test_unknown_colouring_is_refused() -> None:
    scenario, plan = planned(2, 3)
    with pytest.raises(ValueError, match="color_by: got 'mood'"):
        plot_plan(scenario=scenario, plan=plan, color_by="mood")  # type: ignore[arg-type]


def test_constant_bandwidth_still_gets_a_colour_bar() -> None:
    _, plan = planned(2, 1)
    level = np.full_like(plan.bandwidth_knots, 4.0)
    constant = dataclasses.replace(plan, bandwidth_knots=level)
    coloring = Coloring.along(constant, constant.sample_times(), "bandwidth")
    assert coloring.low < 4.0 < coloring.high
    assert np.isfinite(coloring.rgb(coloring.values)).all()


def test_many_flights_are_a_cloud() -> None:
    scenario, plan = planned(2, 3)
    cloud = np.stack([flown(plan, seed)[1][:, 0] for seed in range(5)])
    figure = plot_plan(scenario=scenario, plan=plan, position=cloud)
    assert "5 flights" in legend(figure)


def test_single_output_is_drawn_over_time() -> None:
    scenario, plan = planned(2, 1)
    axes = plot_plan(scenario=scenario, plan=plan).axes[0]
    assert axes.get_xlabel() == "time (s)"
    assert axes.get_ylabel() == "position x (m)"
    assert axes.get_ylim()[1] >= 6.5  # the obstacle ahead


def test_histories_show_the_limits_and_the_tube() -> None:
    scenario, plan = planned(2, 3)
    figure = plot_histories(scenario=scenario, plan=plan)
    assert "flown" not in legend(figure)
    lines = {
        axes.get_ylabel().replace("\n", " "): [
            np.asarray(line.get_ydata(), dtype=float) for line in axes.lines
        ]
        for axes in figure.axes
    }
    half = plan.position_tube(plan.sample_times(0.025))[:, 0]
    error = lines["tracking error ỹ (m)"]
    assert any(np.allclose(y, half) for y in error if y.shape == half.shape)
    assert any(np.allclose(y, -half) for y in error if y.shape == half.shape)
    assert any((y == 4.0).all() for y in lines["speed |ẏ| (m/s)"])
    assert any((y == 12.0).all() for y in lines["input norm ‖u‖ (m/s²)"])
    velocity_tube = plan.error_bound(plan.sample_times(0.025))[:, 1, 0]
    tightened = 4.0 - velocity_tube
    speed = [y for y in lines["speed |ẏ| (m/s)"] if y.shape == half.shape]
    assert any(np.allclose(y, tightened) for y in speed)


def test_the_planned_input_is_the_feedforward_and_lies_below_its_bound() -> None:
    """The drag of the reference is part of u*; the highest derivative alone is not."""
    scenario, plan = planned(2, 3)
    model = DragDoubleIntegrator(drag_estimate=0.2, drag_error_bound=0.05)
    scenario = dataclasses.replace(scenario, model=model)
    panel = plot_histories(scenario=scenario, plan=plan).axes[0]
    assert panel.get_ylabel().startswith("input norm")
    limit, bound, drawn = (np.asarray(line.get_ydata(), float) for line in panel.lines)
    reference = plan.reference(plan.sample_times(0.025))
    velocity = reference[:, 1]
    drag = 0.2 * np.linalg.norm(velocity, axis=1, keepdims=True) * velocity
    planned_input = np.linalg.norm(reference[:, 2] + drag, axis=1)
    np.testing.assert_allclose(drawn, planned_input)
    assert np.abs(drawn - np.linalg.norm(reference[:, 2], axis=1)).max() > 0.1
    assert (drawn < bound).all() and (limit == 12.0).all()


# The replay.


def meshcat_commands(page: str) -> bytes:
    """What the page sends to its viewer."""
    parts = re.findall(r'"data:application/octet-binary;base64,([^"]+)"', page)
    return b"\n".join(base64.b64decode(part) for part in parts)


@pytest.mark.parametrize(("order", "outputs"), [(1, 1), (3, 2), (2, 3)])
def test_replay_is_one_self_contained_file(
    order: int, outputs: int, tmp_path: Path
) -> None:
    scenario, plan = planned(order, outputs)
    time, state = flown(plan)
    path = tmp_path / "replay.html"
    write_replay(
        path,
        scenario=scenario,
        plan=plan,
        flight=ShownFlight(time, state[:, 0], status="certified & <flown>"),
    )
    assert [p.name for p in tmp_path.iterdir()] == ["replay.html"]
    page = path.read_text(encoding="utf-8")
    assert len(page) < 6e6
    markup = re.sub(r"(<script[^>]*>).*?(</script>)", r"\1\2", page, flags=re.S)
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//""", markup)
    assert "<link" not in markup
    assert "@import" not in markup
    commands = meshcat_commands(page)
    assert b"set_animation" in commands
    for name in ("vehicle", "tube", "obstacles", "reference", "trail", "chase"):
        assert f"{ROOT}/".encode() + name.encode() in commands or (
            f"{ROOT}/plan/{name}".encode() in commands
        )
    # The legend: what the colour means, with its unit and its numbers.
    bandwidth = plan.bandwidth(plan.sample_times()).max(axis=-1)
    assert re.search(r"Tube colour: bandwidth.*rad/s", markup)
    assert f"<span>{bandwidth.min():.2f}</span>" in markup
    assert f"<span>{bandwidth.max():.2f}</span>" in markup
    for entry in ("vehicle", "reference", "tube", "obstacles", "start and goal"):
        assert entry in markup
    assert scenario.name.replace("_", " ") in markup
    assert "certified &amp; &lt;flown&gt;" in markup
    assert page.index('id="dtmpc-legend"') < page.index("</body>")


def test_replay_by_speed(tmp_path: Path) -> None:
    scenario, plan = planned(2, 3)
    time, state = flown(plan)
    path = tmp_path / "replay.html"
    write_replay(
        path,
        scenario=scenario,
        plan=plan,
        flight=ShownFlight(time, state[:, 0]),
        color_by="speed",
    )
    assert "Tube colour: speed, m/s" in path.read_text(encoding="utf-8")


def test_replay_refuses_arrays_that_do_not_fit(tmp_path: Path) -> None:
    scenario, plan = planned(2, 3)
    with pytest.raises(ValueError, match="position: got shape"):
        write_replay(
            tmp_path / "replay.html",
            scenario=scenario,
            plan=plan,
            flight=ShownFlight(np.arange(4.0), np.zeros((4, 2))),
        )
    assert not list(tmp_path.iterdir())


def test_scene_can_be_drawn_again_into_a_live_viewer() -> None:
    scenario, plan = planned(2, 3)
    meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    for _ in range(2):
        add_scene(meshcat, scenario=scenario, plan=plan, color_by="speed")
        for name in ("field/ground", "obstacles/1", "plan/tube", "vehicle/body"):
            assert meshcat.HasPath(f"{ROOT}/{name}")


# Geometry.


def test_field_holds_the_tube() -> None:
    scenario, plan = planned(2, 3)
    low, high = field_corners(scenario, plan)
    samples = plan.sample()
    assert (low <= (samples["position"] - samples["position_tube"]).min(axis=0)).all()
    edge = (samples["position"] + samples["position_tube"]).max(axis=0)
    assert (high[:2] >= edge[:2]).all()


@pytest.mark.parametrize(
    ("obstacle", "rank"),
    [
        (Cylinder([1.0, -2.0], 0.7), 2),
        (Sphere([1.0, 2.0, 0.5], 0.3), 3),
        (Ellipsoid([1, 2, 3], [[2, 0.5, 0], [0, 1, 0.3], [0.1, 0, 0.5]], 0.8), 3),
        (Ellipsoid([1, 2, 0.5], [[0, 1, 0.4]], 0.8), 1),
        (Ellipsoid([1, 2, 0.5], [[1, 0, 0], [0, 0, 2]], 0.8), 2),
    ],
)
def test_solids_are_the_obstacles(obstacle: Obstacle, rank: int) -> None:
    low, high = np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 2.0])
    obstacles = ObstacleSet.stack([obstacle], 3)
    (solid,) = obstacle_solids(obstacles, 3, low, high)
    assert solid.rank == rank
    assert np.linalg.det(solid.transform[:3, :3]) > 0
    generator = np.random.default_rng(1)
    direction = generator.standard_normal((200, 3))
    if rank == 3:
        on = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    elif rank == 2:
        side = np.linalg.norm(direction[:, :2], axis=1, keepdims=True)
        on = direction / side
    else:
        on = direction / np.abs(direction[:, 2:])
    points = on @ solid.transform[:3, :3].T + solid.transform[:3, 3]
    np.testing.assert_allclose(obstacles.clearance(points), 0.0, atol=1e-9)


def test_sections_are_taken_at_the_altitude_of_the_tube() -> None:
    obstacles = ObstacleSet.stack(
        [
            Sphere([0.0, 5.0, 2.0], 1.0),
            Sphere([0.0, 5.0, 9.0], 1.0),
            Cylinder([1.0, 2.0], 0.4),
            Ellipsoid([0, 5, 2], [[1, 0.5, 0.3], [0, 1, 0.2], [0.1, 0, 1]], 1.0),
        ],
        3,
    )
    position = np.stack(
        [0 * np.arange(11.0), np.arange(11.0), 1.2 + 0 * np.arange(11)], 1
    )
    tube = np.full_like(position, 0.2)
    sphere, high_above, pillar, ellipsoid = obstacle_sections(obstacles, position, tube)
    # The tube reaches up to 1.4 m, that is 0.6 m below the ball's centre.
    assert sphere[0] is not None
    reach = np.linalg.norm(sphere[0].outline() - [0.0, 5.0], axis=1)
    np.testing.assert_allclose(reach, 0.8)
    np.testing.assert_allclose(
        np.linalg.norm(sphere[1].outline() - [0.0, 5.0], axis=1), 1.0
    )
    assert high_above[0] is None
    assert pillar[0] is not None
    np.testing.assert_allclose(pillar[0].outline(), pillar[1].outline())
    assert ellipsoid[0] is not None
    outline = np.column_stack([ellipsoid[0].outline(), np.full(181, 1.4)])
    np.testing.assert_allclose(obstacles.clearance(outline)[:, 3], 0.0, atol=1e-9)


def test_intervals_of_a_single_output() -> None:
    obstacles = ObstacleSet.stack(
        [Sphere([7.5], 1.0), Ellipsoid([2.0], [[2.0]], 1.0)], 1
    )
    np.testing.assert_allclose(intervals(obstacles), [[6.5, 8.5], [1.5, 2.5]])


def test_swept_boxes_cover_all_between_the_samples() -> None:
    generator = np.random.default_rng(0)
    center = np.cumsum(generator.uniform(-1.0, 1.0, (6, 2)), axis=0)
    half = generator.uniform(0.05, 0.3, (6, 2))
    quads = swept_boxes(center - half, center + half)
    share = generator.uniform(0.0, 1.0, (400, 1))
    k = generator.integers(0, 5, 400)
    middle = (1 - share) * center[k] + share * center[k + 1]
    reach = (1 - share) * half[k] + share * half[k + 1]
    points = middle + generator.uniform(-1.0, 1.0, (400, 2)) * reach
    edge = np.roll(quads, -1, axis=1) - quads
    offset = points[:, None, None] - quads
    turn = edge[..., 0] * offset[..., 1] - edge[..., 1] * offset[..., 0]
    assert (turn >= -1e-12).all(axis=-1).any(axis=-1).all()


def test_tube_rings_hold_the_box_seen_along_the_travel() -> None:
    generator = np.random.default_rng(2)
    velocity = generator.standard_normal((50, 3))
    position = generator.standard_normal((50, 3))
    half = generator.uniform(0.1, 0.5, (50, 3))
    rings = tube_rings(position, velocity, half)
    frames = travel_frames(velocity)
    corners = np.array(
        [[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float
    )
    seen = np.einsum("kij,kci->kcj", frames, half[:, None] * corners)[..., 1:]
    drawn = np.einsum("kij,kci->kcj", frames, rings - position[:, None])[..., 1:]
    np.testing.assert_allclose(
        np.abs(seen).max(axis=1), np.abs(drawn).max(axis=1), atol=1e-12
    )


def test_travel_frames_are_rotations_even_at_rest_and_upright() -> None:
    velocity = np.zeros((9, 3))
    velocity[2:4] = [1.0, 2.0, 0.0]
    velocity[5:7] = [0.0, 0.0, 1.5]
    velocity[8] = [-1.0, 0.0, 0.2]
    for v in (velocity, np.zeros((4, 3))):
        frames = travel_frames(v)
        product = frames @ frames.swapaxes(1, 2)
        np.testing.assert_allclose(
            product, np.tile(np.eye(3), (len(v), 1, 1)), atol=1e-9
        )
        np.testing.assert_allclose(np.linalg.det(frames), 1.0)
        np.testing.assert_allclose(frames[:, 2, 1], 0.0, atol=1e-12)  # left is level


def test_swept_mesh_is_closed() -> None:
    rings = np.random.default_rng(3).standard_normal((7, 5, 3))
    vertices, faces = swept_mesh(rings)
    assert len(vertices) == 35
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    assert (count == 2).all()


def test_embedding_puts_every_output_on_its_axis() -> None:
    np.testing.assert_array_equal(embedding(1) @ [2.0], [0.0, 2.0, 0.0])
    np.testing.assert_array_equal(embedding(2) @ [1.0, 2.0], [1.0, 2.0, 0.0])
    np.testing.assert_array_equal(embedding(4) @ [1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0])
