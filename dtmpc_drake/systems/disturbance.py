"""Disturbances |d| <= D, as Drake diagrams that share one output port.

Whatever is random comes from Drake's `RandomSource`: it belongs to the Context,
so ``diagram.SetRandomContext(context, RandomGenerator(seed))`` decides it all.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import (
    AffineSystem,
    ConstantVectorSource,
    FirstOrderLowPassFilter,
    MatrixGain,
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

_SAMPLES_PER_CORRELATION_TIME = 10
_SHORTEST_SAMPLE = 0.005  # of the wind's white noise, in s


def MakeDisturbance(config: Disturbance, *, slope: Array, order: int) -> Diagram:
    """The disturbance that a scenario describes.

    Args:
        config: one of the scenario's disturbances.
        slope: λ, ``(m,)``, for the worst case.
        order: n, for the worst case.

    Returns:
        A diagram named ``disturbance`` with one output port `disturbance`,
        ``(m,)``.  `WorstCase` also has the input ports `state` and
        `reference`, as the plant and the tracker give them; the others need
        nothing.
    """
    stages = _stages(config, slope=slope, order=order)
    builder = DiagramBuilder()
    for stage in stages:
        builder.AddSystem(stage)
    for upstream, downstream in pairwise(stages):
        builder.Connect(upstream.get_output_port(), downstream.get_input_port())
    for i in range(stages[0].num_input_ports()):
        port = stages[0].get_input_port(i)
        builder.ExportInput(port, port.get_name())
    builder.ExportOutput(stages[-1].get_output_port(), "disturbance")
    diagram = builder.Build()
    diagram.set_name("disturbance")
    return diagram


def _stages(config: Disturbance, *, slope: Array, order: int) -> list[System]:
    """The systems that make a disturbance, each fed by the one before it."""
    bound = np.asarray(config.bound, dtype=float)
    m = len(bound)
    if isinstance(config, Constant):
        return [ConstantVectorSource(config.fraction * bound)]
    if isinstance(config, UniformHold):
        # Uniform on [0, 1), stretched to [-D, D).
        uniform = RandomDistribution.kUniform
        return [RandomSource(uniform, m, config.hold), _affine(2 * bound, -bound)]
    gaussian = RandomDistribution.kGaussian
    if isinstance(config, BangBang):
        return [RandomSource(gaussian, m, config.hold), Relay(force=bound)]
    if isinstance(config, ColoredWind):
        tau = config.correlation_time
        sample = max(tau / _SAMPLES_PER_CORRELATION_TIME, _SHORTEST_SAMPLE)
        # Held noise w passes the filter as x+ = a x + (1 - a) w: this much of
        # it gives x the deviation that is asked for.
        a = np.exp(-sample / tau)
        deviation = config.intensity * bound * np.sqrt((1 + a) / (1 - a))
        return [
            RandomSource(gaussian, m, sample),
            MatrixGain(D=np.diag(deviation)),
            FirstOrderLowPassFilter(time_constant=tau, size=m),
            Saturation(min_value=-bound, max_value=bound),
        ]
    # The worst case.  At s = 0 it pushes too: one that waited for an error
    # would never see any.
    return [SlidingError(slope=slope, order=order), Relay(force=bound)]


def _affine(gain: Array, offset: Array) -> AffineSystem:
    """Gain and offset of every element."""
    m = len(gain)
    return AffineSystem(
        A=np.zeros((0, 0)),
        B=np.zeros((0, m)),
        f0=np.zeros(0),
        C=np.zeros((m, 0)),
        D=np.diag(gain),
        y0=offset,
    )
