"""Disturbances |d| <= D, as Drake diagrams that share one output port.

Whatever is random comes from Drake's `RandomSource`: it belongs to the Context,
so ``diagram.SetRandomContext(context, RandomGenerator(seed))`` decides it all.
A batch of trials draws the same numbers from one seed a trial (`SeedTrials`), and
what shapes them works on every element alone: a trial of a batch is pushed
exactly as it would be alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    FirstOrderLowPassFilter,
    Gain,
    RandomSource,
    Saturation,
)

from dtmpc_drake.models import Array
from dtmpc_drake.scenario import (
    BangBang,
    ColoredWind,
    Constant,
    Disturbance,
    UniformHold,
)
from dtmpc_drake.systems.relay import Relay
from dtmpc_drake.systems.sliding_error import SlidingError
from dtmpc_drake.systems.trial_noise import TrialNoise

_SAMPLES_PER_CORRELATION_TIME = 10
_SHORTEST_SAMPLE = 0.005  # of the wind's white noise, in s
_ONCE = 1e6  # longer than any flight, in s
_NUDGE = 1e-6  # far above what rounding makes of s, far below what a push does


def MakeDisturbance(
    config: Disturbance,
    *,
    slope: Array,
    order: int,
    trials: int | None = None,
    duration: float = 0.0,
) -> Diagram:
    """The disturbance that a scenario describes.

    Args:
        config: one of the scenario's disturbances.
        slope: λ, ``(m,)``, for the worst case.
        order: n, for the worst case.
        trials: how many plants to push; one, without the axis, if left out.
        duration: how long to push many plants, in s; one is pushed for ever.

    Returns:
        A diagram named ``disturbance`` with one output port `disturbance`,
        ``(m,)`` or the flattened ``(trials, m)``.  `WorstCase` also has the
        input ports `state` and `reference`, as the plant and the tracker give
        them; the others need nothing.
    """
    builder = DiagramBuilder()

    def noise(distribution: RandomDistribution, hold: float) -> System:
        m = len(config.bound)
        if trials is None:
            return builder.AddNamedSystem("noise", RandomSource(distribution, m, hold))
        return builder.AddNamedSystem(
            "noise",
            TrialNoise(
                distribution=distribution,
                num_outputs=m,
                hold=hold,
                trials=trials,
                duration=duration,
            ),
        )

    count = 1 if trials is None else trials
    bound = np.tile(np.asarray(config.bound, dtype=float), count)
    if isinstance(config, Constant):
        pushes = builder.AddSystem(ConstantVectorSource(config.fraction * bound))
    elif isinstance(config, UniformHold):
        # Uniform on [0, 1), stretched to [-D, D).
        uniform = noise(RandomDistribution.kUniform, config.hold)
        stretched = _chain(builder, uniform, Gain(k=2 * bound))
        offset = builder.AddSystem(ConstantVectorSource(-bound))
        pushes = _sum(builder, stretched, offset)
    elif isinstance(config, BangBang):
        gaussian = noise(RandomDistribution.kGaussian, config.hold)
        pushes = _chain(builder, gaussian, Relay(force=bound))
    elif isinstance(config, ColoredWind):
        tau = config.correlation_time
        sample = max(tau / _SAMPLES_PER_CORRELATION_TIME, _SHORTEST_SAMPLE)
        # Held noise w passes the filter as x+ = a x + (1 - a) w: this much of
        # it gives x the deviation that is asked for.
        a = np.exp(-sample / tau)
        deviation = config.intensity * bound * np.sqrt((1 + a) / (1 - a))
        pushes = _chain(
            builder,
            noise(RandomDistribution.kGaussian, sample),
            Gain(k=deviation),
            FirstOrderLowPassFilter(time_constant=tau, size=len(bound)),
            Saturation(min_value=-bound, max_value=bound),
        )
    else:
        # The worst case.  At s = 0 it pushes too: one that waited for an error
        # would never see any.  The seed decides to which side, not rounding.
        error = SlidingError(slope=slope, order=order, trials=trials)
        builder.AddSystem(error)
        for name in ("state", "reference"):
            builder.ExportInput(error.GetInputPort(name), name)
        side = noise(RandomDistribution.kGaussian, _ONCE)
        pushes = _chain(
            builder,
            _sum(builder, error, _chain(builder, side, Gain(_NUDGE, len(bound)))),
            Relay(force=bound),
        )
    builder.ExportOutput(pushes.get_output_port(), "disturbance")
    diagram = builder.Build()
    diagram.set_name("disturbance")
    return diagram


def SeedTrials(disturbance: Diagram, context: Context, seeds: Sequence[int]) -> None:
    """Gives every trial the noise of a single flight with its seed.

    Args:
        disturbance: from `MakeDisturbance`; without noise nothing happens.
        context: the root Context.
        seeds: one for each trial.
    """
    if disturbance.HasSubsystemNamed("noise"):
        noise = disturbance.GetSubsystemByName("noise")
        noise.SetSeeds(noise.GetMyMutableContextFromRoot(context), seeds)


def _sum(builder: DiagramBuilder, first: System, second: System) -> System:
    """Adds a system that adds the outputs of two others."""
    total = builder.AddSystem(Adder(num_inputs=2, size=first.get_output_port().size()))
    for i, part in enumerate((first, second)):
        builder.Connect(part.get_output_port(), total.get_input_port(i))
    return total


def _chain(builder: DiagramBuilder, first: System, *others: System) -> System:
    """Adds systems, each fed by the one before it, and returns the last."""
    for other in others:
        builder.AddSystem(other)
    for upstream, downstream in pairwise((first, *others)):
        builder.Connect(upstream.get_output_port(), downstream.get_input_port())
    return others[-1]
