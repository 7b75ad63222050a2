"""What the fields of a scenario must say, by themselves and together.

A model, an obstacle and a disturbance answer for their own fields, in their own files.
Here is what is left: the sections that every scenario has, and how all of it fits.
"""

from __future__ import annotations

import dataclasses
import math
from numbers import Integral

import numpy as np

from dtmpc_drake.checks import (
    Setting,
    require_length,
    require_magnitude,
    require_positive,
)
from dtmpc_drake.errors import ScenarioError, require, show
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.method.stability import ROOM, longest_stable_step
from dtmpc_drake.method.stopping import range_needed
from dtmpc_drake.models import joined
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.scenario.check_costs import check_costs, check_soft_goal
from dtmpc_drake.scenario.check_limits import (
    check_limits_at_ends,
    check_limits_exist,
    limits_by_path,
    smallest_final_tube,
)
from dtmpc_drake.scenario.schema import (
    BACKENDS,
    DERIVATIVES,
    ENDS,
    Scenario,
)
from dtmpc_drake.scenario.size import require_affordable
from dtmpc_drake.scenario.typed import typed

CHOICES = {
    "planner.backend": BACKENDS,
    "planner.tube_margin": ("norm", "support"),
    "planner.velocity_bound": ("comparison", "paper"),
    "planner.uncertainty": ("state_dependent", "constant"),
    "planner.initial_guess": ("straight_line", "best_side"),
}
"""The words that a field may be."""


# Everything.


def validate(scenario: Scenario) -> None:
    """Checks every field and what they say together.

    Raises:
        ScenarioError: at the first thing that is wrong.
    """
    typed(Scenario, scenario, "")
    validate_values(scenario)


def validate_values(scenario: Scenario) -> None:
    """The same for a scenario whose fields are of the right types already."""
    _check_sizes(scenario)
    _check_names(scenario)
    _check_magnitudes(scenario)
    _check_ranges(scenario)
    check_costs(scenario)
    check_soft_goal(scenario)
    _check_parts(scenario)
    require_affordable(scenario)
    _check_bandwidth(scenario)
    _check_plant(scenario)
    _check_motion(scenario)
    _check_clearance(scenario)
    check_limits_at_ends(scenario)
    _check_sensing(scenario)


def _check_magnitudes(scenario: Scenario) -> None:
    chains = Chains.of(scenario.model)
    for field, row in _waypoint_rows(scenario).items():
        k = DERIVATIVES.index(field.split(".")[1])
        units = scenario.model.units_of(k)
        for i, value in enumerate(row):
            require_magnitude(f"{field}[{i}]", value, units[i])
        for i, order in enumerate(chains.orders):
            why = f"0: {scenario.model.axes[i]} is of order {order}"
            require(f"{field}[{i}]", row[i], row[i] == 0 or k < order, why)
    highest, planner = scenario.controller.bandwidth.max, scenario.planner
    require_magnitude("controller.bandwidth.max", highest, "rad/s")
    require_magnitude("planner.compute_delay", planner.compute_delay, "s")
    if planner.replan_period is not None:
        require_magnitude("planner.replan_period", planner.replan_period, "s")


def _check_sizes(scenario: Scenario) -> None:
    for name in ("num_outputs", "order"):
        size = getattr(scenario.model, name, None)
        whole = isinstance(size, Integral) and not isinstance(size, bool)
        require(f"model.{name}", size, whole, "a whole number")
    m, n = scenario.model.num_outputs, scenario.model.order
    require("model.num_outputs", m, 1 <= m <= 1000, "at least 1, at most 1000")
    require("model.order", n, 1 <= n <= 10, "in [1, 10]")
    _check_orders(scenario)
    rows = _waypoint_rows(scenario)
    for field, row in rows.items():
        k = DERIVATIVES.index(field.split(".")[1])
        require(field, row, k < n, f"left out: the model is of order {n}")
    require_length("controller.slope", scenario.controller.slope, m)
    if isinstance(scenario.limits.speed, list):
        require_length("limits.speed", scenario.limits.speed, m)
    for field, row in rows.items():
        require_length(field, row, m)


