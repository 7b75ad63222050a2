"""A replay in Meshcat: one HTML file that needs no server and no network.

`write_replay` draws the scene, records the flight in it as an animation and puts a
legend, a time line and a camera that follows the vehicle over the 3-D view (`page`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatParams, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from dtmpc_drake.logs import quiet
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import plans_in_force
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.geometry import embedding, missing_axes, travel_frames
from dtmpc_drake.visualization.page import legend_html, with_overlay
from dtmpc_drake.visualization.scale import Scale
from dtmpc_drake.visualization.scene import (
    AFAR,
    FLAT,
    ROOT,
    UNKNOWN,
    add_obstacles,
    add_pipe,
    add_scene,
    add_tube,
    field_corners,
    rgba,
    tube_paths,
)
from dtmpc_drake.visualization.shown import ShownFlight
from dtmpc_drake.visualization.style import (
    BLACK,
    BLUE,
    VERMILION,
    ColorBy,
    cloud_colors,
    drawn_period,
)

_FRAME_RATE = 32.0  # of the animation, in 1/s
_PAUSE = 1.5  # at the end of the flight, before it starts again, in s
_TRAIL_PERIOD = 0.1  # length of a piece of the trail, in s
_TRAIL = 0.024  # its radius, of the tube
_SWARM = 40  # vehicles that fly along, about
_BALL = 0.04  # their radius, of the tube
_CLOUD_TRAILS = 240  # trails of a cloud, and points of each: what a file can hold
_CLOUD_POINTS = 150
_GRAVITY = 9.81  # in a problem's own units, for the attitude of the picture only


class Visible(NamedTuple):
    """Something that is shown for a part of the flight only.

    Attributes:
        path: in Meshcat.
        start: from when on, in s.
        stop: until when, in s.
    """

    path: str
    start: float
    stop: float


def write_replay(
    path: str | Path,
    *,
    scenario: Scenario,
    plan: Plan,
    flight: ShownFlight,
    color_by: ColorBy = "bandwidth",
) -> None:
    """Writes a flight as one self-contained HTML file.

    Where there were several plans, each one is drawn while it is in force, and what
    was flown of it from then on.  An obstacle that is not known yet is a ghost.

    Args:
        path: of the file; its directory must exist.
        scenario: gives the obstacles and the name.
        plan: the reference and the tube that the flight stays in; of several plans
            what was in force at each time, as from `flown_plan`.
        flight: to show.
        color_by: what the colours of the tube mean.

    Raises:
        ValueError: if the arrays of the flight do not fit.
        OSError: if the file cannot be written.
    """
    flight.require_fit(plan.num_outputs)
    with quiet("drake"):  # the address of a server that nobody will visit
        meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    add_scene(meshcat, scenario=scenario, plan=plan, color_by=color_by)
    add_cloud_trails(meshcat, clouds=flight.clouds)
    visible = add_discoveries(
        meshcat, scenario=scenario, plan=plan, flight=flight, color_by=color_by
    )
    add_flight(meshcat, scenario=scenario, plan=plan, flight=flight, visible=visible)
    overlay = legend_html(
        scenario=scenario, plan=plan, flight=flight, color_by=color_by
    )
    page = with_overlay(meshcat.StaticHtml(), title=scenario.name, overlay=overlay)
    Path(path).write_text(page, encoding="utf-8")


# Beside the scene.


def add_cloud_trails(meshcat: Meshcat, *, clouds: Mapping[str, FloatArray]) -> None:
    """Draws the trails of many flights as thin lines that do not move.

    Args:
        meshcat: to draw into.
        clouds: flights by the name of their group, ``(flights, K, m)``; no more of
            each than fit into a picture and a file.
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
            rgba(colors[name], 0.35),
        )


