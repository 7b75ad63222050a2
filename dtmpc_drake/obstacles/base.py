"""What an obstacle must say of itself."""

from __future__ import annotations

import abc

from dtmpc_drake.checks import Setting, require_magnitude
from dtmpc_drake.errors import require
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.registry import Registry


class Obstacle(abc.ABC):
    """All r with ``‖H r - p_c‖ < radius``: what the vehicle must not touch.

    A subclass that is a dataclass can be part of a scenario file.
    """

    required: tuple[str, ...] = ()
    """Fields that a file must give, though they have a default."""
    center: list[float]
    """In m."""
    radius: float
    """r_o, in the unit of ``H r``."""
    known_from: float | None = None
    """When the vehicle learns of it, in s; None from the start or, with a sensor, as
    soon as that reaches it."""

    @abc.abstractmethod
    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, ``(rows, m)``."""

    def check(self, path: str, setting: Setting) -> None:
        """Refuses fields that make no sense; extended by whoever has more of them.

        All of them are of the types that the dataclass says, and finite.

        Args:
            path: of this section, for errors.
            setting: what it must fit.

        Raises:
            ScenarioError: that names the field.
        """
        since, field = self.known_from or 0.0, f"{path}.known_from"
        require_magnitude(field, since, "s")
        end = setting.duration
        require(field, since, 0 <= since < end, f"in [0, duration = {end:g}) s")

    def rows(self, num_outputs: int) -> int:
        """Rows of H: how much memory it asks for."""
        return num_outputs


OBSTACLES: Registry[Obstacle] = Registry(Obstacle, "register_obstacle")
register_obstacle = OBSTACLES.register
