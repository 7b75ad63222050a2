"""A small field with every kind of cost."""

from __future__ import annotations

import dataclasses
from typing import Any

from dtmpc_drake.planning import Problem, plan
from dtmpc_drake.planning.charges import charges
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Scenario, parse_scenario, validate

LINE = "line: {point: [0.3, 0], direction: [0, 2]}"
FIELD = """
name: field
model: !IntegratorChain {num_outputs: 2, order: 2, error_bound: 0.1}
disturbance: !UniformHold {bound: [0.3, 0.3]}
controller: {slope: [2, 2], initial_boundary_layer: 0.2}
start: {position: [0, 0]}
goal: {position: [0.3, 6.0], velocity: [0, 0.5]}
duration: 6.0
obstacles: [!Cylinder {center: [-0.4, 3.0], radius: 0.7}]
planner: {intervals: 16, time_limit: 600}
"""
MATRIX = [[2.0, 1.0], [1.0, 2.0]]


def field(backend: str = "clarabel", **goal: Any) -> Scenario:
    """Past a pillar in the plane."""
    scenario = parse_scenario(FIELD)
    scenario.planner.backend = backend
    scenario.goal = dataclasses.replace(scenario.goal, **goal)
    return scenario


def with_cost(text: str, *, soft: Any = False, backend: str = "clarabel") -> Scenario:
    """The same with a section of costs."""
    scenario = parse_scenario(f"{FIELD}cost: {text}\n")
    scenario.planner.backend, scenario.goal.soft = backend, soft
    validate(scenario)
    return scenario


def planned(scenario: Scenario) -> PlanningResult:
    result = plan(scenario)
    assert result.certified, result.message
    return result


def parts(scenario: Scenario, result: PlanningResult) -> dict[str, float]:
    return charges(result.plan, Problem.from_scenario(scenario))
