"""How a system gets into a diagram: checked, added under a name, inputs connected."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from pydrake.systems.framework import (
    DiagramBuilder,
    OutputPort,
    PortDataType,
    System,
)

from dtmpc_drake.errors import require

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


def RequirePorts(
    field: str,
    system: Any,
    *,
    inputs: Mapping[str, int],
    outputs: Mapping[str, int],
    optional: Mapping[str, int] | None = None,
) -> None:
    """Refuses a system that somebody brings along, unless its ports fit.

    Args:
        field: what it is brought as.
        system: any object.
        inputs: sizes of the vector ports that it must have, by name.
        outputs: the same of its outputs.
        optional: the same of inputs and outputs that it may have.

    Raises:
        ScenarioError: naming the ports that it has and those that are needed.
    """
    optional = optional or {}
    allowed = f"a Drake System with {_words(inputs, outputs)}"
    if optional:
        allowed += f"; {_listed(optional)} may be there, too"
    fits, value = isinstance(system, System), system
    if fits:
        ins, outs = _ports(system)
        fits = inputs.items() <= ins.items() and outputs.items() <= outs.items()
        for name, size in optional.items():
            fits &= ins.get(name, size) == outs.get(name, size) == size
        value = f"one with {_words(ins, outs)}"
    require(field, value, fits, allowed)


def _ports(system: System) -> tuple[dict[str, int], dict[str, int]]:
    """Sizes of all input and of all output ports by name; -1 where abstract."""
    ins = map(system.get_input_port, range(system.num_input_ports()))
    outs = map(system.get_output_port, range(system.num_output_ports()))

    def sizes(ports: Iterable[Any]) -> dict[str, int]:
        return {
            port.get_name(): port.size() if _is_vector(port) else -1 for port in ports
        }

    return sizes(ins), sizes(outs)


def _is_vector(port: Any) -> bool:
    return bool(port.get_data_type() == PortDataType.kVectorValued)


def _words(inputs: Mapping[str, int], outputs: Mapping[str, int]) -> str:
    sides = {"input ports": inputs, "output ports": outputs}
    words = [f"{side} {_listed(sizes)}" for side, sizes in sides.items() if sizes]
    return " and ".join(words) or "no ports"


def _listed(sizes: Mapping[str, int]) -> str:
    """Ports by name, with their sizes."""
    words = (
        f"{name} ({size if size >= 0 else 'abstract'})" for name, size in sizes.items()
    )
    return ", ".join(words)
