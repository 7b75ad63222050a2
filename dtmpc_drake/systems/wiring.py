"""How a system gets into a diagram: added under a name, with its inputs connected."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from pydrake.systems.framework import DiagramBuilder, OutputPort

S = TypeVar("S")


def AddConnected(
    builder: DiagramBuilder,
    name: str,
    system: S,
    inputs: Mapping[str, OutputPort | None],
) -> S:
    """Adds a system and connects its input ports.

    Args:
        builder: the DiagramBuilder.
        name: of the system.
        system: to add.
        inputs: output ports by the name of the input port that they go to; None
            leaves one for later, or for ever.

    Returns:
        The system.
    """
    added: S = builder.AddNamedSystem(name, system)
    for input_name, port in inputs.items():
        if port is not None:
            builder.Connect(port, added.GetInputPort(input_name))  # type: ignore[attr-defined]
    return added
