"""Whole experiments: their fields, what the fields must say together, and files."""

from dtmpc_drake.scenario.error import ScenarioError
from dtmpc_drake.scenario.files import (
    SHIPPED,
    load_scenario,
    parse_scenario,
    shipped_scenarios,
)
from dtmpc_drake.scenario.schema import (
    Bandwidth,
    BangBang,
    ColoredWind,
    Constant,
    Controller,
    Cost,
    Disturbance,
    Gust,
    Limits,
    ModelConfig,
    Planner,
    Scenario,
    Sensing,
    Simulation,
    UniformHold,
    Waypoint,
    WorstCase,
)

__all__ = [
    "SHIPPED",
    "Bandwidth",
    "BangBang",
    "ColoredWind",
    "Constant",
    "Controller",
    "Cost",
    "Disturbance",
    "Gust",
    "Limits",
    "ModelConfig",
    "Planner",
    "Scenario",
    "ScenarioError",
    "Sensing",
    "Simulation",
    "UniformHold",
    "Waypoint",
    "WorstCase",
    "load_scenario",
    "parse_scenario",
    "shipped_scenarios",
]
