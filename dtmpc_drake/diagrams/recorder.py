"""Keeps of many trials what is reported, while they fly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtmpc_drake.diagrams.trials import Trial
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.sampling import samples, step_times
from dtmpc_drake.records import verdict
from dtmpc_drake.records.flights import REPORT_PERIOD, Flights
from dtmpc_drake.scenario import Scenario


class Recorder:
    """Keeps of trials what is reported, while they fly.

    Every trial is kept alone, in the same order of additions, so that the result
    does not depend on what else is in its batch.

    Args:
        scenario: that is flown.
        trials: T of them.
    """

    def __init__(self, scenario: Scenario, trials: Sequence[Trial]) -> None:
        simulation = scenario.simulation
        times = step_times(scenario.duration, simulation.max_step_size)
        self.rows = samples(times, max(REPORT_PERIOD, simulation.log_period))
        """Ends of steps, by number, after which `sample` must be called."""
        self._trials = trials
        self._time = times[self.rows]
        count, m = len(trials), scenario.model.num_outputs
        self._position = np.empty((count, len(self.rows), m))
        self._position_ratio = np.empty((count, len(self.rows)))
        self._sampled = 0
        self._highest = np.full(count, -np.inf)  # |ỹ|/Ω since the last sample
        self._effort = np.zeros(count)
        self._last = 0.0, np.zeros(count)  # time and ‖u‖²

    def look(self, time: float, quantities: Array) -> None:
        """Takes in what `verdict.QUANTITIES` are, ``(T, 8)``, at the end of a step."""
        used = quantities[:, verdict.POSITION]
        used = np.where(np.isnan(used), np.inf, used)
        self._highest = np.maximum(self._highest, used)
        before, last_power = self._last
        power = quantities[:, verdict.INPUT] ** 2
        self._effort += (power + last_power) / 2 * (time - before)
        self._last = time, power

    def sample(self, position: Array) -> None:
        """Takes in positions, ``(T, m)``, after a look at the same time."""
        self._position[:, self._sampled] = position
        self._position_ratio[:, self._sampled] = self._highest
        self._sampled += 1
        self._highest = np.full_like(self._highest, -np.inf)

    def flights(self, record: Array) -> Flights:
        """What was kept, with the record of the flights, ``(6, T, 8)``."""
        trials = self._trials
        return Flights(
            index=np.array([trial.index for trial in trials]),
            seed=np.array([trial.seed for trial in trials]),
            parameters={
                name: np.array([trial.parameters[name] for trial in trials])
                for name in trials[0].parameters
            },
            record=record.swapaxes(0, 1).copy(),
            effort=self._effort,
            time=self._time,
            position=self._position,
            position_ratio=self._position_ratio,
        )
