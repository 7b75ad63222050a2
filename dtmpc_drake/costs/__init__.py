"""What a plan is charged for, one cost a file.

A cost answers for itself: what is squared at an instant.  Nothing that searches for
plans may enter here.
"""

from dtmpc_drake.costs.bandwidth import BandwidthCost
from dtmpc_drake.costs.base import COSTS, Cost, register_cost
from dtmpc_drake.costs.input import InputCost
from dtmpc_drake.costs.state import StateCost
from dtmpc_drake.costs.weights import Weight, matrix_of, require_weight

__all__ = [
    "COSTS",
    "BandwidthCost",
    "Cost",
    "InputCost",
    "StateCost",
    "Weight",
    "matrix_of",
    "register_cost",
    "require_weight",
]
