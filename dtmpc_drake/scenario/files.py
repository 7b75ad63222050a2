"""Scenarios that come with the package or from anybody's file, and back to text.

A text becomes sections in one pass (`text`), and these become typed dataclasses
(`typed`).  Writing goes the other way, with a tag for every registered class.
"""

from __future__ import annotations

import dataclasses
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from dtmpc_drake.errors import ScenarioError, require
from dtmpc_drake.registry import is_registered
from dtmpc_drake.scenario.check import validate_values
from dtmpc_drake.scenario.schema import Scenario, SolverOptions
from dtmpc_drake.scenario.text import read_text, read_yaml
from dtmpc_drake.scenario.typed import is_writable, typed

SHIPPED = resources.files("dtmpc_drake.scenario")


# Reading.


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
    validate_values(scenario)
    return scenario


# Writing.


def to_yaml(scenario: Scenario) -> str:
    """A scenario as a text that `parse_scenario` reads.

    Raises:
        ScenarioError: if something is of a class that no file can name.
    """
    checked: Scenario = typed(Scenario, scenario, "")
    parts = {"model": checked.model, "disturbance": checked.disturbance}
    parts |= {f"obstacles[{i}]": one for i, one in enumerate(checked.obstacles)}
    parts |= {f"limits.own[{i}]": one for i, one in enumerate(checked.limits.own)}
    parts |= {f"cost.own[{i}]": one for i, one in enumerate(checked.cost.own)}
    for field, part in parts.items():
        cls = type(part)
        why = "a dataclass: no file can hold another class"
        require(field, cls.__name__, is_writable(cls), why)
    return yaml.dump(
        checked, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=80
    )


class _Dumper(yaml.SafeDumper):
    """Writes dataclasses as their fields, without those that say nothing."""

    def represent_data(self, data: Any) -> yaml.Node:
        """See base class."""
        if not dataclasses.is_dataclass(data):
            return super().represent_data(data)
        given = {}
        for field in dataclasses.fields(data):
            value = getattr(data, field.name)
            left_out = value is field.default and (value is None or value is False)
            left_out |= value == [] or value == SolverOptions()
            if field.init and not left_out:
                given[field.name] = value
        tag = f"!{type(data).__name__}" if is_registered(type(data)) else _PLAIN
        return self.represent_mapping(tag, given)

    def represent_sequence(self, tag: Any, items: Any, flow_style: Any = None) -> Any:
        """Lists of numbers on one line."""
        flow = all(isinstance(item, (int, float, str, type(None))) for item in items)
        return super().represent_sequence(tag, items, flow_style=flow)

    def ignore_aliases(self, data: Any) -> bool:
        """Whatever stands twice is written twice."""
        return True


_PLAIN = "tag:yaml.org,2002:map"
