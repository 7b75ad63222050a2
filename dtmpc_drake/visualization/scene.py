"""The scene in Meshcat: field, obstacles, tube, vehicle and camera.

It is made of pieces that `add_scene` puts into any Meshcat, a live notebook's too.
Nothing here moves; see `replay`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Sequence

import numpy as np
from matplotlib.colors import to_rgb
from pydrake.geometry import Box, Cylinder, Ellipsoid, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.obstacles.drawing import Mesh
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.geometry import (
    TUBE_PERIOD,
    embedding,
    missing_axes,
    near_bounds,
    obstacle_solids,
    position_bounds,
    swept_mesh,
    travel_frames,
    tube_box,
    tube_rings,
)
from dtmpc_drake.visualization.scale import Scale
from dtmpc_drake.visualization.style import (
    BLACK,
    FENCE,
    GHOST,
    GREEN,
    GREY,
    PALE_GREEN,
    VERMILION,
    ColorBy,
    Coloring,
    drawn_period,
)

ROOT = "/dtmpc"
"""Everything drawn here is below this path, in the problem's units; see `Scale`."""
AFAR = f"{ROOT}/afar"
"""What the page hides in the view that follows the vehicle."""
POLE = 1.0
"""By how much the pole of a goal that need not be met is above it, of the field."""
FLAT = 0.04
"""Half-thickness along axes that the vehicle does not have, of the tube."""

_WIDE = 0.05  # half-width of a thin tube from afar, at least, of the field
_FIELD_OF_VIEW = 36.0  # vertical, in degrees


@dataclasses.dataclass(frozen=True)
class Look:
    """What a group of obstacles looks like.

    Attributes:
        group: their name below `ROOT`.
        color: of all of them.
        opacity: of all of them.
    """

    group: str
    color: str
    opacity: float


KNOWN = Look("obstacles", GREY, 0.6)
UNKNOWN = Look("ghosts", GHOST, 0.22)


def add_scene(
    meshcat: Meshcat,
    *,
    scenario: Scenario,
    plan: Plan,
    color_by: ColorBy = "bandwidth",
) -> None:
    """Draws everything that does not move, and the vehicle at the start."""
    meshcat.Delete(ROOT)
    scale = Scale.of(plan)
    meshcat.SetTransform(ROOT, np.diag([*[1 / scale.field] * 3, 1.0]))
    low, high = field_corners(scenario, plan)
    add_field(meshcat, scenario=scenario, low=low, high=high, scale=scale)
    fences = shown_fences(scenario, plan)
    add_fences(meshcat, fences=fences, low=low, high=high)
    add_obstacles(meshcat, scenario=scenario, low=low, high=high)
    add_tube(meshcat, plan=plan, color_by=color_by, scale=scale)
    add_vehicle(
        meshcat,
        num_outputs=plan.num_outputs,
        radius=vehicle_radius(scenario, plan),
        flat=FLAT * scale.tube,
    )
    E = embedding(plan.num_outputs)
    start = RigidTransform(E @ plan.reference(plan.start_time)[0])
    meshcat.SetTransform(f"{ROOT}/vehicle", start)
    set_camera(meshcat, low=low / scale.field, high=high / scale.field)


