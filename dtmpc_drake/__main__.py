"""The command line: ``dtmpc simulate known_environment``.

``python -m dtmpc_drake`` is the same, also where the package is not installed.

Exit status: 0 certified and simulated, 2 bad input (one line on the standard
error), 3 infeasible or not certified, or a certified plan that failed in flight.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from dtmpc_drake import __version__
from dtmpc_drake.errors import ScenarioError, require
from dtmpc_drake.plugins import load_plugins
from dtmpc_drake.records.export import FORMATS
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.scenario import (
    SHIPPED,
    Scenario,
    load_scenario,
    shipped_scenarios,
    to_yaml,
    validate,
)

if TYPE_CHECKING:
    from dtmpc_drake.experiments.monte_carlo import Batch

BAD_INPUT, NOT_CERTIFIED = 2, 3
OPTIONS = (
    "seed",
    "trials",
    "batch-size",
    "disturbance",
    "scheduler",
    "format",
    "out",
)
"""Fields of a ScenarioError that are options and no part of a file."""

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    """Prints the version and ends, if it is asked for."""
    if wanted:
        typer.echo(f"dtmpc_drake {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_version,
            is_eager=True,
            help="Of this package.",
        ),
    ] = False,
) -> None:
    """Dynamic tube MPC: plan a trajectory with its tube, and fly it."""


ScenarioArgument = Annotated[
    str, typer.Argument(help="Name of a shipped scenario, or a YAML file.")
]

PluginOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FILE",
        help="A Python file of your own models, obstacles or disturbances, to be run "
        "first; may be given several times.",
    ),
]
SeedOption = Annotated[
    str | None,
    typer.Option(metavar="N", help="Of everything random, instead of the file's."),
]
TrialsOption = Annotated[
    str,
    typer.Option(
        metavar="N", help="Flights: through each disturbance, or of each plan."
    ),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Of a running Dask scheduler, such as tcp://127.0.0.1:8786, instead of "
        "one worker a core.",
    ),
]


@app.command()
def simulate(
    scenario: ScenarioArgument,
    out: Annotated[
        Path | None,
        typer.Option(help="Directory for the files.  [default: out/<name>]"),
    ] = None,
    seed: SeedOption = None,
    plugin: PluginOption = None,
    backend: Annotated[
        str | None,
        typer.Option(metavar="clarabel|ipopt", help="Solver, instead of the file's."),
    ] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Print what came out, and no progress.")
    ] = False,
) -> None:
    """Plan a scenario, fly it, and write replay, figures and numbers.

    Exits with 0 if the plan is certified and its flight kept layer, tubes, limits
    and obstacles at every step of the integrator, else with 3.
    """
    from dtmpc_drake.experiments.simulate import flight_verdict, run
    from dtmpc_drake.records.result import Iteration, table_header, table_row

    console = Console(highlight=False, soft_wrap=True)

    def report(iteration: Iteration) -> None:
        console.print(table_row(iteration), markup=False)

    with _input_errors(out):
        chosen = _load(scenario, plugin, seed=seed, backend=backend)
        console.print(repr(chosen), markup=False)
        if not quiet:
            console.print(table_header(), style="bold", markup=False)
        shown = console.is_terminal and not quiet
        with _flight(console, chosen.duration) if shown else nullcontext() as flown:
            experiment = run(
                chosen, out, report=None if quiet else report, progress=flown
            )
    console.print()
    console.print(repr(experiment), markup=False)
    if not experiment.safe:
        if experiment.breaches:
            _say(f"{chosen.name}: {flight_verdict(experiment.breaches)}")
        raise typer.Exit(NOT_CERTIFIED)


@app.command("monte-carlo")
def monte_carlo(
    scenario: ScenarioArgument,
    trials: TrialsOption = "1000",
    disturbance: Annotated[
        str,
        typer.Option(
            metavar="KIND",
            help="uniform, bang_bang, worst_case, wind, gust, all, or scenario.",
        ),
    ] = "all",
    seed: SeedOption = None,
    plugin: PluginOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Directory for the files.  [default: out/<name>_monte_carlo]"
        ),
    ] = None,
    scheduler: SchedulerOption = None,
    batch_size: Annotated[
        str, typer.Option(metavar="N", help="Trials in one diagram.")
    ] = "250",
) -> None:
    """Plan a scenario once and fly the plan many times.

    Exits with 0 if the plan is certified and no trial left its tube or hit
    anything, else with 3.
    """
    from dtmpc_drake.experiments import monte_carlo as experiment

    console = Console(highlight=False, soft_wrap=True)
    with _input_errors(out):
        chosen = _load(scenario, plugin, seed=seed)
        console.print(repr(chosen), markup=False)
        with _flights(console) as (start, done):
            ended = experiment.run(
                chosen,
                out,
                trials=_whole("trials", trials),
                disturbance=disturbance,
                batch_size=_whole("batch-size", batch_size),
                scheduler=scheduler,
                start=start,
                done=done,
            )
    console.print()
    console.print(repr(ended), markup=False)
    if not ended.safe:
        raise typer.Exit(NOT_CERTIFIED)


@app.command()
def compare(
    scenario: ScenarioArgument,
    trials: TrialsOption = "1000",
    seed: SeedOption = None,
    plugin: PluginOption = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Directory for the files.  [default: out/<name>_compare]"),
    ] = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Plan a scenario with and without parts of the method, and fly each plan.

    The flights of a plan are shared by bang_bang, worst_case, wind and gust.

    Exits with 0 if the whole method's plan is certified and no flight of it left
    its tube or hit anything, else with 3.
    """
    from dtmpc_drake.experiments import compare as experiment

    console = Console(highlight=False, soft_wrap=True)
    with _input_errors(out):
        chosen = _load(scenario, plugin, seed=seed)
        console.print(repr(chosen), markup=False)
        with _flights(console) as (start, done):
            ended = experiment.run(
                chosen,
                out,
                trials=_whole("trials", trials),
                scheduler=scheduler,
                start=start,
                done=done,
            )
    console.print()
    console.print(repr(ended), markup=False)
    if not ended.safe:
        raise typer.Exit(NOT_CERTIFIED)


