"""A whole experiment as typed dataclasses."""

import dataclasses
import math
import typing
from numbers import Integral
from typing import Any, Union

import numpy as np
from pydrake.common.yaml import yaml_dump_typed

from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.method.stability import ROOM, longest_stable_step
from dtmpc_drake.method.stopping import range_needed
from dtmpc_drake.method.tube import propagate
from dtmpc_drake.models import (
    ConstantUncertainty,
    DragDoubleIntegrator,
    IntegratorChain,
    Model,
)
from dtmpc_drake.numerics.arrays import Array, BoolArray
from dtmpc_drake.obstacles import Obstacle, ObstacleSet
from dtmpc_drake.obstacles.base import KINDS
from dtmpc_drake.obstacles.ellipsoids import Ball
from dtmpc_drake.scenario.error import ScenarioError
from dtmpc_drake.scenario.error import require as _require
from dtmpc_drake.scenario.error import show as _show
from dtmpc_drake.scenario.ranges import require_magnitudes, require_positive
from dtmpc_drake.scenario.size import require_affordable, require_trials
from dtmpc_drake.scenario.typed import typed

# Drake's YAML reads tagged unions of the old spelling only.
ModelConfig = Union[DragDoubleIntegrator, IntegratorChain]  # noqa: UP007


def _three(value: float) -> Any:
    return dataclasses.field(default_factory=lambda: [value] * 3)


@dataclasses.dataclass
class UniformHold:
    """A disturbance drawn uniformly from its bounds, held, and redrawn.

    Attributes:
        bound: D on every output, in m/s².
        hold: how long a value is kept, in s.
    """

    bound: list[float] = _three(0.5)
    hold: float = 0.05


@dataclasses.dataclass
class Constant:
    """A constant disturbance at a fraction of the bound.

    Attributes:
        bound: D on every output, in m/s².
        fraction: of the bound, in [-1, 1].
    """

    bound: list[float] = _three(0.5)
    fraction: float = 1.0


@dataclasses.dataclass
class BangBang:
    """A disturbance that jumps between -D and D at random.

    Attributes:
        bound: D on every output, in m/s².
        hold: how long a sign is kept, in s.
    """

    bound: list[float] = _three(0.5)
    hold: float = 0.5


@dataclasses.dataclass
class WorstCase:
    """A disturbance that pushes away from the plan with all that is allowed.

    It pushes along the sliding variable; where there is no error yet, the seed
    decides to which side of every output.  With `hold` it pushes every output to a
    side that the seed decides, and at random times to the opposite one.

    Attributes:
        bound: D on every output, in m/s².
        hold: the mean time between two reversals of the push on an output, in s;
            if left out, it follows the sliding variable.
        model_error: whether the model error is at a bound, too: ±Δ(x), on the side
            of the push, instead of what the plant's true parameters make of it.
            With `hold` the two are now and then apart.
    """

    bound: list[float] = _three(0.5)
    hold: float | None = None
    model_error: bool = False


@dataclasses.dataclass
class ColoredWind:
    """Filtered white noise, clipped to the bound.

    Attributes:
        bound: D on every output, in m/s².
        correlation_time: of the first-order filter, in s.
        intensity: standard deviation before clipping, as a fraction of D.
    """

    bound: list[float] = _three(0.5)
    correlation_time: float = 0.5
    intensity: float = 0.5


@dataclasses.dataclass
class Gust:
    """A disturbance that pushes all outputs in one direction, for long.

    Each is as strong as the bounds allow: one half of the time at a corner of the
    box abs(d) <= D, and else anywhere on its surface.

    Attributes:
        bound: D on every output, in m/s².
        hold: how long a direction is kept, in s; long compared with 1/λ and 1/α.
        model_error: whether the model error is Δ(x) in the same direction, instead
            of what the plant's true parameters make of it.
    """

    bound: list[float] = _three(0.5)
    hold: float = 4.0
    model_error: bool = False


Disturbance = Union[  # noqa: UP007
    UniformHold, Constant, BangBang, WorstCase, ColoredWind, Gust
]


