"""A whole experiment as typed dataclasses: fields, and what follows from them alone.

What the fields must say is in `check`, and how they are read and written in `files`.
Units are those of a vehicle in metres; whatever else its model names stands in their
place, and of an output of order n_i the unit of the highest derivative is that / s^n_i.
"""

import dataclasses
import math
from typing import Any

import numpy as np

from dtmpc_drake.costs import Cost, Weight
from dtmpc_drake.disturbances import Disturbance, UniformHold
from dtmpc_drake.limits import InputRange, Limit, NormLimit, PositionLimit
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.models import ConstantUncertainty, DragDoubleIntegrator, Model
from dtmpc_drake.numerics.arrays import Array, BoolArray
from dtmpc_drake.obstacles import Obstacle, ObstacleSet

DERIVATIVES = "position", "velocity", "acceleration"
"""Fields of a `Waypoint` and of `StateWeights`, in order."""
ENDS = "start", "goal", "initial_error"
"""Fields of a `Scenario` that are a `Waypoint`."""


def _three(value: float) -> Any:
    return dataclasses.field(default_factory=lambda: [value] * 3)


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

    def interval(self) -> tuple[float, float]:
        """The lowest and the highest α that there may be, in rad/s; equal if fixed."""
        if self.fixed is not None:
            return self.fixed, self.fixed
        return self.min, self.max


@dataclasses.dataclass
class Controller:
    """The boundary-layer sliding controller.

    Attributes:
        slope: λ of the sliding surface on every output, in 1/s.
        reaching_rate: η, in m/s², one number for all outputs: in the unit of each
            one's own highest derivative.
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
        speed: the bound of the speed along every axis, in m/s; a list gives each axis
            its own.
        position: floor, ceiling and fences.
        inputs: bounds of every input by itself.
        norms: ``‖P z + q‖ <= c`` on outputs, their derivatives and the input.
        own: any others, of registered classes; see `limits.Limit`.
    """

    input: float = 5.0
    speed: float | list[float] = 2.5
    position: PositionLimit | None = None
    inputs: InputRange | None = None
    norms: list[NormLimit] = dataclasses.field(default_factory=list)
    own: list[Limit] = dataclasses.field(default_factory=list)

    @property
    def fastest(self) -> float:
        """The largest bound of the speed along an axis, in m/s."""
        return float(np.max(self.speed))

    def speed_along(self, axis: int) -> float:
        """The bound of the speed along an axis, in m/s."""
        return self.speed[axis] if isinstance(self.speed, list) else self.speed

    def speeds(self, num_outputs: int) -> Array:
        """The bounds along all axes, ``(m,)``, in m/s."""
        return np.broadcast_to(np.asarray(self.speed, dtype=float), num_outputs)

    @property
    def others(self) -> tuple[Limit, ...]:
        """All but the norm of the input and the speed."""
        limits: list[Limit] = [
            each for each in (self.position, self.inputs) if each is not None
        ]
        limits += [norm.limit() for norm in self.norms]
        return (*limits, *self.own)


@dataclasses.dataclass
class Line:
    """A straight line in the space of outputs.

    Attributes:
        point: any point of it, in m.
        direction: of any length but zero.
    """

    point: list[float]
    direction: list[float]


@dataclasses.dataclass
class StateWeights:
    """Weights of how far x* is from the goal, derivative by derivative.

    Each is a number (times the identity), a list (one a output) or a matrix; what is
    left out costs nothing.

    Attributes:
        position: in 1/m².
        velocity: in (s/m)².
        acceleration: in (s²/m)², for models of order three.
    """

    position: Weight = 0.0
    velocity: Weight = 0.0
    acceleration: Weight = 0.0


@dataclasses.dataclass
class RunningStateWeights(StateWeights):
    """The same at all times, from the goal or from a line.

    Attributes:
        line: if given, only what leads away from it costs: of the position its
            distance from the line, of the velocity and the acceleration their parts
            square to it.  To go along the line is free.
    """

    line: Line | None = None


