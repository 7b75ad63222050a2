"""Drake systems of the closed loop: thin shells around the pure functions."""

from dtmpc_drake.systems.disturbance import MakeDisturbance, SeedTrials
from dtmpc_drake.systems.dtmpc_planner import DtmpcPlanner
from dtmpc_drake.systems.gusts import Gusts
from dtmpc_drake.systems.model_error import ModelError
from dtmpc_drake.systems.obstacle_sensor import ObstacleSensor
from dtmpc_drake.systems.plant import Plant, Plant_
from dtmpc_drake.systems.relay import Relay
from dtmpc_drake.systems.reversals import Reversals
from dtmpc_drake.systems.sliding_error import SlidingError
from dtmpc_drake.systems.tracker import SlidingModeTracker, SlidingModeTracker_
from dtmpc_drake.systems.trial_noise import TrialNoise
from dtmpc_drake.systems.tube_monitor import TubeMonitor, tube_ratios

__all__ = [
    "DtmpcPlanner",
    "Gusts",
    "MakeDisturbance",
    "ModelError",
    "ObstacleSensor",
    "Plant",
    "Plant_",
    "Relay",
    "Reversals",
    "SeedTrials",
    "SlidingError",
    "SlidingModeTracker",
    "SlidingModeTracker_",
    "TrialNoise",
    "TubeMonitor",
    "tube_ratios",
]
