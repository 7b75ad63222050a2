"""Which side of each obstacle: starts from the straight line and from all sides.

``python -m diagrams.which_side`` runs the scenario ``best_side`` and then compares
both initial guesses on thirty random fields, which takes a minute or two.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from dtmpc_drake.experiments.simulate import run
from dtmpc_drake.experiments.spread import spread
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import plan
from dtmpc_drake.records.result import PlanningResult
from dtmpc_drake.scenario import Planner, Scenario, Waypoint, load_scenario

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
class Comparison:
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


def compare_one(seed: int) -> Comparison:
    """Plans one random field from both initial guesses."""
    results = []
    for guess in ("straight_line", "best_side"):
        scenario = random_field(seed)
        scenario.planner.initial_guess = guess
        results.append(plan(scenario))
    return Comparison(seed, *results)


def compare(seeds: Iterable[int]) -> list[Comparison]:
    """Plans random fields from both initial guesses, one worker process a core."""
    return spread(compare_one, list(seeds))


def main() -> None:
    """Runs the experiment; files go to ``out/best_side``."""
    print(run(load_scenario("best_side")))
    print("\nrandom fields    straight line            best side")
    found = compare(SEEDS)
    for comparison in found:
        print(comparison)
    straight = sum(c.straight.certified for c in found)
    search = sum(c.search.certified for c in found)
    print(f"certified        {straight} of {len(found)}{'':16}{search} of {len(found)}")


if __name__ == "__main__":
    main()
