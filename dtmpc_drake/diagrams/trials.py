"""Trials of a scenario: other seeds, true parameters and initial errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.sliding import sliding_variable
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.scenario import Scenario, Waypoint

SPREAD = 4.0
"""How many times longer or shorter a worst case holds its push in some trials."""
_NEVER = 1e6
"""So many times longer is longer than any flight."""

# Drawing.


@dataclasses.dataclass(frozen=True)
class Trial:
    """One trial of a scenario: what is drawn for it.

    Attributes:
        index: its number, from 0.
        seed: of everything random in it.
        parameters: of the true plant, by name; without effect where the disturbance
            chooses the model error.
        initial_error: of the plant; None for none.
        patience: how many times longer than the scenario says a disturbance is to
            hold its push; see `Disturbance.drawn`.
    """

    index: int
    seed: int
    parameters: dict[str, float]
    initial_error: Waypoint | None = None
    patience: float = 1.0

    def scenario(self, scenario: Scenario) -> Scenario:
        """The scenario of this trial alone, to be simulated by itself."""
        return dataclasses.replace(
            scenario,
            plant=dict(self.parameters),
            initial_error=self.initial_error,
            disturbance=scenario.disturbance.drawn(patience=self.patience),
            simulation=dataclasses.replace(scenario.simulation, seed=self.seed),
        )


def draw_trials(scenario: Scenario, indices: Iterable[int]) -> list[Trial]:
    """Draws trials by their numbers.

    A trial is a function of the scenario's seed and of its own number alone.
    True parameters are spread over all that the model allows, whatever the
    scenario's plant has: trial 0 is at the low end, trial 1 at the high end, and
    the others are uniform between.  The initial error is the scenario's in trial 0,
    its negative in trial 1, and anywhere between the two in the others, in every
    output and derivative.  A worst case that reverses never does so in the first
    two; in the others it holds its push up to `SPREAD` times longer or shorter.
    """
    intervals = {
        name: scenario.model.parameter_interval(name)
        for name in scenario.model.parameter_names
    }
    trials = []
    for index in indices:
        entropy = np.random.SeedSequence([scenario.simulation.seed, index])
        generator = np.random.default_rng(entropy)
        share = generator.random(len(intervals))
        patience = SPREAD ** generator.uniform(-1, 1)
        error = _draw_initial_error(scenario, generator)
        if index < 2:
            share[:] = index
            patience = _NEVER
            error = (1 - 2 * index) * scenario.initial_error_state()
        parameters = {
            name: float((1 - s) * low + s * high)
            for s, (name, (low, high)) in zip(share, intervals.items(), strict=True)
        }
        trials.append(
            Trial(
                index=index,
                seed=int(entropy.generate_state(1)[0]),
                parameters=parameters,
                initial_error=scenario.initial_error and Waypoint(*error[:3].tolist()),
                patience=patience,
            )
        )
    return trials


def _draw_initial_error(scenario: Scenario, generator: np.random.Generator) -> Array:
    """Any error that is nowhere larger than the scenario's, ``(n, m)``.

    The tube opens from its absolute values and so holds all of these, but for
    the layer: signs that differ from the scenario's can give a larger |s(t0)|.
    Such an error is made smaller.
    """
    error = scenario.initial_error_state()
    error = generator.uniform(-1, 1, error.shape) * error
    chains = Chains.of(scenario.model)
    s = np.abs(sliding_variable(error, scenario.slope(), chains))
    layer = scenario.initial_boundary_layer() * (1 - 1e-9)
    return error * layer / np.maximum(s, layer)
