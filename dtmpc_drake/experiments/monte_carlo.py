"""Monte Carlo: one certified plan, flown many times through hard disturbances."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dtmpc_drake.diagrams import FlyTrials, draw_trials
from dtmpc_drake.disturbances import DISTURBANCES, Disturbance
from dtmpc_drake.errors import require
from dtmpc_drake.experiments.outputs import placed, replacing, write_json
from dtmpc_drake.experiments.simulate import color_of, summarize
from dtmpc_drake.experiments.spread import batches, spread
from dtmpc_drake.experiments.tables import text_table
from dtmpc_drake.planning import plan
from dtmpc_drake.records.flights import Flights, save_flights
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import (
    Scenario,
    require_one_plan,
    require_stable_simulation,
    require_trials,
    validate,
)
from dtmpc_drake.visualization import (
    ShownFlight,
    plot_plan,
    plot_quantiles,
    write_replay,
)

OWN = "all", "scenario"
"""Of `choose_disturbances`: all kinds, and the disturbance of the scenario."""
BATCH_SIZE = 250
"""Large enough to pay, small enough for many workers and little memory."""
OUTPUTS = (
    "cloud.png",
    "quantiles.png",
    "replay.html",
    "monte_carlo.npz",
    "summary.json",
)


def hard_disturbances(bound: list[float]) -> dict[str, Disturbance]:
    """One of each registered kind that has a short name, by that name.

    Raises:
        ScenarioError: if two kinds have the same one.
    """
    made: dict[str, Disturbance] = {}
    for kind in DISTURBANCES:
        name = kind.short_name
        if name is not None:
            ok = name not in (*made, *OWN)
            require(f"{kind.__name__}.short_name", name, ok, "that of no other kind")
            made[name] = kind.hard(list(bound))
    return made


def choose_disturbances(scenario: Scenario, choice: str) -> dict[str, Disturbance]:
    """The disturbances to fly through, by name, all with the scenario's bound.

    Args:
        scenario: whose own disturbance stands in for the one of its kind, but for a
            worst case that does not reverse: of that there are too few flights.
        choice: a name of `hard_disturbances`, ``all`` of them, or ``scenario`` for
            its own.

    Raises:
        ScenarioError: if the choice is none of these.
    """
    own = scenario.disturbance
    if choice == "scenario":
        return {choice: own}
    made = hard_disturbances(own.bound)
    allowed = ", ".join((*made, *OWN))
    require("disturbance", choice, choice in (*made, "all"), f"one of {allowed}")
    return {
        name: own if own.is_varied and type(own) is type(kind) else kind
        for name, kind in made.items()
        if choice in (name, "all")
    }


@dataclasses.dataclass(frozen=True, eq=False)
class Batch:
    """Trials that fly side by side: all that a worker needs.

    Attributes:
        name: of the flights that it belongs to.
        scenario: with the disturbance to fly through.
        plan: to fly.
        numbers: of the trials.
    """

    name: str
    scenario: Scenario
    plan: Plan
    numbers: range


def fly(batch: Batch) -> Flights:
    """Flies a batch in one diagram and keeps what is reported."""
    trials = draw_trials(batch.scenario, batch.numbers)
    return FlyTrials(batch.scenario, plan=batch.plan, trials=trials)


def fly_all(
    flown: Mapping[str, tuple[Scenario, Plan]],
    *,
    trials: int,
    batch_size: int = BATCH_SIZE,
    scheduler: str | None = None,
    done: Callable[[Batch], None] | None = None,
) -> dict[str, Flights]:
    """Flies plans many times each, spread over workers; see `spread`.

    The same bits come back from every cluster that has the same versions of the
    libraries installed.

    Args:
        flown: a scenario and the plan to fly in it, by name.
        trials: of each.
        batch_size: trials in one diagram; the results do not depend on it.
        scheduler: address of an existing Dask cluster.
        done: is called with every batch that has ended.

    Returns:
        The flights by the same names.

    Raises:
        ScenarioError: if a number or the address makes no sense.
    """
    work = [
        Batch(name, scenario, plan, numbers)
        for name, (scenario, plan) in flown.items()
        for numbers in batches(trials, batch_size)
    ]
    results = spread(fly, work, scheduler=scheduler, done=done)
    parts: dict[str, list[Flights]] = {name: [] for name in flown}
    for batch, result in zip(work, results, strict=True):
        parts[batch.name].append(result)
    return {name: Flights.concatenate(p) for name, p in parts.items()}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MonteCarlo:
    """What a Monte Carlo experiment ended with.

    Attributes:
        scenario: that was flown.
        result: of planning.
        flights: by disturbance; none without a certified plan.
        files: that were written.
    """

    scenario: Scenario
    result: PlanningResult
    flights: dict[str, Flights]
    files: tuple[Path, ...]

    @property
    def safe(self) -> bool:
        """Whether the plan is certified, was flown, and no trial broke anything."""
        flown = self.flights.values()
        safe = bool(flown) and all(flight.safe for flight in flown)
        return self.result.certified and safe

    def table(self) -> str:
        """One line a disturbance."""
        columns = ["", "flights", "distinct", "violations", "collisions"]
        columns += ["|s|/Φ", "|ỹ|/Ω", "|dỹ/dt|/W", "clearance"]
        columns += ["effort: least", "median", "most"]
        rows = []
        for name, flown in self.flights.items():
            rows.append(
                [
                    name,
                    *map(str, (len(flown), flown.distinct)),
                    *map(str, (flown.outside, flown.collisions)),
                    *(f"{ratio:.3f}" for ratio in flown.worst_ratios.max(axis=0)),
                    f"{flown.smallest_clearance.min():.3f}",
                    *(f"{value:.2f}" for value in flown.summary()["effort"].values()),
                ]
            )
        return text_table(columns, rows)

    def __repr__(self) -> str:
        """A summary that a person can read."""
        lines = [f"{self.scenario.name}: {self.result.status}, {self.result.message}"]
        if self.flights:
            lines += [
                "",
                self.table(),
                "",
                "distinct: not the same to the last bit; violations: flights that left"
                " layer or tubes, broke a limit, or were not finite, at any step;",
                "the largest of all ratios; clearance: smallest,"
                f" {self.scenario.model.length_unit}; effort: ∫‖u‖² dt",
            ]
            lines += [
                f"{name}: {flown.what_broke()}"
                for name, flown in self.flights.items()
                if not flown.safe
            ]
        lines += ["", "files", *(f"  {path}" for path in self.files)]
        return "\n".join(lines)


def run(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    trials: int = 1000,
    disturbance: str = "all",
    batch_size: int = BATCH_SIZE,
    scheduler: str | None = None,
    start: Callable[[int], None] | None = None,
    done: Callable[[Batch], None] | None = None,
) -> MonteCarlo:
    """Plans once, flies the plan many times, and writes `OUTPUTS`.

    Without a certified plan nothing is flown and only ``summary.json`` written.  All
    files take their places at the end; see `outputs.replacing`.

    Args:
        scenario: the whole experiment; its seed decides every trial.
        out: directory; ``out/<name of the scenario>_monte_carlo`` if left out.
        trials: through each disturbance.
        disturbance: as for `choose_disturbances`.
        batch_size: trials in one diagram; the results do not depend on it.
        scheduler: address of an existing Dask cluster.
        start: is called with the number of all trials before they fly.
        done: is called with every batch that has ended.

    Raises:
        ScenarioError: if the scenario or an argument makes no sense.
        OSError: if the directory cannot be written.
    """
    validate(scenario)
    require_one_plan(scenario)
    chosen = choose_disturbances(scenario, disturbance)
    for one in chosen.values():
        pushed = dataclasses.replace(scenario, disturbance=one)
        require_stable_simulation(pushed)
        require_trials(pushed, trials, batch_size)
    batches(trials, batch_size)  # refuses none, too
    out = Path("out", f"{scenario.name}_monte_carlo") if out is None else Path(out)
    flights: dict[str, Flights] = {}
    with replacing(out, OUTPUTS) as work:
        result = plan(scenario)
        if result.certified and result.plan is not None:
            if start is not None:
                start(trials * len(chosen))
            flights = fly_all(
                {
                    name: (dataclasses.replace(scenario, disturbance=d), result.plan)
                    for name, d in chosen.items()
                },
                trials=trials,
                batch_size=batch_size,
                scheduler=scheduler,
                done=done,
            )
            draw(scenario, result.plan, flights, work)
            save_flights(work / "monte_carlo.npz", flights)
        write_json(work / "summary.json", to_numbers(scenario, result, flights))
        files = [work / name for name in OUTPUTS if (work / name).exists()]
    return MonteCarlo(scenario, result, flights, placed(files, work, out))


def to_numbers(
    scenario: Scenario, result: PlanningResult, flights: Mapping[str, Flights]
) -> dict[str, Any]:
    """A Monte Carlo experiment as plain numbers and texts."""
    return summarize(scenario, result, None) | {
        "flights": {name: flown.summary() for name, flown in flights.items()}
    }


def draw(
    scenario: Scenario, plan: Plan, flights: Mapping[str, Flights], out: Path
) -> None:
    """Writes the figures and the replay; nothing if no flight is finite.

    The vehicle of the replay is the flight that used most of its tube.

    Raises:
        OSError: if the directory cannot be written.
    """
    flights = {name: f for name, f in flights.items() if f.finite.any()}
    if not flights:
        return
    labels = {name: name.replace("_", " ") for name in flights}
    # The widest clouds at the bottom.
    wide = sorted(flights, key=lambda name: -flights[name].position_ratio.mean())
    clouds = {
        f"{flights[n].finite.sum()} × {labels[n]}": flights[n].position[
            flights[n].finite
        ]
        for n in wide
    }
    first = flights[wide[0]]
    color_by = color_of(scenario)
    plot_plan(
        scenario=scenario,
        plan=plan,
        position=clouds,
        time=first.time,
        color_by=color_by,
    ).savefig(out / "cloud.png")
    plot_quantiles(
        time=first.time,
        ratios={labels[name]: f.position_ratio for name, f in flights.items()},
    ).savefig(out / "quantiles.png")
    hardest = max(flights.values(), key=lambda f: float(f.worst_ratios[f.hardest, 1]))
    count = sum(map(len, flights.values()))
    shown = ShownFlight(
        time=first.time,
        position=hardest.position[hardest.hardest],
        status=f"{count} flights; the worst is drawn large",
        clouds=clouds,
    )
    write_replay(
        out / "replay.html",
        scenario=scenario,
        plan=plan,
        flight=shown,
        color_by=color_by,
    )
