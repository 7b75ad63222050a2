"""Many trials of one scenario: drawing, spreading and judging them.

Nothing here knows how a trial is flown: `spread` calls any function on batches of
trials, in this process or on a Dask cluster.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np

from dtmpc_drake import verdict
from dtmpc_drake.logs import quiet
from dtmpc_drake.models import Array
from dtmpc_drake.sampling import samples, step_times
from dtmpc_drake.scenario import (
    BangBang,
    ColoredWind,
    Disturbance,
    Gust,
    Scenario,
    ScenarioError,
    UniformHold,
    Waypoint,
    WorstCase,
)
from dtmpc_drake.sliding import sliding_variable

REPORT_PERIOD = 0.05
"""Between two samples that are kept of a flight at least, in s."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
RATIOS = ("layer", "position", "velocity")
"""What |s|/Φ, |ỹ|/Ω and |dỹ/dt|/W are shares of."""

PATIENCE = 10.0
"""How long an existing scheduler may take to answer, in s."""

SPREAD = 4.0
"""How many times longer or shorter a worst case holds its push in some trials."""
_NEVER = 1e6
"""So many times longer is longer than any flight."""

Item = TypeVar("Item")
Result = TypeVar("Result")

# Drawing.


@dataclasses.dataclass(frozen=True)
class Trial:
    """One trial of a scenario: what is drawn for it.

    Attributes:
        index: its number, from 0.
        seed: of everything random in it.
        parameters: of the true plant, by name; without effect where the disturbance
            chooses the model error.
        initial_error: of the plant; None for none.
        patience: how many times longer than the scenario says a `WorstCase` that
            reverses its push holds it.
    """

    index: int
    seed: int
    parameters: dict[str, float]
    initial_error: Waypoint | None = None
    patience: float = 1.0

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def scenario(self, scenario: Scenario) -> Scenario:
        """The scenario of this trial alone, to be simulated by itself."""
        disturbance = scenario.disturbance
        if isinstance(disturbance, WorstCase) and disturbance.hold is not None:
            disturbance = dataclasses.replace(
                disturbance, hold=self.patience * disturbance.hold
            )
        return dataclasses.replace(
            scenario,
            plant=dict(self.parameters),
            initial_error=self.initial_error,
            disturbance=disturbance,
            simulation=dataclasses.replace(scenario.simulation, seed=self.seed),
        )


def draw_trials(scenario: Scenario, indices: Iterable[int]) -> list[Trial]:
    """Draws trials by their numbers.

    A trial is a function of the scenario's seed and of its own number alone.
    True parameters are spread over all that the model allows, whatever the
    scenario's plant has: trial 0 is at the low end, trial 1 at the high end, and
    the others are uniform between.  The initial error is the scenario's in trial 0,
    its negative in trial 1, and anywhere between the two in the others, in every
    output and derivative.  A worst case that reverses never does so in the first
    two; in the others it holds its push up to `SPREAD` times longer or shorter.
    """
    intervals = {
        name: scenario.model.parameter_interval(name)
        for name in scenario.model.parameter_names
    }
    trials = []
    for index in indices:
        entropy = np.random.SeedSequence([scenario.simulation.seed, index])
        generator = np.random.default_rng(entropy)
        share = generator.random(len(intervals))
        patience = SPREAD ** generator.uniform(-1, 1)
        error = _draw_initial_error(scenario, generator)
        if index < 2:
            share[:] = index
            patience = _NEVER
            error = (1 - 2 * index) * scenario.initial_error_state()
        parameters = {
            name: float((1 - s) * low + s * high)
            for s, (name, (low, high)) in zip(share, intervals.items(), strict=True)
        }
        trials.append(
            Trial(
                index=index,
                seed=int(entropy.generate_state(1)[0]),
                parameters=parameters,
                initial_error=scenario.initial_error and Waypoint(*error[:3].tolist()),
                patience=patience,
            )
        )
    return trials


def _draw_initial_error(scenario: Scenario, generator: np.random.Generator) -> Array:
    """Any error that is nowhere larger than the scenario's, ``(n, m)``.

    The tube opens from its absolute values and so holds all of these, but for
    the layer: signs that differ from the scenario's can give a larger |s(t0)|.
    Such an error is made smaller.
    """
    error = scenario.initial_error_state()
    error = generator.uniform(-1, 1, error.shape) * error
    s = np.abs(sliding_variable(error, scenario.slope()))
    layer = scenario.initial_boundary_layer() * (1 - 1e-9)
    return np.asarray(error * layer / np.maximum(s, layer))


