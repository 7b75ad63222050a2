"""A plan that rests: what is flown where no certified plan exists."""

from __future__ import annotations

import math

import numpy as np

from dtmpc_drake.method.layer import layer_pieces
from dtmpc_drake.method.tube import TubeStart, propagate
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario

_STEPS = 400
"""Of the tube of a plan that rests, at least."""
_STEP = 0.5
"""Of these steps, at most, in time constants of the fastest filter."""


def hold_plan(scenario: Scenario) -> Plan:
    """A reference that rests at the start, with the tube that is true for it.

    It is what is flown where no certified plan exists.  The bandwidth is the
    highest that plans use, and the tube starts from the plant's actual error, its
    velocity included, so the plant does stay inside it.  Nobody has checked
    that tube against obstacles or the input limit: it is not certified.
    """
    law, bandwidth = scenario.sliding_law(), scenario.controller.bandwidth
    n, m = law.order, law.num_outputs
    start = scenario.start_state()
    rest = np.zeros((n + 1, m))
    rest[0] = start[0]
    error = start + scenario.initial_error_state() - rest[:n]
    # A little inside the limit, where plans may go on from it.
    highest = np.full(m, bandwidth.interval()[1])
    if bandwidth.fixed is None:
        highest *= 1 - scenario.planner.options.bandwidth_reserve
    layer = np.maximum(
        scenario.initial_boundary_layer(), np.abs(law.sliding_variable(error))
    )
    fastest = float((highest + n * law.slope).max())
    steps = max(_STEPS, math.ceil(scenario.duration * fastest / _STEP))
    step = scenario.duration / steps
    reference = np.broadcast_to(rest[:n], (2 * steps + 1, n, m))
    alpha = np.broadcast_to(highest, (2 * steps + 1, m))
    bounds = propagate(
        law,
        reference=reference,
        bandwidth=alpha,
        start=TubeStart.of_error(error, layer, law.slope, law.chains),
        velocity_bound="comparison",
        step=step,
    )
    coefficients = np.zeros((1, n + 2, m))
    coefficients[0, 0] = rest[0]
    return Plan(
        knots=np.array([0.0, scenario.duration]),
        coefficients=coefficients,
        bandwidth_knots=np.stack([highest, highest]),
        tube_times=np.linspace(0.0, scenario.duration, steps + 1),
        layer_coefficients=layer_pieces(
            law, reference=reference, bandwidth=alpha, initial=layer, step=step
        ),
        bound_samples=bounds.error_bound,
        bound_rate_samples=bounds.error_bound_rate,
        orders=law.chains.each,
    )
