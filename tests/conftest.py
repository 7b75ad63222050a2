"""Fixtures that the tests share."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import hypothesis
import pytest

from dtmpc_drake.costs import COSTS
from dtmpc_drake.disturbances import DISTURBANCES
from dtmpc_drake.limits import LIMITS
from dtmpc_drake.models import MODELS
from dtmpc_drake.obstacles import OBSTACLES
from dtmpc_drake.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from dtmpc_drake.planning import Problem
    from dtmpc_drake.records.result import PlanningResult

REGISTRIES = (MODELS, OBSTACLES, DISTURBANCES, LIMITS, COSTS)

# The same examples on every machine, and no files left behind.
hypothesis.settings.register_profile(
    "deterministic", max_examples=25, deadline=None, derandomize=True, database=None
)
hypothesis.settings.load_profile("deterministic")


@pytest.fixture(autouse=True)
def library_only(request: pytest.FixtureRequest) -> Iterator[None]:
    """No test sees what another one's file has registered.

    Known are the library's classes, those that the test's module can see, and those
    of the packages that it names in `OWN_KINDS`.
    """
    own = getattr(request.module, "OWN_KINDS", ())
    seen = set(map(id, vars(request.module).values()))
    with forgetting():
        for registry in REGISTRIES:
            for name, cls in list(registry._classes.items()):
                known = cls.__module__.startswith(("dtmpc_drake.", *own))
                if not known and id(cls) not in seen:
                    del registry._classes[name]
        yield


@pytest.fixture
def own_registries() -> Iterator[None]:
    """Forgets in the end what a test registers."""
    with forgetting():
        yield


@contextlib.contextmanager
def forgetting() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for registry in REGISTRIES:
            patch.setattr(registry, "_classes", dict(registry._classes))
        yield


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