@dataclasses.dataclass
class Bandwidth:
    """The control bandwidth α.

    Attributes:
        min: in rad/s.
        max: in rad/s.
        rate_max: the bound of abs(dα/dt), in rad/s².
        fixed: if given, α is this constant instead of a decision, in rad/s.
    """

    min: float = 0.5
    max: float = 4.0
    rate_max: float = 2.0
    fixed: float | None = None


@dataclasses.dataclass
class Controller:
    """The boundary-layer sliding controller.

    Attributes:
        slope: λ of the sliding surface on every output, in 1/s.
        reaching_rate: η, in m/s².
        initial_boundary_layer: Φ(t0), in m/s.
        bandwidth: bounds of α.
    """

    slope: list[float] = _three(2.0)
    reaching_rate: float = 0.1
    initial_boundary_layer: float = 0.3
    bandwidth: Bandwidth = dataclasses.field(default_factory=Bandwidth)


@dataclasses.dataclass
class Limits:
    """What the vehicle may do.

    Attributes:
        input: u_m, the bound of the norm of u, in m/s².
        speed: the bound of the speed along every axis, in m/s.
    """

    input: float = 5.0
    speed: float = 2.5


@dataclasses.dataclass
class Cost:
    """Weights of the running cost uᵀQu + α̃ᵀRα̃ with α̃ = α - α_min.

    Attributes:
        input: Q, times the identity.
        bandwidth: R, times the identity.
    """

    input: float = 2.0
    bandwidth: float = 0.1


@dataclasses.dataclass
class Waypoint:
    """A state of the reference; derivatives that are left out are zero.

    Attributes:
        position: in m.
        velocity: in m/s.
        acceleration: in m/s², for models of order three.
    """

    position: list[float] = _three(0.0)
    velocity: list[float] | None = None
    acceleration: list[float] | None = None


@dataclasses.dataclass
class Planner:
    """How the plan is computed.

    Attributes:
        backend: ``clarabel`` (sequential convex programming) or ``ipopt``.
        intervals: N, the number of polynomial pieces.
        tube_margin: ``norm`` (the paper's) or ``support`` (tighter).
        velocity_bound: ``comparison`` (tighter) or ``paper``.
        uncertainty: ``state_dependent``, or ``constant`` for the supremum of Δ
            at the speed limit.
        max_iterations: of the sequential convex program.
        initial_guess: ``straight_line`` (the paper's), or ``best_side``, which
            also tries other sides of the obstacles and takes the cheapest plan.
        time_budget: for ``best_side``, in s.  It buys candidates at fixed prices
            (see `planning.best_side`), so a plan never depends on the clock.  Every
            plan on the way has it, too: `compute_delay` should not be shorter.
        time_limit: in s by the clock on the wall, for each plan and for each time
            that is planned on the way.  What is best until then is judged as it is.
            Only a plan that takes longer depends on the clock.
        replan_period: between two plans, in s; if left out, there is a new plan
            only where a new obstacle is known.
        compute_delay: from a measurement until the plan that is made from it
            takes effect, in s.  The default is the longest that was measured without
            a search for sides, which is 0.13 s of processor time for a stop (0.08 s
            for a plan around a new obstacle, 0.02 s for the next plan of a period,
            certificate included), and half as much again.
    """

    backend: str = "clarabel"
    intervals: int = 56
    tube_margin: str = "norm"
    velocity_bound: str = "comparison"
    uncertainty: str = "state_dependent"
    max_iterations: int = 40
    initial_guess: str = "straight_line"
    time_budget: float = 2.0
    time_limit: float = 30.0
    replan_period: float | None = None
    compute_delay: float = 0.2


@dataclasses.dataclass
class Sensing:
    """How the vehicle learns of obstacles.

    Attributes:
        range: how near an obstacle's surface must come to be known, in m; if left
            out, all are known, each from its `known_from` on.
        period: between two looks of the sensor and of the planner, in s.
    """

    range: float | None = None
    period: float = 0.02


