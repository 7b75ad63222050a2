"""A replay in Meshcat: one HTML file that needs no server and no network.

The scene is made of pieces (`add_field`, `add_obstacles`, `add_tube`,
`add_vehicle`) that `add_scene` puts into any Meshcat, a live notebook's too.
`write_replay` adds the flight as an animation and, over the 3-D view, a legend,
a time line and a camera that follows the vehicle.
"""

from __future__ import annotations

import html
import itertools
import json
import math
from collections.abc import Container, Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from pydrake.geometry import (
    Box,
    Cylinder,
    Ellipsoid,
    Meshcat,
    MeshcatAnimation,
    MeshcatParams,
    Rgba,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix

from dtmpc_drake.logs import quiet
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles.drawing import Mesh
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import Replan, plans_in_force
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.geometry import (
    embedding,
    missing_axes,
    obstacle_solids,
    swept_mesh,
    travel_frames,
    tube_rings,
)
from dtmpc_drake.visualization.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    VERMILION,
    ColorBy,
    Coloring,
    cloud_colors,
    drawn_period,
)

GHOST = "#7FA8C9"
"""Colour of obstacles that are not known yet."""

ROOT = "/dtmpc"
"""Everything drawn here is below this path."""

_FRAME_RATE = 32.0  # of the animation, in 1/s
_PAUSE = 1.5  # at the end of the flight, before it starts again, in s
_TRAIL_PERIOD = 0.1  # length of a piece of the trail, in s
_TUBE_PERIOD = 0.05  # between two rings of the tube, in s
_SWARM = 40  # vehicles that fly along, about
_BALL = 0.04  # their radius, in m
_CLOUD_TRAILS = 240  # trails of a cloud, and points of each: what a file can hold
_CLOUD_POINTS = 150
_FLAT = 0.04  # half-thickness along axes that the vehicle does not have, in m
_GRAVITY = 9.81  # m/s², for the attitude of the picture only


