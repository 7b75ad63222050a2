"""The certificate: what a plan keeps, for all times, checked after the solve.

Nothing here knows how a plan was found.  The tube is propagated again from the
plan's own polynomials, twice as finely; then every margin is bounded from below
on every short interval, not only at its ends.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.models import Array, ConstantUncertainty
from dtmpc_drake.plan import Plan
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.sliding import bandwidth as implied_bandwidth
from dtmpc_drake.sliding import switching_gain
from dtmpc_drake.tightening import input_bound, rate_bound
from dtmpc_drake.tube import Tube, propagate_error_bounds

REFINEMENT = 2
"""Intervals of the certificate in each step of the plan's own tube."""
FIXED_TOLERANCE = 5e-3
"""Allowed deviation from a fixed bandwidth, relative."""
END_TOLERANCE = 1e-6
"""Allowed distance from the start and goal states, in their units."""
TUBE_TOLERANCE = 1e-4
"""How far the tube that a plan carries may lie below the one propagated here, on
which all margins rest; they differ where the model has kinks.  In m and m/s."""


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

    Args:
        plan: whose polynomials are checked.
        problem: gives model, limits and obstacles.

    Returns:
        The certificate.
    """
    n = problem.model.order
    half = _refined(plan.tube_times, 2 * REFINEMENT)
    flow = flow_along(plan, problem, half, problem.initial_error)
    tube, bandwidth, nodes = flow.tube, flow.bandwidth, slice(None, None, 2)
    time, reference, gain = half[nodes], flow.reference[nodes], flow.gain[nodes]
    margins: dict[str, Margin] = {}
    if len(problem.obstacles):
        margins["obstacles"] = _obstacle_margin(
            plan, problem, time, reference[:, 0], tube
        )

    speed = problem.speed_limit - np.abs(reference[:, 1])
    speed = speed - rate_bound(
        model=problem.model,
        reference=reference[:, :n],
        error_bound=tube.error_bound,
        gain=gain,
        disturbance_bound=problem.disturbance_bound,
    )
    margins["speed"] = _smallest(time, _between(speed), "m/s", "axis")
    used = input_bound(
        model=problem.model,
        reference=reference[:, :n],
        highest=reference[:, n],
        error_bound=tube.error_bound,
        gain=gain,
        slope=problem.slope,
    )
    room = (problem.input_limit - used)[:, None]
    margins["input"] = _smallest(time, _between(room), f"m/s^{n}", "")
    margins |= _bandwidth_margins(problem, half, bandwidth)
    layer = tube.boundary_layer
    margins["boundary_layer"] = _smallest(time, _between(layer), "m/s", "axis")
    own = plan.error_bound(time) - tube.error_bound + TUBE_TOLERANCE
    margins["tube"] = _smallest(time, own.reshape(len(time), -1), "", "bound")
    ends = np.stack(
        [
            np.abs(reference[0, :n] - problem.start).max(keepdims=True)[0],
            # What is not a number is free.
            np.nan_to_num(np.abs(reference[-1, :n] - problem.goal)).max(keepdims=True)[
                0
            ],
        ]
    )
    margins["ends"] = _smallest(time[[0, -1]], END_TOLERANCE - ends, "", "axis")
    if isinstance(problem.model, ConstantUncertainty):
        true = problem.model.model.model_error_bound_over(
            reference[:, :n], tube.error_bound
        )
        room = problem.model.bound - true
        margins["model_error"] = _smallest(time, _between(room), "m/s²", "axis")
    return Certificate(margins, problem.model.bounds_certified)


@dataclasses.dataclass(frozen=True)
class Flow:
    """What a plan's polynomials imply on a half grid of K = 2 M + 1 times.

    Attributes:
        reference: y* and its derivatives, ``(K, n + 1, m)``.
        gain: κ, ``(K, m)``.
        bandwidth: α = κ / Φ, ``(K, m)``.
        tube: at the M + 1 nodes.
    """

    reference: Array
    gain: Array
    bandwidth: Array
    tube: Tube

    __hash__: ClassVar[None]  # type: ignore[assignment]


def flow_along(plan: Plan, problem: Problem, time: Array, error: Array) -> Flow:
    """The tube along a plan, or along a part of it, propagated again.

    Args:
        plan: whose polynomials are used.
        problem: gives the model and the controller.
        time: a half grid, ``(2 M + 1,)``, uniform, in s.
        error: x̃ at the first of these times, or bounds of its size, ``(n, m)``.
    """
    reference = plan.reference(time)
    state = reference[:, : problem.model.order]
    layer, layer_rate = plan.layer(time)
    gain = switching_gain(
        model_error_bound=problem.model.model_error_bound(state),
        disturbance_bound=problem.disturbance_bound,
        reaching_rate=problem.reaching_rate,
        boundary_layer_rate=layer_rate,
    )
    bandwidth = implied_bandwidth(gain=gain, boundary_layer=layer)
    tube = propagate_error_bounds(
        model=problem.model,
        reference=state,
        bandwidth=bandwidth,
        boundary_layer=layer[::2],
        boundary_layer_rate=layer_rate[::2],
        slope=problem.slope,
        disturbance_bound=problem.disturbance_bound,
        initial_error=error,
        velocity_bound=problem.velocity_bound,
        step=float(time[2] - time[0]),
    )
    return Flow(reference, gain, bandwidth, tube)


def clearance_ahead(plan: Plan, problem: Problem, start: float, error: Array) -> Margin:
    """The smallest distance of a plan's tube from obstacles, from a time on.

    Args:
        plan: to look along, from `start` to its end.
        problem: gives the obstacles; at least one.
        start: in s.
        error: x̃ at that time, or bounds of its size, ``(n, m)``.
    """
    finest = float(np.diff(plan.tube_times).min()) / REFINEMENT
    steps = max(2, int(np.ceil((plan.end_time - start) / finest)))
    half = np.linspace(start, plan.end_time, 2 * steps + 1)
    flow = flow_along(plan, problem, half, error)
    return _obstacle_margin(plan, problem, half[::2], flow.reference[::2, 0], flow.tube)


def _bandwidth_margins(
    problem: Problem, time: Array, bandwidth: Array
) -> dict[str, Margin]:
    """Margins of α, which is linear between any two of these times."""
    unit = "rad/s"
    if problem.bandwidth_is_fixed:
        room = FIXED_TOLERANCE * problem.bandwidth_max
        room = room - np.abs(bandwidth - problem.bandwidth_max)
        return {"bandwidth_fixed": _smallest(time, room, unit, "axis")}
    low, high = bandwidth - problem.bandwidth_min, problem.bandwidth_max - bandwidth
    rate = np.diff(bandwidth[::2], axis=0) / np.diff(time[::2])[:, None]
    slack = problem.bandwidth_rate_max - np.abs(rate)
    return {
        "bandwidth_min": _smallest(time, low, unit, "axis"),
        "bandwidth_max": _smallest(time, high, unit, "axis"),
        "bandwidth_rate": _smallest(time[::2], slack, "rad/s²", "axis"),
    }


def _refined(grid: Array, factor: int) -> Array:
    """The same grid with `factor` times as many intervals."""
    count = (len(grid) - 1) * factor
    return np.interp(np.arange(count + 1) / factor, np.arange(len(grid)), grid)


def _between(values: Array) -> Array:
    """Lower bounds between samples, ``(K, ...)`` to ``(K - 1, ...)``.

    A smooth function sags below a chord by an eighth of its second difference;
    half of the largest one near by is taken off, which covers kinks too.  Only
    valleys have a positive one.
    """
    ends = np.minimum(values[:-1], values[1:])
    second = np.maximum(np.diff(values, 2, axis=0), 0.0)
    second = np.concatenate([second[:1], second, second[-1:]])
    return np.asarray(ends - np.maximum(second[:-1], second[1:]) / 2)


def _smallest(time: Array, values: Array, unit: str, where: str) -> Margin:
    """The smallest of ``(K, q)`` values, and the name of its column."""
    row, column = np.unravel_index(int(np.argmin(values)), values.shape)
    name = f"{where} {column}" if where else ""
    return Margin(float(values[row, column]), unit, float(time[row]), name)


def _obstacle_margin(
    plan: Plan, problem: Problem, time: Array, position: Array, tube: Tube
) -> Margin:
    """Clearance of the tube, bounded on every interval by a half-plane.

    Within an interval the reference leaves its chord by at most ``h²/8 max|ÿ|``,
    and so does the tube; ``ν'z - size`` is linear along both chords, hence
    smallest at an end.
    """
    obstacles = problem.obstacles
    offset = obstacles.offsets(position)
    position_tube = tube.error_bound[:, 0]
    middle = (offset[:-1] + offset[1:]) / 2
    if problem.tube_margin == "support":
        # Any normal is valid; that of the nearest point of the tube is the best.
        largest = np.maximum(position_tube[:-1], position_tube[1:])
        nearest = obstacles.nearest_offset(middle, largest)
        inside = np.linalg.norm(nearest, axis=-1, keepdims=True) < 1e-9
        middle = np.where(inside, middle, nearest)
    length = np.maximum(np.linalg.norm(middle, axis=-1, keepdims=True), 1e-9)
    normal = middle / length
    if problem.tube_margin == "support":
        extent = np.abs(np.einsum("oij,koi->koj", obstacles.shape, normal))
        start = (extent * position_tube[:-1, None]).sum(-1)
        end = (extent * position_tube[1:, None]).sum(-1)
    else:
        size = np.linalg.norm(obstacles.tube_radii(position_tube), axis=-1)
        start, end = size[:-1], size[1:]
    bound = np.minimum(
        (normal * offset[:-1]).sum(-1) - start, (normal * offset[1:]).sum(-1) - end
    )

    # How far curve and tube leave their chords, in the metric of each obstacle.
    h = time[1] - time[0]
    piece = np.clip(
        np.searchsorted(plan.knots, time[:-1], side="right") - 1,
        0,
        len(plan.knots) - 2,
    )
    curvature = _largest_acceleration(plan)[piece]
    bend = np.abs(np.diff(tube.error_bound_rate[:, 0], axis=0)) / h
    bend = np.maximum(bend[:-1], bend[1:])
    bend = np.concatenate([bend[:1], bend])
    # Twice the measured bend of the tube: it is smooth within an interval.
    leave = h**2 / 8 * (curvature + 2 * bend)
    sag = np.linalg.norm(obstacles.tube_radii(leave), axis=-1)
    values = bound - obstacles.radius - sag
    margin = _smallest(time, values, "m", "obstacle")
    nearest = obstacles.index[values.min(axis=0).argmin()]
    return dataclasses.replace(margin, where=f"obstacle {nearest}")


def _largest_acceleration(plan: Plan) -> Array:
    """A bound of ``|ÿ*|`` on every piece, ``(N, m)``."""
    powers = plan.coefficients
    factors = [p * (p - 1) for p in range(powers.shape[1])]
    h = np.diff(plan.knots)[:, None]
    terms = [
        f * np.abs(powers[:, p]) * h ** (p - 2) for p, f in enumerate(factors) if f
    ]
    return np.asarray(sum(terms))
