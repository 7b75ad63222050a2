"""Diagrams that are built from the systems, and their simulation."""

from dtmpc_drake.diagrams.closed_loop import (
    MakeClosedLoop,
    MakeController,
    MakeSideBySide,
)
from dtmpc_drake.diagrams.simulate import FlyTrials, Simulate, SimulateTrials
from dtmpc_drake.diagrams.trials import Trial, draw_trials

__all__ = [
    "FlyTrials",
    "MakeClosedLoop",
    "MakeController",
    "MakeSideBySide",
    "Simulate",
    "SimulateTrials",
    "Trial",
    "draw_trials",
]
