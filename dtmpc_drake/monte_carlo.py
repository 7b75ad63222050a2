"""Many trials of one scenario."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import ClassVar

import numpy as np

from dtmpc_drake.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Trial:
    """One trial of a scenario: what is drawn for it.

    Attributes:
        index: its number, from 0.
        seed: of everything random in it.
        parameters: of the true plant, by name.
    """

    index: int
    seed: int
    parameters: dict[str, float]

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def scenario(self, scenario: Scenario) -> Scenario:
        """The scenario of this trial alone, to be simulated by itself."""
        return dataclasses.replace(
            scenario,
            plant=dict(self.parameters),
            simulation=dataclasses.replace(scenario.simulation, seed=self.seed),
        )


def draw_trials(scenario: Scenario, indices: Iterable[int]) -> list[Trial]:
    """Draws trials by their numbers.

    A trial is a function of the scenario's seed and of its own number alone.
    True parameters are spread over all that the model allows: trial 0 is at
    the low end, trial 1 at the high end, and the others are uniform between.
    """
    intervals = {
        name: scenario.model.parameter_interval(name)
        for name in scenario.model.parameter_names
    }
    trials = []
    for index in indices:
        entropy = np.random.SeedSequence([scenario.simulation.seed, index])
        share = np.random.default_rng(entropy).random(len(intervals))
        if index < 2:
            share[:] = index
        parameters = {
            name: float((1 - s) * low + s * high)
            for s, (name, (low, high)) in zip(share, intervals.items(), strict=True)
        }
        seed = int(entropy.generate_state(1)[0])
        trials.append(Trial(index, seed, parameters))
    return trials
