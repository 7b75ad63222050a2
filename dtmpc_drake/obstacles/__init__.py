"""What must not be hit, one kind of obstacle a file, and the field of them all."""

from dtmpc_drake.obstacles.ellipsoids import Cylinder, Ellipsoid, Obstacle, Sphere
from dtmpc_drake.obstacles.field import ObstacleSet

__all__ = ["Cylinder", "Ellipsoid", "Obstacle", "ObstacleSet", "Sphere"]