@dataclasses.dataclass
class Simulation:
    """How the diagram is simulated.

    Attributes:
        integration_scheme: a name that Drake's ``SimulatorConfig`` takes.
        max_step_size: of every step, in s; what happens at fixed times, such as
            a new value of the disturbance, shortens one.
        seed: of everything random.
        log_period: between two samples of a flight's log, in s: they are at the ends
            of steps, and so no more frequent than these.  Of many flights samples are
            kept at least 0.05 s apart.  Extremes and verdicts are those of every
            step, and no flight depends on the period.
    """

    integration_scheme: str = "runge_kutta3"
    max_step_size: float = 0.01
    seed: int = 0
    log_period: float = 0.01


@dataclasses.dataclass
class Scenario:
    """A whole experiment.

    Attributes:
        name: also the name of the output directory.
        model: what the planner and the controller know.
        plant: parameters of the true plant, by name; those left out are at the
            middle of what the model allows.
        disturbance: what acts on the plant, and its bound D.
        controller: the sliding controller.
        limits: of input and speed.
        cost: weights.
        start: of the reference.
        goal: of the reference, at the end.
        initial_error: of the plant, relative to the start of the reference.
        duration: in s.
        obstacles: any mix of shapes.
        sensing: how the vehicle learns of them.
        planner: how the plan is computed.
        simulation: how the diagram is simulated.
    """

    name: str = "scenario"
    model: ModelConfig = dataclasses.field(default_factory=DragDoubleIntegrator)
    plant: dict[str, float] = dataclasses.field(default_factory=dict)
    disturbance: Disturbance = dataclasses.field(default_factory=UniformHold)
    controller: Controller = dataclasses.field(default_factory=Controller)
    limits: Limits = dataclasses.field(default_factory=Limits)
    cost: Cost = dataclasses.field(default_factory=Cost)
    start: Waypoint = dataclasses.field(default_factory=Waypoint)
    goal: Waypoint = dataclasses.field(
        default_factory=lambda: Waypoint(position=[0.0, 10.0, 0.0])
    )
    initial_error: Waypoint | None = None
    duration: float = 10.0
    obstacles: list[Obstacle] = dataclasses.field(default_factory=list)
    sensing: Sensing = dataclasses.field(default_factory=Sensing)
    planner: Planner = dataclasses.field(default_factory=Planner)
    simulation: Simulation = dataclasses.field(default_factory=Simulation)

    # What the mathematics wants, derived from the fields.

    def planning_model(self) -> Model:
        """The model as the planner and the controller use it."""
        model: Model = self.model
        if self.planner.uncertainty == "constant":
            return ConstantUncertainty(
                model, model.constant_model_error_bound(self.limits.speed)
            )
        return model

    def obstacle_set(self) -> ObstacleSet:
        """The obstacles as stacked arrays."""
        return ObstacleSet.stack(self.obstacles, self.model.num_outputs)

    def known_from(self) -> Array:
        """When each obstacle is known whatever the sensor sees, ``(o,)``, in s."""
        unseen = 0.0 if self.sensing.range is None else math.inf
        times = [o.known_from for o in self.obstacles]
        return np.array([unseen if t is None else t for t in times], dtype=float)

    def visible_obstacles(self, time: float, position: Array) -> BoolArray:
        """Which obstacles can be known at a time and a place, ``(o,)``."""
        return self.obstacle_set().visible(
            known_from=self.known_from(),
            sensing_range=self.sensing.range or 0.0,
            time=time,
            position=position,
        )

    def known_at_start(self) -> BoolArray:
        """Which obstacles the first plan knows, ``(o,)``."""
        position = self.start_state()[0] + self.initial_error_state()[0]
        return self.visible_obstacles(0.0, position)

    @property
    def is_receding(self) -> bool:
        """Whether there may be more plans than one."""
        always = bool(self.known_at_start().all())
        return self.planner.replan_period is not None or not always

    def require_one_plan(self) -> None:
        """Refuses what only makes sense with several plans.

        Raises:
            ScenarioError: if `is_receding`.
        """
        why = "left out: many trials fly one plan, which knows every obstacle"
        again = self.planner.replan_period
        _require("planner.replan_period", again, again is None, why)
        for i in np.flatnonzero(~self.known_at_start())[:1]:
            since = self.obstacles[i].known_from
            if since is None:
                raise ScenarioError("sensing.range", self.sensing.range, why)
            raise ScenarioError(f"obstacles[{i}].known_from", since, why)

    def require_trials(self, count: int, batch_size: int = 250) -> None:
        """Refuses more flights than there is memory and time for.

        Args:
            count: of flights through one disturbance.
            batch_size: flights side by side in one diagram.

        Raises:
            ScenarioError: naming ``trials`` or ``batch-size``.
        """
        require_trials(self, count, batch_size)

    def require_stable_simulation(self) -> None:
        """Refuses a step with which the integrator would make a flight diverge.

        Raises:
            ScenarioError: naming ``simulation.max_step_size`` and what is too fast.
        """
        b, disturbance = self.controller.bandwidth, self.disturbance
        room = ROOM if self.model.error_bound_varies else 1.0
        rates = {
            f"controller.slope[{i}] = {slope:g} 1/s": slope
            for i, slope in enumerate(self.controller.slope)
        }
        fixed = b.fixed is not None
        name = f"controller.bandwidth.{'fixed' if fixed else 'max'}"
        alpha = b.max if b.fixed is None else b.fixed
        rates[f"{name} = {alpha:g} rad/s"] = room * alpha
        if isinstance(disturbance, ColoredWind):
            tau = disturbance.correlation_time
            rates[f"disturbance.correlation_time = {tau:g} s"] = 1 / tau
        scheme, step = self.simulation.integration_scheme, self.simulation.max_step_size
        longest = longest_stable_step(scheme, rates)
        if longest is not None:
            _require(
                "simulation.max_step_size",
                step,
                step <= longest[0],
                f"at most {longest[0]:.4g} s: with {scheme} a longer step makes the"
                f" flight diverge, because of {longest[1]}",
            )

    def planning_delay(self) -> float:
        """From a measurement until its plan takes effect, which is at a look, in s."""
        looks = math.ceil(self.planner.compute_delay / self.sensing.period - 1e-9)
        return max(1, looks) * self.sensing.period

    def sensing_range_needed(self, velocity: Array | None = None) -> float:
        """The range from which the vehicle can stop before any obstacle, in m.

        `dtmpc_drake.sensing.range_needed` at the lowest bandwidth.  The delay is
        twice what planning takes (it may just have begun when an obstacle
        appears), two looks of the sensor, and one interval of the plan for every
        derivative that must turn round.

        Args:
            velocity: of the vehicle, ``(m,)``; if left out, the speed limit along
                all axes that obstacles look at, which no certified flight exceeds.
        """
        if velocity is None:
            velocity = self.limits.speed * self.obstacle_set().outputs_seen()
        bandwidth, n = self.controller.bandwidth, self.model.order
        interval = self.duration / self.planner.intervals
        return range_needed(
            model=self.planning_model(),
            velocity=velocity,
            bandwidth=bandwidth.fixed or bandwidth.min,
            slope=self.slope(),
            disturbance_bound=self.disturbance_bound(),
            reaching_rate=self.controller.reaching_rate,
            initial_boundary_layer=self.initial_boundary_layer(),
            input_limit=self.limits.input,
            delay=2 * (self.planning_delay() + self.sensing.period) + n * interval,
        )

    def disturbance_bound(self) -> Array:
        """D, shape ``(m,)``."""
        return np.array(self.disturbance.bound, dtype=float)

    def slope(self) -> Array:
        """λ, shape ``(m,)``."""
        return np.array(self.controller.slope, dtype=float)

    def initial_boundary_layer(self) -> Array:
        """Φ(t0), shape ``(m,)``."""
        return np.full(self.model.num_outputs, self.controller.initial_boundary_layer)

    def start_state(self) -> Array:
        """x*(t0), shape ``(n, m)``."""
        return self._state(self.start)

    def goal_state(self) -> Array:
        """x*(t_f), shape ``(n, m)``."""
        return self._state(self.goal)

    def initial_error_state(self) -> Array:
        """x̃(t0), shape ``(n, m)``."""
        if self.initial_error is None:
            return np.zeros((self.model.order, self.model.num_outputs))
        return self._state(self.initial_error)

    def plant_parameters(self) -> dict[str, float]:
        """Every parameter of the true plant."""
        middle = {
            name: sum(self.model.parameter_interval(name)) / 2
            for name in self.model.parameter_names
        }
        return middle | self.plant

    def _state(self, waypoint: Waypoint) -> Array:
        rows = [waypoint.position, waypoint.velocity, waypoint.acceleration]
        state = np.zeros((self.model.order, self.model.num_outputs))
        for k, row in enumerate(rows[: self.model.order]):
            if row is not None:
                state[k] = row
        return state

    # Validation.

    def validate(self) -> None:
        """Checks every field and what they say together.

        Raises:
            ScenarioError: at the first thing that is wrong.
        """
        self._check_types()
        require_magnitudes(self)
        self._check_sizes()
        self._check_ranges()
        require_affordable(self)
        self._check_together()

    def _check_types(self) -> None:
        ok, name = isinstance(self.model, Model), type(self.model).__name__
        _require("model", name, ok, "a Model of dtmpc_drake.models")
        # Of a model of one's own nobody knows the fields.
        own = type(self.model) not in typing.get_args(ModelConfig)
        known = DragDoubleIntegrator() if own else self.model
        typed(Scenario, dataclasses.replace(self, model=known), "")

    def _check_sizes(self) -> None:
        for name in ("num_outputs", "order"):
            size = getattr(self.model, name, None)
            whole = isinstance(size, Integral) and not isinstance(size, bool)
            _require(f"model.{name}", size, whole, "a whole number")
        m, n = self.model.num_outputs, self.model.order
        _require("model.num_outputs", m, 1 <= m <= 1000, "at least 1, at most 1000")
        _require("model.order", n, 1 <= n <= 10, "in [1, 10]")
        lists = {
            "disturbance.bound": self.disturbance.bound,
            "controller.slope": self.controller.slope,
        }
        for end in ("start", "goal", "initial_error"):
            waypoint = getattr(self, end)
            if waypoint is None:
                continue
            for k, field in enumerate(("position", "velocity", "acceleration")):
                row = getattr(waypoint, field)
                if row is None:
                    continue
                _require(
                    f"{end}.{field}",
                    row,
                    k < n,
                    f"left out: the model is of order {n}",
                )
                lists[f"{end}.{field}"] = row
        for i, obstacle in enumerate(self.obstacles):
            for fault in obstacle.faults(m):
                field = f"obstacles[{i}].{fault.field}"
                _require(field, fault.value, False, fault.allowed)
        for field, value in lists.items():
            _require(field, value, len(value) == m, f"{m} numbers, one for each output")

    def _check_ranges(self) -> None:
        c, b = self.controller, self.controller.bandwidth
        positive = {
            "duration": (self.duration, "s"),
            "limits.input": (self.limits.input, "m/s²"),
            "limits.speed": (self.limits.speed, "m/s"),
            "controller.reaching_rate": (c.reaching_rate, "m/s²"),
            "controller.initial_boundary_layer": (c.initial_boundary_layer, "m/s"),
            "controller.bandwidth.min": (b.min, "rad/s"),
            "controller.bandwidth.rate_max": (b.rate_max, "rad/s²"),
            "simulation.max_step_size": (self.simulation.max_step_size, "s"),
            "simulation.log_period": (self.simulation.log_period, "s"),
            "planner.time_budget": (self.planner.time_budget, "s"),
            "planner.time_limit": (self.planner.time_limit, "s"),
            "sensing.period": (self.sensing.period, "s"),
        }
        if self.sensing.range is not None:
            positive["sensing.range"] = (self.sensing.range, "m")
        for i, slope in enumerate(c.slope):
            positive[f"controller.slope[{i}]"] = (slope, "1/s")
        for i, obstacle in enumerate(self.obstacles):
            if isinstance(obstacle, Ball):
                positive[f"obstacles[{i}].radius"] = (obstacle.radius, "m")
        for name in ("hold", "correlation_time"):
            seconds = getattr(self.disturbance, name, None)
            if seconds is not None:
                positive[f"disturbance.{name}"] = (seconds, "s")
        for field, (value, unit) in positive.items():
            require_positive(field, value, unit)
        for i, obstacle in enumerate(self.obstacles):
            since, field = obstacle.known_from or 0.0, f"obstacles[{i}].known_from"
            ok = 0 <= since < self.duration
            _require(field, since, ok, f"in [0, duration = {self.duration:g}) s")
        delay, again = self.planner.compute_delay, self.planner.replan_period
        _require("planner.compute_delay", delay, delay >= 0, "at least 0 s")
        if again is not None:
            shortest = max(delay, self.sensing.period)
            _require(
                "planner.replan_period",
                again,
                again >= shortest,
                f"at least {shortest:g} s, which planner.compute_delay and"
                " sensing.period need",
            )
        for i, bound in enumerate(self.disturbance.bound):
            field = f"disturbance.bound[{i}]"
            _require(field, bound, bound >= 0, "at least 0 m/s²")
        if isinstance(self.disturbance, Constant):
            f = self.disturbance.fraction
            _require("disturbance.fraction", f, abs(f) <= 1, "in [-1, 1]")
        if isinstance(self.disturbance, ColoredWind):
            f = self.disturbance.intensity
            _require("disturbance.intensity", f, f >= 0, "at least 0")
        for name in ("input", "bandwidth"):
            weight = getattr(self.cost, name)
            _require(f"cost.{name}", weight, weight >= 0, "at least 0")
        for name in ("drag_estimate", "drag_error_bound", "error_bound"):
            value = getattr(self.model, name, 0.0)
            _require(f"model.{name}", value, value >= 0, "at least 0")
        seed = self.simulation.seed
        _require("simulation.seed", seed, 0 <= seed < 2**32, "in [0, 2^32)")
        N = self.planner.intervals
        low = 2 * self.model.order + 2
        _require(
            "planner.intervals", N, low <= N <= 1000, f"a whole number in [{low}, 1000]"
        )
        iterations = self.planner.max_iterations
        ok = 1 <= iterations <= 10_000
        _require("planner.max_iterations", iterations, ok, "at least 1, at most 10000")
        choices = {
            "planner.backend": ("clarabel", "ipopt"),
            "planner.tube_margin": ("norm", "support"),
            "planner.velocity_bound": ("comparison", "paper"),
            "planner.uncertainty": ("state_dependent", "constant"),
            "planner.initial_guess": ("straight_line", "best_side"),
            "simulation.integration_scheme": _integration_schemes(),
        }
        for field, allowed in choices.items():
            section, name = field.split(".")
            value = getattr(getattr(self, section), name)
            _require(field, value, value in allowed, "one of " + ", ".join(allowed))
        name_ok = self.name.isprintable() and not set(self.name) & set("/\\")
        name_ok = name_ok and self.name not in ("", ".", "..")
        name_ok = name_ok and len(self.name.encode()) <= 200
        _require(
            "name",
            self.name,
            name_ok,
            "a file name of at most 200 bytes, without slashes",
        )
        for name in self.plant:
            names = ", ".join(self.model.parameter_names) or "nothing"
            known = name in self.model.parameter_names
            _require(f"plant.{name}", self.plant[name], known, f"one of: {names}")

    def _check_together(self) -> None:
        b, speed = self.controller.bandwidth, self.limits.speed
        _require(
            "controller.bandwidth.min",
            b.min,
            b.min <= b.max,
            f"at most controller.bandwidth.max = {b.max:g} rad/s",
        )
        if b.fixed is not None:
            _require(
                "controller.bandwidth.fixed",
                b.fixed,
                b.min <= b.fixed <= b.max,
                f"in [{b.min:g}, {b.max:g}] rad/s, the bandwidth's min and max",
            )
        for name, value in self.plant.items():
            low, high = self.model.parameter_interval(name)
            tolerance = 1e-9 * max(1.0, abs(low), abs(high))
            _require(
                f"plant.{name}",
                value,
                low - tolerance <= value <= high + tolerance,
                f"in [{low:g}, {high:g}], which the model's error bound covers",
            )
        if self.planner.uncertainty == "constant":
            try:
                self.planning_model()
            except NotImplementedError as error:
                raise ScenarioError(
                    "planner.uncertainty", "constant", f"state_dependent: {error}"
                ) from None
        start, goal = self.start_state(), self.goal_state()
        if self.model.order > 1:
            for end, state in (("start", start), ("goal", goal)):
                _require(
                    f"{end}.velocity",
                    state[1],
                    bool((np.abs(state[1]) <= speed).all()),
                    f"at most limits.speed = {speed:g} m/s along every axis",
                )
        shortest = float(np.abs(goal[0] - start[0]).max()) / speed
        _require(
            "duration",
            self.duration,
            self.duration >= shortest,
            f"at least {shortest:.4g} s: the goal is that far at the speed limit",
        )
        s = sliding_variable(self.initial_error_state(), self.slope())
        layer = self.controller.initial_boundary_layer
        _require(
            "initial_error",
            np.abs(s),
            bool((np.abs(s) <= layer).all()),
            f"so small that |s(t0)| is at most the initial boundary layer, {layer:g}"
            " m/s (the values are |s(t0)|)",
        )
        obstacles = self.obstacle_set()
        ends = {
            "start.position": (start[0], np.abs(self.initial_error_state()[0])),
            "goal.position": (goal[0], self._smallest_final_tube()),
        }
        for field, (position, tube) in ends.items():
            clearance = obstacles.clearance(position, tube, self.planner.tube_margin)
            for i in np.flatnonzero(clearance < 0)[:1]:
                _require(
                    field,
                    position,
                    False,
                    f"outside obstacles[{i}], tube included: it is"
                    f" {-clearance[i]:.3g} m too close (tube {_show(tube.round(3))} m)",
                )
        if self.sensing.range is not None and np.isinf(self.known_from()).any():
            needed = self.sensing_range_needed()
            reason = "to stop at the speed limit before what it senses"
            if math.isinf(needed):
                reason = "but the feedback leaves no input to brake with"
            _require(
                "sensing.range",
                self.sensing.range,
                self.sensing.range >= needed,
                f"at least {needed:.4g} m, {reason}",
            )

    def _smallest_final_tube(self) -> Array:
        """Ω(t_f) at the highest bandwidth and without model error.

        No plan has a smaller one.
        """
        b = self.controller.bandwidth
        m, n, alpha = self.model.num_outputs, self.model.order, b.fixed or b.max
        # After ten time constants nothing is left of the start.
        rates = [*self.controller.slope, alpha]
        span = min(self.duration, 10 * n / min(rates))
        half = 2 * int(np.clip(span * max(rates), 200, 2000)) + 1
        tube = propagate(
            model=IntegratorChain(m, n, 0.0),
            reference=np.zeros((half, n, m)),
            bandwidth=np.full((half, m), alpha),
            slope=self.slope(),
            disturbance_bound=self.disturbance_bound(),
            reaching_rate=self.controller.reaching_rate,
            initial_boundary_layer=self.initial_boundary_layer(),
            initial_error=self.initial_error_state(),
            velocity_bound="paper",
            step=2 * span / (half - 1),
        )
        return np.asarray(tube.error_bound[-1, 0])

    def to_yaml(self) -> str:
        """The scenario as a file that `load_scenario` reads.

        Raises:
            ScenarioError: if something is of a type that no file can name, such as
                a model of your own: it would be written as a similar one.
        """
        self._check_types()
        # Drake's writer wants to be told every kind of obstacle.
        anything: Any = Union.__getitem__(tuple(KINDS))
        kinds: dict[str, Any] = {"obstacles": list[anything]}
        fields = dataclasses.fields(Scenario)
        schema = dataclasses.make_dataclass(
            "Scenario", [(f.name, kinds.get(f.name, f.type)) for f in fields]
        )
        return str(yaml_dump_typed(typed(Scenario, self, ""), schema=schema))

    def __repr__(self) -> str:
        """Names what a reader wants to know first."""
        return (
            f"Scenario({self.name!r}: {type(self.model).__name__}, "
            f"{len(self.obstacles)} obstacles, {self.duration:g} s, "
            f"{type(self.disturbance).__name__} disturbance, "
            f"{self.planner.backend} with {self.planner.intervals} intervals)"
        )


def _integration_schemes() -> tuple[str, ...]:
    from pydrake.systems.analysis import GetIntegrationSchemes

    # CENIC is for multibody plants only.
    return tuple(name for name in GetIntegrationSchemes() if name != "cenic")
