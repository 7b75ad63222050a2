"""The certificate: what a plan keeps, for all times, checked after the solve.

Nothing here knows how a plan was found.  The tube is propagated again from the
plan's own polynomials, and every margin is bounded from below on short intervals
(see `enclosure`), which are cut further where a bound is not good enough.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.models import Array, ConstantUncertainty
from dtmpc_drake.plan import Plan
from dtmpc_drake.planning.enclosure import (
    Corridor,
    Enclosure,
    Polynomial,
    claimed_corridor,
    enclose,
)
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.tightening import input_bound, rate_bound

INTERVALS = (16e-3, 2e-3, 5e-4)
"""Longest interval, in s: the next one is taken if a bound is negative.  The first
is for models whose error bound is constant: nothing is of first order then but F̂."""
FIXED_TOLERANCE = 5e-3
"""Allowed deviation from a fixed bandwidth, relative."""
END_TOLERANCE = 1e-6
"""Allowed distance from the start and goal states, in their units."""
TUBE_TOLERANCE = 1e-4
"""How far the tube that a plan carries may lie below the proven one, on which all
margins rest; in m for the position tube."""
TOP_TOLERANCE = 2e-3
"""The same for the highest derivative that is a state (for n = 2 the velocity tube,
in m/s), whose bound depends on itself and, through Δ̄, on the whole tube."""


@dataclasses.dataclass(frozen=True)
class Margin:
    """The smallest distance from a limit over a whole plan.

    Attributes:
        value: negative where the limit is broken.
        unit: of the value.
        time: when it is smallest, in s.
        where: which obstacle, axis or bound.
    """

    value: float
    unit: str
    time: float
    where: str

    def __str__(self) -> str:
        """For one line of a report."""
        at = f"{self.value:+.4f} {self.unit} at t = {self.time:.2f} s"
        return f"{at} ({self.where})" if self.where else at


@dataclasses.dataclass(frozen=True)
class Certificate:
    """Every margin of a plan.

    Attributes:
        margins: by name.
        bounds_proven: whether the model's bounds over a box are proven; if they
            were sampled, no plan is certified.
    """

    margins: dict[str, Margin]
    bounds_proven: bool

    __hash__: ClassVar[None]  # type: ignore[assignment]

    @property
    def certified(self) -> bool:
        """Whether no margin is negative and the bounds are proven."""
        return self.bounds_proven and self.worst[1].value >= 0

    @property
    def worst(self) -> tuple[str, Margin]:
        """The smallest margin and its name, among limits where all are kept."""
        items = sorted(self.margins.items(), key=lambda item: item[1].value)
        limits = [item for item in items if item[0] not in ("tube", "ends")]
        return items[0] if items[0][1].value < 0 else limits[0]

    def __str__(self) -> str:
        """One line a margin."""
        lines = [f"{name:<16} {margin}" for name, margin in self.margins.items()]
        if not self.bounds_proven:
            lines.append("the model's bounds over a box are sampled, not proven")
        return "\n".join(lines)


def certify(plan: Plan, problem: Problem) -> Certificate:
    """Checks a plan against its problem, for all times.

    Every margin is a lower bound of what is left of a limit; it is exact up to
    second order in the length of the intervals, and up to first order where a
    model is asked for its bounds over a box.

    Args:
        plan: whose polynomials are checked.
        problem: gives model, limits and obstacles.

    Returns:
        The certificate.

    Raises:
        ValueError: if the plan's grids are not uniform, one within the other.
    """
    for longest in INTERVALS[problem.model.error_bound_varies :]:
        enclosure = enclose(
            plan, problem, longest=longest, velocity_slack=TOP_TOLERANCE
        )
        margins = _margins(plan, problem, enclosure)
        certificate = Certificate(margins, problem.model.bounds_certified)
        name, worst = certificate.worst
        # An obstacle's bound is cut on its own.
        if worst.value >= 0 or name in ("obstacles", "ends"):
            break
    return certificate


def _margins(plan: Plan, problem: Problem, enclosure: Enclosure) -> dict[str, Margin]:
    """Every margin by name."""
    n, corridor = problem.model.order, enclosure.corridor
    time, middle = corridor.time[:-1], corridor.reference.derivatives
    radius = enclosure.reference_radius
    margins: dict[str, Margin] = {}
    if len(problem.obstacles):
        margins["obstacles"] = _obstacle_margin(problem, corridor)

    # κ - Δ(x*), which is also K(x) - Δ(x), is a polynomial.
    layer_rate = enclosure.layer.derivatives[:, 1]
    model_error = problem.model.model_error_bound(middle[:, :n])
    switching = problem.disturbance_bound + problem.reaching_rate - layer_rate
    gain, gain_radius = switching + model_error, enclosure.layer.radius(1)

    speed = problem.speed_limit - corridor.reference.largest(1)
    speed = speed - rate_bound(
        model=problem.model,
        reference=middle[:, :n],
        error_bound=enclosure.error_bound,
        gain=gain,
        disturbance_bound=problem.disturbance_bound,
        reference_radius=radius,
        gain_radius=gain_radius,
    )
    margins["speed"] = _smallest(time, speed, "m/s", "axis")
    # The norm of y*^(n), which is linear, is largest at an end.
    rise = corridor.reference.half * middle[:, n + 1]
    used = input_bound(
        model=problem.model,
        reference=middle[:, :n],
        highest=np.stack([middle[:, n] - rise, middle[:, n] + rise]),
        error_bound=enclosure.error_bound,
        gain=gain,
        slope=problem.slope,
        reference_radius=radius,
        gain_radius=gain_radius,
    )
    room = (problem.input_limit - used.max(axis=0))[:, None]
    margins["input"] = _smallest(time, room, f"m/s^{n}", "")
    margins |= _bandwidth_margins(plan, problem, enclosure)
    thinnest = enclosure.layer.derivatives[:, 0] - enclosure.layer.radius(0)
    margins["boundary_layer"] = _smallest(time, thinnest, "m/s", "axis")
    tolerance = np.full((n, 1), TUBE_TOLERANCE)
    tolerance[-1] = TOP_TOLERANCE if n > 1 else TUBE_TOLERANCE
    own = enclosure.claim_excess + tolerance
    margins["tube"] = _smallest(time, own.reshape(len(time), -1), "", "bound")
    ends = plan.reference(np.array([plan.start_time, plan.end_time]))[:, :n]
    wanted = np.stack([problem.start, problem.goal])
    # What is not a number is free.
    missing = np.nan_to_num(np.abs(ends - wanted)).max(axis=1)
    times = np.array([plan.start_time, plan.end_time])
    margins["ends"] = _smallest(times, END_TOLERANCE - missing, "", "axis")
    if isinstance(problem.model, ConstantUncertainty) and problem.model.covers:
        true = problem.model.model.model_error_bound_over(
            middle[:, :n], enclosure.error_bound + radius
        )
        room = problem.model.bound - true
        margins["model_error"] = _smallest(time, room, "m/s²", "axis")
    return margins


def _bandwidth_margins(
    plan: Plan, problem: Problem, enclosure: Enclosure
) -> dict[str, Margin]:
    """Margins of α = (Δ(x*) + D + η - dΦ*/dt)/Φ*, and of the planned α's rate.

    The rate is that of the plan's own piecewise-linear α, which the layer
    realises.
    """
    order, layer = problem.model.order, enclosure.layer
    middle = enclosure.corridor.reference.derivatives[:, :order]
    time, unit = enclosure.corridor.time[:-1], "rad/s"
    constant = problem.disturbance_bound + problem.reaching_rate

    def excess(bandwidth: Array) -> tuple[Array, Array]:
        """Bounds of dΦ/dt + bΦ - D - η, which is Δ(x*) where α = b."""
        rows = layer.derivatives[:, 1:].copy()
        rows[:, 0] -= constant
        scaled = bandwidth * layer.derivatives[:, :-1]
        whole = Polynomial(rows + scaled, layer.half)
        value, radius = whole.derivatives[:, 0], whole.radius(0)
        return value - radius, value + radius

    low, high = problem.bandwidth_min, problem.bandwidth_max
    if problem.bandwidth_is_fixed:
        low, high = low * (1 - FIXED_TOLERANCE), high * (1 + FIXED_TOLERANCE)
    model, radius = problem.model, enclosure.reference_radius
    thick = layer.derivatives[:, 0] + layer.radius(0)
    above = model.model_error_bound_under(middle, radius) - excess(low)[1]
    below = excess(high)[0] - model.model_error_bound_over(middle, radius)
    margins = {
        "bandwidth_min": _smallest(time, above / thick, unit, "axis"),
        "bandwidth_max": _smallest(time, below / thick, unit, "axis"),
    }
    if not problem.bandwidth_is_fixed:
        rate = np.diff(plan.bandwidth_knots, axis=0) / np.diff(plan.knots)[:, None]
        slack = problem.bandwidth_rate_max - np.abs(rate)
        margins["bandwidth_rate"] = _smallest(plan.knots, slack, "rad/s²", "axis")
    return margins


def _smallest(time: Array, values: Array, unit: str, where: str) -> Margin:
    """The smallest of ``(K, q)`` values, and the name of its column."""
    row, column = np.unravel_index(int(np.argmin(values)), values.shape)
    name = f"{where} {column}" if where else ""
    return Margin(float(values[row, column]), unit, float(time[row]), name)


def clearance_ahead(plan: Plan, problem: Problem, start: float) -> Margin:
    """The smallest distance of a certified plan's tube from obstacles, from then on.

    Args:
        plan: whose own tube is taken for granted.
        problem: gives the obstacles, at least one; others than it was planned for.
        start: in s.
    """
    corridor = claimed_corridor(plan, longest=INTERVALS[0], slack=TUBE_TOLERANCE)
    return _obstacle_margin(problem, corridor, start)


def _obstacle_margin(
    problem: Problem, corridor: Corridor, after: float = -np.inf
) -> Margin:
    """Clearance of the tube, for all times: branch and bound.

    An interval is as long as a step of the plan's own tube; those on which the
    bound is negative are halved, down to those of the corridor.
    """
    stride = corridor.parts
    start: Array = np.arange(0, len(corridor.time) - 1, stride)
    start = start[corridor.time[start + stride] > after]
    found: list[Margin] = []
    while len(start):
        values = _clearance_bounds(problem, corridor, start, stride)
        open_ = (values < 0).any(axis=1) & (stride > 1)
        if not open_.all():
            time = corridor.time[start[~open_]]
            margin = _smallest(time, values[~open_], "m", "")
            nearest = problem.obstacles.index[values[~open_].min(axis=0).argmin()]
            found.append(dataclasses.replace(margin, where=f"obstacle {nearest}"))
        stride //= 2
        start = (start[open_, None] + [0, stride]).ravel()
    return min(found, key=lambda margin: margin.value)


def _clearance_bounds(
    problem: Problem, corridor: Corridor, start: Array, stride: int
) -> Array:
    """Lower bounds of the clearance on some intervals, by half-planes.

    Within an interval the reference leaves its chord by at most ``h²/8 max|ÿ*|``,
    and Ω by ``h²/8 max|d²Ω/dt²|``; ``ν'z - size`` is linear along both chords, hence
    smallest at an end.

    Args:
        problem: gives the obstacles.
        corridor: of the plan.
        start: indices into its times, ``(q,)``.
        stride: how many of its intervals make one of these.

    Returns:
        Shape ``(q, num_obstacles)``.
    """
    obstacles = problem.obstacles
    ends = np.stack([start, start + stride])
    offset = obstacles.offsets(corridor.reference.at_ends()[ends])
    tube = corridor.position_tube[ends]
    normal = offset.mean(axis=0)
    if problem.tube_margin == "support":
        # Any normal is valid; that of the nearest point of the tube is the best.
        nearest = obstacles.nearest_offset(normal, tube.max(axis=0))
        inside = np.linalg.norm(nearest, axis=-1, keepdims=True) < 1e-9
        normal = np.where(inside, normal, nearest)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    if problem.tube_margin == "support":
        extent = np.abs(np.einsum("oij,koi->koj", obstacles.shape, normal))
        size = np.einsum("koj,ekj->eko", extent, tube)
    else:
        size = np.linalg.norm(obstacles.tube_radii(tube), axis=-1)
    bound = ((normal * offset).sum(axis=-1) - size).min(axis=0)

    inner = start[:, None] + np.arange(stride)
    bend = corridor.reference.largest(2) + corridor.position_bend
    leave = (stride * corridor.step) ** 2 / 8 * bend[inner].max(axis=1)
    sag = np.linalg.norm(obstacles.tube_radii(leave), axis=-1)
    return np.asarray(bound - obstacles.radius - sag)
