"""What a planner and a controller may know about a plant, one model a file.

A model answers for itself: its nominal dynamics, the bound of its error, and the bounds
of both over a box.  Nothing of limits, tubes or plans may enter here.
"""

# In this order they are named; a section of a file without a tag is of the first.
# isort: off
from dtmpc_drake.models.drag import DragDoubleIntegrator
from dtmpc_drake.models.chain import IntegratorChain

# isort: on
from dtmpc_drake.models.base import MODELS, Model, joined, register_model
from dtmpc_drake.models.constant import ConstantUncertainty
from dtmpc_drake.models.lagged import LaggedMultirotor
from dtmpc_drake.models.sampled import SampledBoxBounds

__all__ = [
    "MODELS",
    "ConstantUncertainty",
    "DragDoubleIntegrator",
    "IntegratorChain",
    "LaggedMultirotor",
    "Model",
    "SampledBoxBounds",
    "joined",
    "register_model",
]
