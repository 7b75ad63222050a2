"""What pushes the plant, one kind a file: its fields, and how a diagram makes it.

A disturbance answers for itself: its fields and their checks, the systems it is made
of, how fast they settle, and what experiments of many flights make of it.  The leaf
systems that only disturbances use are here, too.  Nothing of scenarios, plans or
closed loops may enter.
"""

# In this order they are named; a section of a file without a tag is of the first.
# isort: off
from dtmpc_drake.disturbances.uniform_hold import UniformHold
from dtmpc_drake.disturbances.constant import Constant
from dtmpc_drake.disturbances.bang_bang import BangBang
from dtmpc_drake.disturbances.worst_case import WorstCase
from dtmpc_drake.disturbances.colored_wind import ColoredWind
from dtmpc_drake.disturbances.gust import Gust

# isort: on
from dtmpc_drake.disturbances.base import (
    DISTURBANCES,
    Disturbance,
    MakeDisturbance,
    Parts,
    SeedTrials,
    register_disturbance,
)
from dtmpc_drake.disturbances.gusts import Gusts
from dtmpc_drake.disturbances.model_error import ModelError
from dtmpc_drake.disturbances.relay import Relay
from dtmpc_drake.disturbances.reversals import Reversals
from dtmpc_drake.disturbances.sliding_error import SlidingError
from dtmpc_drake.disturbances.trial_noise import TrialNoise

__all__ = [
    "DISTURBANCES",
    "BangBang",
    "ColoredWind",
    "Constant",
    "Disturbance",
    "Gust",
    "Gusts",
    "MakeDisturbance",
    "ModelError",
    "Parts",
    "Relay",
    "Reversals",
    "SeedTrials",
    "SlidingError",
    "TrialNoise",
    "UniformHold",
    "WorstCase",
    "register_disturbance",
]
