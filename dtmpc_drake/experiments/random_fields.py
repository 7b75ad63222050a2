"""Random fields, each planned from both initial guesses.

How many does the straight line certify, and how many the search for the best sides?
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from dtmpc_drake.experiments.spread import spread
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import plan
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Planner, Scenario, Waypoint

SEEDS = range(30)


def random_field(seed: int) -> Scenario:
    """Ten pillars at random on 9 m of the way, some of them in the way."""
    generator = np.random.default_rng(seed)
    obstacles = []
    for _ in range(10):
        x, y = generator.uniform(-2.5, 2.5), generator.uniform(2.5, 11.5)
        obstacles.append(Cylinder([x, y], generator.uniform(0.4, 0.9)))
    return Scenario(
        name=f"random_field_{seed}",
        start=Waypoint(position=[0.0, 0.0, 1.0], velocity=[0.0, 1.0, 0.0]),
        goal=Waypoint(position=[0.0, 14.0, 1.0], velocity=[0.0, 1.0, 0.0]),
        duration=10.0,
        obstacles=list(obstacles),
        planner=Planner(intervals=28, time_budget=1.0),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class FieldPlans:
    """One field, planned from both initial guesses.

    Attributes:
        seed: of the field.
        straight: planned from the straight line.
        search: planned with ``best_side``.
    """

    seed: int
    straight: PlanningResult
    search: PlanningResult

    def __str__(self) -> str:
        """One line: both statuses and costs."""
        parts = [
            f"{result.status:<13} {result.cost:7.2f}"
            if result.certified
            # The cost of what breaks the constraints says nothing.
            else f"{result.status:<13} {'':7}"
            for result in (self.straight, self.search)
        ]
        return f"field {self.seed:2d}  " + "  ".join(parts)


def plan_field(seed: int) -> FieldPlans:
    """Plans one random field from both initial guesses."""
    results = []
    for guess in ("straight_line", "best_side"):
        scenario = random_field(seed)
        scenario.planner.initial_guess = guess
        results.append(plan(scenario))
    return FieldPlans(seed, *results)


def plan_fields(seeds: Iterable[int]) -> list[FieldPlans]:
    """Plans random fields from both initial guesses, one worker process a core.

    A script that calls this must guard its main part; see `spread`.
    """
    return spread(plan_field, list(seeds))
