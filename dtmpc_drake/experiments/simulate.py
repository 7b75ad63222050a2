"""One experiment, from a scenario to files: plan, simulate, draw, write."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.diagrams.simulate import Progress
from dtmpc_drake.experiments.outputs import placed, plain, replacing, write_json
from dtmpc_drake.models import Model
from dtmpc_drake.planning import Problem, plan
from dtmpc_drake.planning.charges import charges
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.replan import counted, table
from dtmpc_drake.records.result import Iteration, PlanningResult
from dtmpc_drake.records.verdict import Breach, in_one_line
from dtmpc_drake.scenario import Scenario, require_stable_simulation, validate
from dtmpc_drake.visualization import (
    ShownFlight,
    plot_candidates,
    plot_histories,
    plot_plan,
    plot_receding_horizon,
    plot_replans,
    write_replay,
)
from dtmpc_drake.visualization.style import ColorBy

OUTPUTS = (
    "replay.html",
    "figure.png",
    "histories.png",
    "plan.npz",
    "log.npz",
    "summary.json",
)
ATTEMPT = "attempt.png"
"""The figure of a plan that is not certified."""
CANDIDATES = "candidates.png"
"""The figure of a search for the best sides, if there was one."""
REPLANS = "replans.png"
"""The figure of all plans on the way, if there could be any."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Experiment:
    """What an experiment ended with.

    Attributes:
        scenario: that was run.
        result: of planning.
        log: of the simulation; None if there was no certified plan to fly.
        files: that were written.
    """

    scenario: Scenario
    result: PlanningResult
    log: Flight | None
    files: tuple[Path, ...]

    @property
    def breaches(self) -> tuple[Breach, ...]:
        """What the flight broke, the first before all else; none if not flown."""
        return self.log.breaches(self.scenario) if self.log is not None else ()

    @property
    def safe(self) -> bool:
        """Whether the plan is certified, and its flight kept all that this means."""
        return self.result.certified and self.log is not None and not self.breaches

    def summary(self) -> dict[str, Any]:
        """The contents of ``summary.json``; see `summarize`."""
        return summarize(self.scenario, self.result, self.log)

    def __repr__(self) -> str:
        """A summary that a person can read."""
        result = self.result
        lines = [f"{self.scenario.name}: {result.status}, {result.message}"]
        if result.certificate is not None:
            lines += ["", "margins, for all times"]
            lines += [f"  {line}" for line in str(result.certificate).splitlines()]
        lines += [
            "",
            f"cost            {result.cost:.4f}",
            f"planning time   {result.times['total']:.3f} s"
            f" ({len(result.history)} iterations on {result.backend},"
            f" certificate {result.times['certify']:.3f} s)",
        ]
        if result.candidates:
            rows = result.candidates_table().splitlines()
            lines += ["", "candidates", *(f"  {row}" for row in rows), ""]
        if self.log is None:
            lines.append("simulation      none: there is no certified plan to fly")
        else:
            seen = self.log.extremes()
            model = self.scenario.model
            length, speed = model.length_unit, model.derivative_unit(1)
            lines += [
                "simulation      worst"
                f" |s|/Φ {seen['worst_layer_ratio']:.3f},"
                f" |ỹ|/Ω {seen['worst_position_ratio']:.3f},"
                f" |dỹ/dt|/W {seen['worst_velocity_ratio']:.3f}",
                f"{'':16}smallest clearance {seen['smallest_clearance']:.3f} {length}",
                f"{'':16}largest input {seen['largest_input']:.3f} {model.input_unit},"
                f" largest speed {seen['largest_speed']:.3f} {speed}",
            ]
            lines.append(f"flight          {flight_verdict(self.breaches)}")
        if self.log is not None and self.log.replans:
            lines += ["", counted(self.log.replans)]
            lines += [f"  {line}" for line in table(self.log.replans).splitlines()]
        lines += ["", "files", *(f"  {path}" for path in self.files)]
        return "\n".join(lines)


def run(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    report: Callable[[Iteration], None] | None = None,
    progress: Progress | None = None,
) -> Experiment:
    """Plans, simulates if the plan is certified, and writes everything.

    A certified plan gives all of `OUTPUTS`, `CANDIDATES` after a search for the best
    sides, and `REPLANS` if there may be more plans on the way; ``plan.npz`` is then
    what was in force at each time.  Any other gives ``summary.json`` and a figure of
    the attempt.  All take their places at the end, and outputs of an earlier run
    that these do not replace are set aside; see `outputs.replacing`.

    Args:
        scenario: the whole experiment.
        out: directory; ``out/<name of the scenario>`` if left out.
        report: is called with every iteration of the planner as it ends.
        progress: is told how far the flight is.

    Raises:
        ScenarioError: if the scenario makes no sense; nothing is written then.
        OSError: if the directory cannot be written.
    """
    validate(scenario)
    require_stable_simulation(scenario)
    out = Path("out", scenario.name) if out is None else Path(out)
    with replacing(out, (*OUTPUTS, ATTEMPT, CANDIDATES, REPLANS)) as work:
        ended = _run(scenario, work, report, progress)
    return dataclasses.replace(ended, files=placed(ended.files, work, out))


