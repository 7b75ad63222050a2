"""How a plan travels between systems: an abstract port that holds any object."""

from __future__ import annotations

from typing import Any

from pydrake.common.value import Value

from dtmpc_drake.records.plan import Plan


def DeclarePlanInputPort(system: Any) -> Any:
    """Declares the abstract input port `plan` and returns its handle."""
    return system.DeclareAbstractInputPort("plan", Value[object]())


def EvalPlan(port: Any, context: Any) -> Plan:
    """The plan at an input port.

    Raises:
        RuntimeError: if the port is not connected.
        TypeError: if the port holds something else: Drake cannot tell, since
            every Python object is a ``Value[object]``.
    """
    try:
        value = port.Eval(context)
    except RuntimeError:
        if port.HasValue(context):
            raise
        what = f"{port.GetFullDescription()} must be connected to a plan"
        raise RuntimeError(what) from None
    if not isinstance(value, Plan):
        raise TypeError(
            f"{port.GetFullDescription()} must hold a Plan,"
            f" but it holds a {type(value).__name__}"
        )
    return value