def add_discoveries(
    meshcat: Meshcat,
    *,
    scenario: Scenario,
    plan: Plan,
    flight: ShownFlight,
    color_by: ColorBy = "bandwidth",
) -> list[Visible]:
    """Draws each plan in place of the one in `add_scene`, and ghosts of obstacles.

    Args:
        meshcat: `add_scene` drew into it.
        scenario: gives the obstacles.
        plan: that `add_scene` drew.
        flight: with less than two plans nothing of them changes.
        color_by: what the colours mean.

    Returns:
        What is visible for a part of the flight only.
    """
    visible: list[Visible] = []
    if flight.found:
        low, high = field_corners(scenario, plan)
        add_obstacles(
            meshcat,
            scenario=scenario,
            low=low,
            high=high,
            look=UNKNOWN,
            chosen=flight.found,
        )
        for i, since in flight.found.items():
            visible.append(Visible(f"{ROOT}/ghosts/{i}", -np.inf, since))
            visible.append(Visible(f"{ROOT}/obstacles/{i}", since, np.inf))
    shown = plans_in_force(flight.replans)
    if len(shown) > 1:
        scale = Scale.of(plan)
        for path in tube_paths("plan", scale):
            meshcat.Delete(path)
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
                    scale=scale,
                )
                for path in tube_paths(name, scale):
                    visible.append(Visible(path, since, until))
    return visible


# The flight.


def add_flight(
    meshcat: Meshcat,
    *,
    scenario: Scenario,
    plan: Plan,
    flight: ShownFlight,
    visible: Sequence[Visible] = (),
) -> None:
    """Records the flight as an animation that plays at once, in a loop.

    Time in the recording is that of the flight; the page plays it `Scale.time` times
    as fast.  The vehicle's attitude is a picture: it leans as a quadrotor would that
    flies the reference.  Some flights of the clouds fly along, as small balls.

    Args:
        meshcat: to record into.
        scenario: gives the problem's own units.
        plan: drawn by `add_scene` before.
        flight: of the plan.
        visible: as from `add_discoveries`.
    """
    start, last = flight.time[0], flight.time[-1]
    end = float(last - start)
    scale = Scale.of(plan)
    # Every frame, but of a long flight only some: the viewer interpolates.
    rate, pause = _FRAME_RATE / scale.time, _PAUSE * scale.time
    every = math.ceil(drawn_period(plan, 1 / rate) * rate)
    frames = np.arange(0.0, end, every / rate)
    frames = np.append(frames, [end, end + pause])
    now = np.minimum(start + frames, last)

    _add_reference_now(meshcat, scale)
    balls = _add_swarm(meshcat, flight, now, scale)
    meshcat.StartRecording(
        frames_per_second=rate, set_visualizations_while_recording=False
    )
    lean = _GRAVITY * scenario.own_units().of(2)
    _record_motion(meshcat, plan, flight, frames, now, lean)
    for k, t in enumerate(frames):
        if k % 3 == 0 or k == len(frames) - 1:
            for path, ball in balls.items():
                meshcat.SetTransform(path, RigidTransform(ball[k]), t)
    for path, begin, stop in [*_add_trail(meshcat, plan, flight, scale), *visible]:
        _show(meshcat, path, begin - start, stop - start, end + pause)
    animation = meshcat.get_mutable_recording()
    animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    animation.set_repetitions(10_000)
    meshcat.StopRecording()
    meshcat.PublishRecording()


def _add_reference_now(meshcat: Meshcat, scale: Scale) -> None:
    """The point of the reference, and a box of half-width one around it."""
    point = Sphere(0.035 * scale.tube)
    meshcat.SetObject(f"{ROOT}/reference_now/point", point, rgba(BLACK))
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1)
    ends = [np.moveaxis(corners, i, 0).reshape(2, 4, 3) for i in range(3)]
    starts, stops = (np.concatenate([e[k] for e in ends]).T for k in (0, 1))
    meshcat.SetLineSegments(f"{ROOT}/tube_now/edges", starts, stops, 2.0, rgba(BLUE))