def _check_orders(scenario: Scenario) -> None:
    """The order of each output, and which of them say where the vehicle is."""
    model = scenario.model
    m, n, orders = model.num_outputs, model.order, model.orders
    if orders is not None:
        require_length("model.orders", orders, m)
        for i, order in enumerate(orders):
            whole = isinstance(order, Integral) and not isinstance(order, bool)
            ok = whole and 1 <= order <= n
            allowed = f"a whole number in [1, {n}], the model's order"
            require(f"model.orders[{i}]", order, ok, allowed)
        most = f"{n} for one output at least, as the model's order is"
        require("model.orders", orders, max(orders) == n, most)
    place = model.num_positions
    if place is not None:
        allowed = f"at least 1, at most {m}, the model's outputs"
        require("model.num_positions", place, 1 <= place <= m, allowed)


def _check_names(scenario: Scenario) -> None:
    """What a model calls its outputs, its inputs and its units."""
    model, m = scenario.model, scenario.model.num_outputs
    for unit in (model.length_unit, *model.output_units):
        ok = isinstance(unit, str) and 0 < len(unit) <= 20 and unit.isalpha()
        require("model.length_unit", unit, ok, "a word, such as m, mm or rad")
    for field in ("output_names", "input_names", "output_units", "input_units"):
        names = getattr(model, field)
        texts = [name for name in names if isinstance(name, str)]
        ok = len(texts) == len(names) == m
        ok = ok and all(0 < len(t) <= 20 and t.isprintable() for t in texts)
        allowed = f"{m} printable texts of at most 20 characters"
        if field in ("output_names", "input_names"):
            ok, allowed = ok and len(set(texts)) == m, f"{allowed}, no two the same"
        require(f"model.{field}", list(names), ok, allowed)


def _check_ranges(scenario: Scenario) -> None:
    c, b = scenario.controller, scenario.controller.bandwidth
    planner, sensing = scenario.planner, scenario.sensing
    simulation, model = scenario.simulation, scenario.model
    positive = {
        "duration": (scenario.duration, "s"),
        "limits.input": (scenario.limits.input, model.input_unit),
        "controller.reaching_rate": (
            c.reaching_rate,
            joined(model.highest_units()),
        ),
        "controller.initial_boundary_layer": (
            c.initial_boundary_layer,
            joined(model.highest_units(below=1)),
        ),
        "controller.bandwidth.min": (b.min, "rad/s"),
        "simulation.max_step_size": (simulation.max_step_size, "s"),
        "simulation.log_period": (simulation.log_period, "s"),
        "planner.time_budget": (planner.time_budget, "s"),
        "planner.time_limit": (planner.time_limit, "s"),
        "sensing.period": (sensing.period, "s"),
    }
    if sensing.range is not None:
        positive["sensing.range"] = (sensing.range, model.length_unit)
    speed = scenario.limits.speed
    for i, bound in enumerate(speed if isinstance(speed, list) else [speed]):
        field = f"limits.speed[{i}]" if isinstance(speed, list) else "limits.speed"
        along = i if isinstance(speed, list) else 0
        positive[field] = (bound, model.units_of(1)[along])
    for i, slope in enumerate(c.slope):
        positive[f"controller.slope[{i}]"] = (slope, "1/s")
    for field, (value, unit) in positive.items():
        require_positive(field, value, unit)
    # As good as no limit: α stays in its own range.
    ok, field = 1e-9 <= b.rate_max <= 1e300, "controller.bandwidth.rate_max"
    require(field, b.rate_max, ok, "greater than 0 rad/s², in [1e-09, 1e+300]")
    delay, again = planner.compute_delay, planner.replan_period
    require("planner.compute_delay", delay, delay >= 0, "at least 0 s")
    if again is not None:
        shortest = max(delay, sensing.period)
        require(
            "planner.replan_period",
            again,
            again >= shortest,
            f"at least {shortest:g} s, which planner.compute_delay and"
            " sensing.period need",
        )
    seed = simulation.seed
    require("simulation.seed", seed, 0 <= seed < 2**32, "in [0, 2^32)")
    N, low = planner.intervals, 2 * scenario.model.order + 2
    whole = f"a whole number in [{low}, 1000]"
    require("planner.intervals", N, low <= N <= 1000, whole)
    for option in dataclasses.fields(planner.options):
        number, field = getattr(planner.options, option.name), option.name
        ok = 0 < number <= 1e9
        require(f"planner.options.{field}", number, ok, "greater than 0, at most 1e9")
    iterations = planner.max_iterations
    ok = 1 <= iterations <= 10_000
    require("planner.max_iterations", iterations, ok, "at least 1, at most 10000")
    for field, allowed in CHOICES.items():
        word = getattr(planner, field.split(".")[1])
        require(field, word, word in allowed, "one of " + ", ".join(allowed))
    scheme, schemes = simulation.integration_scheme, _integration_schemes()
    ok, field = scheme in schemes, "simulation.integration_scheme"
    require(field, scheme, ok, "one of " + ", ".join(schemes))
    name = scenario.name
    ok = name.isprintable() and not set(name) & set("/\\")
    ok = ok and name not in ("", ".", "..") and len(name.encode()) <= 200
    require("name", name, ok, "a file name of at most 200 bytes, without slashes")
    for name, value in scenario.plant.items():
        names = ", ".join(scenario.model.parameter_names) or "nothing"
        known = name in scenario.model.parameter_names
        require(f"plant.{name}", value, known, f"one of: {names}")