def write_replay(
    *,
    scenario: Scenario,
    plan: Plan,
    time: FloatArray,
    position: FloatArray,
    path: str | Path,
    color_by: ColorBy = "bandwidth",
    status: str | None = None,
    clouds: Mapping[str, FloatArray] | None = None,
    replans: Sequence[Replan] = (),
    known_since: FloatArray | None = None,
) -> None:
    """Writes a flight as one self-contained HTML file.

    Where there were several plans, each one is drawn while it is in force, and what
    was flown of it from then on.  An obstacle that is not known yet is a ghost.

    Args:
        scenario: gives the obstacles and the name.
        plan: the reference and the tube that the flight stays in; of several plans
            what was in force at each time, as from `flown_plan`.
        time: of the flight, ``(K,)``, in s, increasing.
        position: y of the vehicle, ``(K, m)``, in m.
        path: of the file; its directory must exist.
        color_by: what the colours of the tube mean.
        status: one line for the legend, such as the plan's status.
        clouds: more flights of the same plan at the same times by the name of
            their group, ``(flights, K, m)``.
        replans: every time that was planned, if there was more than one.
        known_since: of each obstacle, ``(o,)``, in s; from the start if left out.

    Raises:
        ValueError: if `time` and `position` do not fit.
        OSError: if the file cannot be written.
    """
    time, position = np.asarray(time), np.asarray(position)
    if len(time) < 2 or position.shape != (len(time), plan.num_outputs):
        raise ValueError(
            f"position: got shape {position.shape}, but it must be"
            f" (len(time), {plan.num_outputs}) with at least two times"
        )
    with quiet("drake"):  # the address of a server that nobody will visit
        meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    add_scene(meshcat, scenario=scenario, plan=plan, color_by=color_by)
    swarm = None
    if clouds is not None:
        add_cloud_trails(meshcat, clouds=clouds)
        each = -(-_SWARM // len(clouds))
        swarm = {name: flights[:each] for name, flights in clouds.items()}
    visible = add_discoveries(
        meshcat,
        scenario=scenario,
        plan=plan,
        replans=replans,
        known_since=known_since,
        color_by=color_by,
    )
    add_flight(
        meshcat,
        plan=plan,
        time=time,
        position=position,
        swarm=swarm,
        visible=visible,
    )
    page = meshcat.StaticHtml()
    overlay = legend_html(
        scenario=scenario,
        plan=plan,
        time=time,
        position=position,
        color_by=color_by,
        status=status,
        clouds=() if clouds is None else clouds,
        replans=replans,
        ghosts=known_since is not None and bool((known_since > 0).any()),
    )
    head, end, tail = page.rpartition("</body>")
    title = html.escape(scenario.name)
    head = head.replace("<title>Drake MeshCat</title>", f"<title>{title}</title>")
    Path(path).write_text(head + overlay + end + tail, encoding="utf-8")


# The scene.


def add_scene(
    meshcat: Meshcat,
    *,
    scenario: Scenario,
    plan: Plan,
    color_by: ColorBy = "bandwidth",
) -> None:
    """Draws everything that does not move, and the vehicle at the start."""
    meshcat.Delete(ROOT)
    low, high = field_corners(scenario, plan)
    add_field(meshcat, scenario=scenario, low=low, high=high)
    add_obstacles(meshcat, scenario=scenario, low=low, high=high)
    add_tube(meshcat, plan=plan, color_by=color_by)
    add_vehicle(meshcat, num_outputs=plan.num_outputs, radius=_radius(scenario, plan))
    E = embedding(plan.num_outputs)
    start = RigidTransform(E @ plan.reference(plan.start_time)[0])
    meshcat.SetTransform(f"{ROOT}/vehicle", start)
    set_camera(meshcat, low=low, high=high)


def field_corners(scenario: Scenario, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Two corners of the picture's field, ``(3,)`` each, in m.

    It holds the tube and the obstacles near it, with some air around.  Its floor
    is the ground, z = 0, unless something flies below; its ceiling is just above
    the highest reference, so that cylinders without an end do not hide what
    flies between them.  A vehicle in the plane gets a little of both.
    """
    E = embedding(plan.num_outputs)
    samples = plan.sample(drawn_period(plan, _TUBE_PERIOD))
    center, half = samples["position"] @ E.T, samples["position_tube"] @ E.T
    low, high = (center - half).min(axis=0), (center + half).max(axis=0)
    reach = max(2.0, 0.1 * float((high - low).max()))
    bounds = [(low, high)]
    for solid in obstacle_solids(scenario.obstacle_set(), plan.num_outputs, low, high):
        lowest, highest = solid.bounds()
        near = (lowest < high + reach) & (highest > low - reach)
        if near.all():
            bounds.append((lowest, highest))
    low = np.min([np.maximum(b[0], low - reach) for b in bounds], axis=0)
    high = np.max([np.minimum(b[1], high + reach) for b in bounds], axis=0)
    air = np.array([0.5, 0.5, 0.0])
    low, high = low - air, high + air
    low[2], high[2] = min(low[2], 0.0), center[:, 2].max() + 0.05
    if plan.num_outputs < 3:
        low[2], high[2] = -3 * _FLAT, 3 * _FLAT
    return low, high


def add_field(
    meshcat: Meshcat, *, scenario: Scenario, low: FloatArray, high: FloatArray
) -> None:
    """A light ground with a grid, start and goal, on a light background."""
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    background = "/Background/<object>"
    meshcat.SetProperty(background, "top_color", [0.90, 0.93, 0.96])
    meshcat.SetProperty(background, "bottom_color", [1.0, 1.0, 1.0])
    # Meshcat's point lights reach a few metres only: use sun and sky instead.
    for light in ("SpotLight", "PointLightNegativeX", "PointLightPositiveX"):
        meshcat.SetProperty(f"/Lights/{light}", "visible", False)
    meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 2.0)
    meshcat.SetProperty("/Lights/FillLight/<object>", "intensity", 1.6)
    meshcat.SetProperty("/Lights/FillLight/<object>", "position", [8.0, -6.0, 12.0])
    low, high = np.floor(low), np.append(np.ceil(high[:2]), high[2])
    size, middle = high - low, (low + high) / 2
    meshcat.SetObject(
        f"{ROOT}/field/ground", Box(size[0], size[1], 0.02), Rgba(1.0, 1.0, 0.99)
    )
    meshcat.SetTransform(
        f"{ROOT}/field/ground", RigidTransform([middle[0], middle[1], low[2] - 0.03])
    )
    x, y = (np.arange(low[i], high[i] + 0.5, grid_spacing(size)) for i in (0, 1))
    z = low[2] - 0.015
    starts = [[v, low[1], z] for v in x] + [[low[0], v, z] for v in y]
    ends = [[v, high[1], z] for v in x] + [[high[0], v, z] for v in y]
    meshcat.SetLineSegments(
        f"{ROOT}/field/grid",
        np.array(starts).T,
        np.array(ends).T,
        1.0,
        Rgba(0.82, 0.83, 0.84),
    )
    E = embedding(scenario.model.num_outputs)
    for name, state in (
        ("start", scenario.start_state()),
        ("goal", scenario.goal_state()),
    ):
        where = E @ state[0]
        where[2] = z
        meshcat.SetObject(f"{ROOT}/field/{name}", Cylinder(0.3, 0.01), _rgba(GREEN))
        meshcat.SetTransform(f"{ROOT}/field/{name}", RigidTransform(where))


def grid_spacing(size: FloatArray) -> float:
    """Of the lines on the ground, in m: about thirty along the field."""
    rough = float(size.max()) / 40.0
    return max(1.0, float(10 ** np.ceil(np.log10(max(rough, 1e-9)))))


def add_obstacles(
    meshcat: Meshcat,
    *,
    scenario: Scenario,
    low: FloatArray,
    high: FloatArray,
    color: str = GREY,
    opacity: float = 0.6,
    name: str = "obstacles",
    chosen: Container[int] | None = None,
) -> None:
    """The scenario's obstacles, in grey; those without an end fill the field.

    Args:
        meshcat: to draw into.
        scenario: gives the obstacles.
        low: one corner of the field, ``(3,)``, as from `field_corners`.
        high: the opposite corner.
        color: of all of them.
        opacity: of all of them.
        name: of the group, so that known and unknown ones can be told apart.
        chosen: the indices of those to draw; all of them if left out.
    """
    solids = obstacle_solids(
        scenario.obstacle_set(), scenario.model.num_outputs, low, high
    )
    primitives = {1: Box(2.0, 2.0, 2.0), 2: Cylinder(1.0, 2.0), 3: Sphere(1.0)}
    for i, solid in enumerate(solids):
        if chosen is not None and i not in chosen:
            continue
        path = f"{ROOT}/{name}/{i}"
        if isinstance(solid, Mesh):
            meshcat.SetTriangleMesh(
                path, solid.vertices.T, solid.faces.T, _rgba(color, opacity)
            )
            continue
        meshcat.SetObject(path, primitives[solid.rank], _rgba(color, opacity))
        meshcat.SetTransform(path, solid.transform)


def add_tube(
    meshcat: Meshcat,
    *,
    plan: Plan,
    color_by: ColorBy = "bandwidth",
    name: str = "plan",
    opacity: float = 0.75,
    among: Sequence[Plan] = (),
    capped: bool = True,
) -> None:
    """The reference as a line and the tube around it as a coloured surface.

    The tube is the box ``|ỹ_i| <= Ω_i`` swept along the reference.  Across the
    travel it is drawn as the rectangle that just holds the box, one side
    horizontal: exactly the box's silhouette on level flight, and never smaller.
    The half above the reference is faint, so that one looks into the tube.

    Args:
        meshcat: to draw into.
        plan: to draw.
        color_by: what the colours mean.
        name: of the group.
        opacity: of the lower half.
        among: plans that share their colours.
        capped: whether the tube's ends are closed.
    """
    time = plan.sample_times(drawn_period(plan, _TUBE_PERIOD))
    reference = plan.reference(time) @ embedding(plan.num_outputs).T
    half_axes = plan.position_tube(time) @ embedding(plan.num_outputs).T
    half_axes = half_axes + _FLAT * missing_axes(plan.num_outputs)
    position, velocity = reference[:, 0], reference[:, 1]
    coloring = Coloring.along(plan, time, color_by, among)
    rings = tube_rings(position, velocity, half_axes)
    middle = (rings + rings[:, [1, 0, 3, 2]]) / 2
    upper = np.stack([middle[:, 0], rings[:, 0], rings[:, 3], middle[:, 3]], axis=1)
    lower = np.stack([middle[:, 0], rings[:, 1], rings[:, 2], middle[:, 3]], axis=1)
    for half, shell, alpha in (
        ("lower", lower, opacity),
        ("upper", upper, 0.25 * opacity),
    ):
        path = f"{ROOT}/{name}/tube/{half}"
        vertices, faces = swept_mesh(shell, closed=False, capped=capped)
        colors = _linear(coloring.rgb(coloring.values)).repeat(shell.shape[1], axis=0)
        meshcat.SetTriangleColorMesh(path, vertices.T, faces.T, colors.T)
        meshcat.SetProperty(path, "opacity", alpha)
        # What is behind a translucent wall must not vanish.
        meshcat.SetProperty(f"{path}/<object>", "material.depthWrite", False)
    _add_pipe(meshcat, f"{ROOT}/{name}/reference", position, BLACK, 0.011)


def add_discoveries(
    meshcat: Meshcat,
    *,
    scenario: Scenario,
    plan: Plan,
    replans: Sequence[Replan],
    known_since: FloatArray | None = None,
    color_by: ColorBy = "bandwidth",
) -> list[tuple[str, float, float]]:
    """Draws each plan in place of the one in `add_scene`, and ghosts of obstacles.

    Args:
        meshcat: `add_scene` drew into it.
        scenario: gives the obstacles.
        plan: that `add_scene` drew.
        replans: every time that was planned; with less than two nothing changes.
        known_since: of each obstacle, ``(o,)``, in s.
        color_by: what the colours mean.

    Returns:
        What is visible for a part of the flight only: path, from and until when, s.
    """
    visible: list[tuple[str, float, float]] = []
    if known_since is not None and (known_since > 0).any():
        low, high = field_corners(scenario, plan)
        found = [int(i) for i in np.flatnonzero(known_since > 0)]
        add_obstacles(
            meshcat,
            scenario=scenario,
            low=low,
            high=high,
            color=GHOST,
            opacity=0.22,
            name="ghosts",
            chosen=found,
        )
        for i in found:
            since = float(known_since[i])
            visible.append((f"{ROOT}/ghosts/{i}", -np.inf, since))
            visible.append((f"{ROOT}/obstacles/{i}", since, np.inf))
    shown = plans_in_force(replans)
    if len(shown) > 1:
        meshcat.Delete(f"{ROOT}/plan")
        plans = [s.plan for s in shown]
        for i, s in enumerate(shown):
            # All of it while it is in force, then only what was flown of it.
            last = s is shown[-1]
            parts = [("in_force", s.plan.end_time, s.start, np.inf if last else s.end)]
            if not last:
                parts.append(("flown", s.end, s.end, np.inf))
            for part, end, since, until in parts:
                name = f"plans/{i}/{part}"
                add_tube(
                    meshcat,
                    plan=s.plan.between(s.start, end),
                    color_by=color_by,
                    name=name,
                    opacity=0.75 if part == "in_force" else 0.5,
                    among=plans,
                    capped=part == "in_force",
                )
                visible.append((f"{ROOT}/{name}", since, until))
    return visible


def add_vehicle(
    meshcat: Meshcat, *, num_outputs: int, radius: float, name: str = "vehicle"
) -> None:
    """A quadrotor (in three dimensions) or a puck; the model itself is a point.

    Args:
        meshcat: to draw into.
        num_outputs: m.
        radius: half the width of the picture of it, in m.
        name: of the group, which `add_flight` moves.
    """
    path = f"{ROOT}/{name}"
    dark, bright = _rgba(BLACK), _rgba(VERMILION)
    if num_outputs < 3:
        meshcat.SetObject(f"{path}/body", Cylinder(radius, 0.3 * radius), bright)
        meshcat.SetTransform(
            f"{path}/body", RigidTransform([0.0, 0.0, _FLAT + 0.15 * radius])
        )
        return
    meshcat.SetObject(
        f"{path}/body", Ellipsoid(0.42 * radius, 0.3 * radius, 0.2 * radius), bright
    )
    meshcat.SetObject(f"{path}/camera", Sphere(0.12 * radius), dark)
    meshcat.SetTransform(f"{path}/camera", RigidTransform([0.4 * radius, 0.0, 0.0]))
    rotor = 0.42 * radius
    arm = radius - rotor  # so that the rotors end at the radius on both axes
    for i in range(4):
        angle = np.pi / 4 + i * np.pi / 2
        turn = RotationMatrix.MakeZRotation(angle)
        reach = np.sqrt(2.0) * arm
        hub = turn @ np.array([reach, 0.0, 0.12 * radius])
        meshcat.SetObject(
            f"{path}/arm{i}", Box(reach, 0.1 * radius, 0.08 * radius), dark
        )
        meshcat.SetTransform(
            f"{path}/arm{i}",
            RigidTransform(turn, turn @ np.array([reach / 2, 0.0, 0.03 * radius])),
        )
        front = i in (0, 3)
        meshcat.SetObject(
            f"{path}/rotor{i}",
            Cylinder(rotor, 0.05 * radius),
            _rgba(VERMILION if front else BLACK, 0.75),
        )
        meshcat.SetTransform(f"{path}/rotor{i}", RigidTransform(hub))


def _radius(scenario: Scenario, plan: Plan) -> float:
    """So that the picture of the vehicle fits through the narrowest place."""
    position = plan.reference(plan.sample_times(drawn_period(plan, _TUBE_PERIOD)))[:, 0]
    distance = scenario.obstacle_set().clearance(position)
    return float(np.clip(0.85 * np.min(distance, initial=np.inf), 0.1, 0.25))


def set_camera(meshcat: Meshcat, *, low: FloatArray, high: FloatArray) -> None:
    """Looks at the whole field, with its long axis across the picture."""
    along_y = high[1] - low[1] >= high[0] - low[0]
    azimuth = np.deg2rad(-12.0 if along_y else -102.0)
    elevation = np.deg2rad(42.0)
    back = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(back, right)
    tall = np.tan(np.deg2rad(_FIELD_OF_VIEW) / 2)
    wide = tall * 16 / 9
    middle = (low + high) / 2
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1)
    corners = corners.reshape(-1, 3) - middle
    distance = max(
        (np.abs(corners @ right) / (0.94 * wide) + corners @ back).max(),
        (np.abs(corners @ up) / (0.55 * tall) + corners @ back).max(),
    )
    # The legend needs the upper third, so aim above the field.
    target = middle + 0.25 * tall * distance * up
    meshcat.SetCameraPose(target + distance * back, target)
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "fov", _FIELD_OF_VIEW)


_FIELD_OF_VIEW = 36.0  # vertical, in degrees


def _add_pipe(
    meshcat: Meshcat, path: str, points: FloatArray, color: str, radius: float
) -> None:
    """A line with a width that every browser draws."""
    step = np.gradient(points, axis=0)
    frames = travel_frames(step)
    angle = np.arange(5) * 2 * np.pi / 5
    circle = radius * np.stack([0 * angle, np.cos(angle), np.sin(angle)])
    vertices, faces = swept_mesh(points[:, None] + (frames @ circle).swapaxes(1, 2))
    meshcat.SetTriangleMesh(path, vertices.T, faces.T, _rgba(color))


def _linear(rgb: FloatArray) -> FloatArray:
    """Linear light of sRGB colours, which the viewer expects of vertex colours."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def _rgba(color: str, opacity: float = 1.0) -> Rgba:
    return Rgba(*to_rgb(color), opacity)


# The flight.


def add_cloud_trails(meshcat: Meshcat, *, clouds: Mapping[str, FloatArray]) -> None:
    """Draws the trails of many flights as thin lines that do not move.

    Args:
        meshcat: to draw into.
        clouds: flights by the name of their group, ``(flights, K, m)``, in m; no
            more of each than fit into a picture and a file.
    """
    colors = cloud_colors(clouds)
    for i, (name, flights) in enumerate(clouds.items()):
        every = max(1, flights.shape[1] // _CLOUD_POINTS)
        points = flights[: _CLOUD_TRAILS // len(clouds), ::every]
        points = points @ embedding(points.shape[-1]).T
        meshcat.SetLineSegments(
            f"{ROOT}/cloud/trails/{i}",
            points[:, :-1].reshape(-1, 3).T,
            points[:, 1:].reshape(-1, 3).T,
            1.0,
            _rgba(colors[name], 0.35),
        )


def add_flight(
    meshcat: Meshcat,
    *,
    plan: Plan,
    time: FloatArray,
    position: FloatArray,
    swarm: Mapping[str, FloatArray] | None = None,
    visible: Sequence[tuple[str, float, float]] = (),
) -> None:
    """Records the flight as an animation that plays at once, in a loop.

    The vehicle's attitude is a picture: it leans as a quadrotor would that
    flies the reference.

    Args:
        meshcat: to record into.
        plan: drawn by `add_scene` before.
        time: ``(K,)``, in s.
        position: ``(K, m)``, in m.
        swarm: more vehicles that fly along, as small balls, by the name of their
            group, ``(flights, K, m)``.
        visible: what to show for a part of the flight only, as from
            `add_discoveries`.
    """
    E = embedding(plan.num_outputs)
    end = float(time[-1] - time[0])
    # Every frame, but of a long flight only some: the viewer interpolates.
    every = math.ceil(drawn_period(plan, 1 / _FRAME_RATE) * _FRAME_RATE)
    frames = np.arange(0.0, end, every / _FRAME_RATE)
    frames = np.append(frames, [end, end + _PAUSE])
    now = np.minimum(time[0] + frames, time[-1])
    flown = _interpolate(now, time, position) @ E.T
    reference = plan.reference(now) @ E.T
    half_axes = plan.position_tube(now) @ E.T + _FLAT * missing_axes(plan.num_outputs)
    attitude = _attitudes(reference)
    chase = travel_frames(reference[:, 1])

    meshcat.SetObject(f"{ROOT}/reference_now/point", Sphere(0.035), _rgba(BLACK))
    box = f"{ROOT}/tube_now"
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1)
    ends = [np.moveaxis(corners, i, 0).reshape(2, 4, 3) for i in range(3)]
    starts, stops = (np.concatenate([e[k] for e in ends]).T for k in (0, 1))
    meshcat.SetLineSegments(f"{box}/edges", starts, stops, 2.0, _rgba(BLUE))

    balls: dict[str, FloatArray] = {}
    for name, flights in (swarm or {}).items():
        color = _rgba(cloud_colors(swarm or {})[name])
        for flight in flights:
            path = f"{ROOT}/cloud/vehicles/{len(balls)}"
            meshcat.SetObject(path, Sphere(_BALL), color)
            balls[path] = _interpolate(now, time, flight) @ E.T

    meshcat.StartRecording(
        frames_per_second=_FRAME_RATE, set_visualizations_while_recording=False
    )
    for k, t in enumerate(frames):
        vehicle = RigidTransform(RotationMatrix(attitude[k]), flown[k])
        meshcat.SetTransform(f"{ROOT}/vehicle", vehicle, t)
        point = RigidTransform(reference[k, 0])
        meshcat.SetTransform(f"{ROOT}/reference_now", point, t)
        meshcat.SetTransform(box, point, t)
        meshcat.SetProperty(box, "scale", np.maximum(half_axes[k], 1e-3).tolist(), t)
        camera = RigidTransform(RotationMatrix(chase[k]), reference[k, 0])
        meshcat.SetTransform(f"{ROOT}/chase", camera, t)
        if k % 3 == 0 or k == len(frames) - 1:
            for path, flight in balls.items():
                meshcat.SetTransform(path, RigidTransform(flight[k]), t)
    trail = drawn_period(plan, _TRAIL_PERIOD)
    pieces = np.append(np.arange(time[0], time[-1], trail), time[-1])
    for i, (begin, stop) in enumerate(itertools.pairwise(pieces)):
        points = _interpolate(np.linspace(begin, stop, 6), time, position) @ E.T
        path = f"{ROOT}/trail/{i}"
        _add_pipe(meshcat, path, points, VERMILION, 0.024)
        _show(meshcat, path, stop - time[0], np.inf, end + _PAUSE)
    for path, begin, stop in visible:
        _show(meshcat, path, begin - time[0], stop - time[0], end + _PAUSE)
    animation = meshcat.get_mutable_recording()
    animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    animation.set_repetitions(10_000)
    meshcat.StopRecording()
    meshcat.PublishRecording()


def _show(meshcat: Meshcat, path: str, start: float, stop: float, end: float) -> None:
    """Shows something between two times of a recording that lasts until `end`."""
    # Every track must be as long as the flight, or it repeats too soon.
    for t in sorted({0.0, *(t for t in (start, stop) if 0.0 < t < end), end}):
        meshcat.SetProperty(path, "visible", bool(start <= t < stop), t)


def _interpolate(now: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(now, time, column) for column in values.T], axis=-1)


def _attitudes(reference: FloatArray) -> FloatArray:
    """Rotations whose third axis is the thrust and whose first looks ahead.

    Args:
        reference: embedded y* and its derivatives, ``(K, n + 1, 3)``.

    Returns:
        Shape ``(K, 3, 3)``.
    """
    forward = travel_frames(reference[:, 1] * [1.0, 1.0, 0.0])[:, :, 0]
    thrust = np.tile([0.0, 0.0, _GRAVITY], (len(forward), 1))
    if reference.shape[1] > 2:
        thrust = thrust + reference[:, 2]
    up = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    left = np.cross(up, forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=2)


# The page around the scene.


def legend_html(
    *,
    scenario: Scenario,
    plan: Plan,
    time: FloatArray,
    position: FloatArray,
    color_by: ColorBy = "bandwidth",
    status: str | None = None,
    clouds: Iterable[str] = (),
    replans: Sequence[Replan] = (),
    ghosts: bool = False,
) -> str:
    """What Meshcat cannot draw: legend, time line, read-outs, chase view.

    Args:
        scenario: as in `write_replay`, and all that follows.
        plan: in force at each time.
        time: ``(K,)``, in s.
        position: ``(K, m)``, in m.
        color_by: what the colours mean.
        status: one line.
        replans: gives the news of each moment.
        ghosts: whether there are obstacles that are not known from the start.
        clouds: names of groups of more flights.

    Returns:
        HTML to put before a page's ``</body>``.  It degrades to the legend
        alone where the viewer is not the one that it knows.
    """
    shown = plans_in_force(replans)
    coloring = Coloring.along(plan, time, color_by, [s.plan for s in shown])
    share = np.linspace(0.0, 1.0, 9)
    colors = coloring.rgb(coloring.low + share * (coloring.high - coloring.low))
    ticks = coloring.low + np.array([0.0, 0.5, 1.0]) * (coloring.high - coloring.low)
    error = np.abs(position - plan.reference(time)[:, 0])
    ratio = error / np.maximum(plan.position_tube(time), 1e-6)
    low, high = field_corners(scenario, plan)
    every = np.unique(np.linspace(0, len(time) - 1, 300).astype(int))
    data = {
        "time": (time[every] - time[0]).round(3).tolist(),
        "value": coloring.values[every].round(3).tolist(),
        "ratio": ratio.max(axis=1)[every].round(3).tolist(),
        "end": round(float(time[-1] - time[0]), 3),
        "start": round(float(time[0]), 3),
        "width": round(2 * _radius(scenario, plan), 3),
        "unit": coloring.unit,
        "quantity": color_by,
        "news": [
            [round(s.start - float(time[0]), 3), s.replan.headline()] for s in shown
        ],
    }
    template = resources.files("dtmpc_drake.visualization") / "overlay.html"
    fields = {
        "name": html.escape(scenario.name.replace("_", " ")),
        "status": html.escape(status or ""),
        "label": html.escape(f"{coloring.label}, {coloring.unit}"),
        "gradient": ", ".join(to_hex(c) for c in colors),
        "low": f"{ticks[0]:.2f}",
        "middle": f"{ticks[1]:.2f}",
        "high": f"{ticks[2]:.2f}",
        "vehicle_color": VERMILION,
        "clouds": "".join(
            f'<li><i style="color: {color}"></i>{html.escape(name)}</li>'
            for name, color in cloud_colors(clouds).items()
        ),
        "reference_color": BLACK,
        "box_color": BLUE,
        "obstacle_color": GREY,
        "goal_color": GREEN,
        "grid": f"{grid_spacing(high - low):g}",
        "obstacles_shown": "" if scenario.obstacles else "hidden",
        "ghosts_shown": "" if ghosts else "hidden",
        "ghost_color": GHOST,
        "cut": "(pillars cut at flight altitude)" if plan.num_outputs >= 3 else "",
        # So that no text can end the script element.
        "data": json.dumps(data).replace("<", "\\u003c"),
    }
    return Template(template.read_text(encoding="utf-8")).substitute(fields)
