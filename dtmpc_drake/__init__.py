"""Dynamic Tube MPC for nonlinear systems, as Drake systems.

The face: what most programs need, by the names that it has in the rooms behind.  All
else is imported from its room, such as `dtmpc_drake.systems`.  A name is fetched when
it is first used, so that importing this package loads neither Drake nor matplotlib.

Nothing in the package may import from here.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dtmpc_drake.costs import Cost
    from dtmpc_drake.diagrams import MakeClosedLoop, MakeController, Simulate
    from dtmpc_drake.experiments import run_comparison, run_experiment, run_monte_carlo
    from dtmpc_drake.limits import Limit
    from dtmpc_drake.models import (
        DragDoubleIntegrator,
        IntegratorChain,
        Model,
        SampledBoxBounds,
    )
    from dtmpc_drake.obstacles import Cylinder, Ellipsoid, Obstacle, Sphere
    from dtmpc_drake.planning import Problem, certify, plan, replan
    from dtmpc_drake.records.certificate import Certificate
    from dtmpc_drake.records.flight import Flight
    from dtmpc_drake.records.plan import Plan
    from dtmpc_drake.records.result import PlanningResult
    from dtmpc_drake.scenario import Scenario, ScenarioError, Waypoint, load_scenario
    from dtmpc_drake.visualization import plot_histories, plot_plan, write_replay

__version__ = "0.1.0"

__all__ = [
    "Certificate",
    "Cost",
    "Cylinder",
    "DragDoubleIntegrator",
    "Ellipsoid",
    "Flight",
    "IntegratorChain",
    "Limit",
    "MakeClosedLoop",
    "MakeController",
    "Model",
    "Obstacle",
    "Plan",
    "PlanningResult",
    "Problem",
    "SampledBoxBounds",
    "Scenario",
    "ScenarioError",
    "Simulate",
    "Sphere",
    "Waypoint",
    "__version__",
    "certify",
    "load_scenario",
    "plan",
    "plot_histories",
    "plot_plan",
    "replan",
    "run_comparison",
    "run_experiment",
    "run_monte_carlo",
    "write_replay",
]

_ROOMS = {
    "costs": ("Cost",),
    "diagrams": ("MakeClosedLoop", "MakeController", "Simulate"),
    "experiments": ("run_comparison", "run_experiment", "run_monte_carlo"),
    "limits": ("Limit",),
    "models": ("DragDoubleIntegrator", "IntegratorChain", "Model", "SampledBoxBounds"),
    "obstacles": ("Cylinder", "Ellipsoid", "Obstacle", "Sphere"),
    "planning": ("Problem", "certify", "plan", "replan"),
    "records.certificate": ("Certificate",),
    "records.flight": ("Flight",),
    "records.plan": ("Plan",),
    "records.result": ("PlanningResult",),
    "scenario": ("Scenario", "ScenarioError", "Waypoint", "load_scenario"),
    "visualization": ("plot_histories", "plot_plan", "write_replay"),
}
"""Where `__getattr__` finds them: the imports above, again."""


def __getattr__(name: str) -> Any:
    for room, names in _ROOMS.items():
        if name in names:
            value = getattr(import_module(f"{__name__}.{room}"), name)
            globals()[name] = value  # once: the next use finds it by itself
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
