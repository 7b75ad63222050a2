"""The command line: ``python -m diagrams simulate known_environment``.

Exit status: 0 certified and simulated, 2 bad input (one line on the standard
error), 3 infeasible or not certified.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from dtmpc_drake.scenario import (
    SHIPPED,
    Scenario,
    ScenarioError,
    load_scenario,
    shipped_scenarios,
)

BAD_INPUT, NOT_CERTIFIED = 2, 3

app = typer.Typer(
    help="Dynamic tube MPC: plan a trajectory with its tube, and fly it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ScenarioArgument = Annotated[
    str, typer.Argument(help="Name of a shipped scenario, or a YAML file.")
]


@app.command()
def simulate(
    scenario: ScenarioArgument,
    out: Annotated[
        Path | None,
        typer.Option(help="Directory for the files.  [default: out/<name>]"),
    ] = None,
    seed: Annotated[
        str | None,
        typer.Option(metavar="N", help="Of everything random, instead of the file's."),
    ] = None,
    backend: Annotated[
        str | None,
        typer.Option(metavar="clarabel|ipopt", help="Solver, instead of the file's."),
    ] = None,
) -> None:
    """Plan a scenario, fly it, and write replay, figures and numbers."""
    from diagrams.experiment import run
    from dtmpc_drake.planning import Iteration
    from dtmpc_drake.planning.planner import table_header, table_row

    console = Console(highlight=False, soft_wrap=True)

    def report(iteration: Iteration) -> None:
        console.print(table_row(iteration), markup=False)

    try:
        chosen = _with_options(load_scenario(scenario), seed=seed, backend=backend)
        console.print(repr(chosen), markup=False)
        console.print(table_header(), style="bold", markup=False)
        experiment = run(chosen, out, report=report)
    except ScenarioError as error:
        _refuse(str(error))
    except OSError as error:
        reason = error.strerror or type(error).__name__
        where = error.filename or out
        _refuse(f"--out: got {str(where)!r}, but it must be writable ({reason})")
    console.print()
    console.print(repr(experiment), markup=False)
    if not experiment.result.certified:
        raise typer.Exit(NOT_CERTIFIED)


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
) -> None:
    """Print a scenario file, to be copied and changed."""
    try:
        scenario = load_scenario(name)
    except ScenarioError as error:
        _refuse(str(error))
    shipped = name in shipped_scenarios()
    typer.echo((_text(name) if shipped else scenario.to_yaml()).rstrip())


@app.command()
def check(
    file: Annotated[str, typer.Argument(help="A YAML file, or a shipped scenario.")],
) -> None:
    """Validate a scenario without planning it."""
    try:
        scenario = load_scenario(file)
    except ScenarioError as error:
        _refuse(str(error))
    typer.echo(f"valid: {scenario!r}")


def _with_options(
    scenario: Scenario, *, seed: str | None, backend: str | None
) -> Scenario:
    """The scenario with what the command line replaces, validated again."""
    if seed is not None:
        try:
            scenario.simulation.seed = int(seed)
        except ValueError:
            raise ScenarioError("--seed", seed, "a whole number") from None
    if backend is not None:
        scenario.planner.backend = backend
    scenario.validate()
    return scenario


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


def _refuse(message: str) -> NoReturn:
    """Ends with one line on the standard error."""
    print(" ".join(message.split()), file=sys.stderr)
    raise typer.Exit(BAD_INPUT)


def main() -> None:
    """Entry point of the command line."""
    app(prog_name="python -m diagrams")


if __name__ == "__main__":
    main()