@dataclasses.dataclass
class Costs:
    """Weights of the cost, the paper's Problem 1.

    ``∫ u*'Q u* + α̃'R α̃ + v'R_v v + x̂'Q_x x̂ dt + x̂(t_f)'R_f x̂(t_f)`` with
    α̃ = α - α_min, v = dα/dt and x̂ = x* - x_goal.  Each weight is a number (times the
    identity), a list (one number an input or output) or a symmetric positive
    semi-definite matrix.

    Attributes:
        input: Q.
        bandwidth: R.
        bandwidth_rate: R_v.
        state: Q_x, such as ``{position: 1.0, velocity: 0.1}``; or, for x̂ from a
            line, ``{position: 1.0, line: {point: [0, 0, 1], direction: [0, 1, 0]}}``.
        terminal: R_f, such as ``{position: 2.0}``.  What the goal has no `soft` for
            is met, so that its weight charges nothing.
        own: any others, of registered classes; see `costs.Cost`.
    """

    input: Weight = 2.0
    bandwidth: Weight = 0.1
    bandwidth_rate: Weight = 0.0
    state: RunningStateWeights | None = None
    terminal: StateWeights | None = None
    own: list[Cost] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Waypoint:
    """A state of the reference; derivatives that are left out are zero.

    Attributes:
        position: in m.
        velocity: in m/s.
        acceleration: in m/s², for models of order three.
        soft: of a goal: which of these are no conditions, but only where
            `cost.state` and `cost.terminal` draw to; true for all, or a list of names
            such as ``[velocity]``.  What costs nothing either is free.
    """

    position: list[float] = _three(0.0)
    velocity: list[float] | None = None
    acceleration: list[float] | None = None
    soft: bool | list[str] = False


@dataclasses.dataclass(frozen=True)
class SolverOptions:
    """Tolerances of the search for plans, and how far it looks.

    No certificate depends on any of them.  The defaults suit most problems: lengths and
    speeds are in a problem's own units, in which those of all problems are alike; see
    `method.units`.

    Attributes:
        tolerance: iterations stop when the next one promises less than this part of
            the cost.
        doubt: part of the tolerance that is left where a step was not taken whole.
        accuracy: tolerance of a convex program's duality gap; a fiftieth of it for
            feasibility.
        coarse_accuracy: the same on the coarser grids.
        coarsest: grids are halved for a first solution, down to no fewer intervals.
        coarse_iterations: programs on each of the coarser grids, which only have to
            find the way.
        bandwidth_reserve: by how much the bandwidth stays inside its limits,
            relative.
        sampled_reserve: the same of limits that are looked at on the fine grid: the
            tube's pieces round off the model's kinks.
        convex_reserve: the same of limits on the reference's derivatives: the velocity
            tube is proven with some slack.
        backoff: how much programs ask for beyond every limit, in lengths and in
            limits over their scales, so that an iterate that is feasible to this
            keeps the limit itself.
        sampled_backoff: the same of limits that are looked at between knots, where
            they may peak between the nodes, too.
        penalty: first weight of the slack; raised while a converged plan still needs
            slack.
        max_penalty: largest weight of the slack.
        rigid: a start that violates no more than this is hoped to need no slack.
        rotation: weight of a half-plane's rotation, at least.
        secant: half-width of the differences along the state.  Model
            errors often have a kink at rest; a derivative would not see it, a secant
            does.
        proximity: first weight of the square of the step, at most, after one that
            failed.
        shortest_step: parts of a step below this are not tried.
        max_failures: programs that the solver may fail to solve before the
            iterations end.
        near: part of all reaches near a solution; from a cold start they are whole.
        obstacle_reach: pieces and obstacles further apart have no half-plane.
        obstacle_reach_of_a_step: the same in parts of what the speed limit allows
            between two knots, if that is more.
        convex_reach: control points with more margin than this part of a limit are
            left out of the programs.
        sampled_reach: the same of knots.
        between_reach: the same of nodes between knots.
        bandwidth_reach: bandwidths further above their lower bound, in parts of their
            range, are left to the projection.
        bandwidth_rate_reach: the same of rates below this part of their limit.
    """

    tolerance: float = 0.025
    doubt: float = 0.6
    accuracy: float = 5e-4
    coarse_accuracy: float = 2e-3
    coarsest: int = 12
    coarse_iterations: int = 2
    bandwidth_reserve: float = 2e-3
    sampled_reserve: float = 2e-3
    convex_reserve: float = 1e-3
    backoff: float = 3e-4
    sampled_backoff: float = 1e-3
    penalty: float = 1e3
    max_penalty: float = 1e6
    rigid: float = 1e-2
    rotation: float = 1.0
    secant: float = 0.1
    proximity: float = 0.1
    shortest_step: float = 0.02
    max_failures: int = 3
    near: float = 0.3
    obstacle_reach: float = 0.8
    obstacle_reach_of_a_step: float = 0.32
    convex_reach: float = 0.28
    sampled_reach: float = 0.2
    between_reach: float = 0.06
    bandwidth_reach: float = 0.6
    bandwidth_rate_reach: float = 0.5


