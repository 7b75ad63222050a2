"""Flies closed loops to their ends, one or many side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram, EventStatus, System

from dtmpc_drake.diagrams.closed_loop import MakeClosedLoop, MakeSideBySide
from dtmpc_drake.diagrams.recorder import Recorder
from dtmpc_drake.diagrams.trials import Trial
from dtmpc_drake.disturbances import SeedTrials
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.sampling import samples, step_times
from dtmpc_drake.records import verdict
from dtmpc_drake.records.flight import LOGGED, Flight
from dtmpc_drake.records.flights import Flights
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import Scenario, require_stable_simulation

Progress = Callable[[float], None]
"""Is called with the time of a flight, in s, after every step of its grid."""


def Simulate(
    scenario: Scenario,
    *,
    plan: Plan | None = None,
    plant: System | None = None,
    disturbance: System | None = None,
    progress: Progress | None = None,
) -> Flight:
    """Simulates a scenario to its end.

    The seed of the scenario decides everything random, so the same scenario
    gives the same log.

    Args:
        scenario: the whole experiment.
        plan: to fly instead of planning at the start.
        plant: of one's own, as for `MakeClosedLoop`.
        disturbance: of one's own, as for `MakeClosedLoop`.
        progress: is told how far the flight is.

    Returns:
        The log.  If no certified plan was found, its status says why, and what
        was flown is `hold_plan`.

    Raises:
        ScenarioError: if the integrator's step is too long to be stable, or plan, plant
            or disturbance do not fit the scenario's model.
    """
    require_stable_simulation(scenario)
    loop = MakeClosedLoop(scenario, plan=plan, plant=plant, disturbance=disturbance)
    context = loop.CreateDefaultContext()
    loop.SetRandomContext(context, RandomGenerator(scenario.simulation.seed))
    return _logged(scenario, loop, context, lead=(), progress=progress)


def SimulateTrials(
    scenario: Scenario, *, plan: Plan, trials: Sequence[Trial]
) -> Flight:
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
            recorder.sample(state.Eval(context).reshape(count, -1)[:, :m])
    return recorder.flights(_record(loop, context, (count,)))


def _side_by_side(
    scenario: Scenario, plan: Plan, trials: Sequence[Trial]
) -> tuple[Diagram, Context]:
    """The loop of many trials, and its Context with the seed of each."""
    require_stable_simulation(scenario)
    loop = MakeSideBySide(scenario, plan=plan, trials=trials)
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
        loop: from `MakeClosedLoop` or `MakeSideBySide`.
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
        # A little more: else rounding would cut slivers off the steps of the grid.
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
) -> Flight:
    """Simulates a closed loop to its end, and logs it.

    Args:
        scenario: gives the integrator, the end and the period of the log.
        loop: from `MakeClosedLoop` or `MakeSideBySide`.
        context: of the loop, with its seed.
        lead: ``()``, or ``(trials,)``.
        progress: as for `Simulate`.
    """
    times = step_times(scenario.duration, scenario.simulation.max_step_size)
    rows = samples(times, scenario.simulation.log_period)
    row_of = {int(step): row for row, step in enumerate(rows)}
    ports = {name: loop.GetOutputPort(name) for name in LOGGED}
    flat = {name: np.empty((len(rows), port.size())) for name, port in ports.items()}
    for step in _steps(scenario, loop, context, progress=progress):
        if step in row_of:
            for name, port in ports.items():
                flat[name][row_of[step]] = port.Eval(context)

    chains = Chains.of(scenario.model)
    n, m = chains.order, chains.num_outputs
    flat["state"] = chains.unpack(flat["state"].reshape(len(rows), *lead, chains.size))
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
    return Flight(
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
    return record.reshape(shape)
