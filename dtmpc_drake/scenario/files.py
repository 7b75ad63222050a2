"""Scenarios that come with the package or from anybody's file."""

from importlib import resources
from pathlib import Path

from dtmpc_drake.scenario.error import ScenarioError
from dtmpc_drake.scenario.schema import Scenario
from dtmpc_drake.scenario.text import read_text, read_yaml
from dtmpc_drake.scenario.typed import typed

SHIPPED = resources.files("dtmpc_drake.scenario")


# Reading files.


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(
        entry.name.removesuffix(".yaml")
        for entry in SHIPPED.iterdir()
        if entry.name.endswith(".yaml")
    )


def load_scenario(source: str | Path) -> Scenario:
    """Loads and validates a scenario.

    Args:
        source: the name of a shipped scenario, or the path of a YAML file.

    Raises:
        ScenarioError: if there is no such scenario, or anything in it is wrong.
    """
    if str(source) in shipped_scenarios():
        text = (SHIPPED / f"{source}.yaml").read_text(encoding="utf-8")
    else:
        try:
            text = read_text(source)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            names = ", ".join(shipped_scenarios())
            raise ScenarioError(
                "scenario",
                str(source),
                f"a file ({reason}) or one of: {names}",
            ) from None
    return parse_scenario(text)


def parse_scenario(text: str) -> Scenario:
    """Builds and validates a scenario from YAML text; errors as `load_scenario`."""
    scenario: Scenario = typed(Scenario, read_yaml(text), "")
    scenario.validate()
    return scenario
