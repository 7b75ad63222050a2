"""Problems and plans in units of their own, see `method.units`."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.costs.in_units import bandwidth_in_units
from dtmpc_drake.costs.in_units import in_units as cost_in_units
from dtmpc_drake.limits.in_units import in_units as limit_in_units
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tube import TubeStart
from dtmpc_drake.method.units import Units
from dtmpc_drake.models.in_units import in_units as model_in_units
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.records.plan import Plan


def own_units(problem: Problem) -> Units:
    """A problem's own units in those of the user."""
    if not problem.units.are_the_users:
        return problem.units
    return Units.own(
        speed=problem.speed.size,
        slope=problem.law.slope,
        bandwidth=problem.bandwidth.high,
        orders=problem.law.chains.orders,
    )


def canonical(problem: Problem) -> Problem:
    """A problem in its own units.

    A problem that is in them already, or whose user's units are near enough, is
    returned as it is.
    """
    law, n = problem.law, problem.law.order
    units = own_units(problem)
    if units == problem.units:
        return problem
    rows, highest = units.of_rows(n), units.of(n)
    stages, top = problem.tube_start.stages, problem.tube_start.highest
    given = problem.start_highest, problem.start_bandwidth
    return Problem(
        law=SlidingLaw(
            model=model_in_units(law.model, units.of_rows(n + 1)),
            slope=law.slope * units.time,
            disturbance_bound=law.disturbance_bound / highest,
            reaching_rate=law.reaching_rate / highest,
        ),
        obstacles=problem.obstacles.in_units(units.length),
        tube_margin=problem.tube_margin,
        input=problem.input.in_units(units, n),
        speed=problem.speed.in_units(units, n),
        other_limits=tuple(
            limit_in_units(limit, law, units) for limit in problem.other_limits
        ),
        bandwidth=problem.bandwidth.in_units(units.time),
        costs=tuple(
            cost_in_units(cost, law, units, running=True) for cost in problem.costs
        ),
        bandwidth_cost=bandwidth_in_units(problem.bandwidth_cost, units),
        start_time=problem.start_time / units.time,
        duration=problem.duration / units.time,
        start=problem.start / rows,
        goal=problem.goal / rows,
        soft=problem.soft,
        terminal=tuple(
            cost_in_units(cost, law, units, running=False) for cost in problem.terminal
        ),
        tube_start=TubeStart(stages / rows, top / rows[-1]),
        velocity_bound=problem.velocity_bound,
        start_highest=None if given[0] is None else given[0] / highest,
        start_bandwidth=None if given[1] is None else given[1] * units.time,
        units=units,
    )


def plan_in_units(plan: Plan, units: Units) -> Plan:
    """A plan in other units.

    Args:
        plan: in any units.
        units: the new ones in those.
    """
    n, time = plan.order, units.time

    def divided(powers: Array, unit: float) -> Array:
        """Coefficients of what is measured in a unit, by powers of the time."""
        return powers * (time ** np.arange(powers.shape[1]) / unit)[:, None]

    rows = units.of_rows(n)
    return Plan(
        knots=plan.knots / time,
        coefficients=divided(plan.coefficients, units.length),
        bandwidth_knots=plan.bandwidth_knots * time,
        tube_times=plan.tube_times / time,
        layer_coefficients=divided(plan.layer_coefficients, units.of(n - 1)),
        bound_samples=plan.bound_samples / rows,
        bound_rate_samples=plan.bound_rate_samples / rows * time,
        orders=plan.orders,
    )
