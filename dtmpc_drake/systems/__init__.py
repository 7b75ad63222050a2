"""Drake systems of the closed loop: thin shells around the pure functions."""

from dtmpc_drake.systems.dtmpc_planner import DtmpcPlanner
from dtmpc_drake.systems.obstacle_sensor import ObstacleSensor
from dtmpc_drake.systems.plant import Plant, Plant_
from dtmpc_drake.systems.tracker import SlidingModeTracker, SlidingModeTracker_
from dtmpc_drake.systems.tube_monitor import TubeMonitor, tube_ratios

__all__ = [
    "DtmpcPlanner",
    "ObstacleSensor",
    "Plant",
    "Plant_",
    "SlidingModeTracker",
    "SlidingModeTracker_",
    "TubeMonitor",
    "tube_ratios",
]