def field_corners(scenario: Scenario, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Two corners of the picture's field, ``(3,)`` each.

    It holds the tube, and the obstacles and fences near it, with some air around.  Its
    floor is the ground, z = 0, unless something flies below; its ceiling is just above
    the highest reference, so that cylinders without an end do not hide what
    flies between them.  A vehicle in the plane gets a little of both.
    """
    E, scale = embedding(plan.num_outputs), Scale.of(plan)
    low, high = (E @ corner for corner in tube_box(plan))
    reach = max(2.0 * scale.field, 0.1 * float((high - low).max()))
    bounds = [(low, high)]
    for solid in obstacle_solids(scenario.obstacle_set(), plan.num_outputs, low, high):
        lowest, highest = solid.bounds()
        near = (lowest < high + reach) & (highest > low - reach)
        if near.all():
            bounds.append((lowest, highest))
    low = np.min([np.maximum(b[0], low - reach) for b in bounds], axis=0)
    high = np.max([np.minimum(b[1], high + reach) for b in bounds], axis=0)
    low, high = _with_fences(low, high, shown_fences(scenario, plan))
    air = scale.field * np.array([0.5, 0.5, 0.0])
    low, high = low - air, high + air
    highest = (plan.reference(_ring_times(plan))[:, 0] @ E.T)[:, 2].max()
    low[2], high[2] = min(low[2], 0.0), highest + 0.05 * scale.field
    if plan.num_outputs < 3:
        low[2], high[2] = -3 * FLAT * scale.tube, 3 * FLAT * scale.field
    return low, high


def shown_fences(scenario: Scenario, plan: Plan) -> FloatArray:
    """Bounds of the position near a plan, ``(3, 2)``; infinite where there are none."""
    m, units = plan.num_outputs, scenario.model.output_units
    bounds = position_bounds(scenario.limits.position, m)
    near = near_bounds(bounds, *tube_box(plan), units)
    axis, output = np.nonzero(embedding(m))
    fences = np.tile([-np.inf, np.inf], (3, 1))
    fences[axis] = near[output]
    return fences


def _with_fences(
    low: FloatArray, high: FloatArray, fences: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A box that reaches to all fences around it."""
    least, largest = fences.T
    low = np.where(np.isfinite(least), np.minimum(low, least), low)
    high = np.where(np.isfinite(largest), np.maximum(high, largest), high)
    return low, high


def add_fences(
    meshcat: Meshcat, *, fences: FloatArray, low: FloatArray, high: FloatArray
) -> None:
    """Floor, ceiling and walls as thin sheets with a frame, across the field.

    One looks through the ceiling, so it is the faintest.

    Args:
        meshcat: to draw into.
        fences: as from `shown_fences`, ``(3, 2)``.
        low: one corner of the field, ``(3,)``, as from `field_corners`.
        high: the opposite corner.
    """
    inside = np.where(np.isfinite(fences.T), fences.T, [low, high])
    for axis, side in np.argwhere(np.isfinite(fences)):
        corners = inside.copy()
        corners[:, axis] = fences[axis, side]
        size = corners[1] - corners[0]
        size[axis] = 1e-4 * float(size.max())
        path = f"{ROOT}/fences/{'xyz'[axis]}{'min' if side == 0 else 'max'}"
        opacity = 0.05 if (axis, side) == (2, 1) else 0.14
        meshcat.SetObject(f"{path}/sheet", Box(*size), rgba(FENCE, opacity))
        meshcat.SetTransform(f"{path}/sheet", RigidTransform(corners.mean(axis=0)))
        meshcat.SetProperty(f"{path}/sheet/<object>", "material.depthWrite", False)
        a, b = (i for i in range(3) if i != axis)
        frame = np.tile(corners[0], (5, 1))
        frame[[1, 2], a], frame[[2, 3], b] = corners[1, a], corners[1, b]
        meshcat.SetLine(f"{path}/frame", frame.T, 1.5, rgba(FENCE))


def add_field(
    meshcat: Meshcat,
    *,
    scenario: Scenario,
    low: FloatArray,
    high: FloatArray,
    scale: Scale,
) -> None:
    """A light ground with a grid, start and goal, on a light background.

    Args:
        meshcat: to draw into.
        scenario: gives start and goal.
        low: one corner of the field, ``(3,)``, as from `field_corners`.
        high: the opposite corner.
        scale: of the picture.
    """
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
    one = scale.field
    low, high = one * np.floor(low / one), one * np.ceil(high / one)
    size, middle = high - low, (low + high) / 2
    meshcat.SetObject(
        f"{ROOT}/field/ground", Box(size[0], size[1], 0.02 * one), Rgba(1.0, 1.0, 0.99)
    )
    where = [middle[0], middle[1], low[2] - 0.03 * one]
    meshcat.SetTransform(f"{ROOT}/field/ground", RigidTransform(where))
    lines = grid_spacing(size, scale)
    x, y = (np.arange(low[i], high[i] + 0.5 * one, lines) for i in (0, 1))
    z = low[2] - 0.015 * one
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
    for name, state, color in (
        ("start", scenario.start_state(), GREEN),
        ("goal", scenario.goal_state(), PALE_GREEN if scenario.goal_is_soft else GREEN),
    ):
        place = E @ state[0]
        place[2] = z
        disc = Cylinder(0.3 * one, 0.01 * one)
        meshcat.SetObject(f"{ROOT}/field/{name}", disc, rgba(color))
        meshcat.SetTransform(f"{ROOT}/field/{name}", RigidTransform(place))
    if scenario.goal_is_soft:  # its disc may be hidden by the tube's end
        height = (E @ scenario.goal_state()[0])[2] + POLE * one - z
        pole = f"{ROOT}/field/goal/pole"
        meshcat.SetObject(pole, Cylinder(0.04 * one, height), rgba(PALE_GREEN))
        meshcat.SetTransform(pole, RigidTransform([0.0, 0.0, height / 2]))


def grid_spacing(size: FloatArray, scale: Scale) -> float:
    """Of the lines on the ground: about thirty along the field."""
    rough = float(size.max()) / 40.0
    return max(scale.field, float(10 ** np.ceil(np.log10(max(rough, 1e-9)))))


def add_obstacles(
    meshcat: Meshcat,
    *,
    scenario: Scenario,
    low: FloatArray,
    high: FloatArray,
    look: Look = KNOWN,
    chosen: Container[int] | None = None,
) -> None:
    """The scenario's obstacles; those without an end fill the field.

    Args:
        meshcat: to draw into.
        scenario: gives the obstacles.
        low: one corner of the field, ``(3,)``, as from `field_corners`.
        high: the opposite corner.
        look: of all of them.
        chosen: the indices of those to draw; all of them if left out.
    """
    solids = obstacle_solids(
        scenario.obstacle_set(), scenario.model.num_outputs, low, high
    )
    primitives = {1: Box(2.0, 2.0, 2.0), 2: Cylinder(1.0, 2.0), 3: Sphere(1.0)}
    for i, solid in enumerate(solids):
        if chosen is not None and i not in chosen:
            continue
        path = f"{ROOT}/{look.group}/{i}"
        color = rgba(look.color, look.opacity)
        if isinstance(solid, Mesh):
            meshcat.SetTriangleMesh(path, solid.vertices.T, solid.faces.T, color)
            continue
        meshcat.SetObject(path, primitives[solid.rank], color)
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
    scale: Scale | None = None,
) -> None:
    """The reference as a line and the tube around it as a coloured surface.

    The tube is the box ``|ỹ_i| <= Ω_i`` swept along the reference.  Across the
    travel it is drawn as the rectangle that just holds the box, one side
    horizontal: exactly the box's silhouette on level flight, and never smaller.
    The half above the reference is faint, so that one looks into the tube.  One that
    is too thin to be seen from afar is also drawn wider, below `AFAR`.

    Args:
        meshcat: to draw into.
        plan: to draw.
        color_by: what the colours mean.
        name: of the group.
        opacity: of the lower half.
        among: plans that share their colours.
        capped: whether the tube's ends are closed.
        scale: of the picture; as the plan alone would have it if left out.
    """
    scale = Scale.of(plan) if scale is None else scale
    coloring = Coloring.along(plan, _ring_times(plan), color_by, among)
    nearby, *afar = tube_paths(name, scale)
    _add_tube(meshcat, nearby, plan, coloring, opacity, capped, scale)
    for path in afar:
        _add_tube(meshcat, path, plan, coloring, opacity, capped, scale.from_afar)


