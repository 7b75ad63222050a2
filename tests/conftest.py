"""Fixtures that the tests share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import hypothesis
import pytest

from dtmpc_drake.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from dtmpc_drake.planning import Problem
    from dtmpc_drake.records.result import PlanningResult

# The same examples on every machine, and no files left behind.
hypothesis.settings.register_profile(
    "deterministic", max_examples=25, deadline=None, derandomize=True, database=None
)
hypothesis.settings.load_profile("deterministic")


@pytest.fixture
def known_scenario() -> Scenario:
    """The paper's first experiment, fresh for each test."""
    return load_scenario("known_environment")


@pytest.fixture(scope="session")
def known_result() -> PlanningResult:
    """The plan of the paper's first experiment, solved once."""
    from dtmpc_drake.planning import plan

    return plan(load_scenario("known_environment"))


@pytest.fixture(scope="session")
def known_problem() -> Problem:
    """What that plan solves."""
    from dtmpc_drake.planning import Problem

    return Problem.from_scenario(load_scenario("known_environment"))
