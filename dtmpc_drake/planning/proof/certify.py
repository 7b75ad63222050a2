"""The certificate: what a plan keeps, for all times, checked after the solve.

Nothing here knows how a plan was found.  The tube is propagated again from the
plan's own polynomials, and every margin is bounded from below on short intervals
(see `enclosure`), which are cut further where a bound is not good enough.
"""

from __future__ import annotations

import itertools
from collections.abc import Container

import numpy as np

from dtmpc_drake.limits import ObstacleLimit
from dtmpc_drake.method.enclosure import Enclosure
from dtmpc_drake.method.margin import Margin, smallest
from dtmpc_drake.planning.canonical import canonical, plan_in_units
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.consistency import consistency_margins, plan_faults
from dtmpc_drake.planning.proof.enclosure import claimed_corridor, enclose
from dtmpc_drake.records.certificate import OF_THE_ENDS, Certificate
from dtmpc_drake.records.plan import Plan

INTERVALS = (16e-3, 4e-3, 2e-3, 1e-3, 5e-4)
"""Longest interval, in s: the next one is taken if a bound is negative.  The first
is for models whose error bound is constant: nothing is of first order then but F̂."""
TUBE_TOLERANCE = 1e-4
"""How far the tube that a plan carries may lie below the proven one, on which all
margins rest; in m for the position tube."""
TOP_TOLERANCE = 2e-3
"""The same for the highest derivative that is a state (for n = 2 the velocity tube,
in m/s), whose bound depends on itself and, through Δ̄, on the whole tube."""
CLOSE = 1e-3
"""So much may an obstacle's bound be too low on the longest intervals, in m: one
that is lower is not looked at on shorter ones."""
OF_THE_SAMPLES = frozenset({"tube", "bandwidth_knots"})
"""Margins that more samples of the same tube improve."""


def certify(plan: Plan, problem: Problem) -> Certificate:
    """Checks a plan against its problem, for all times.

    Every margin is a lower bound of what is left of a limit; it is exact up to
    second order in the length of the intervals, and up to first order where a
    model is asked for its bounds over a box.

    Args:
        plan: whose polynomials are checked.
        problem: gives model, limits and obstacles.

    Returns:
        The certificate.  A plan that is none, or of another kind than the problem,
        has `Certificate.faults`.
    """
    proven = problem.model.bounds_certified
    faults = plan_faults(plan, problem)
    if faults:
        return Certificate({}, proven, faults)
    plan, problem = _in_own_units(plan, problem)
    values: dict[str, float] = {}
    # What is not a number is found at the end; nothing may be lost before.
    with np.errstate(all="ignore"):
        for longest in INTERVALS[problem.model.error_bound_varies :]:
            enclosure = enclose(
                plan, problem, longest=longest, velocity_slack=TOP_TOLERANCE
            )
            margins = _margins(plan, problem, enclosure)
            certificate = Certificate(margins, proven)
            if certificate.kept:
                break
            name, margin = certificate.worst
            hopeless = (
                name == "obstacles" and margin.value < -CLOSE * problem.units.length
            )
            # What shorter intervals gain is of first order in their length, so it
            # will not be more than it was.
            gained = margin.value - values.get(name, -np.inf)
            hopeless |= margin.value + gained < 0
            if hopeless or name in OF_THE_ENDS or not np.isfinite(margin.value):
                break
            values = {each: m.value for each, m in margins.items()}
    return certificate


def _in_own_units(plan: Plan, problem: Problem) -> tuple[Plan, Problem]:
    """In which all tolerances here are; a problem in them comes with such a plan."""
    own = canonical(problem)
    if own is not problem:
        with np.errstate(all="ignore"):
            plan = plan_in_units(plan, own.units)
    return plan, own


def _margins(plan: Plan, problem: Problem, enclosure: Enclosure) -> dict[str, Margin]:
    """Every margin by name."""
    n, units = problem.law.order, problem.units
    time = enclosure.time * units.time
    margins: dict[str, Margin] = {}
    own = set(map(id, problem.other_limits))
    for limit in problem.limits:
        if id(limit) not in own:
            margins |= limit.certify(enclosure)
    margins |= problem.bandwidth.certify(enclosure)
    thinnest = enclosure.layer.derivatives[:, 0] - enclosure.layer.radius(0)
    chains, model = problem.law.chains, problem.model
    units_, axes = model.highest_units(below=1), model.axes
    margins["boundary_layer"] = smallest(time, thinnest, units_, axes, units.of(n - 1))
    tolerance = np.full(chains.exists.shape, TUBE_TOLERANCE)
    chains.set_top(tolerance, TOP_TOLERANCE if n > 1 else TUBE_TOLERANCE)
    left = chains.pack(enclosure.claim_excess + tolerance)
    bounds = [f"bound {k} on {axes[i]}" for k, i in np.argwhere(chains.exists)]
    margins["tube"] = smallest(time, left, "", bounds)
    margins |= consistency_margins(plan, problem)
    for limit in problem.other_limits:
        for name, margin in limit.certify(enclosure).items():
            # No margin may stand in another one's place, whatever it is called.
            margins[_free(name, margins)] = margin
    return margins


def _free(name: str, taken: Container[str]) -> str:
    """A name that nobody has: ``power``, ``power_2``, ..."""
    names = itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
    return next(each for each in names if each not in taken)


def clearance_ahead(plan: Plan, problem: Problem, start: float) -> Margin:
    """The smallest distance of a certified plan's tube from obstacles, from then on.

    Args:
        plan: whose own tube is taken for granted.
        problem: gives the obstacles, at least one; others than it was planned for.
        start: in s.
    """
    plan, problem = _in_own_units(plan, problem)
    corridor = claimed_corridor(
        plan, longest=INTERVALS[0], slack=TUBE_TOLERANCE, units=problem.units
    )
    return ObstacleLimit(problem.obstacles, problem.tube_margin).clearance(
        problem.law, corridor, start / problem.units.time
    )
