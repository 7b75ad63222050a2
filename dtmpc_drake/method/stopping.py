"""How long a vehicle takes to stop, and how far it must see for that."""

from __future__ import annotations

from math import factorial

import numpy as np

from dtmpc_drake.method.tightening import input_bound
from dtmpc_drake.method.tube import propagate
from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array

_STEPS = 200  # of the tube's integration, until it has settled


def stopping_time(speed: float, deceleration: float, order: int) -> float:
    """How long a chain of integrators goes until it rests.

    From level flight (no higher derivative) to rest, with ``|y^(n)| <= a``: the
    velocity falls along the perfect spline of degree r = n - 1 for
    ``T = (4^(r-1) (r-1)! v / a)^(1/r)``.  That is ``v / a`` for n = 2; for n = 1
    the vehicle stops at once.  It falls symmetrically, so the way is ``v T / 2``.

    Args:
        speed: v, in m/s.
        deceleration: a, in m/s^n.
        order: n.

    Returns:
        T in s; infinite without any deceleration.
    """
    if order == 1:
        return 0.0
    if deceleration <= 0:
        return np.inf
    r = order - 1
    spline = 4 ** (r - 1) * factorial(r - 1)
    return float((spline * speed / deceleration) ** (1 / r))


def range_needed(
    *,
    model: Model,
    velocity: Array,
    bandwidth: float,
    slope: Array,
    disturbance_bound: Array,
    reaching_rate: float,
    initial_boundary_layer: Array,
    input_limit: float,
    delay: float,
) -> float:
    """A range from which the vehicle can stop before what it senses.

    ``R = v (δ + T / 2) + 2 ‖Ω‖``: it flies on for the delay δ, then stops in T with
    the deceleration a that the feedback leaves of the input, ``a = u_m - ū_fb``
    (see `stopping_time`), and both now and at rest it may be ‖Ω‖ from its
    reference.  Tube and ū_fb (Theorem 2) are the largest while the vehicle flies
    at this velocity with this bandwidth, so the lowest bandwidth is the worst.
    Where the model's bounds depend on the position, they are taken at zero.

    Args:
        model: gives the bounds.
        velocity: ``(m,)``, in m/s.
        bandwidth: α, in rad/s.
        slope: λ, ``(m,)``.
        disturbance_bound: D, ``(m,)``.
        reaching_rate: η.
        initial_boundary_layer: Φ(t0), ``(m,)``.
        input_limit: u_m.
        delay: from when an obstacle comes within range until the reference
            brakes as hard as it may, in s.

    Returns:
        R in m; infinite if the feedback leaves nothing to brake with.
    """
    n, m = model.order, model.num_outputs
    state = np.zeros((2 * _STEPS + 1, n, m))
    if n > 1:
        state[:, 1] = velocity
    span = 10 * n / min(bandwidth, float(slope.min()))
    tube = propagate(
        model=model,
        reference=state,
        bandwidth=np.full((2 * _STEPS + 1, m), bandwidth),
        slope=slope,
        disturbance_bound=disturbance_bound,
        reaching_rate=reaching_rate,
        initial_boundary_layer=initial_boundary_layer,
        initial_error=np.zeros((n, m)),
        velocity_bound="comparison",
        step=span / _STEPS,
    )
    error_bound = tube.error_bound.max(axis=0)
    feedback = input_bound(
        model=model,
        reference=state[0],
        highest=np.zeros(m),
        error_bound=error_bound,
        gain=bandwidth * tube.boundary_layer.max(axis=0),
        slope=slope,
    )
    speed = float(np.linalg.norm(velocity))
    stop = stopping_time(speed, input_limit - float(feedback), n)
    return speed * (delay + stop / 2) + 2 * float(np.linalg.norm(error_bound[0]))