def tube_paths(name: str, scale: Scale) -> list[str]:
    """Where a tube of this name is drawn: as it is and, if it is thin, for afar."""
    return [f"{ROOT}/{name}", *([f"{AFAR}/{name}"] if scale.tube_is_thin else [])]


def _add_tube(
    meshcat: Meshcat,
    path: str,
    plan: Plan,
    coloring: Coloring,
    opacity: float,
    capped: bool,
    scale: Scale,
) -> None:
    time = _ring_times(plan)
    reference = plan.derivatives(time) @ embedding(plan.num_outputs).T
    half_axes = plan.position_tube(time) @ embedding(plan.num_outputs).T
    half_axes = half_axes + FLAT * scale.tube * missing_axes(plan.num_outputs)
    if path.startswith(AFAR):
        half_axes = np.maximum(half_axes, _WIDE * scale.field)
    position, velocity = reference[:, 0], reference[:, 1]
    rings = tube_rings(position, velocity, half_axes)
    middle = (rings + rings[:, [1, 0, 3, 2]]) / 2
    upper = np.stack([middle[:, 0], rings[:, 0], rings[:, 3], middle[:, 3]], axis=1)
    lower = np.stack([middle[:, 0], rings[:, 1], rings[:, 2], middle[:, 3]], axis=1)
    for half, shell, alpha in (
        ("lower", lower, opacity),
        ("upper", upper, 0.25 * opacity),
    ):
        part = f"{path}/tube/{half}"
        vertices, faces = swept_mesh(shell, closed=False, capped=capped)
        colors = _linear(coloring.rgb(coloring.values)).repeat(shell.shape[1], axis=0)
        meshcat.SetTriangleColorMesh(part, vertices.T, faces.T, colors.T)
        meshcat.SetProperty(part, "opacity", alpha)
        # What is behind a translucent wall must not vanish.
        meshcat.SetProperty(f"{part}/<object>", "material.depthWrite", False)
    add_pipe(meshcat, f"{path}/reference", position, BLACK, 0.011 * scale.tube)