@app.command()
def export(
    plan: Annotated[
        Path, typer.Argument(help="A saved plan, such as out/<name>/plan.npz.")
    ],
    kind: Annotated[
        str, typer.Option("--format", metavar="|".join(FORMATS), help="Of the text.")
    ] = "csv",
    out: Annotated[
        Path | None, typer.Option(help="File to write.  [default: standard output]")
    ] = None,
) -> None:
    """Write a plan's reference in a format that other programs read.

    csv: the piecewise polynomials that small quadrotors read (Crazyswarm,
    uav_trajectories). A line has the duration of a piece and its coefficients of x,
    y, z and yaw, in powers 0 to 7 of the time since the piece began.
    """
    with _input_errors(out):
        require("format", kind, kind in FORMATS, ", ".join(FORMATS))
        saved = _plan(plan)
        text = FORMATS[kind](saved)
        if out is None:
            typer.echo(text, nl=False)
            return
        own = not (out.exists() and out.samefile(plan))
        require("out", str(out), own, "another file than the plan's own")
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    duration = saved.end_time - saved.start_time
    typer.echo(f"{out}: {len(saved.knots) - 1} pieces, {duration:g} s")


@app.command("list")
def list_scenarios() -> None:
    """List the shipped scenarios."""
    names = shipped_scenarios()
    width = max(map(len, names), default=0)
    for name in names:
        typer.echo(f"{name:<{width}}  {_description(name)}")


@app.command()
def show(
    name: Annotated[str, typer.Argument(help="Name of a shipped scenario, or a file.")],
    plugin: PluginOption = None,
) -> None:
    """Print a scenario file, to be copied and changed."""
    try:
        scenario = _load(name, plugin)
    except ScenarioError as error:
        _refuse(str(error))
    shipped = name in shipped_scenarios()
    typer.echo((_text(name) if shipped else to_yaml(scenario)).rstrip())


@app.command()
def check(
    file: Annotated[str, typer.Argument(help="A YAML file, or a shipped scenario.")],
    plugin: PluginOption = None,
) -> None:
    """Validate a scenario without planning it."""
    try:
        scenario = _load(file, plugin)
    except ScenarioError as error:
        _refuse(str(error))
    typer.echo(f"valid: {scenario!r}")


def _load(
    name: str,
    plugins: list[str] | None,
    *,
    seed: str | None = None,
    backend: str | None = None,
) -> Scenario:
    """The scenario with what the command line replaces, validated again."""
    try:
        load_plugins(plugins or [])
    except ScenarioError as error:
        _refuse(f"--{error}")
    scenario = load_scenario(name)
    if seed is not None:
        scenario.simulation.seed = _whole("seed", seed)
    if backend is not None:
        scenario.planner.backend = backend
    validate(scenario)
    return scenario


def _plan(path: Path) -> Plan:
    """A saved plan; ends with one line if there is none."""
    try:
        return Plan.load(path)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        _refuse(f"plan: got {str(path)!r}, but it must be readable ({reason})")
    except ValueError as error:
        _refuse(str(error))


def _whole(option: str, value: str) -> int:
    try:
        return int(value)
    except ValueError:
        raise ScenarioError(option, value, "a whole number") from None


def _text(name: str) -> str:
    return (SHIPPED / f"{name}.yaml").read_text(encoding="utf-8")


def _description(name: str) -> str:
    """The comment at the top of a shipped file."""
    lines = []
    for line in _text(name).splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.removeprefix("#").strip())
    return " ".join(lines)


@contextlib.contextmanager
def _input_errors(out: Path | None) -> Iterator[None]:
    """Ends with one line if a scenario, an option or the directory is bad."""
    try:
        yield
    except ScenarioError as error:
        option = "--" if error.field in OPTIONS else ""
        _refuse(f"{option}{error}")
    except OSError as error:
        reason = error.strerror or type(error).__name__
        where = error.filename or out
        _refuse(f"--out: got {str(where)!r}, but it must be writable ({reason})")


@contextlib.contextmanager
def _flight(console: Console, duration: float) -> Iterator[Callable[[float], None]]:
    """A line that says how much of a flight is flown: what to call on the way."""
    columns = (
        TextColumn("flight"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:g} s"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("", total=duration, start=False, visible=False)
        said = -duration

        def flown(time: float) -> None:
            nonlocal said
            if time >= said + duration / 200:  # steps may be very many
                said = time
                progress.start_task(task)
                progress.update(task, completed=time, visible=True)

        yield flown


@contextlib.contextmanager
def _flights(
    console: Console,
) -> Iterator[tuple[Callable[[int], None], Callable[[Batch], None]]]:
    """A progress bar: what to call before all flights, and after each batch."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("planning", total=None)

        def start(total: int) -> None:
            progress.update(task, description="flights", total=total)

        def done(batch: Batch) -> None:
            progress.advance(task, len(batch.numbers))

        yield start, done


def _say(message: str) -> None:
    """One line on the standard error."""
    print(" ".join(message.split()), file=sys.stderr)


def _refuse(message: str) -> NoReturn:
    """Ends with one line on the standard error."""
    _say(message)
    raise typer.Exit(BAD_INPUT)


def main() -> None:
    """Entry point of ``dtmpc`` and of ``python -m dtmpc_drake``."""
    app()


if __name__ == "__main__":
    main()