def _add_swarm(
    meshcat: Meshcat, flight: ShownFlight, now: FloatArray, scale: Scale
) -> dict[str, FloatArray]:
    """Some flights of each cloud as small balls: their paths and where they are."""
    colors = cloud_colors(flight.clouds)
    balls: dict[str, FloatArray] = {}
    for name, flights in flight.clouds.items():
        few = -(-_SWARM // len(flight.clouds))
        for one in flights[:few]:
            path = f"{ROOT}/cloud/vehicles/{len(balls)}"
            ball = Sphere(_BALL * scale.tube)
            meshcat.SetObject(path, ball, rgba(colors[name]))
            E = embedding(one.shape[-1])
            balls[path] = _interpolate(now, flight.time, one) @ E.T
    return balls


def _record_motion(
    meshcat: Meshcat,
    plan: Plan,
    flight: ShownFlight,
    frames: FloatArray,
    now: FloatArray,
    gravity: float,
) -> None:
    """Records vehicle, reference, tube and the camera that follows.

    Args:
        meshcat: that records.
        plan: gives reference and tube.
        flight: gives the vehicle.
        frames: since the recording began, ``(F,)``, in s.
        now: time of the flight in each frame, ``(F,)``, in s.
        gravity: against which the vehicle leans.
    """
    flat = FLAT * Scale.of(plan).tube
    E = embedding(plan.num_outputs)
    flown = _interpolate(now, flight.time, flight.position) @ E.T
    reference = plan.derivatives(now) @ E.T
    half_axes = plan.position_tube(now) @ E.T + flat * missing_axes(plan.num_outputs)
    attitude, chase = _attitudes(reference, gravity), travel_frames(reference[:, 1])
    for k, t in enumerate(frames):
        vehicle = RigidTransform(RotationMatrix(attitude[k]), flown[k])
        meshcat.SetTransform(f"{ROOT}/vehicle", vehicle, t)
        point = RigidTransform(reference[k, 0])
        meshcat.SetTransform(f"{ROOT}/reference_now", point, t)
        box, scale = f"{ROOT}/tube_now", np.maximum(half_axes[k], 0.025 * flat)
        meshcat.SetTransform(box, point, t)
        meshcat.SetProperty(box, "scale", scale.tolist(), t)
        camera = RigidTransform(RotationMatrix(chase[k]), reference[k, 0])
        meshcat.SetTransform(f"{ROOT}/chase", camera, t)


def _add_trail(
    meshcat: Meshcat, plan: Plan, flight: ShownFlight, scale: Scale
) -> list[Visible]:
    """What was flown, in pieces that are seen from their ends on."""
    start, last = flight.time[0], flight.time[-1]
    E = embedding(plan.num_outputs)
    period = drawn_period(plan, _TRAIL_PERIOD * scale.time)
    times = np.arange(start, last, period)
    pieces = []
    for i, (begin, stop) in enumerate(itertools.pairwise(np.append(times, last))):
        now = np.linspace(begin, stop, 6)
        points = _interpolate(now, flight.time, flight.position) @ E.T
        for path in tube_paths(f"trail/{i}", scale):
            unit = scale.field if path.startswith(AFAR) else scale.tube
            add_pipe(meshcat, path, points, VERMILION, _TRAIL * unit)
            pieces.append(Visible(path, stop, np.inf))
    return pieces


def _show(meshcat: Meshcat, path: str, start: float, stop: float, end: float) -> None:
    """Shows something between two times of a recording that lasts until `end`."""
    # Every track must be as long as the flight, or it repeats too soon.
    for t in sorted({0.0, *(t for t in (start, stop) if 0.0 < t < end), end}):
        meshcat.SetProperty(path, "visible", bool(start <= t < stop), t)


def _interpolate(now: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(now, time, column) for column in values.T], axis=-1)


def _attitudes(reference: FloatArray, gravity: float) -> FloatArray:
    """Rotations whose third axis is the thrust and whose first looks ahead.

    Args:
        reference: embedded y* and its derivatives, ``(K, n + 1, 3)``.
        gravity: what the thrust is against.

    Returns:
        Shape ``(K, 3, 3)``.
    """
    forward = travel_frames(reference[:, 1] * [1.0, 1.0, 0.0])[:, :, 0]
    thrust = np.tile([0.0, 0.0, gravity], (len(forward), 1))
    if reference.shape[1] > 2:
        thrust = thrust + reference[:, 2]
    up = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    left = np.cross(up, forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=2)