def _check_parts(scenario: Scenario) -> None:
    """What answers for itself."""
    model = scenario.model
    setting = Setting(
        num_outputs=model.num_outputs,
        order=model.order,
        duration=scenario.duration,
        length_unit=model.length_unit,
        output_units=model.output_units,
        highest_units=model.highest_units(),
        input_units=model.input_units,
        num_positions=model.num_positions,
    )
    model.check("model", setting)
    scenario.disturbance.check("disturbance", setting)
    for i, obstacle in enumerate(scenario.obstacles):
        obstacle.check(f"obstacles[{i}]", setting.place)
    for path, part in limits_by_path(scenario).items():
        part.check(path, setting)
    check_limits_exist(scenario)
    for i, cost in enumerate(scenario.cost.own):
        cost.check(f"cost.own[{i}]", setting)


# Together.


def _check_bandwidth(scenario: Scenario) -> None:
    b = scenario.controller.bandwidth
    require(
        "controller.bandwidth.min",
        b.min,
        b.min <= b.max,
        f"at most controller.bandwidth.max = {b.max:g} rad/s",
    )
    if b.fixed is not None:
        require(
            "controller.bandwidth.fixed",
            b.fixed,
            b.min <= b.fixed <= b.max,
            f"in [{b.min:g}, {b.max:g}] rad/s, the bandwidth's min and max",
        )


def _check_plant(scenario: Scenario) -> None:
    for name, value in scenario.plant.items():
        low, high = scenario.model.parameter_interval(name)
        tolerance = 1e-9 * max(1.0, abs(low), abs(high))
        require(
            f"plant.{name}",
            value,
            low - tolerance <= value <= high + tolerance,
            f"in [{low:g}, {high:g}], which the model's error bound covers",
        )
    if scenario.planner.uncertainty == "constant":
        try:
            scenario.planning_model()
        except NotImplementedError as error:
            raise ScenarioError(
                "planner.uncertainty", "constant", f"state_dependent: {error}"
            ) from None


def _check_motion(scenario: Scenario) -> None:
    """Speeds, time and initial error."""
    model = scenario.model
    start, goal = scenario.start_state(), scenario.goal_state()
    duration = scenario.duration
    speed = scenario.limits.speeds(start.shape[1])
    given = show(scenario.limits.speed)
    if scenario.model.order > 1:
        ends = {"start": start, "goal": goal}
        if 1 in scenario.soft_derivatives():
            del ends["goal"]
        for end, state in ends.items():
            require(
                f"{end}.velocity",
                state[1],
                bool((np.abs(state[1]) <= speed).all()),
                f"at most limits.speed = {given} {model.derivative_unit(1)} along every"
                " axis",
            )
    shortest = float((np.abs(goal[0] - start[0]) / speed).max())
    require(
        "duration",
        duration,
        duration >= shortest or scenario.goal_is_soft,
        f"at least {shortest:.4g} s: the goal is that far at the speed limit",
    )
    chains = Chains.of(scenario.model)
    s = sliding_variable(scenario.initial_error_state(), scenario.slope(), chains)
    layer = scenario.controller.initial_boundary_layer
    require(
        "initial_error",
        np.abs(s),
        bool((np.abs(s) <= layer).all()),
        f"so small that |s(t0)| is at most the initial boundary layer, {layer:g}"
        f" {joined(model.highest_units(below=1))} (the values are |s(t0)|)",
    )


def _check_clearance(scenario: Scenario) -> None:
    """Both ends, with the smallest tubes that they may have."""
    obstacles, margin = scenario.obstacle_set(), scenario.planner.tube_margin
    unit = scenario.model.length_unit
    error = np.abs(scenario.initial_error_state()[0])
    ends = {
        "start.position": (scenario.start_state()[0], error),
    }
    if not scenario.goal_is_soft:
        goal = scenario.goal_state()[0]
        ends["goal.position"] = goal, smallest_final_tube(scenario)
    for field, (position, tube) in ends.items():
        clearance = obstacles.clearance(position, tube, margin)
        for i in np.flatnonzero(clearance < 0)[:1]:
            raise ScenarioError(
                field,
                position,
                f"outside obstacles[{i}], tube included: it is"
                f" {-clearance[i]:.3g} {unit} too close"
                f" (tube {show(tube.round(3))} {unit})",
            )