def add_vehicle(
    meshcat: Meshcat,
    *,
    num_outputs: int,
    radius: float,
    flat: float = FLAT,
    name: str = "vehicle",
) -> None:
    """A quadrotor (in three dimensions) or a puck; the model itself is a point.

    Args:
        meshcat: to draw into.
        num_outputs: m.
        radius: half the width of the picture of it.
        flat: half-thickness of the tube that a puck is on.
        name: of the group, which `add_flight` moves.
    """
    path = f"{ROOT}/{name}"
    dark, bright = rgba(BLACK), rgba(VERMILION)
    if num_outputs < 3:
        meshcat.SetObject(f"{path}/body", Cylinder(radius, 0.3 * radius), bright)
        on_the_tube = RigidTransform([0.0, 0.0, flat + 0.15 * radius])
        meshcat.SetTransform(f"{path}/body", on_the_tube)
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
            rgba(VERMILION if front else BLACK, 0.75),
        )
        meshcat.SetTransform(f"{path}/rotor{i}", RigidTransform(hub))


def vehicle_radius(scenario: Scenario, plan: Plan) -> float:
    """So that the picture of the vehicle fits through the narrowest place."""
    position = plan.reference(_ring_times(plan))[:, 0]
    nearest = np.min(scenario.obstacle_set().clearance(position), initial=np.inf)
    unit = Scale.of(plan).tube
    return float(np.clip(0.85 * nearest, 0.1 * unit, 0.25 * unit))


def _ring_times(plan: Plan) -> FloatArray:
    return plan.sample_times(drawn_period(plan, TUBE_PERIOD))


def set_camera(meshcat: Meshcat, *, low: FloatArray, high: FloatArray) -> None:
    """Looks at the whole field, with its long axis across the picture.

    Args:
        meshcat: to set the camera of.
        low: one corner of the field, ``(3,)``, in the unit of the scene.
        high: the opposite corner.
    """
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


def add_pipe(
    meshcat: Meshcat, path: str, points: FloatArray, color: str, radius: float
) -> None:
    """A line with a width that every browser draws."""
    step = np.gradient(points, axis=0)
    frames = travel_frames(step)
    angle = np.arange(5) * 2 * np.pi / 5
    circle = radius * np.stack([0 * angle, np.cos(angle), np.sin(angle)])
    vertices, faces = swept_mesh(points[:, None] + (frames @ circle).swapaxes(1, 2))
    meshcat.SetTriangleMesh(path, vertices.T, faces.T, rgba(color))


def _linear(rgb: FloatArray) -> FloatArray:
    """Linear light of sRGB colours, which the viewer expects of vertex colours."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def rgba(color: str, opacity: float = 1.0) -> Rgba:
    """Drake's colour of a named one."""
    return Rgba(*to_rgb(color), opacity)