KINDS: dict[str, Callable[[list[float]], Disturbance]] = {
    "uniform": lambda bound: UniformHold(bound=bound),
    "bang_bang": lambda bound: BangBang(bound=bound),
    "worst_case": lambda bound: WorstCase(bound=bound, hold=1.5, model_error=True),
    "wind": lambda bound: ColoredWind(bound=bound, intensity=1.0),
    "gust": lambda bound: Gust(bound=bound, model_error=True),
}
"""What `choose_disturbances` makes of a bound D."""


def choose_disturbances(scenario: Scenario, choice: str) -> dict[str, Disturbance]:
    """The disturbances to fly through, by name, all with the scenario's bound.

    Args:
        scenario: whose own disturbance stands in for the one of its kind, but for a
            worst case that does not reverse: of that there are too few flights.
        choice: one of `KINDS`, ``all`` of them, or ``scenario`` for its own.

    Raises:
        ScenarioError: if the choice is none of these.
    """
    own = scenario.disturbance
    if choice == "scenario":
        return {choice: own}
    names = list(KINDS) if choice == "all" else [choice]
    if not set(names) <= set(KINDS):
        allowed = ", ".join((*KINDS, "all", "scenario"))
        raise ScenarioError("disturbance", choice, f"one of {allowed}")
    made = {name: KINDS[name](list(own.bound)) for name in names}
    varied = not isinstance(own, WorstCase) or own.hold is not None
    return {n: own if varied and type(own) is type(d) else d for n, d in made.items()}


# Spreading.


def batches(count: int, size: int) -> list[range]:
    """The numbers of `count` trials in batches; the last may be smaller.

    Raises:
        ScenarioError: if there would be none, or they would be empty.
    """
    for field, value in (("trials", count), ("batch-size", size)):
        if value < 1:
            raise ScenarioError(field, value, "at least 1")
    return [range(i, min(i + size, count)) for i in range(0, count, size)]


def spread(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    scheduler: str | None = None,
    done: Callable[[Item], None] | None = None,
) -> list[Result]:
    """Calls a function on every item as Dask tasks.

    A task whose worker dies is run again by another.  Without a scheduler the
    workers are processes of this machine, one a core; a single item is computed
    in this process then.  As with any such processes, a script that calls this
    must guard its main part by ``if __name__ == "__main__"``.

    Args:
        function: must be importable where the workers run, and give the same
            for the same item, since it may be called twice.
        items: one a task.
        scheduler: address of an existing cluster, such as
            ``tcp://127.0.0.1:8786``.
        done: is called with every item whose result is there.

    Returns:
        The results in the order of the items.

    Raises:
        ScenarioError: if no scheduler answers at the address.
    """
    done = done or (lambda _: None)
    if scheduler is None and len(items) == 1:
        results = [function(items[0])]
        done(items[0])
        return results

    # Only here: importing it takes longer than flying a few trials.
    from distributed import as_completed

    with _connected(scheduler, tasks=len(items)) as client:
        # Every task carries all it needs: what is scattered dies with a worker.
        futures = [client.submit(function, item, pure=False) for item in items]
        if scheduler is not None:
            _wait_for_workers(client, scheduler)
        numbers = {future.key: i for i, future in enumerate(futures)}
        collected: dict[int, Result] = {}
        for future, result in as_completed(futures, with_results=True):
            collected[numbers[future.key]] = result
            done(items[numbers[future.key]])
    return [collected[i] for i in range(len(items))]


@contextlib.contextmanager
def _connected(scheduler: str | None, *, tasks: int) -> Iterator[Any]:
    """A client of an existing cluster, or of one that lives as long as it does."""
    from distributed import Client, LocalCluster

    with contextlib.ExitStack() as stack:
        stack.enter_context(quiet("distributed"))
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout=PATIENCE)
            except (OSError, ValueError, TypeError) as error:
                raise ScenarioError(
                    "scheduler",
                    scheduler,
                    f"the address of a Dask scheduler that answers ({error})",
                ) from None
        else:
            cluster = LocalCluster(
                n_workers=min(tasks, os.cpu_count() or 1),
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",  # any free port; nobody looks
            )
            client = Client(stack.enter_context(cluster))
        yield stack.enter_context(client)


def _wait_for_workers(client: Any, scheduler: str) -> None:
    try:
        client.wait_for_workers(1, timeout=6 * PATIENCE)
    except TimeoutError:
        allowed = f"a scheduler with workers: none came in {6 * PATIENCE:g} s"
        raise ScenarioError("scheduler", scheduler, allowed) from None


# Judging.


