"""What costs, and a goal that they draw to, must say of a model."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.checks import require_length, require_magnitude
from dtmpc_drake.costs import Weight, matrix_of, require_weight
from dtmpc_drake.errors import require
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.models import Model
from dtmpc_drake.scenario.schema import DERIVATIVES, ENDS, Scenario, StateWeights


def check_costs(scenario: Scenario) -> None:
    """Refuses weights that are none, or that weigh what an output does not have."""
    cost, m = scenario.cost, scenario.model.num_outputs
    for name in ("input", "bandwidth", "bandwidth_rate"):
        require_weight(f"cost.{name}", getattr(cost, name), m)
    for name in ("state", "terminal"):
        weights: StateWeights | None = getattr(cost, name)
        for k, derivative in enumerate(DERIVATIVES if weights is not None else ()):
            field, weight = f"cost.{name}.{derivative}", getattr(weights, derivative)
            require_weight(field, weight, m)
            order = scenario.model.order
            why = f"left out: the model is of order {order}"
            require(field, weight, k < order or not np.any(weight), why)
            if np.any(weight):
                _check_weighed(field, weight, k, scenario.model)
    if cost.state is None or cost.state.line is None:
        return
    for name in ("point", "direction"):
        row, field = getattr(cost.state.line, name), f"cost.state.line.{name}"
        require_length(field, row, m)
        for i, value in enumerate(row):
            require_magnitude(f"{field}[{i}]", value, scenario.model.output_units[i])
    require(field, row, bool(np.linalg.norm(row) >= 1e-9), "longer than 0")


def _check_weighed(field: str, weight: Weight, k: int, model: Model) -> None:
    """Refuses to weigh derivatives of outputs that do not have them."""
    chains = Chains.of(model)
    whole = matrix_of(weight, chains.num_outputs)
    for i in np.flatnonzero(chains.each <= k):
        why = (
            f"a list or a matrix that is 0 for {model.axes[i]}, which is of order"
            f" {chains.orders[i]}"
        )
        require(field, weight, not whole[i].any(), why)


def check_soft_goal(scenario: Scenario) -> None:
    """Refuses what is not soft, or no derivative of the model."""
    names = DERIVATIVES[: scenario.model.order]
    for end in ENDS:
        waypoint = getattr(scenario, end)
        soft = waypoint.soft if waypoint is not None else False
        if end != "goal":
            require(f"{end}.soft", soft, not soft, "left out: only a goal may be soft")
        for i, name in enumerate([] if isinstance(soft, bool) else soft):
            known = "one of " + ", ".join(names)
            require(f"{end}.soft[{i}]", name, name in names, known)
