"""Disturbances |d| <= D, and model errors |f̃| <= Δ(x), as Drake diagrams.

Whatever is random comes from Drake's `RandomSource`: it belongs to the Context,
so ``diagram.SetRandomContext(context, RandomGenerator(seed))`` decides it all.
A batch of trials draws the same numbers from one seed a trial (`SeedTrials`), and
what shapes them works on every element alone: a trial of a batch is pushed
exactly as it would be alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from typing import assert_never, get_args

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
)
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    FirstOrderLowPassFilter,
    Gain,
    RandomSource,
    Saturation,
)

from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.scenario import (
    BangBang,
    ColoredWind,
    Constant,
    Disturbance,
    Gust,
    UniformHold,
    WorstCase,
)
from dtmpc_drake.scenario.typed import require_kind
from dtmpc_drake.systems.gusts import Gusts
from dtmpc_drake.systems.model_error import ModelError
from dtmpc_drake.systems.relay import Relay
from dtmpc_drake.systems.reversals import Reversals
from dtmpc_drake.systems.sliding_error import SlidingError
from dtmpc_drake.systems.trial_noise import TrialNoise

_SAMPLES_PER_CORRELATION_TIME = 10
_SHORTEST_SAMPLE = 0.005  # of the wind's white noise, in s
_ONCE = 1e6  # longer than any flight, in s
_NUDGE = 1e-6  # far above what rounding makes of s, far below what a push does
_LOOK = 0.04  # between two times at which a push may reverse, in s


def MakeDisturbance(
    config: Disturbance,
    *,
    model: Model,
    slope: Array,
    trials: Sequence[Disturbance] | None = None,
    duration: float = 0.0,
) -> Diagram:
    """The disturbance that a scenario describes.

    Args:
        config: one of the scenario's disturbances.
        model: of the plant; gives n and Δ.
        slope: λ, ``(m,)``, for the worst case.
        trials: the disturbance of each of many plants, which may differ from
            `config` in `WorstCase.hold` alone; one plant, without the axis, if
            left out.
        duration: how long to push many plants, in s; one is pushed for ever.

    Returns:
        A diagram named ``disturbance`` with an output port `disturbance`, ``(m,)``
        or the flattened ``(trials, m)``, and, for a disturbance with `model_error`,
        another one of that name and shape.  Where the push depends on them there
        are the input ports `state` and `reference`, as the plant and the tracker
        give them.

    Raises:
        ScenarioError: if the disturbance is of no class that is known here.
    """
    require_kind("disturbance", config, get_args(Disturbance))
    builder = DiagramBuilder()
    count = None if trials is None else len(trials)
    parts = _Parts(builder, model, slope, count, duration)
    bound = np.tile(np.asarray(config.bound, dtype=float), count or 1)
    if isinstance(config, Constant):
        pushes = builder.AddSystem(ConstantVectorSource(config.fraction * bound))
    elif isinstance(config, UniformHold):
        # Uniform on [0, 1), stretched to [-D, D).
        uniform = parts.noise(RandomDistribution.kUniform, config.hold)
        stretched = parts.chain(uniform, Gain(k=2 * bound))
        pushes = parts.sum(stretched, builder.AddSystem(ConstantVectorSource(-bound)))
    elif isinstance(config, BangBang):
        gaussian = parts.noise(RandomDistribution.kGaussian, config.hold)
        pushes = parts.chain(gaussian, Relay(force=bound))
    elif isinstance(config, ColoredWind):
        tau = config.correlation_time
        sample = max(tau / _SAMPLES_PER_CORRELATION_TIME, _SHORTEST_SAMPLE)
        # Held noise w passes the filter as x+ = a x + (1 - a) w: this much of
        # it gives x the deviation that is asked for.
        a = np.exp(-sample / tau)
        deviation = config.intensity * bound * np.sqrt((1 + a) / (1 - a))
        pushes = parts.chain(
            parts.noise(RandomDistribution.kGaussian, sample),
            Gain(k=deviation),
            FirstOrderLowPassFilter(time_constant=tau, size=len(bound)),
            Saturation(min_value=-bound, max_value=bound),
        )
    elif isinstance(config, WorstCase | Gust):
        # What share of their bounds d and f̃ have, -1 to 1.
        if isinstance(config, Gust):
            push = model_error_push = parts.gust(config.hold)
        elif config.hold is None:
            push = model_error_push = parts.along_the_error()
        else:
            every = [config] if trials is None else trials
            holds = [w.hold for w in every if isinstance(w, WorstCase) and w.hold]
            push, model_error_push = parts.reversals(holds)
        pushes = builder.AddSystem(Gain(k=bound))
        builder.Connect(push, pushes.get_input_port())
        if config.model_error:
            error = builder.AddSystem(ModelError(model=model, trials=count))
            builder.Connect(model_error_push, error.GetInputPort("push"))
            parts.look_at("state", error)
            builder.ExportOutput(error.get_output_port(), "model_error")
    else:
        assert_never(config)
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


@dataclasses.dataclass(frozen=True, eq=False)
class _Parts:
    """Adds to a diagram what disturbances are made of; see `MakeDisturbance`."""

    builder: DiagramBuilder
    model: Model
    slope: Array
    trials: int | None
    duration: float
    exported: set[str] = dataclasses.field(default_factory=set)

    def noise(
        self, distribution: RandomDistribution, hold: float, num_outputs: int = 0
    ) -> System:
        """The diagram's only noise, for every trial; m outputs if not given."""
        num_outputs = num_outputs or self.model.num_outputs
        if self.trials is None:
            source = RandomSource(distribution, num_outputs, hold)
        else:
            source = TrialNoise(
                distribution=distribution,
                num_outputs=num_outputs,
                hold=hold,
                trials=self.trials,
                duration=self.duration,
            )
        return self.builder.AddNamedSystem("noise", source)

    def along_the_error(self) -> OutputPort:
        """The side of every output to which s goes.

        At s = 0 it pushes too: one that waited for an error would never see any.
        The seed decides to which side, not rounding.
        """
        error = self.builder.AddSystem(
            SlidingError(slope=self.slope, order=self.model.order, trials=self.trials)
        )
        for name in ("state", "reference"):
            self.look_at(name, error)
        size = error.get_output_port().size()
        side = self.noise(RandomDistribution.kGaussian, _ONCE)
        nudged = self.sum(error, self.chain(side, Gain(_NUDGE, size)))
        return self.chain(nudged, Relay(force=np.ones(size))).get_output_port()

    def reversals(self, hold: Sequence[float]) -> tuple[OutputPort, OutputPort]:
        """One side of every output, and at random times the other: for d and f̃.

        Args:
            hold: the mean time between two reversals, of all trials or of each.
        """
        noise = self.noise(RandomDistribution.kUniform, _LOOK)
        each = np.broadcast_to(hold, self.trials or 1).repeat(self.model.num_outputs)
        sides = self.builder.AddSystem(Reversals(hold=each, period=_LOOK))
        self.builder.Connect(noise.get_output_port(), sides.get_input_port())
        return sides.GetOutputPort("push"), sides.GetOutputPort("model_error_push")

    def gust(self, hold: float) -> OutputPort:
        """One direction of all outputs after the other."""
        m = self.model.num_outputs
        noise = self.noise(RandomDistribution.kUniform, _LOOK, m + 1)
        gusts = Gusts(num_outputs=m, hold=hold, period=_LOOK, trials=self.trials)
        return self.chain(noise, gusts).get_output_port()

    def look_at(self, name: str, system: System) -> None:
        """Connects an input port of a system to that of the diagram."""
        port = system.GetInputPort(name)
        if name in self.exported:
            self.builder.ConnectInput(name, port)
        else:
            self.builder.ExportInput(port, name)
            self.exported.add(name)

    def sum(self, first: System, second: System) -> System:
        """Adds a system that adds the outputs of two others."""
        size = first.get_output_port().size()
        total = self.builder.AddSystem(Adder(num_inputs=2, size=size))
        for i, part in enumerate((first, second)):
            self.builder.Connect(part.get_output_port(), total.get_input_port(i))
        return total

    def chain(self, first: System, *others: System) -> System:
        """Adds systems, each fed by the one before it, and returns the last."""
        for other in others:
            self.builder.AddSystem(other)
        for upstream, downstream in pairwise((first, *others)):
            self.builder.Connect(
                upstream.get_output_port(), downstream.get_input_port()
            )
        return others[-1]
