"""The figure of a plan, and of a flight of it, over time, each with its bounds."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from dtmpc_drake.limits import flown
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.method.tightening import Instant, deviation_bound, input_bound
from dtmpc_drake.numerics.arrays import Array, FloatArray
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.figures.view import PERIOD
from dtmpc_drake.visualization.style import (
    BLACK,
    BLUE,
    GREEN,
    LIGHT_GREY,
    PALE_BLUE,
    VERMILION,
    axis_name,
    drawn_period,
    unit_of,
)

_PLANNED: dict[str, Any] = {"color": BLUE, "lw": 1.5}
_FLOWN: dict[str, Any] = {"color": VERMILION, "lw": 0.8, "zorder": 3}
_LIMIT: dict[str, Any] = {"color": BLACK, "lw": 1.0, "ls": "--"}
_TIGHTENED: dict[str, Any] = {"color": GREEN, "lw": 1.3, "ls": "-."}


def plot_histories(
    *, scenario: Scenario, plan: Plan, flight: Flight | None = None
) -> Figure:
    """Errors, bandwidth, speed and input over time, each with its bounds.

    One column for every output: tracking error inside ±Ω, sliding variable
    inside ±Φ, bandwidth α and its limits, speed and its limit before and after
    tightening (limit - W).  Below, norms of inputs: of the planned one, which is the
    feedforward u* = B⁻¹ (y*⁽ⁿ⁾ - F̂(x*)) of the cost; the bound of ‖u‖ anywhere in
    the tube (corollary 2), feedback included, which is below the limit if the plan
    keeps it; and of the flown one.

    Args:
        scenario: gives limits, model and controller.
        plan: a plan, or an infeasible attempt.
        flight: of the plan, if it was flown.

    Returns:
        A figure, to be saved with ``savefig``.
    """
    planned = _Planned.of(scenario, plan)
    n, m = plan.order, plan.num_outputs
    rows = ["error", "sliding", "bandwidth", "speed"]
    if n == 1:
        rows.remove("sliding")  # s is the error itself
    others = scenario.limits.others
    figure, panels, bottoms = _panels(rows, m, 1 + len(others))
    bottom = bottoms[0]
    for i in range(m):
        column = {name: panels[name, i] for name in rows}
        title = f"along {axis_name(i, m)}" if m > 1 else ""
        column["error"].set_title(title, fontsize=10)
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
    labels = {
        "error": "tracking\nerror ỹ (m)",
        "sliding": f"sliding\nvariable s ({unit_of(n - 1)})",
        "bandwidth": "bandwidth α\n(rad/s)",
        "speed": f"speed |ẏ|\n({unit_of(1)})",
    }
    if n == 1:
        labels["error"] = "tracking\nerror ỹ = s (m)"
    for name in rows:
        panels[name, 0].set_ylabel(labels[name])
    bottom.set_ylabel(f"input norm ‖u‖\n({unit_of(n)})")
    for limit, left, axes in zip(others, planned.others, bottoms[1:], strict=True):
        axes.axhline(0.0, **_LIMIT)
        axes.plot(planned.time, left, **_TIGHTENED)
        seen = None
        if flight is not None:
            seen = flown(limit, plan.chains, flight.state, flight.control)
        if flight is not None and seen is not None:
            axes.plot(flight.time, seen.min(axis=-1), **_FLOWN)
        unit = limit.unit(scenario.sliding_law())
        axes.set_ylabel(f"left of the\n{limit.title}\n({unit})")
    bottoms[-1].set_xlabel("time (s)")
    bottom.set_xlim(planned.time[0], planned.time[-1])
    for axes in figure.axes:
        axes.grid(True, color=LIGHT_GREY, lw=0.5)
        axes.set_axisbelow(True)
    figure.align_ylabels()
    handles: list[Artist] = [
        Patch(fc=PALE_BLUE, ec=BLACK, label="tube ±Ω" + (", ±Φ" if n > 1 else "")),
        Line2D([], [], label="planned; ‖u*‖", **_PLANNED),
        Line2D([], [], label="limit", **_LIMIT),
        Line2D([], [], label="tightened speed limit; bound of ‖u‖", **_TIGHTENED),
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


@dataclasses.dataclass(frozen=True, eq=False)
class _Planned:
    """What a plan says at K times, and what follows from it.

    Attributes:
        time: ``(K,)``, in s.
        velocity: dy*/dt, ``(K, m)``.
        bandwidth: α, ``(K, m)``.
        error_bound: R_k, ``(K, n, m)``.
        boundary_layer: Φ, ``(K, m)``.
        rate_bound: of |dỹ/dt|, ``(K, m)``.
        feedforward: u*, ``(K, m)``.
        input_bound: of ‖u‖ anywhere in the tube, ``(K,)``.
        others: what is left of each of `Limits.others` anywhere in the tube,
            ``(K,)`` each.
    """

    time: FloatArray
    velocity: FloatArray
    bandwidth: FloatArray
    error_bound: FloatArray
    boundary_layer: FloatArray
    rate_bound: FloatArray
    feedforward: FloatArray
    input_bound: FloatArray
    others: list[FloatArray]

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
            velocity=plan.derivatives(time)[:, 1],
            bandwidth=plan.bandwidth(time),
            error_bound=error_bound,
            boundary_layer=layer,
            rate_bound=deviation_bound(law, at, 1),
            feedforward=law.model.input_for(state, highest - law.model.drift(state)),
            input_bound=input_bound(law, at),
            others=[
                each.margins(law, at).min(axis=-1) for each in scenario.limits.others
            ],
        )


def _panels(
    rows: list[str], columns: int, below: int
) -> tuple[Figure, dict[tuple[str, int], Axes], list[Axes]]:
    """A figure with panels by row and column, and some as wide below them."""
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
            panels[name, i] = figure.add_subplot(
                grid[row, i], sharex=bottom, sharey=panels.get((name, 0))
            )
            panels[name, i].tick_params(labelbottom=False, labelleft=i == 0)
    return figure, panels, bottoms


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


def _draw_planned_input(scenario: Scenario, planned: _Planned, panel: Axes) -> None:
    limit = scenario.limits.input
    panel.axhline(limit, **_LIMIT)
    panel.plot(planned.time, planned.input_bound, **_TIGHTENED)
    norm = np.linalg.norm(planned.feedforward, axis=1)
    panel.plot(planned.time, norm, **_PLANNED)
    panel.set_ylim(0.0, 1.08 * max(limit, float(planned.input_bound.max())))


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
    panels["error"].plot(flight.time, error[:, 0, i], **_FLOWN)
    if "sliding" in panels:
        panels["sliding"].plot(flight.time, s, **_FLOWN)
    if order > 1:  # else the velocity is no state
        panels["speed"].plot(flight.time, np.abs(flight.state[:, 1, i]), **_FLOWN)


def _band(axes: Axes, time: FloatArray, half: FloatArray) -> None:
    axes.fill_between(time, -half, half, fc=PALE_BLUE, ec="none", zorder=1)
    for edge in (-half, half):
        axes.plot(time, edge, color=BLACK, lw=0.9, zorder=2)
