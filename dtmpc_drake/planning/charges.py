"""What a plan is charged for, one term after the other."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.records.plan import Plan


def charges(plan: Plan, problem: Problem) -> dict[str, float]:
    """The terms of a plan's cost, whose sum is `PlanningResult.cost`.

    Args:
        plan: on its own knots.
        problem: gives the costs.

    Returns:
        By name: ``input``, ``bandwidth`` (its rate included), ``state``, ``terminal``
        and the classes of others, as far as the problem has them.
    """
    knots, n = plan.knots, plan.order
    reference = plan.reference(knots)
    state, highest = reference[:, :n], reference[:, n]
    steps = np.diff(knots)

    def integral(running: Array) -> float:
        return float(steps @ (running[1:] + running[:-1]) / 2)

    of_bandwidth = problem.bandwidth_cost.running(plan.bandwidth_knots, steps[0])
    found = {"bandwidth": integral(of_bandwidth)}
    for cost in problem.costs:
        running = (cost.residuals(problem.law, state, highest) ** 2).sum(axis=-1)
        name = cost.title or type(cost).__name__
        found[name] = found.get(name, 0.0) + integral(running)
    for cost in problem.terminal:
        left = cost.residuals(problem.law, state[-1:], highest[-1:])
        found["terminal"] = found.get("terminal", 0.0) + float((left**2).sum())
    return found