@dataclasses.dataclass(frozen=True, repr=False)
class Flights:
    """What is kept of T trials that flew one plan through one disturbance.

    Attributes:
        index: numbers of the trials, ``(T,)``.
        seed: of each trial, ``(T,)``.
        parameters: true parameters by name, ``(T,)`` each.
        record: of `dtmpc_drake.verdict`, ``(T, 6, 7)``: the worst of everything that
            was seen at any step of the integrator, and what broke first.
        effort: ∫‖u‖² dt, ``(T,)``.
        time: ``(K,)``, in s, `REPORT_PERIOD` apart, or the scenario's log period if
            that is longer.
        position: ``(T, K, m)``.
        position_ratio: |ỹ|/Ω of the worst axis, the largest since the sample
            before, ``(T, K)``; infinite where it is no number.
    """

    index: Array
    seed: Array
    parameters: dict[str, Array]
    record: Array
    effort: Array
    time: Array
    position: Array
    position_ratio: Array

    __hash__: ClassVar[None]  # type: ignore[assignment]

    @classmethod
    def concatenate(cls, parts: Sequence[Flights]) -> Flights:
        """All trials of some batches, in their order."""

        def join(name: str) -> Array:
            return np.concatenate([getattr(part, name) for part in parts])

        shared = {"time", "parameters"}
        names = {field.name for field in dataclasses.fields(cls)} - shared
        parameters = {
            name: np.concatenate([part.parameters[name] for part in parts])
            for name in parts[0].parameters
        }
        return cls(
            time=parts[0].time, parameters=parameters, **{n: join(n) for n in names}
        )

    def __len__(self) -> int:
        """T."""
        return len(self.index)

    @property
    def worst_ratios(self) -> Array:
        """The largest |s|/Φ, |ỹ|/Ω and |dỹ/dt|/W, ``(T, 3)``."""
        ratios = slice(verdict.LAYER, verdict.VELOCITY + 1)
        return np.asarray(self.record[:, verdict.WORST, ratios])

    @property
    def smallest_clearance(self) -> Array:
        """To any obstacle, ``(T,)``, in m."""
        return np.asarray(-self.record[:, verdict.WORST, verdict.OBSTACLES])

    @property
    def broken(self) -> Array:
        """Which of `verdict.QUANTITIES` each trial broke, ``(T, 7)``."""
        return verdict.broken(self.record.swapaxes(0, 1))

    @property
    def violations(self) -> dict[str, int]:
        """How many trials broke anything but an obstacle, by its name."""
        counts = map(int, self.broken.sum(axis=0))
        named = dict(zip(verdict.QUANTITIES, counts, strict=True))
        del named["obstacles"]
        return named

    def what_broke(self) -> str:
        """How many trials broke what, in words; empty if none broke anything."""
        counts = {
            name.replace("_", " "): int(count)
            for name, count in zip(
                verdict.QUANTITIES, self.broken.sum(axis=0), strict=True
            )
        }
        broken = [f"{name} {count}" for name, count in counts.items() if count]
        return f"of {len(self)} flights broke: {', '.join(broken)}" if broken else ""

    @property
    def outside(self) -> int:
        """How many trials broke any of `violations`."""
        others = np.arange(len(verdict.QUANTITIES)) != verdict.OBSTACLES
        return int(self.broken[:, others].any(axis=1).sum())

    @property
    def collisions(self) -> int:
        """How many trials touched an obstacle."""
        return int(self.broken[:, verdict.OBSTACLES].sum())

    @property
    def finite(self) -> Array:
        """Which trials have a position at every time, ``(T,)``."""
        return np.asarray(np.isfinite(self.position).all(axis=(1, 2)))

    @property
    def hardest(self) -> int:
        """The row of the trial that used most of its tube, among `finite` ones."""
        return int(np.where(self.finite, self.worst_ratios[:, 1], -1.0).argmax())

    @property
    def distinct(self) -> int:
        """How many different flights there are, to the last bit of a position."""
        return len({flight.tobytes() for flight in self.position})

    @property
    def safe(self) -> bool:
        """Whether there are trials, and none broke or touched anything."""
        return len(self) > 0 and not self.broken.any()

    def quantiles(self) -> Array:
        """Of |ỹ|/Ω over the trials, at every time, ``(len(QUANTILES), K)``."""
        # Between a finite and an infinite one there is nothing to interpolate.
        finite = bool(np.isfinite(self.position_ratio).all())
        method: Literal["linear", "higher"] = "linear" if finite else "higher"
        return np.asarray(
            np.quantile(self.position_ratio, QUANTILES, axis=0, method=method)
        )

    def arrays(self) -> dict[str, Array]:
        """Everything as arrays by name, to be saved."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        parameters = fields.pop("parameters")
        for name in ("worst_ratios", "smallest_clearance"):
            fields[name] = getattr(self, name)
        return fields | {f"parameter_{n}": v for n, v in parameters.items()}

    def summary(self) -> dict[str, Any]:
        """Plain numbers: counts, extremes and the trials that reached them."""
        closest = int(self.smallest_clearance.argmin())
        worst = int(self.worst_ratios[:, 1].argmax())
        return {
            "trials": len(self),
            "distinct": self.distinct,
            "violations": self.violations,
            "trials_with_violations": self.outside,
            "collisions": self.collisions,
            "worst_ratios": dict(
                zip(RATIOS, map(float, self.worst_ratios.max(axis=0)), strict=True)
            ),
            "worst_position_trial": int(self.index[worst]),
            "smallest_clearance": float(self.smallest_clearance[closest]),
            "closest_trial": int(self.index[closest]),
            "effort": _quantiles(self.effort),
            # One number a trial: how much of its tube it ever used.
            "largest_position_ratio": _quantiles(self.worst_ratios[:, 1]),
        }

    def __repr__(self) -> str:
        """Names what a reader wants to know first."""
        layer, position, velocity = self.worst_ratios.max(axis=0)
        return (
            f"Flights({len(self)} trials, {self.distinct} distinct, "
            f"{self.outside} with violations, "
            f"{self.collisions} collisions, worst |s|/Φ {layer:.3f}, |ỹ|/Ω "
            f"{position:.3f}, |dỹ/dt|/W {velocity:.3f}, clearance "
            f"{self.smallest_clearance.min():.3f} m)"
        )


class Recorder:
    """Keeps of trials what is reported, while they fly.

    Every trial is kept alone, in the same order of additions, so that the result
    does not depend on what else is in its batch.

    Args:
        scenario: that is flown.
        trials: T of them.
    """

    def __init__(self, scenario: Scenario, trials: Sequence[Trial]) -> None:
        simulation = scenario.simulation
        times = step_times(scenario.duration, simulation.max_step_size)
        self.rows = samples(times, max(REPORT_PERIOD, simulation.log_period))
        """Ends of steps, by number, after which `sample` must be called."""
        self._trials = trials
        self._time = times[self.rows]
        count, m = len(trials), scenario.model.num_outputs
        self._position = np.empty((count, len(self.rows), m))
        self._position_ratio = np.empty((count, len(self.rows)))
        self._sampled = 0
        self._highest = np.full(count, -np.inf)  # |ỹ|/Ω since the last sample
        self._effort = np.zeros(count)
        self._last = 0.0, np.zeros(count)  # time and ‖u‖²

    def look(self, time: float, quantities: Array) -> None:
        """Takes in what `verdict.QUANTITIES` are, ``(T, 7)``, at the end of a step."""
        used = quantities[:, verdict.POSITION]
        used = np.where(np.isnan(used), np.inf, used)
        self._highest = np.maximum(self._highest, used)
        before, last_power = self._last
        power = quantities[:, verdict.INPUT] ** 2
        self._effort += (power + last_power) / 2 * (time - before)
        self._last = time, power

    def sample(self, position: Array) -> None:
        """Takes in positions, ``(T, m)``, after a look at the same time."""
        self._position[:, self._sampled] = position
        self._position_ratio[:, self._sampled] = self._highest
        self._sampled += 1
        self._highest = np.full_like(self._highest, -np.inf)

    def flights(self, record: Array) -> Flights:
        """What was kept, with the record of the flights, ``(6, T, 7)``."""
        trials = self._trials
        return Flights(
            index=np.array([trial.index for trial in trials]),
            seed=np.array([trial.seed for trial in trials]),
            parameters={
                name: np.array([trial.parameters[name] for trial in trials])
                for name in trials[0].parameters
            },
            record=record.swapaxes(0, 1).copy(),
            effort=self._effort,
            time=self._time,
            position=self._position,
            position_ratio=self._position_ratio,
        )


def _quantiles(values: Array) -> dict[str, float]:
    """Of those that are finite; no numbers if none is."""
    names = ["smallest", "median", "largest"]
    finite = values[np.isfinite(values)]
    found = np.quantile(finite, (0, 0.5, 1)) if len(finite) else np.full(3, np.nan)
    return dict(zip(names, map(float, found), strict=True))


def save_flights(path: str | Path, flights: Mapping[str, Flights]) -> None:
    """Writes flights by the name of their disturbance, as ``<name>_<field>``.

    Args:
        path: of the ``.npz`` file.
        flights: by name.

    Raises:
        OSError: if the file cannot be written.
    """
    arrays: dict[str, Any] = {
        f"{kind}_{name}": array
        for kind, flown in flights.items()
        for name, array in flown.arrays().items()
    }
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)
