"""Which steps of an explicit integrator are stable in the closed loop.

Inside the layer the closed loop is triangular: ds/dt = -(K(x)/Φ) s + ... with
K(x)/Φ near the bandwidth α, and dy_j/dt = -λ y_j + y_(j+1) in the cascade.  So its
rates are α and λ.  A step h of a method is stable for a rate a if |R(-a h)| <= 1 with
the method's stability function R (Hairer and Wanner, Solving Ordinary Differential
Equations II, section IV.2).
"""

from __future__ import annotations

from collections.abc import Mapping

LIMITS = {
    "explicit_euler": 2.0,
    "semi_explicit_euler": 2.0,
    "runge_kutta2": 2.0,
    "runge_kutta3": 2.5127,
    "bogacki_shampine3": 2.5127,
    "runge_kutta5": 3.3065,
}
"""How far each explicit scheme's interval of stability reaches along the negative
real axis.  Schemes that are not here are implicit, and stable on all of it."""
ROOM = 1.25
"""K(x)/Φ is α + (Δ(x) - Δ(x*))/Φ: what the bandwidth is taken to be larger, where the
model error varies.  An allowance: it reached 1.2 α in the shipped experiments."""
SHARE = 0.98
"""Of a limit that steps may use: Drake makes a step up to a hundredth longer than the
longest, and a fixed bandwidth may deviate by half as much."""


def longest_stable_step(
    scheme: str, rates: Mapping[str, float]
) -> tuple[float, str] | None:
    """The longest step that is stable for all rates, and which rate asks for it.

    Args:
        scheme: a name of Drake's ``SimulatorConfig``.
        rates: by what they are of, in 1/s.

    Returns:
        The step in s and the name of the fastest rate; None if any step is stable.
    """
    if scheme not in LIMITS:
        return None
    fastest = max(rates, key=lambda name: rates[name])
    return SHARE * LIMITS[scheme] / rates[fastest], fastest