BACKENDS = ["clarabel", "ipopt"]
"""What `Planner.backend` may be; `planning.backend.register_backend` adds to it."""


@dataclasses.dataclass
class Planner:
    """How the plan is computed.

    Attributes:
        backend: ``clarabel`` (sequential convex programming), ``ipopt``, or one of
            your own.
        intervals: N, the number of polynomial pieces.
        tube_margin: ``norm`` (the paper's) or ``support`` (tighter).
        velocity_bound: ``comparison`` (tighter) or ``paper``.
        uncertainty: ``state_dependent``, or ``constant`` for the supremum of Δ
            at the speed limit.
        max_iterations: of the sequential convex program.
        initial_guess: ``straight_line`` (the paper's), or ``best_side``, which
            also tries other sides of the obstacles and takes the cheapest plan.
        time_budget: for ``best_side``, in s.  It buys candidates at fixed prices
            (see `planning.search`), so a plan never depends on the clock.  Every plan
            on the way has it, too: `compute_delay` should not be shorter.
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
        options: tolerances and reaches; none of them needs to be looked at.
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
    options: SolverOptions = dataclasses.field(default_factory=SolverOptions)


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
        goal: of the reference, at the end; see `Waypoint.soft`.
        initial_error: of the plant, relative to the start of the reference.
        duration: in s.
        obstacles: any mix of shapes.
        sensing: how the vehicle learns of them.
        planner: how the plan is computed.
        simulation: how the diagram is simulated.
    """

    name: str = "scenario"
    model: Model = dataclasses.field(default_factory=DragDoubleIntegrator)
    plant: dict[str, float] = dataclasses.field(default_factory=dict)
    disturbance: Disturbance = dataclasses.field(default_factory=UniformHold)
    controller: Controller = dataclasses.field(default_factory=Controller)
    limits: Limits = dataclasses.field(default_factory=Limits)
    cost: Costs = dataclasses.field(default_factory=Costs)
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
                model, model.constant_model_error_bound(self.limits.fastest)
            )
        return model

    def obstacle_set(self) -> ObstacleSet:
        """The obstacles as stacked arrays, as they are seen by all outputs."""
        model = self.model
        return ObstacleSet.stack(self.obstacles, model.num_outputs, model.num_positions)

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

    def planning_delay(self) -> float:
        """From a measurement until its plan takes effect, which is at a look, in s."""
        looks = math.ceil(self.planner.compute_delay / self.sensing.period - 1e-9)
        return max(1, looks) * self.sensing.period

    def disturbance_bound(self) -> Array:
        """D, shape ``(m,)``."""
        return np.array(self.disturbance.bound, dtype=float)

    def sliding_law(self) -> SlidingLaw:
        """The controller, with the model that it knows."""
        return SlidingLaw(
            model=self.planning_model(),
            slope=self.slope(),
            disturbance_bound=self.disturbance_bound(),
            reaching_rate=self.controller.reaching_rate,
        )

    def own_units(self) -> Units:
        """In which it is planned and proven."""
        return Units.own(
            speed=self.limits.fastest,
            slope=self.slope(),
            bandwidth=self.controller.bandwidth.interval()[1],
            orders=Chains.of(self.model).orders,
        )

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

    def soft_derivatives(self) -> tuple[int, ...]:
        """Which rows of the goal are no conditions, in order."""
        soft, rows = self.goal.soft, range(self.model.order)
        if isinstance(soft, bool):
            return tuple(rows) if soft else ()
        names = [*DERIVATIVES]
        return tuple(k for k in rows if k < len(names) and names[k] in soft)

    @property
    def goal_is_soft(self) -> bool:
        """Whether a plan need not end at the goal's position."""
        return 0 in self.soft_derivatives()

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
        rows = [getattr(waypoint, name) for name in DERIVATIVES]
        state = np.zeros((self.model.order, self.model.num_outputs))
        for k, row in enumerate(rows[: self.model.order]):
            if row is not None:
                state[k] = row
        return state

    def __repr__(self) -> str:
        """Names what a reader wants to know first."""
        return (
            f"Scenario({self.name!r}: {type(self.model).__name__}, "
            f"{len(self.obstacles)} obstacles, {self.duration:g} s, "
            f"{type(self.disturbance).__name__} disturbance, "
            f"{self.planner.backend} with {self.planner.intervals} intervals)"
        )