def _run(
    scenario: Scenario,
    out: Path,
    report: Callable[[Iteration], None] | None,
    progress: Progress | None,
) -> Experiment:
    result = plan(scenario, report=report)
    log = None
    files = []
    color_by = color_of(scenario)
    if result.certified and result.plan is not None:
        # On the way, the planner makes its own first plan: the same one.
        given = None if scenario.is_receding else result.plan
        log = Simulate(scenario, plan=given, progress=progress)
        flown = log.flown_plan() or result.plan
        files += [out / name for name in OUTPUTS]
        status = counted(log.replans) if log.replans else result.status
        write_replay(
            files[0],
            scenario=scenario,
            plan=flown,
            flight=ShownFlight.of(log, status),
            color_by=color_by,
        )
        if log.replans and scenario.model.num_outputs > 1:
            figure = plot_receding_horizon(
                scenario=scenario, flight=log, color_by=color_by
            )
        else:
            figure = plot_plan(
                scenario=scenario,
                plan=flown,
                position=log.position,
                time=log.time,
                color_by=color_by,
            )
        figure.savefig(files[1])
        if log.replans:
            files.insert(2, out / REPLANS)
            plot_replans(scenario=scenario, flight=log).savefig(files[2])
        plot_histories(scenario=scenario, plan=flown, flight=log).savefig(
            out / "histories.png"
        )
        flown.save(out / "plan.npz")
        log.save(out / "log.npz")
    else:
        if result.attempt is not None:
            files.append(out / ATTEMPT)
            plot_plan(
                scenario=scenario, plan=result.attempt, color_by=color_by
            ).savefig(files[-1])
        files.append(out / OUTPUTS[-1])
    if result.candidates and result.attempt and result.attempt.num_outputs > 1:
        plot_candidates(
            scenario=scenario, plan=result.attempt, candidates=result.candidates
        ).savefig(out / CANDIDATES)
        files.insert(-1, out / CANDIDATES)
    write_json(files[-1], summarize(scenario, result, log))
    return Experiment(scenario, result, log, tuple(files))


def _charges(scenario: Scenario, result: PlanningResult) -> dict[str, float] | None:
    """The terms of a plan's cost."""
    if result.attempt is None:
        return None
    return charges(result.attempt, Problem.from_scenario(scenario))


def flight_verdict(breaches: Sequence[Breach]) -> str:
    """One line: what a flight broke first, when and by how much."""
    if not breaches:
        return "kept layer, tubes, limits and obstacles at every step"
    return in_one_line(breaches)


def color_of(scenario: Scenario) -> ColorBy:
    """What the colours of a plan show: a fixed bandwidth's would say nothing."""
    return "bandwidth" if scenario.controller.bandwidth.fixed is None else "speed"


def units(model: Model) -> dict[str, Any]:
    """What the numbers of an experiment are in, by what its outputs are called."""
    return {
        "length": model.length_unit,
        "time": "s",
        "outputs": dict(zip(model.output_names, model.output_units, strict=True)),
        "inputs": dict(zip(model.input_names, model.input_units, strict=True)),
    }


def summarize(
    scenario: Scenario, result: PlanningResult, log: Flight | None
) -> dict[str, Any]:
    """An experiment as plain numbers and texts; None where there is no number.

    Times are in s; `plan_time_s` is one cold plan, certificate included.
    """
    certificate = result.certificate
    broken = log.breaches(scenario) if log is not None else ()
    margins = certificate.margins if certificate is not None else {}
    summary = {
        "scenario": scenario.name,
        "status": result.status,
        "certified": bool(result.certified),
        "flight_ok": None if log is None else not broken,
        "flight": None if log is None else flight_verdict(broken),
        "breaches": [dataclasses.asdict(breach) for breach in broken],
        "message": result.message,
        "backend": result.backend,
        "seed": scenario.simulation.seed,
        "units": units(scenario.model),
        "margins": {name: margin.summary() for name, margin in margins.items()},
        "cost": result.cost,
        "charges": _charges(scenario, result),
        "iterations": len(result.history),
        "plan_time_s": result.times["total"],
        "times": result.times,
        "candidates": [
            {
                "start": c.start,
                "sides": c.sides,
                "length": c.length,
                "coarse_cost": c.coarse_cost,
                "violation": c.violation,
                "status": c.status,
                "cost": c.cost,
                "chosen": c.chosen,
            }
            for c in result.candidates
        ],
        "extremes": log.extremes() if log is not None else None,
        "known_since": log.known_since if log is not None else None,
        "replans": [r.summary() for r in log.replans] if log is not None else None,
    }
    cleaned: dict[str, Any] = plain(summary)
    return cleaned
