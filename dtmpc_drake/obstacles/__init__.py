"""What must not be hit, one kind of obstacle a file, and the field of them all.

An obstacle answers for itself: nobody outside of this package knows how it is
described.  Nothing may enter here that plans, proves or draws.
"""

from dtmpc_drake.obstacles.base import OBSTACLES, Obstacle, register_obstacle
from dtmpc_drake.obstacles.ellipsoids import Cylinder, Ellipsoid, Sphere
from dtmpc_drake.obstacles.field import ObstacleSet

__all__ = [
    "OBSTACLES",
    "Cylinder",
    "Ellipsoid",
    "Obstacle",
    "ObstacleSet",
    "Sphere",
    "register_obstacle",
]
