"""The page around the scene: legend, time line and read-outs, as HTML."""

from __future__ import annotations

import html
import json
from importlib import resources
from string import Template

import numpy as np
from matplotlib.colors import to_hex

from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import plans_in_force
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.visualization.scale import Scale, decimals
from dtmpc_drake.visualization.scene import (
    field_corners,
    grid_spacing,
    shown_fences,
    vehicle_radius,
)
from dtmpc_drake.visualization.shown import ShownFlight
from dtmpc_drake.visualization.style import (
    BLACK,
    BLUE,
    FENCE,
    GHOST,
    GREEN,
    GREY,
    VERMILION,
    ColorBy,
    Coloring,
    cloud_colors,
)


def with_overlay(page: str, *, title: str, overlay: str) -> str:
    """Meshcat's own page, with a title and with more before its end."""
    head, end, tail = page.rpartition("</body>")
    old, new = "Drake MeshCat", html.escape(title)
    head = head.replace(f"<title>{old}</title>", f"<title>{new}</title>")
    return head + overlay + end + tail


def legend_html(
    *,
    scenario: Scenario,
    plan: Plan,
    flight: ShownFlight,
    color_by: ColorBy = "bandwidth",
) -> str:
    """What Meshcat cannot draw: legend, time line, read-outs, chase view.

    Args:
        scenario: gives the obstacles and the name.
        plan: in force at each time.
        flight: of the plan.
        color_by: what the colours mean.

    Returns:
        HTML to put before a page's ``</body>``.  It degrades to the legend
        alone where the viewer is not the one that it knows.
    """
    time, position = flight.time, flight.position
    shown = plans_in_force(flight.replans)
    coloring = Coloring.along(
        plan,
        time,
        color_by,
        [s.plan for s in shown],
        scenario.model.derivative_unit(1),
    )
    share = np.linspace(0.0, 1.0, 9)
    colors = coloring.rgb(coloring.low + share * (coloring.high - coloring.low))
    ticks = coloring.low + np.array([0.0, 0.5, 1.0]) * (coloring.high - coloring.low)
    scale, digits = Scale.of(plan), decimals(coloring.high - coloring.low)
    error = np.abs(position - plan.reference(time)[:, 0])
    ratio = error / np.maximum(plan.position_tube(time), 1e-6 * scale.tube)
    low, high = field_corners(scenario, plan)
    every = np.unique(np.linspace(0, len(time) - 1, 300).astype(int))
    data = {
        "time": [_short(t - time[0]) for t in time[every]],
        "value": [f"{value:.{digits}f}" for value in coloring.values[every]],
        "ratio": ratio.max(axis=1)[every].round(3).tolist(),
        "end": _short(time[-1] - time[0]),
        "start": _short(time[0]),
        "faster": scale.time,
        "width": _short(2 * vehicle_radius(scenario, plan) / scale.field),
        "thin": scale.tube / scale.field,
        "size": scale.tube,
        "unit": coloring.unit,
        "quantity": color_by,
        "news": [[_short(s.start - time[0]), s.replan.headline()] for s in shown],
    }
    length = html.escape(scenario.model.length_unit)
    fenced = np.isfinite(shown_fences(scenario, plan)).any()
    template = resources.files("dtmpc_drake.visualization") / "overlay.html"
    fields = {
        "name": html.escape(scenario.name.replace("_", " ")),
        "status": html.escape(flight.status),
        "label": html.escape(f"{coloring.label}, {coloring.unit}"),
        "gradient": ", ".join(to_hex(c) for c in colors),
        "low": f"{ticks[0]:.{digits}f}",
        "middle": f"{ticks[1]:.{digits}f}",
        "high": f"{ticks[2]:.{digits}f}",
        "vehicle_color": VERMILION,
        "clouds": "".join(
            f'<li><i style="color: {color}"></i>{html.escape(name)}</li>'
            for name, color in cloud_colors(flight.clouds).items()
        ),
        "reference_color": BLACK,
        "box_color": BLUE,
        "obstacle_color": GREY,
        "goal_color": GREEN,
        "goal": "soft goal (pole)" if scenario.goal_is_soft else "goal",
        "grid": f"{grid_spacing(high - low, scale):g} {length}",
        "obstacles_shown": "" if scenario.obstacles else "hidden",
        "ghosts_shown": "" if flight.found else "hidden",
        "ghost_color": GHOST,
        "fences_shown": "" if fenced else "hidden",
        "fence_color": FENCE,
        "afar": " (widened from afar)" if scale.tube_is_thin else "",
        "cut": "(pillars cut at flight altitude)" if plan.num_outputs >= 3 else "",
        # So that no text can end the script element.
        "data": json.dumps(data).replace("<", "\\u003c"),
    }
    return Template(template.read_text(encoding="utf-8")).substitute(fields)


def _short(number: float) -> float:
    """With the digits that a picture needs."""
    return float(f"{number:.6g}")
