"""What a disturbance must say of itself, and the parts that disturbances are made of.

Whatever is random comes from Drake's `RandomSource`: it belongs to the Context,
so ``diagram.SetRandomContext(context, RandomGenerator(seed))`` decides it all.
A batch of trials draws the same numbers from one seed a trial (`SeedTrials`), and
what shapes them works on every element alone: a trial of a batch is pushed
exactly as it would be alone.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from typing import Self, TypeVar

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
)
from pydrake.systems.primitives import Adder, ConstantVectorSource, Gain, RandomSource

from dtmpc_drake.checks import (
    Part,
    Setting,
    require_length,
    require_magnitude,
)
from dtmpc_drake.disturbances.model_error import ModelError
from dtmpc_drake.disturbances.trial_noise import TrialNoise
from dtmpc_drake.errors import require
from dtmpc_drake.models import Model
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.registry import Registry

ONCE = 1e6
"""How long noise is kept that is drawn but once, in s: longer than any flight."""
LOOK = 0.04
"""Between two times at which a push may change its side, in s."""


class Disturbance(Part, abc.ABC):
    """What acts on the plant beside its input: any d with ``|d| <= bound``.

    A subclass that is a dataclass can be part of a scenario file.
    """

    bound: list[float]
    """D on every output, in m/s²."""
    short_name: str | None = None
    """Of the kind in experiments that fly through many disturbances; a kind without
    one has no part in them."""

    @abc.abstractmethod
    def build(self, parts: Parts) -> OutputPort:
        """Adds the systems that make the disturbance to a diagram.

        Args:
            parts: what there is to build with.

        Returns:
            The port of d, of the size of `parts.bound`: ``(m,)``, or the flattened
            ``(trials, m)``.
        """

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        require_length(f"{path}.bound", self.bound, setting.num_outputs)
        for i, bound in enumerate(self.bound):
            field = f"{path}.bound[{i}]"
            unit = setting.highest_units[i]
            require_magnitude(field, bound, unit)
            require(field, bound, bound >= 0, f"at least 0 {unit}")

    def rates(self) -> dict[str, float]:
        """How fast its own systems settle, in 1/s, by what it follows from.

        An explicit integrator needs steps that are short against all of them.
        """
        return {}

    def periods(self) -> dict[str, float]:
        """How far apart its discrete events are, in s, by the field that says so."""
        return {}

    @classmethod
    def hard(cls, bound: list[float]) -> Self:
        """One that is hard to withstand, for experiments; see `short_name`."""
        made = cls()
        made.bound = bound
        return made

    @property
    def is_varied(self) -> bool:
        """Whether many flights through it differ in more than a few sides."""
        return True

    def drawn(self, *, patience: float) -> Disturbance:
        """The one of a single trial of many.

        Args:
            patience: how many times longer than usual it is to hold its push.
        """
        return self


DISTURBANCES: Registry[Disturbance] = Registry(Disturbance, "register_disturbance")
register_disturbance = DISTURBANCES.register

Own = TypeVar("Own", bound=Disturbance)


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
        config: of any registered class.
        model: of the plant; gives n and Δ.
        slope: λ, ``(m,)``, for the worst case.
        trials: the disturbance of each of many plants, as `Disturbance.drawn` makes
            them from `config`; one plant, without the axis, if left out.
        duration: how long to push many plants, in s; one is pushed for ever.

    Returns:
        A diagram named ``disturbance`` with an output port `disturbance`, ``(m,)``
        or the flattened ``(trials, m)``, and, for a disturbance that chooses the
        model error, another one `model_error` of that shape.  Where the push depends
        on them there are the input ports `state` and `reference`, as the plant and
        the tracker give them.

    Raises:
        ScenarioError: if the disturbance is of no registered class.
    """
    DISTURBANCES.require("disturbance", config)
    builder = DiagramBuilder()
    count = None if trials is None else len(trials)
    parts = Parts(
        builder=builder,
        model=model,
        slope=slope,
        bound=np.tile(np.asarray(config.bound, dtype=float), count or 1),
        trials=trials,
        duration=duration,
    )
    builder.ExportOutput(config.build(parts), "disturbance")
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
class Parts:
    """Adds to a diagram what disturbances are made of; see `Disturbance.build`.

    Attributes:
        builder: of the diagram.
        model: of the plant.
        slope: λ, ``(m,)``.
        bound: D of every element of the push: ``(m,)``, or ``(trials * m,)``.
        trials: the disturbance of each of many plants; None for one plant.
        duration: how long many plants are pushed, in s.
    """

    builder: DiagramBuilder
    model: Model
    slope: Array
    bound: Array
    trials: Sequence[Disturbance] | None = None
    duration: float = 0.0
    _exported: set[str] = dataclasses.field(default_factory=set, init=False)

    @property
    def count(self) -> int | None:
        """How many plants; None for one, without the axis."""
        return None if self.trials is None else len(self.trials)

    def each(self, config: Own) -> list[Own]:
        """The disturbance of every plant, where they are of the class of `config`."""
        every = [config] if self.trials is None else self.trials
        return [one for one in every if isinstance(one, type(config))]

    def constant(self, value: Array) -> OutputPort:
        """The same value for ever."""
        return self.builder.AddSystem(ConstantVectorSource(value)).get_output_port()

    def noise(
        self,
        distribution: RandomDistribution,
        hold: float = ONCE,
        num_outputs: int | None = None,
    ) -> OutputPort:
        """The noise of the diagram, of which there may be one alone, for every plant.

        Args:
            distribution: of every number.
            hold: how long a value is kept, in s; if left out, it is drawn once.
            num_outputs: of one plant; m if left out.
        """
        size = self.model.num_outputs if num_outputs is None else num_outputs
        if self.count is None:
            source = RandomSource(distribution, size, hold)
        else:
            source = TrialNoise(
                distribution=distribution,
                num_outputs=size,
                hold=hold,
                trials=self.count,
                duration=self.duration,
            )
        return self.builder.AddNamedSystem("noise", source).get_output_port()

    def scaled(self, push: OutputPort, gain: Array) -> OutputPort:
        """A push times a number for every element."""
        return self.chain(push, Gain(k=gain))

    def sum(self, first: OutputPort, second: OutputPort) -> OutputPort:
        """Two pushes, added."""
        total = self.builder.AddSystem(Adder(num_inputs=2, size=first.size()))
        for i, port in enumerate((first, second)):
            self.builder.Connect(port, total.get_input_port(i))
        return total.get_output_port()

    def chain(self, port: OutputPort, *systems: System) -> OutputPort:
        """Adds systems of one input and output, each fed by the one before it."""
        for system in systems:
            self.builder.AddSystem(system)
        ports = [port, *(system.get_output_port() for system in systems)]
        for upstream, downstream in zip(ports[:-1], systems, strict=True):
            self.builder.Connect(upstream, downstream.get_input_port())
        return ports[-1]

    def look_at(self, name: str, system: System) -> None:
        """Gives a system's input port what the plant or the tracker says.

        Args:
            name: of the port: ``state`` or ``reference``.
            system: that has such a port; of many plants, with one more axis in front
                of the state.
        """
        port = system.GetInputPort(name)
        if name in self._exported:
            self.builder.ConnectInput(name, port)
        else:
            self.builder.ExportInput(port, name)
            self._exported.add(name)

    def choose_model_error(self, push: OutputPort) -> None:
        """Replaces what the plant's true parameters make of the model error.

        Args:
            push: the share of Δ(x) that it has, -1 to 1 on every output.
        """
        error = self.builder.AddSystem(ModelError(model=self.model, trials=self.count))
        self.builder.Connect(push, error.GetInputPort("push"))
        self.look_at("state", error)
        self.builder.ExportOutput(error.get_output_port(), "model_error")
