"""What limits must say of a model, and whether start and goal keep them."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.checks import Part
from dtmpc_drake.errors import ScenarioError, require, show
from dtmpc_drake.limits import ConvexLimit
from dtmpc_drake.limits.norms import DERIVATIVES as NAMES
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.tube import TubeStart, propagate
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.scenario.schema import DERIVATIVES, Scenario


def smallest_final_tube(scenario: Scenario) -> Array:
    """Ω(t_f) at the highest bandwidth and without model error, ``(m,)``.

    No plan has a smaller one.
    """
    chains = Chains.of(scenario.model)
    m, n = chains.num_outputs, chains.order
    _, alpha = scenario.controller.bandwidth.interval()
    # After ten time constants nothing is left of the start.
    rates = [*scenario.controller.slope, alpha]
    span = min(scenario.duration, 10 * n / min(rates))
    half = 2 * int(np.clip(span * max(rates), 200, 2000)) + 1
    exact = IntegratorChain(orders=list(chains.orders), error_bound=0.0)
    law = dataclasses.replace(scenario.sliding_law(), model=exact)
    tube = propagate(
        law,
        reference=np.zeros((half, n, m)),
        bandwidth=np.full((half, m), alpha),
        start=TubeStart.of_error(
            scenario.initial_error_state(),
            scenario.initial_boundary_layer(),
            law.slope,
            chains,
        ),
        velocity_bound="paper",
        step=2 * span / (half - 1),
    )
    return tube.error_bound[-1, 0]


def limits_by_path(scenario: Scenario) -> dict[str, Part]:
    """What stands in a scenario for each of `Limits.others`, in their order."""
    limits, parts = scenario.limits, dict[str, Part]()
    for name in ("position", "inputs"):
        if (limit := getattr(limits, name)) is not None:
            parts[f"limits.{name}"] = limit
    parts |= {f"limits.norms[{i}]": norm for i, norm in enumerate(limits.norms)}
    return parts | {f"limits.own[{i}]": own for i, own in enumerate(limits.own)}


def check_limits_exist(scenario: Scenario) -> None:
    """Refuses limits of derivatives beyond the highest that is bounded, y_i^(n_i)."""
    chains = Chains.of(scenario.model)
    limits = zip(limits_by_path(scenario), scenario.limits.others, strict=True)
    for path, limit in limits:
        if not isinstance(limit, ConvexLimit):
            continue
        k = limit.derivative
        beyond = limit.reads(chains.num_outputs) & (chains.each < k)
        for i in np.flatnonzero(beyond)[:1]:
            name = [*NAMES][k] if k < len(NAMES) else f"derivative {k}"
            axis, order = scenario.model.axes[i], chains.orders[i]
            why = (
                f"one that does not look at {axis} (a column of zeros in its matrix):"
                f" it is of order {order}, and nothing bounds its {name}"
            )
            raise ScenarioError(path, name, why)


def check_limits_at_ends(scenario: Scenario) -> None:
    """Limits of the states at both ends, with the smallest tubes that they may have."""
    if not scenario.limits.others:
        return
    error, names = np.abs(scenario.initial_error_state()), DERIVATIVES
    law, chains = scenario.sliding_law(), Chains.of(scenario.model)
    final = np.zeros_like(error)
    final[0] = smallest_final_tube(scenario)
    ends = {
        "start": (scenario.start_state(), error),
        "goal": (scenario.goal_state(), final),
    }
    limits = zip(limits_by_path(scenario), scenario.limits.others, strict=True)
    for path, limit in limits:
        if not isinstance(limit, ConvexLimit) or not limit.is_of_states(chains):
            continue
        k = limit.derivative
        for end, (state, tube) in ends.items():
            if end == "goal" and k in scenario.soft_derivatives():
                continue
            left = limit.left(state[k], tube[k])
            worst = int(left.argmin())
            where, unit = limit.where(law, worst), limit.unit(law, worst)
            where = f" ({where})" if where else ""
            require(
                f"{end}.{names[k]}" if k < len(names) else end,
                state[k],
                bool(left[worst] >= 0),
                f"inside {path}{where}, tube included: {-left[worst]:.3g} {unit} are"
                f" missing (tube {show(tube[k].round(3))} {unit})",
            )
