"""The closed loop: planner, tracker, plant, disturbance and monitor, wired.

    known = sensor(state)             if not all obstacles are known from the start
    plan = planner(scenario)          when the simulation starts, and then, if asked
                                      for, planner(state, known) on the way
    control, reference = tracker(state, plan)
    state = plant(control, disturbance)

This is the one place where the wiring is written.
"""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus

from diagrams.live_view import LiveView
from diagrams.saved_log import check_arrays, read_array, read_replans, read_status
from dtmpc_drake import verdict
from dtmpc_drake.models import Array
from dtmpc_drake.monte_carlo import Flights, Recorder, Trial
from dtmpc_drake.plan import DAMAGE, Plan
from dtmpc_drake.replan import Replan, flown_plan
from dtmpc_drake.sampling import samples, step_times
from dtmpc_drake.scenario import Scenario
from dtmpc_drake.systems import (
    DtmpcPlanner,
    MakeDisturbance,
    ObstacleSensor,
    Plant,
    SeedTrials,
    SlidingModeTracker,
    TubeMonitor,
)

_LOGGED = (
    "state",
    "control",
    "reference",
    "disturbance",
    "tube_ratios",
    "clearance",
)
_OF_EACH_TRIAL = [name for name in _LOGGED if name != "reference"]


def MakeClosedLoop(
    scenario: Scenario,
    *,
    plan: Plan | None = None,
    trials: Sequence[Trial] | None = None,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """The diagram of a scenario.

    Args:
        scenario: the whole experiment; the diagram's default Context is its
            start (apart from randomness, which `SetRandomContext` seeds).
        plan: to fly instead of planning at the start.
        trials: to fly a plan many times side by side, each with its own true
            parameters; `state`, `control`, `disturbance`, `tube_ratios` and
            `clearance` then have one more axis in front.
        meshcat: to watch the simulation of a single flight in, if given.

    Returns:
        A diagram named ``closed_loop`` that exports the output ports `state`,
        `control`, `reference`, `plan`, `status`, `disturbance`, `tube_ratios`,
        `clearance`, `quantities` and `record`; if there may be more plans than one,
        `known_since` and `replans`, too; if the disturbance chooses it,
        `model_error`.  See the systems for their meaning.

    Raises:
        ValueError: if trials come without a plan or with a Meshcat, or with a
            scenario that asks for plans on the way.
    """
    model = scenario.model
    parameters: dict[str, Any] = dict(scenario.plant_parameters())
    initial_error = scenario.initial_error_state()
    count = disturbances = None
    if trials is not None:
        if plan is None or meshcat is not None:
            raise ValueError("trials: they fly a given plan, and are not shown")
        scenario.require_one_plan()
        count = len(trials)
        for name in parameters:
            parameters[name] = [trial.parameters[name] for trial in trials]
        own = [trial.scenario(scenario) for trial in trials]
        initial_error = np.stack([one.initial_error_state() for one in own])
        disturbances = [one.disturbance for one in own]
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem(
        "plant",
        Plant(
            model=model,
            parameters=parameters,
            initial_state=scenario.start_state() + initial_error,
            trials=count,
        ),
    )
    planner = builder.AddNamedSystem(
        "planner", DtmpcPlanner(scenario=scenario, plan=plan)
    )
    tracker = builder.AddNamedSystem(
        "tracker", SlidingModeTracker(scenario=scenario, trials=count)
    )
    disturbance = builder.AddNamedSystem(
        "disturbance",
        MakeDisturbance(
            scenario.disturbance,
            model=model,
            slope=scenario.slope(),
            trials=disturbances,
            duration=scenario.duration,
        ),
    )
    outputs = {
        "state": plant.GetOutputPort("state"),
        "control": tracker.GetOutputPort("control"),
        "reference": tracker.GetOutputPort("reference"),
        "plan": planner.GetOutputPort("plan"),
        "status": planner.GetOutputPort("status"),
        "disturbance": disturbance.GetOutputPort("disturbance"),
    }
    monitor = TubeMonitor.AddToBuilder(
        builder=builder,
        scenario=scenario,
        state=outputs["state"],
        plan=outputs["plan"],
        control=outputs["control"],
        trials=count,
    )
    for name in ("tube_ratios", "clearance", "quantities", "record"):
        outputs[name] = monitor.GetOutputPort(name)

    if trials is None:
        builder.Connect(outputs["state"], planner.GetInputPort("state"))
        if scenario.is_receding:
            sensor = builder.AddNamedSystem(
                "obstacle_sensor", ObstacleSensor(scenario=scenario)
            )
            builder.Connect(outputs["state"], sensor.GetInputPort("state"))
            measured = sensor.GetOutputPort("measured_obstacles")
            builder.Connect(measured, planner.GetInputPort("measured_obstacles"))
            outputs["known_since"] = sensor.GetOutputPort("known_since")
            outputs["replans"] = planner.GetOutputPort("replans")
    builder.Connect(outputs["state"], tracker.GetInputPort("state"))
    builder.Connect(outputs["plan"], tracker.GetInputPort("plan"))
    builder.Connect(outputs["control"], plant.GetInputPort("control"))
    builder.Connect(outputs["disturbance"], plant.GetInputPort("disturbance"))
    if disturbance.HasOutputPort("model_error"):
        outputs["model_error"] = disturbance.GetOutputPort("model_error")
        builder.Connect(outputs["model_error"], plant.GetInputPort("model_error"))
    for name in ("state", "reference"):  # only the hardest look at them
        if disturbance.HasInputPort(name):
            builder.Connect(outputs[name], disturbance.GetInputPort(name))
    if meshcat is not None:
        view = LiveView(scenario=scenario, meshcat=meshcat)
        builder.AddNamedSystem("live_view", view)
        for name in ("state", "plan"):
            builder.Connect(outputs[name], view.GetInputPort(name))
    for name, port in outputs.items():
        builder.ExportOutput(port, name)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return diagram


@dataclasses.dataclass(frozen=True, repr=False)
class Log:
    """What the exported ports said, once in every `log_period` and at the end.

    Only `record` looks more often: at every step of the integrator.

    The log of many trials has an axis for them after the time, except in
    `reference`, which they share.

    Attributes:
        time: ``(K,)``, in s.
        state: x of the plant, ``(K, n, m)``.
        control: u, ``(K, m)``.
        reference: y* and its derivatives, ``(K, n + 1, m)``.
        disturbance: d, ``(K, m)``.
        tube_ratios: |s|/Φ, |ỹ|/Ω and |dỹ/dt|/W, ``(K, 3, m)``.
        clearance: to each obstacle, ``(K, obstacles)`` in m; one column of
            infinities without obstacles.
        record: of `dtmpc_drake.verdict`, ``(6, 7)``: the worst of everything that was
            seen at any step of the integrator, and what broke first.
        status: of the planner at the end.
        known_since: when each obstacle became known, ``(obstacles,)`` in s;
            infinite where it never was.
        replans: every time that was planned on the way, the start included; none
            if there could only be one plan.
    """

    time: Array
    state: Array
    control: Array
    reference: Array
    disturbance: Array
    tube_ratios: Array
    clearance: Array
    record: Array
    status: str
    known_since: Array
    replans: tuple[Replan, ...] = ()

    __hash__: ClassVar[None]  # type: ignore[assignment]

    @property
    def position(self) -> Array:
        """Where the plant was, ``(K, m)``."""
        return np.asarray(self.state[..., 0, :])

    def trial(self, row: int) -> Log:
        """The log of one of many trials."""
        names = (*_OF_EACH_TRIAL, "record")
        own = {name: getattr(self, name)[:, row] for name in names}
        return dataclasses.replace(self, **own)

    def extremes(self) -> dict[str, float]:
        """The worst that was seen at any step of the integrator, by name.

        The speed is the largest along any axis, as in the scenario's limit; it
        is taken from differences of the position where it is no state (n = 1).
        """
        return verdict.extremes(self.record)

    def breaches(self, scenario: Scenario) -> tuple[verdict.Breach, ...]:
        """What a single flight broke, the first before all else; none if it is well.

        Args:
            scenario: that was flown.
        """
        return verdict.breaches(
            self.record,
            largest=verdict.largest_kept(
                input_limit=scenario.limits.input, speed_limit=scenario.limits.speed
            ),
            order=scenario.model.order,
            replans=self.replans,
        )

    def flown_plan(self) -> Plan | None:
        """The plan that was in force at each time, if there could be several."""
        return flown_plan(self.replans) if self.replans else None

    def save(self, path: str | Path) -> None:
        """Writes all arrays as ``.npz``, under their names here.

        `replans` is a text in JSON; the plan of its entry i is in the arrays
        ``plan<i>_<field of Plan>``.
        """
        arrays = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        arrays["replans"] = json.dumps([r.summary() for r in self.replans])
        for i, one in enumerate(self.replans):
            if one.plan is not None:
                for field in dataclasses.fields(Plan):
                    arrays[f"plan{i}_{field.name}"] = getattr(one.plan, field.name)
        with open(path, "wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Log:
        """Reads what `save` wrote of a single flight.

        What was logged of a flight that diverged is loaded as it was, so states and
        what follows from them may be infinite or not a number.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a saved log, or anything in it is wrong;
                it names the file and the field.
        """
        with open(path, "rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError(f"{path}: not a saved log (not an .npz file)")
        reading = "the archive: "
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays: dict[str, Any] = {}
                for field in dataclasses.fields(cls):
                    reading = f"{field.name}: "
                    arrays[field.name] = read_array(data, field.name)
                reading = ""  # what is wrong begins with the field
                check_arrays(arrays)
                reading = "status: "
                texts: dict[str, Any] = {"status": read_status(arrays["status"])}
                reading = "replans: "
                texts["replans"] = read_replans(arrays["replans"], data)
        except DAMAGE as error:
            why = " ".join(str(error).split())
            raise ValueError(f"{path}: not a saved log ({reading}{why})") from None
        return cls(**arrays | texts)

    def __repr__(self) -> str:
        """Names what a reader wants to know first."""
        seen = self.extremes()
        return (
            f"Log({len(self.time)} samples over {self.time[-1]:g} s, "
            f"worst |s|/Φ {seen['worst_layer_ratio']:.3f}, "
            f"|ỹ|/Ω {seen['worst_position_ratio']:.3f}, "
            f"clearance {seen['smallest_clearance']:.3f} m, plan {self.status})"
        )


Progress = Callable[[float], None]
"""Is called with the time of a flight, in s, after every step of its grid."""


def Simulate(
    scenario: Scenario, *, plan: Plan | None = None, progress: Progress | None = None
) -> Log:
    """Simulates a scenario to its end.

    The seed of the scenario decides everything random, so the same scenario
    gives the same log.

    Args:
        scenario: the whole experiment.
        plan: to fly instead of planning at the start.
        progress: is told how far the flight is.

    Returns:
        The log.  If no certified plan was found, its status says why, and what
        was flown is `hold_plan`.

    Raises:
        ScenarioError: if the integrator's step is too long to be stable.
    """
    scenario.require_stable_simulation()
    loop = MakeClosedLoop(scenario, plan=plan)
    context = loop.CreateDefaultContext()
    loop.SetRandomContext(context, RandomGenerator(scenario.simulation.seed))
    return _logged(scenario, loop, context, lead=(), progress=progress)


def SimulateTrials(scenario: Scenario, *, plan: Plan, trials: Sequence[Trial]) -> Log:
    """Simulates many trials of a scenario side by side, in one diagram.

    Each flies as ``Simulate(trial.scenario(scenario), plan=plan)`` does, to the
    last bit, whatever else is in the batch.

    Args:
        scenario: the whole experiment; the trials replace its seed and its
            plant's parameters.
        plan: to fly.
        trials: at least one.

    Returns:
        One log of them all.

    Raises:
        ScenarioError: if the integrator's step is too long to be stable.
    """
    loop, context = _side_by_side(scenario, plan, trials)
    return _logged(scenario, loop, context, lead=(len(trials),))


def FlyTrials(scenario: Scenario, *, plan: Plan, trials: Sequence[Trial]) -> Flights:
    """Flies many trials as `SimulateTrials` does, and keeps what is reported alone.

    Args:
        scenario: as for `SimulateTrials`.
        plan: to fly.
        trials: at least one.

    Raises:
        ScenarioError: if the integrator's step is too long to be stable.
    """
    loop, context = _side_by_side(scenario, plan, trials)
    recorder = Recorder(scenario, trials)
    count = len(trials)
    state, quantities = map(loop.GetOutputPort, ("state", "quantities"))

    def look(root: Context) -> EventStatus:
        recorder.look(root.get_time(), quantities.Eval(root).reshape(count, -1))
        return EventStatus.DidNothing()

    rows = set(recorder.rows.tolist())
    m = scenario.model.num_outputs
    for step in _steps(scenario, loop, context, look=look):
        if step in rows:
            recorder.sample(state.Eval(context).reshape(count, -1, m)[:, 0])
    return recorder.flights(_record(loop, context, (count,)))


def _side_by_side(
    scenario: Scenario, plan: Plan, trials: Sequence[Trial]
) -> tuple[Diagram, Context]:
    """The loop of many trials, and its Context with the seed of each."""
    scenario.require_stable_simulation()
    loop = MakeClosedLoop(scenario, plan=plan, trials=trials)
    context = loop.CreateDefaultContext()
    disturbance = loop.GetSubsystemByName("disturbance")
    SeedTrials(disturbance, context, [trial.seed for trial in trials])
    return loop, context


def _steps(
    scenario: Scenario,
    loop: Diagram,
    context: Context,
    *,
    look: Callable[[Context], EventStatus] | None = None,
    progress: Progress | None = None,
) -> Iterator[int]:
    """Flies to the end, and stops at the start and after every step of the grid.

    The steps are those of `step_times`, whoever looks at them and when, so that a
    flight is the same to the last bit however it is logged.

    Args:
        scenario: gives the integrator and the end.
        loop: from `MakeClosedLoop`.
        context: of the loop.
        look: is called at the start and after every step of the integrator, also
            where something else that happens has cut a step of the grid in two.
        progress: is called after every step of the grid.

    Yields:
        The number of the step in `step_times`.
    """
    simulator = Simulator(loop, context)
    config = SimulatorConfig(
        integration_scheme=scenario.simulation.integration_scheme,
        # A hair more: else rounding would cut slivers off the steps of the grid.
        max_step_size=scenario.simulation.max_step_size * (1 + 1e-6),
        # A step that depends on the error would tie each trial to all others.
        use_error_control=False,
    )
    ApplySimulatorConfig(config, simulator)
    if look is not None:
        simulator.set_monitor(look)
    simulator.Initialize()
    yield 0
    times = step_times(scenario.duration, scenario.simulation.max_step_size)
    for number, time in enumerate(times[1:].tolist(), start=1):
        simulator.AdvanceTo(time)
        if progress is not None:
            progress(time)
        yield number


def _logged(
    scenario: Scenario,
    loop: Diagram,
    context: Context,
    *,
    lead: tuple[int, ...],
    progress: Progress | None = None,
) -> Log:
    """Simulates a closed loop to its end, and logs it.

    Args:
        scenario: gives the integrator, the end and the period of the log.
        loop: from `MakeClosedLoop`.
        context: of the loop, with its seed.
        lead: ``()``, or ``(trials,)``.
        progress: as for `Simulate`.
    """
    times = step_times(scenario.duration, scenario.simulation.max_step_size)
    rows = samples(times, scenario.simulation.log_period)
    row_of = {int(step): row for row, step in enumerate(rows)}
    ports = {name: loop.GetOutputPort(name) for name in _LOGGED}
    flat = {name: np.empty((len(rows), port.size())) for name, port in ports.items()}
    for step in _steps(scenario, loop, context, progress=progress):
        if step in row_of:
            for name, port in ports.items():
                flat[name][row_of[step]] = port.Eval(context)

    n, m = scenario.model.order, scenario.model.num_outputs
    shapes = {
        "state": (*lead, n, m),
        "reference": (n + 1, m),
        "tube_ratios": (*lead, 3, m),
    }
    arrays = {
        name: rows_of.reshape(len(rows), *shapes.get(name, (*lead, -1)))
        for name, rows_of in flat.items()
    }
    known_since, replans = np.zeros(len(scenario.obstacles)), ()
    if loop.HasOutputPort("replans"):
        known_since = loop.GetOutputPort("known_since").Eval(context).copy()
        known_since = known_since[: len(scenario.obstacles)]
        replans = loop.GetOutputPort("replans").Eval(context)
    return Log(
        record=_record(loop, context, lead),
        time=times[rows],
        status=loop.GetOutputPort("status").Eval(context),
        known_since=known_since,
        replans=replans,
        **arrays,
    )


def _record(loop: Diagram, context: Context, lead: tuple[int, ...]) -> Array:
    """What the monitor recorded, ``(6, *lead, 7)``."""
    record = loop.GetOutputPort("record").Eval(context)
    shape = (len(verdict.COLUMNS), *lead, len(verdict.QUANTITIES))
    return np.asarray(record.reshape(shape))
