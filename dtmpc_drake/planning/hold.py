"""A plan that rests: what is flown where no certified plan exists."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dtmpc_drake.method import tube
from dtmpc_drake.method.layer import layer_pieces
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.planning.transcription import HAIR
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario

_HOLD_STEPS = 400
"""Of the tube of a plan that rests, at least."""
_HOLD_STEP = 0.5
"""Of these steps, at most, in time constants of the fastest filter."""


def hold_plan(scenario: Scenario) -> Plan:
    """A reference that rests at the start, with the tube that is true for it.

    It is what is flown where no certified plan exists.  The bandwidth is the
    highest that plans use, and the tube starts from the plant's actual error, its
    velocity included, so the plant does stay inside it.  Nobody has checked
    that tube against obstacles or the input limit: it is not certified.
    """
    model = scenario.planning_model()
    n, m = model.order, model.num_outputs
    start = scenario.start_state()
    rest = np.zeros((n + 1, m))
    rest[0] = start[0]
    error = start + scenario.initial_error_state() - rest[:n]
    slope, bandwidth = scenario.slope(), scenario.controller.bandwidth
    # A hair inside the limit, where plans may go on from it.
    highest = np.full(m, bandwidth.fixed or bandwidth.max * (1 - HAIR))
    layer = np.maximum(
        scenario.initial_boundary_layer(), np.abs(sliding_variable(error, slope))
    )
    fastest = float((highest + n * slope).max())
    steps = max(_HOLD_STEPS, math.ceil(scenario.duration * fastest / _HOLD_STEP))
    half_grid = 2 * steps + 1
    shared: dict[str, Any] = {
        "model": model,
        "reference": np.broadcast_to(rest[:n], (half_grid, n, m)),
        "bandwidth": np.broadcast_to(highest, (half_grid, m)),
        "disturbance_bound": scenario.disturbance_bound(),
        "reaching_rate": scenario.controller.reaching_rate,
        "initial_boundary_layer": layer,
        "step": scenario.duration / steps,
    }
    bounds = tube.propagate(
        slope=slope, initial_error=error, velocity_bound="comparison", **shared
    )
    coefficients = np.zeros((1, n + 2, m))
    coefficients[0, 0] = rest[0]
    return Plan(
        knots=np.array([0.0, scenario.duration]),
        coefficients=coefficients,
        bandwidth_knots=np.stack([highest, highest]),
        tube_times=np.linspace(0.0, scenario.duration, steps + 1),
        layer_coefficients=layer_pieces(**shared),
        bound_samples=bounds.error_bound,
        bound_rate_samples=bounds.error_bound_rate,
    )