def _check_sensing(scenario: Scenario) -> None:
    sensed = scenario.sensing.range
    if sensed is None or not np.isinf(scenario.known_from()).any():
        return
    needed = sensing_range_needed(scenario)
    reason = "to stop at the speed limit before what it senses"
    if math.isinf(needed):
        reason = "but the feedback leaves no input to brake with"
    ok = sensed >= needed
    unit = scenario.model.length_unit
    require("sensing.range", sensed, ok, f"at least {needed:.4g} {unit}, {reason}")


def sensing_range_needed(scenario: Scenario, velocity: Array | None = None) -> float:
    """The range from which the vehicle can stop before any obstacle, in m.

    `dtmpc_drake.method.stopping.range_needed` at the lowest bandwidth.  The delay is
    twice what planning takes (it may just have begun when an obstacle appears), two
    looks of the sensor, and one interval of the plan for every derivative that must
    turn round.

    Args:
        scenario: the whole experiment.
        velocity: of the vehicle, ``(m,)``; if left out, the speed limit along
            all axes that obstacles look at, which no certified flight exceeds.
    """
    if velocity is None:
        along = scenario.limits.speeds(scenario.model.num_outputs)
        velocity = along * scenario.obstacle_set().outputs_seen()
    n, interval = scenario.model.order, scenario.duration / scenario.planner.intervals
    looks = scenario.planning_delay() + scenario.sensing.period
    return range_needed(
        scenario.sliding_law(),
        velocity=velocity,
        bandwidth=scenario.controller.bandwidth.interval()[0],
        layer=scenario.initial_boundary_layer(),
        input_limit=scenario.limits.input,
        delay=2 * looks + n * interval,
    )


# What only some experiments ask.


def require_one_plan(scenario: Scenario) -> None:
    """Refuses what only makes sense with several plans.

    Raises:
        ScenarioError: if `Scenario.is_receding`.
    """
    why = "left out: many trials fly one plan, which knows every obstacle"
    again = scenario.planner.replan_period
    require("planner.replan_period", again, again is None, why)
    for i in np.flatnonzero(~scenario.known_at_start())[:1]:
        since = scenario.obstacles[i].known_from
        if since is None:
            raise ScenarioError("sensing.range", scenario.sensing.range, why)
        raise ScenarioError(f"obstacles[{i}].known_from", since, why)


def require_stable_simulation(scenario: Scenario) -> None:
    """Refuses a step with which the integrator would make a flight diverge.

    Raises:
        ScenarioError: naming ``simulation.max_step_size`` and what is too fast.
    """
    b = scenario.controller.bandwidth
    room = ROOM if scenario.model.error_bound_varies else 1.0
    rates = {
        f"controller.slope[{i}] = {slope:g} 1/s": slope
        for i, slope in enumerate(scenario.controller.slope)
    }
    name, (_, alpha) = "max" if b.fixed is None else "fixed", b.interval()
    rates[f"controller.bandwidth.{name} = {alpha:g} rad/s"] = room * alpha
    own = scenario.disturbance.rates()
    rates |= {f"disturbance.{what}": rate for what, rate in own.items()}
    scheme = scenario.simulation.integration_scheme
    step = scenario.simulation.max_step_size
    longest = longest_stable_step(scheme, rates)
    if longest is not None:
        require(
            "simulation.max_step_size",
            step,
            step <= longest[0],
            f"at most {longest[0]:.4g} s: with {scheme} a longer step makes the"
            f" flight diverge, because of {longest[1]}",
        )


def _waypoint_rows(scenario: Scenario) -> dict[str, list[float]]:
    """All that is given of start, goal and initial error, by its field."""
    return {
        f"{end}.{name}": row
        for end in ENDS
        if (waypoint := getattr(scenario, end)) is not None
        for name in DERIVATIVES
        if (row := getattr(waypoint, name)) is not None
    }


def _integration_schemes() -> tuple[str, ...]:
    from pydrake.systems.analysis import GetIntegrationSchemes

    # CENIC is for multibody plants only.
    return tuple(name for name in GetIntegrationSchemes() if name != "cenic")
