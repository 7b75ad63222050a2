"""Noise for many trials side by side, each from its own seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    EventStatus,
    LeafSystem,
    ValueProducer,
)
from pydrake.systems.primitives import RandomSource

from dtmpc_drake.numerics.arrays import Array


class TrialNoise(LeafSystem):
    """Holds and redraws noise, one seed a trial.

    .. pydrake_system::

        name: TrialNoise
        output_ports:
        - noise

    `noise` is the flattened ``(trials, m)`` array.  Row i has the very numbers
    that a `RandomSource` with m outputs gives in a diagram whose Context was
    made random by ``RandomGenerator(seeds[i])``.  As many such sources would do
    the same, but each of them would cost time in every step of the simulation.

    The seeds are numeric parameters of the Context (see `SetSeeds`), and its
    state counts the draws.  All draws of the horizon are made at once and kept
    in a cache entry; beyond the horizon the last one is held.
    """

    def __init__(
        self,
        *,
        distribution: RandomDistribution,
        num_outputs: int,
        hold: float,
        trials: int,
        duration: float,
    ) -> None:
        """Constructs a source.

        Args:
            distribution: of every number.
            num_outputs: m.
            hold: how long a value is kept, in s.
            trials: how many.
            duration: the horizon, in s.
        """
        LeafSystem.__init__(self)
        self._size = num_outputs
        # One update of so many numbers draws what many updates of few would.
        self._draws = int(duration / hold) + 3
        self._source = RandomSource(distribution, self._draws * num_outputs, hold)
        self._seeds = self.DeclareNumericParameter(BasicVector(trials))
        self._count = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(hold, 0.0, self._redraw)
        self._table = self.DeclareCacheEntry(
            "draws",
            ValueProducer(allocate=Value[object], calc=self._calc_table),
            {self.all_parameters_ticket()},
        )
        self.DeclareVectorOutputPort(
            "noise",
            trials * num_outputs,
            self._calc_noise,
            prerequisites_of_calc={self._table.ticket(), self.xd_ticket()},
        )

    def SetSeeds(self, context: Any, seeds: Sequence[int]) -> None:
        """Sets every trial's seed, below 2^32, in this system's Context."""
        parameter = context.get_mutable_numeric_parameter(self._seeds)
        parameter.SetFromVector(np.array(seeds, dtype=float))

    def _redraw(self, context: Any, state: Any) -> EventStatus:
        count = context.get_discrete_state_vector()[0]
        state.set_value([count + 1])
        return EventStatus.Succeeded()

    def _calc_table(self, context: Any, value: Any) -> None:
        """All draws, ``(draws, trials, m)``."""
        seeds = context.get_numeric_parameter(self._seeds).value()
        draws: list[Array] = []
        own = self._source.CreateDefaultContext()
        for seed in seeds:
            self._source.SetRandomContext(own, RandomGenerator(int(seed)))
            draw = self._source.get_output_port().Eval(own)
            draws.append(draw.reshape(self._draws, self._size).copy())
        value.set_value(np.stack(draws, axis=1))

    def _calc_noise(self, context: Any, output: Any) -> None:
        table = self._table.Eval(context)
        count = int(context.get_discrete_state_vector()[0])
        output.SetFromVector(table[min(count, self._draws - 1)].ravel())
