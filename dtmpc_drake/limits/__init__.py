"""What a plan must keep, one limit a file.

A limit answers the same few questions for everybody: what is left of it at an instant,
and what is proven for all times of an interval.  Nothing that searches for plans may
enter here: the certificate rests on this room.
"""

from dtmpc_drake.limits.bandwidth import BandwidthLimit
from dtmpc_drake.limits.base import (
    LIMITS,
    ConvexLimit,
    Limit,
    LinearLimit,
    SampledLimit,
    flown,
    register_limit,
)
from dtmpc_drake.limits.cover import CoverLimit
from dtmpc_drake.limits.input import InputLimit
from dtmpc_drake.limits.inputs import InputRange
from dtmpc_drake.limits.norms import NormLimit
from dtmpc_drake.limits.obstacles import ObstacleLimit
from dtmpc_drake.limits.position import PositionLimit
from dtmpc_drake.limits.speed import SpeedLimit

__all__ = [
    "LIMITS",
    "BandwidthLimit",
    "ConvexLimit",
    "CoverLimit",
    "InputLimit",
    "InputRange",
    "Limit",
    "LinearLimit",
    "NormLimit",
    "ObstacleLimit",
    "PositionLimit",
    "SampledLimit",
    "SpeedLimit",
    "flown",
    "register_limit",
]
