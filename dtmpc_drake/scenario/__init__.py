"""Whole experiments: their fields, what the fields must say, and files.

Three parts: `schema` holds the dataclasses, `check` what they must say by themselves
and together, `files` reads and writes them.  Nothing here plans or flies.
"""

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.scenario.check import (
    require_one_plan,
    require_stable_simulation,
    sensing_range_needed,
    validate,
)
from dtmpc_drake.scenario.files import (
    SHIPPED,
    load_scenario,
    parse_scenario,
    shipped_scenarios,
    to_yaml,
)
from dtmpc_drake.scenario.schema import (
    Bandwidth,
    Controller,
    Costs,
    Limits,
    Planner,
    Scenario,
    Sensing,
    Simulation,
    SolverOptions,
    Waypoint,
)
from dtmpc_drake.scenario.size import require_trials

__all__ = [
    "SHIPPED",
    "Bandwidth",
    "Controller",
    "Costs",
    "Limits",
    "Planner",
    "Scenario",
    "ScenarioError",
    "Sensing",
    "Simulation",
    "SolverOptions",
    "Waypoint",
    "load_scenario",
    "parse_scenario",
    "require_one_plan",
    "require_stable_simulation",
    "require_trials",
    "sensing_range_needed",
    "shipped_scenarios",
    "to_yaml",
    "validate",
]
