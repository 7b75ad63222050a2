"""Baselines: the same scenario planned with parts of the method taken away."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dtmpc_drake.costs import Weight
from dtmpc_drake.disturbances import Disturbance
from dtmpc_drake.errors import show
from dtmpc_drake.experiments.monte_carlo import (
    BATCH_SIZE,
    Batch,
    choose_disturbances,
    fly_all,
)
from dtmpc_drake.experiments.outputs import placed, replacing, write_json
from dtmpc_drake.experiments.spread import batches
from dtmpc_drake.experiments.tables import text_table
from dtmpc_drake.planning.baselines import (
    RESOLUTION,
    Outcome,
    crossover,
    make_baselines,
    solve,
)
from dtmpc_drake.planning.charges import charges
from dtmpc_drake.records.flights import Flights
from dtmpc_drake.scenario import (
    Scenario,
    require_one_plan,
    require_stable_simulation,
    require_trials,
    validate,
)
from dtmpc_drake.scenario.schema import DERIVATIVES, StateWeights
from dtmpc_drake.visualization import Panel, plot_plans

_OF_A_PLAN = (
    "cost",
    "input_cost",
    "bandwidth_cost",
    "other_cost",
    "fixed_bandwidth",
    "crossover",
    "tube_mean",
    "tube_largest",
    "flights",
    "collisions",
    "violations",
    "effort",
    "clearance",
)
OUTPUTS = ("compare.png", "compare.txt", "compare.csv", "compare.json")


@dataclasses.dataclass(frozen=True, eq=False)
class Row:
    """One baseline: how it was planned and how it flew.

    Attributes:
        outcome: of planning.
        flights: through all of `chosen_disturbances`; None without a plan.
    """

    outcome: Outcome
    flights: Flights | None

    def numbers(self) -> dict[str, Any]:
        """What the table says; None where there is no number.

        Lengths in m, times in s, bandwidths in rad/s.  `fixed_bandwidth` is what
        the plan is flown with, the best of a sweep where there was one.
        `input_cost`, `bandwidth_cost` and `other_cost` make up `cost`; `crossover`
        is that of the whole loop, its mean over time and axes; `effort` is ∫‖u‖² dt
        of the median flight.  `plan_time_s` counts the whole sweep.
        """
        outcome, plan, flights = self.outcome, self.outcome.plan, self.flights
        numbers: dict[str, Any] = {
            "name": outcome.baseline.name,
            "feasible": plan is not None,
            "certified": outcome.certified,
            "message": outcome.message,
            "plan_time_s": outcome.plan_time,
        }
        numbers |= dict.fromkeys(_OF_A_PLAN)
        if plan is not None and outcome.result.attempt is not None:
            parts = charges(outcome.result.attempt, outcome.baseline.problem)
            of_input, of_bandwidth = parts.pop("input"), parts.pop("bandwidth")
            tube = plan.position_tube(plan.sample_times())
            numbers |= {
                "cost": outcome.result.cost,
                "input_cost": of_input,
                "bandwidth_cost": of_bandwidth,
                "other_cost": sum(parts.values()),
                "fixed_bandwidth": outcome.baseline.fixed_bandwidth,
                "crossover": crossover(plan, outcome.baseline.scenario),
                "tube_mean": tube.mean(),
                "tube_largest": tube.max(),
            }
        if flights is not None:
            numbers |= {
                "flights": len(flights),
                "collisions": flights.collisions,
                "violations": flights.outside,
                "effort": np.median(flights.effort),
                "clearance": flights.smallest_clearance.min(),
            }
        return numbers


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """What a comparison ended with.

    Attributes:
        scenario: that was planned.
        rows: one a baseline, as in `baselines.TITLES`.
        files: that were written.
    """

    scenario: Scenario
    rows: dict[str, Row]
    files: tuple[Path, ...]

    @property
    def safe(self) -> bool:
        """Whether DTMPC itself is certified and no flight of it was unsafe."""
        row = self.rows["both"]
        return row.outcome.certified and row.flights is not None and row.flights.safe

    def table(self) -> str:
        """All numbers as text, what they mean, and why a plan is not certified."""
        return to_text(self.scenario, self.rows)

    def figure(self) -> Figure:
        """All plans from above; of a scenario with two outputs or more."""
        return to_figure(self.scenario, self.rows)

    def __repr__(self) -> str:
        """The table."""
        files = [f"  {path}" for path in self.files]
        return "\n".join([self.table(), "", "files", *files])


def run(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    trials: int = 1000,
    batch_size: int = BATCH_SIZE,
    scheduler: str | None = None,
    start: Callable[[int], None] | None = None,
    done: Callable[[Batch], None] | None = None,
) -> Comparison:
    """Plans all baselines, flies what can be flown, and writes `OUTPUTS`.

    A single output has no figure.

    Args:
        scenario: the whole experiment; its seed decides every trial, which are
            the same for all baselines.
        out: directory; ``out/<name of the scenario>_compare`` if left out.
        trials: of each plan, shared by all disturbances and rounded up.
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
    # Baselines are flown with bandwidths up to the largest.
    bandwidth = dataclasses.replace(scenario.controller.bandwidth, fixed=None)
    controller = dataclasses.replace(scenario.controller, bandwidth=bandwidth)
    require_stable_simulation(dataclasses.replace(scenario, controller=controller))
    require_trials(scenario, trials, batch_size)
    batches(trials, batch_size)  # refuses none, too
    out = Path("out", f"{scenario.name}_compare") if out is None else Path(out)
    with replacing(out, OUTPUTS) as work:
        outcomes = [solve(baseline) for baseline in make_baselines(scenario)]
        flown = {}
        for outcome in outcomes:
            if outcome.plan is None:
                continue
            own = outcome.baseline.scenario
            for name, disturbance in chosen_disturbances(own).items():
                pushed = dataclasses.replace(own, disturbance=disturbance)
                flown[f"{outcome.baseline.name} {name}"] = pushed, outcome.plan
        each = -(-trials // len(chosen_disturbances(scenario)))
        if start is not None:
            start(each * len(flown))
        flights = fly_all(
            flown, trials=each, batch_size=batch_size, scheduler=scheduler, done=done
        )
        rows = {}
        for outcome in outcomes:
            name = outcome.baseline.name
            own_flights = [flights[key] for key in flights if key.split()[0] == name]
            rows[name] = Row(
                outcome, Flights.concatenate(own_flights) if own_flights else None
            )
        files = _write(scenario, rows, work)
    return Comparison(scenario, rows, placed(files, work, out))


def chosen_disturbances(scenario: Scenario) -> dict[str, Disturbance]:
    """What every plan has to fly through: all kinds, without the mildest."""
    chosen = choose_disturbances(scenario, "all")
    return {name: made for name, made in chosen.items() if name != "uniform"}


def _write(scenario: Scenario, rows: dict[str, Row], out: Path) -> list[Path]:
    files = [out / name for name in OUTPUTS]
    if scenario.model.num_outputs > 1:
        to_figure(scenario, rows).savefig(out / OUTPUTS[0])
    else:  # there is no field to look at
        files.remove(out / OUTPUTS[0])
    files[-3].write_text(to_text(scenario, rows) + "\n", encoding="utf-8")
    numbers = [row.numbers() for row in rows.values()]
    with open(files[-2], "w", encoding="utf-8", newline="") as table:
        writer = csv.DictWriter(table, fieldnames=list(numbers[0]))
        writer.writeheader()
        writer.writerows(numbers)
    write_json(
        files[-1],
        {
            "scenario": scenario.name,
            "seed": scenario.simulation.seed,
            "disturbances": list(chosen_disturbances(scenario)),
            "currency": currency(scenario),
            "advantage": advantage(rows),
            "baselines": [
                row.numbers()
                | {"sweep": [dataclasses.asdict(p) for p in row.outcome.sweep]}
                for row in rows.values()
            ],
        },
    )
    return files


def currency(scenario: Scenario) -> dict[str, Any]:
    """In what costs are counted, and what they leave out, in SI units and rad/s."""
    bandwidth, cost = scenario.controller.bandwidth, scenario.cost
    rate = cost.bandwidth_rate
    others = {
        "bandwidth_rate_weight": rate if np.any(rate) else None,
        "state_weights": cost.state and dataclasses.asdict(cost.state),
        "terminal_weights": cost.terminal and dataclasses.asdict(cost.terminal),
        "own": [type(each).__name__ for each in cost.own],
    }
    return {
        "input_weight": scenario.cost.input,
        "bandwidth_weight": scenario.cost.bandwidth,
        "bandwidth_min": bandwidth.min,
        "bandwidth_max": bandwidth.max,
        "slope": list(scenario.controller.slope),
        **{name: value for name, value in others.items() if value},
    }


def currency_text(scenario: Scenario) -> tuple[str, str]:
    """The same as two lines: what the cost charges, and what it does not."""
    c = currency(scenario)
    low, high = c["bandwidth_min"], c["bandwidth_max"]
    slopes = [f"{value:g}" for value in c["slope"]]
    slope = slopes[0] if len(set(slopes)) == 1 else f"({', '.join(slopes)})"
    running, end = _terms(scenario)
    return (
        f"cost: ∫ {' + '.join(running)} dt{''.join(f' + {term}' for term in end)},"
        f" with α from {low:g} to {high:g} rad/s;",
        f"it does not charge λ = {slope} 1/s: compare other λ by ω_c, "
        "the gain crossover of the loop of α and λ",
    )


def _terms(scenario: Scenario) -> tuple[list[str], list[str]]:
    """Of the cost: under the integral, and at the end."""
    cost, low = scenario.cost, scenario.controller.bandwidth.min

    def term(weight: Weight, what: str) -> str:
        if isinstance(weight, (int, float)):
            return f"{weight:g}‖{what}‖²"
        return f"({what})'{show(weight)}({what})"

    def of_state(weights: StateWeights | None, goal: str, when: str) -> list[str]:
        each = [getattr(weights, name, 0.0) for name in DERIVATIVES]
        names = [f"{y}*{when} − {goal}" for y in ("y", "ẏ", "ÿ")]
        return [
            term(weight, name)
            for weight, name in zip(each, names, strict=True)
            if np.any(weight)
        ]

    running = [term(cost.input, "u*"), term(cost.bandwidth, f"α − {low:g}")]
    if np.any(cost.bandwidth_rate):
        running.append(term(cost.bandwidth_rate, "dα/dt"))
    to = "line" if cost.state is not None and cost.state.line is not None else "goal"
    running += of_state(cost.state, to, "")
    running += [type(each).__name__ for each in cost.own]
    return running, of_state(cost.terminal, "goal", "(t_f)")


def advantage(rows: dict[str, Row]) -> float | None:
    """What the best fixed bandwidth costs, relative to DTMPC, if both are certified."""
    fixed, whole = rows["state_dependent"].outcome, rows["both"].outcome
    if not (fixed.certified and whole.certified):
        return None
    return fixed.result.cost / whole.result.cost


def to_figure(scenario: Scenario, rows: dict[str, Row]) -> Figure:
    """The plans, or last attempts at one, and in what their cost is counted."""
    panels = list(to_panels(rows.values()))
    return plot_plans(
        scenario=scenario, panels=panels, note="\n".join(currency_text(scenario))
    )


def to_panels(rows: Iterable[Row]) -> Iterator[Panel]:
    """The baselines in the figure: plans, or last attempts at one."""
    for row in rows:
        outcome = row.outcome
        baseline, result = outcome.baseline, outcome.result
        alpha = baseline.fixed_bandwidth
        title = baseline.title + (f", α = {alpha:.4g} rad/s" if alpha else "")
        if outcome.plan is not None and row.flights is not None:
            certified = "certified" if outcome.certified else "not certified"
            loop = crossover(outcome.plan, baseline.scenario)
            title += f": {certified}, cost {result.cost:.1f}, ω_c {loop:.1f} rad/s,"
            title += f" {row.flights.collisions} of {len(row.flights)} flights collide"
            yield Panel(title, outcome.plan)
        elif result.attempt is not None:
            why = f"{result.status}, the last attempt"
            others = len(outcome.sweep) - 1
            if others > 0:
                why = f"{result.status}, as at {others} others; the nearest attempt"
            yield Panel(f"{title}: {why}", result.attempt)


def to_text(scenario: Scenario, rows: dict[str, Row]) -> str:
    """The table as text."""

    def cell(value: Any, form: str) -> str:
        if isinstance(value, bool):
            return "yes" if value else "no"
        return "-" if value is None else format(value, form)

    columns = {
        "feasible": ("feasible", ""),
        "certified": ("certified", ""),
        "cost": ("cost", ".2f"),
        "input_cost": ("of it input", ".2f"),
        "fixed_bandwidth": ("fixed α", ".4g"),
        "crossover": ("ω_c", ".2f"),
        "tube_mean": ("tube mean", ".3f"),
        "tube_largest": ("largest", ".3f"),
        "effort": ("effort", ".2f"),
        "violations": ("violations", "d"),
        "collisions": ("collisions", "d"),
        "flights": ("of flights", "d"),
        "clearance": ("clearance", ".3f"),
        "plan_time_s": ("plan s", ".2f"),
    }
    lines = []
    for row in rows.values():
        numbers = row.numbers()
        cells = [cell(numbers[key], form) for key, (_, form) in columns.items()]
        lines.append([row.outcome.baseline.title, *cells])
    notes = [
        f"{row.outcome.baseline.title}: {row.outcome.result.status}, "
        f"{row.outcome.message}"
        if row.outcome.plan is None
        else f"{row.outcome.baseline.title}: {row.outcome.message}"
        for row in rows.values()
        if not row.outcome.certified
    ]
    table = text_table(["", *(title for title, _ in columns.values())], lines)
    bandwidth = scenario.controller.bandwidth
    step = RESOLUTION * (bandwidth.max - bandwidth.min)
    factor, unit = advantage(rows), scenario.model.length_unit
    legend = [
        *currency_text(scenario),
        "ω_c: mean over time and axes, rad/s; fixed α: the best of a sweep in steps "
        f"down to {step:.3g} rad/s,",
        "of the nominal plan the highest, with which it is flown; plan s: of a whole "
        "sweep;",
        f"tube: Ω over time and axes, {unit}; effort: ∫‖u‖² dt of the median flight;",
        f"flights through {', '.join(chosen_disturbances(scenario))}; clearance: "
        f"smallest, {unit};",
        "violations: flights that left layer or tubes, broke a limit, were not finite",
    ]
    if factor is not None:
        legend.append(f"the best fixed α costs {factor:.2f} times as much as DTMPC")
    return "\n".join([table, *legend, *(["", *notes] if notes else [])])
