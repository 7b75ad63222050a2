"""The figure of a plan, and of a flight of it, over time, each with its bounds."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Iterable
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from dtmpc_drake.checks import derivative_unit
from dtmpc_drake.limits import ConvexLimit, Limit
from dtmpc_drake.limits import flown as left_in_flight
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.method.tightening import (
    Instant,
    deviation_bound,
    input_bound,
    input_range,
)
from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array, FloatArray
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures.view import PERIOD
from dtmpc_drake.visualization.geometry import near_bounds, position_bounds
from dtmpc_drake.visualization.style import (
    BLACK,
    BLUE,
    GREEN,
    LIGHT_GREY,
    PALE_BLUE,
    PALER_GREEN,
    VERMILION,
    drawn_period,
)

_PLANNED: dict[str, Any] = {"color": BLUE, "lw": 1.5}
_FLOWN: dict[str, Any] = {"color": VERMILION, "lw": 0.8, "zorder": 3}
_LIMIT: dict[str, Any] = {"color": BLACK, "lw": 1.0, "ls": "--"}
_TIGHTENED: dict[str, Any] = {"color": GREEN, "lw": 1.3, "ls": "-."}
_SYMBOLS = {
    "position": "y",
    "velocity": "ẏ",
    "acceleration": "ÿ",
    "jerk": "y⁽³⁾",
    "input": "u",
}


def plot_histories(
    *, scenario: Scenario, plan: Plan, flight: Flight | None = None
) -> Figure:
    """Positions, errors, bandwidth, speed and input over time, each with its bounds.

    One column for every output: position with the tube ±Ω and the bounds that are near,
    tracking error inside ±Ω, sliding variable inside ±Φ, bandwidth α and its limits,
    speed and its limit before and after tightening (limit - W).  Where every input has
    bounds of its own, a row shows where it may be anywhere in the tube.

    Below, norms of inputs: of the planned one, which is the feedforward
    u* = B⁻¹ (y*⁽ⁿ⁾ - F̂(x*)) of the cost; the bound of ‖u‖ anywhere in the tube
    (corollary 2), feedback included, which is below the limit if the plan keeps it; and
    of the flown one.  Then what is left of every other limit.

    Args:
        scenario: gives limits, model and controller.
        plan: a plan, or an infeasible attempt.
        flight: of the plan, if it was flown.

    Returns:
        A figure, to be saved with ``savefig``.
    """
    planned = _Planned.of(scenario, plan)
    n, m = plan.order, plan.num_outputs
    model, limits = scenario.model, scenario.limits
    rows = ["position", "error", "sliding", "bandwidth", "speed", "inputs"]
    if n == 1:
        rows.remove("sliding")  # s is the error itself
    if limits.inputs is None:
        rows.remove("inputs")
    alike = {name for name, units in _units(model).items() if len(set(units)) == 1}
    alike -= {"position", "speed"} if isinstance(limits.speed, list) else {"position"}
    others = _others(scenario)
    figure, panels, bottoms = _panels(rows, alike, m, 1 + len(others))
    bottom = bottoms[0]
    near = near_bounds(
        position_bounds(limits.position, m), *planned.box, model.output_units
    )
    for i in range(m):
        column = {name: panels[name, i] for name in rows}
        title = f"along {model.output_names[i]}" if m > 1 else ""
        column["position"].set_title(title, fontsize=10)
        _draw_planned_position(planned, near[i], column["position"], i)
        _draw_planned(scenario, planned, column, i)
        if flight is not None:
            error = flight.state - plan.reference(flight.time)[:, :n]
            s = sliding_variable(error, scenario.slope(), plan.chains)[:, i]
            _draw_flown(flight, error, s, column, i, plan.chains.orders[i])
        column["speed"].set_ylim(bottom=0.0)
    _draw_planned_input(scenario, planned, bottom)
    if flight is not None:
        norm = np.linalg.norm(flight.control, axis=1)
        bottom.plot(flight.time, norm, **_FLOWN)
    _label({name: [panels[name, i] for i in range(m)] for name in rows}, model)
    bottom.set_ylabel(f"input norm ‖u‖\n({model.input_unit})")
    for (limit, title), axes in zip(others, bottoms[1:], strict=True):
        _draw_what_is_left(scenario, planned, limit, axes, flight)
        axes.set_title(title, fontsize=9, loc="left")
    bottoms[-1].set_xlabel("time (s)")
    bottom.set_xlim(planned.time[0], planned.time[-1])
    for axes in figure.axes:
        axes.grid(True, color=LIGHT_GREY, lw=0.5)
        axes.set_axisbelow(True)
    figure.align_ylabels()
    handles: list[Artist] = [
        Patch(fc=PALE_BLUE, ec=BLACK, label="tube ±Ω" + (", ±Φ" if n > 1 else "")),
        Line2D([], [], label="planned", **_PLANNED),
        Line2D([], [], label="limit", **_LIMIT),
        Line2D([], [], label="tightened limit; worst in the tube", **_TIGHTENED),
    ]
    if flight is not None:
        handles.insert(2, Line2D([], [], label="flown", **_FLOWN))
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles) if m > 2 else 3,
        frameon=False,
    )
    return figure


def _units(model: Model) -> dict[str, tuple[str, ...]]:
    """Of the rows, one for each output."""
    units, orders = model.output_units, Chains.of(model).orders

    def of(derivatives: Iterable[int]) -> tuple[str, ...]:
        return tuple(map(derivative_unit, units, derivatives))

    return {
        "position": units,
        "error": units,
        "sliding": of(n - 1 for n in orders),
        "bandwidth": ("rad/s",) * len(units),
        "speed": of(1 for _ in units),
        "inputs": model.input_units,
    }


def _label(rows: dict[str, list[Axes]], model: Model) -> None:
    """Writes beside the rows what they are and, if it is one, their unit.

    Else the unit stands above each panel.
    """
    words = {
        "position": "position y",
        "error": "tracking\nerror ỹ" + (" = s" if model.order == 1 else ""),
        "sliding": "sliding\nvariable s",
        "bandwidth": "bandwidth α",
        "speed": "speed |ẏ|",
        "inputs": "each input u",
    }
    units = _units(model)
    for name, panels in rows.items():
        mixed = len(set(units[name])) > 1
        space = " " if "\n" in words[name] else "\n"
        unit = "" if mixed else f"{space}({units[name][0]})"
        panels[0].set_ylabel(words[name] + unit)
        for i, panel in enumerate(panels):
            above = [model.input_names[i]] if name == "inputs" else []
            above += [f"({units[name][i]})"] if mixed else []
            panel.set_title(" ".join(above), fontsize=9, loc="left")


def _others(scenario: Scenario) -> list[tuple[Limit, str]]:
    """Limits that have a panel of their own, and its title."""
    law, others = scenario.sliding_law(), list[tuple[Limit, str]]()
    for i, norm in enumerate(scenario.limits.norms):
        limit = norm.limit()
        what = ("" if norm.matrix is None else "P ") + _SYMBOLS[norm.of]
        what += "" if norm.offset is None else " + q"
        text = f"‖{what}‖ ≤ {norm.bound:g} {limit.unit(law)}"
        others.append((limit, f"what is left of limits.norms[{i}], {text}"))
    for i, own in enumerate(scenario.limits.own):
        others.append((own, f"what is left of limits.own[{i}], the {own.title}"))
    return others


@dataclasses.dataclass(frozen=True, eq=False)
class _Planned:
    """What a plan says at K times, and what follows from it.

    Attributes:
        time: ``(K,)``, in s.
        position: y*, ``(K, m)``.
        velocity: dy*/dt, ``(K, m)``.
        bandwidth: α, ``(K, m)``.
        error_bound: R_k, ``(K, n, m)``.
        boundary_layer: Φ, ``(K, m)``.
        rate_bound: of |dỹ/dt|, ``(K, m)``.
        feedforward: u*, ``(K, m)``.
        input_bound: of ‖u‖ anywhere in the tube, ``(K,)``.
        input_range: where u may be anywhere in the tube, a middle and how far from it,
            ``(K, m)`` each.
        at: what is known of each time.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    bandwidth: FloatArray
    error_bound: FloatArray
    boundary_layer: FloatArray
    rate_bound: FloatArray
    feedforward: FloatArray
    input_bound: FloatArray
    input_range: tuple[FloatArray, FloatArray]
    at: Instant

    @classmethod
    def of(cls, scenario: Scenario, plan: Plan) -> _Planned:
        """The plan, as often as it is drawn."""
        law = scenario.sliding_law()
        time = plan.sample_times(drawn_period(plan, PERIOD))
        reference, error_bound = plan.reference(time), plan.error_bound(time)
        state, highest = reference[:, :-1], reference[:, -1]
        layer, layer_rate = plan.layer(time)
        at = Instant(state, highest, law.gain(state, layer_rate), error_bound)
        return cls(
            time=time,
            position=reference[:, 0],
            velocity=plan.derivatives(time)[:, 1],
            bandwidth=plan.bandwidth(time),
            error_bound=error_bound,
            boundary_layer=layer,
            rate_bound=deviation_bound(law, at, 1),
            feedforward=law.model.input_for(state, highest - law.model.drift(state)),
            input_bound=input_bound(law, at),
            input_range=input_range(law, at),
            at=at,
        )

    @property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Two corners of a box that holds the tube, ``(m,)`` each."""
        center, half = self.position, self.error_bound[:, 0]
        return (center - half).min(axis=0), (center + half).max(axis=0)


def _panels(
    rows: list[str], alike: Container[str], columns: int, below: int
) -> tuple[Figure, dict[tuple[str, int], Axes], list[Axes]]:
    """A figure with panels by row and column, and some as wide below them.

    Args:
        rows: their names, from above.
        alike: those that have one scale for all columns.
        columns: their number.
        below: the number of wide panels.
    """
    count = len(rows) + below
    figure = Figure(
        figsize=(max(6.0, 1.5 + 2.9 * columns), 1.75 * count + 0.5),
        dpi=150,
        layout="constrained",
    )
    grid = figure.add_gridspec(count, columns)
    bottom = figure.add_subplot(grid[len(rows), :])
    bottoms = [bottom]
    for row in range(len(rows) + 1, count):
        bottoms.append(figure.add_subplot(grid[row, :], sharex=bottom))
    for axes in bottoms[:-1]:
        axes.tick_params(labelbottom=False)
    panels: dict[tuple[str, int], Axes] = {}
    for row, name in enumerate(rows):
        for i in range(columns):
            first = panels.get((name, 0)) if name in alike else None
            panel = figure.add_subplot(grid[row, i], sharex=bottom, sharey=first)
            panel.tick_params(labelbottom=False, labelleft=first is None)
            panels[name, i] = panel
    return figure, panels, bottoms


def _draw_planned_position(
    planned: _Planned, near: FloatArray, panel: Axes, i: int
) -> None:
    """Draws the position of one output.

    Args:
        planned: the plan.
        near: the least and the largest position, ``(2,)``; infinite for none.
        panel: to draw into.
        i: the output.
    """
    time, half = planned.time, planned.error_bound[:, 0, i]
    center = planned.position[:, i]
    _band(panel, time, half, center)
    for bound, inwards in zip(near, (1.0, -1.0), strict=True):
        if np.isfinite(bound):
            panel.axhline(bound, **_LIMIT)
            panel.plot(time, bound + inwards * half, **_TIGHTENED)
    panel.plot(time, center, **_PLANNED)


def _draw_planned(
    scenario: Scenario, planned: _Planned, panels: dict[str, Axes], i: int
) -> None:
    """Draws one output into the panels of its column."""
    time = planned.time
    _band(panels["error"], time, planned.error_bound[:, 0, i])
    if "sliding" in panels:
        _band(panels["sliding"], time, planned.boundary_layer[:, i])
    panel, allowed = panels["bandwidth"], scenario.controller.bandwidth
    if allowed.fixed is None:
        panel.axhline(allowed.min, **_LIMIT)
        panel.axhline(allowed.max, **_LIMIT)
    panel.plot(time, planned.bandwidth[:, i], **_PLANNED)
    panel.set_ylim(0.0, 1.12 * allowed.max)
    panel, limit = panels["speed"], scenario.limits.speed_along(i)
    panel.axhline(limit, **_LIMIT)
    panel.plot(time, limit - planned.rate_bound[:, i], **_TIGHTENED)
    panel.plot(time, np.abs(planned.velocity[:, i]), **_PLANNED)
    if scenario.limits.inputs is not None:
        panel = panels["inputs"]
        for bound in scenario.limits.inputs.both()[i]:
            if np.isfinite(bound):
                panel.axhline(bound, **_LIMIT)
        middle, spread = (each[:, i] for each in planned.input_range)
        panel.fill_between(
            time, middle - spread, middle + spread, fc=PALER_GREEN, ec="none", zorder=1
        )
        for edge in (middle - spread, middle + spread):
            panel.plot(time, edge, **_TIGHTENED)
        panel.plot(time, planned.feedforward[:, i], **_PLANNED)


def _draw_planned_input(scenario: Scenario, planned: _Planned, panel: Axes) -> None:
    limit = scenario.limits.input
    panel.axhline(limit, **_LIMIT)
    panel.plot(planned.time, planned.input_bound, **_TIGHTENED)
    norm = np.linalg.norm(planned.feedforward, axis=1)
    panel.plot(planned.time, norm, **_PLANNED)
    panel.set_ylim(0.0, 1.08 * max(limit, float(planned.input_bound.max())))


def _draw_what_is_left(
    scenario: Scenario,
    planned: _Planned,
    limit: Limit,
    axes: Axes,
    flight: Flight | None,
) -> None:
    """Draws what is left of a limit: anywhere in the tube, planned and flown."""
    law, at = scenario.sliding_law(), planned.at
    axes.axhline(0.0, **_LIMIT)
    lines = [(planned.time, limit.margins(law, at), _TIGHTENED)]
    if isinstance(limit, ConvexLimit):  # also of what is no state
        value = law.chains.derivative_of(at.state, at.highest, limit.derivative)
        lines.append((planned.time, limit.left(value, np.zeros_like(value)), _PLANNED))
    elif (left := limit.flown(at.state, planned.feedforward)) is not None:
        lines.append((planned.time, left, _PLANNED))
    if flight is not None:
        left = left_in_flight(limit, law.chains, flight.state, flight.control)
        if left is not None:
            lines.append((flight.time, left, _FLOWN))
    for time, margins, style in lines:
        axes.plot(time, margins.min(axis=-1), **style)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -0.08 * high), high)  # the line of zero inside
    axes.set_ylabel(f"left\n({limit.unit(law)})")


def _draw_flown(
    flight: Flight, error: Array, s: Array, panels: dict[str, Axes], i: int, order: int
) -> None:
    """Draws one output of a flight into the panels of its column.

    Args:
        flight: to draw.
        error: x̃, ``(K, n, m)``.
        s: the sliding variable of the output, ``(K,)``.
        panels: by name.
        i: the output.
        order: of the output.
    """
    panels["position"].plot(flight.time, flight.position[:, i], **_FLOWN)
    panels["error"].plot(flight.time, error[:, 0, i], **_FLOWN)
    if "sliding" in panels:
        panels["sliding"].plot(flight.time, s, **_FLOWN)
    if order > 1:  # else the velocity is no state
        panels["speed"].plot(flight.time, np.abs(flight.state[:, 1, i]), **_FLOWN)
    if "inputs" in panels:
        panels["inputs"].plot(flight.time, flight.control[:, i], **_FLOWN)


def _band(
    axes: Axes, time: FloatArray, half: FloatArray, center: FloatArray | float = 0.0
) -> None:
    axes.fill_between(
        time, center - half, center + half, fc=PALE_BLUE, ec="none", zorder=1
    )
    for edge in (center - half, center + half):
        axes.plot(time, edge, color=BLACK, lw=0.9, zorder=2)
