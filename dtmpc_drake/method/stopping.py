"""How long a vehicle takes to stop, and how far it must see for that."""

from __future__ import annotations

from math import factorial

import numpy as np

from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant, input_bound
from dtmpc_drake.method.tube import TubeStart, propagate
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
    law: SlidingLaw,
    *,
    velocity: Array,
    bandwidth: float,
    layer: Array,
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
        law: the controller.
        velocity: ``(m,)``, in m/s.
        bandwidth: α, in rad/s.
        layer: Φ(t0), ``(m,)``.
        input_limit: u_m.
        delay: from when an obstacle comes within range until the reference
            brakes as hard as it may, in s.

    Returns:
        R in m; infinite if the feedback leaves nothing to brake with.
    """
    n, m = law.order, law.num_outputs
    state = np.zeros((2 * _STEPS + 1, n, m))
    if n > 1:
        state[:, 1] = velocity
    state = law.chains.existing(state)
    span = 10 * n / min(bandwidth, float(law.slope.min()))
    tube = propagate(
        law,
        reference=state,
        bandwidth=np.full((2 * _STEPS + 1, m), bandwidth),
        start=TubeStart.of_error(np.zeros((n, m)), layer, law.slope, law.chains),
        velocity_bound="comparison",
        step=span / _STEPS,
    )
    error_bound = tube.error_bound.max(axis=0)
    at_rest = Instant(
        state=state[0],
        highest=np.zeros(m),
        gain=bandwidth * tube.boundary_layer.max(axis=0),
        error_bound=error_bound,
    )
    feedback = float(input_bound(law, at_rest))
    speed = float(np.linalg.norm(velocity))
    moving = law.chains.each[velocity != 0]
    stop = max(
        (stopping_time(speed, input_limit - feedback, int(k)) for k in set(moving)),
        default=0.0,
    )
    place = error_bound[0, : law.model.num_positions]
    return speed * (delay + stop / 2) + 2 * float(np.linalg.norm(place))
