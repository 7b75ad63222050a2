"""What an obstacle is: a convex set that answers two questions, in one file.

Nobody outside of this package looks into an obstacle.  All that planning, proof,
sensing and pictures need follows from its *core* and a radius: the obstacle is
everything that is nearer to the core than the radius (a sphere-swept volume).  A
core is any convex set that can tell its farthest point in a direction and its point
that is nearest to another one.

With the first answer alone a half-plane is sound, whichever unit normal ν it has:
all of the obstacle is where ``ν'y <= σ(ν)``, with ``σ(ν)`` the farthest of the core
plus the radius.  The second one only finds normals that part well.

Distances are Euclidean, unless the obstacle sees outputs through a matrix H: then the
core lives in the image of H, and distances are measured there.  So a cylinder does
not see z, and an ellipsoid is a ball.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from dtmpc_drake.checks import Part, Setting, require_magnitude
from dtmpc_drake.errors import require
from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.registry import Registry

Indices = npt.NDArray[np.intp]


class Cores(Protocol):
    """The cores of several obstacles of one kind, asked together."""

    def support(self, member: Indices, direction: FloatArray) -> FloatArray:
        """The farthest point of a core in a direction.

        Args:
            member: whose core, ``(P,)``.
            direction: of any length, ``(P, ..., rows)``.

        Returns:
            The same shape as `direction`.
        """

    def nearest(self, member: Indices, point: FloatArray) -> FloatArray:
        """The point of a core that is nearest to another; shapes as `support`."""


@dataclasses.dataclass
class Obstacle(Part, abc.ABC):
    """A convex set that must not be hit.

    A kind of obstacle is a dataclass with the two abstract methods.  All else has a
    default, for a bounded set in the space of the outputs.

    Attributes:
        known_from: when the vehicle learns of it, in s; if left out, from the start
            or, with a sensor, as soon as that reaches it.
    """

    known_from: float | None = dataclasses.field(default=None, kw_only=True)

    @abc.abstractmethod
    def support(self, direction: FloatArray) -> FloatArray:
        """The farthest point of the core in a direction of any length.

        Args:
            direction: ``(..., rows)``, one row for each output unless
                `shape_matrix` says otherwise.

        Returns:
            The same shape, in m.
        """

    @abc.abstractmethod
    def nearest(self, point: FloatArray) -> FloatArray:
        """The point of the core that is nearest to another, or that point itself.

        Args:
            point: ``(..., rows)``.

        Returns:
            The same shape.
        """

    def swept_radius(self) -> float:
        """How far the obstacle reaches beyond its core."""
        return 0.0

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, ``(rows, m)``, through which the obstacle sees the outputs."""
        return np.eye(num_outputs)

    def middle(self, num_outputs: int) -> FloatArray:
        """Any point inside of the core, ``(rows,)``."""
        rows = len(self.shape_matrix(num_outputs))
        directions = np.concatenate([np.eye(rows), -np.eye(rows)])
        return self.support(directions).mean(axis=0)

    def check(self, path: str, setting: Setting) -> None:
        """See base class."""
        since, field = self.known_from or 0.0, f"{path}.known_from"
        require_magnitude(field, since, "s")
        end = setting.duration
        require(field, since, 0 <= since < end, f"in [0, duration = {end:g}) s")

    @classmethod
    def cores(cls, members: Sequence[Any]) -> Cores | None:
        """The cores of some obstacles of this kind, to be asked together.

        The default asks one after the other.  A kind of which there are many may
        stack their numbers; one whose cores are points has none.
        """
        return OneByOne(members)


@dataclasses.dataclass(frozen=True, eq=False)
class OneByOne:
    """Cores that are asked one after the other.

    Attributes:
        members: whose cores.
    """

    members: Sequence[Obstacle]

    def support(self, member: Indices, direction: FloatArray) -> FloatArray:
        """See `Cores`."""
        return self._ask(lambda obstacle: obstacle.support, member, direction)

    def nearest(self, member: Indices, point: FloatArray) -> FloatArray:
        """See `Cores`."""
        return self._ask(lambda obstacle: obstacle.nearest, member, point)

    def _ask(
        self,
        question: Callable[[Obstacle], Callable[[FloatArray], FloatArray]],
        member: Indices,
        given: FloatArray,
    ) -> FloatArray:
        answer = np.empty(given.shape)
        for i in np.unique(member):
            mine = member == i
            answer[mine] = question(self.members[i])(given[mine])
        return answer


OBSTACLES: Registry[Obstacle] = Registry(Obstacle, "register_obstacle")
register_obstacle = OBSTACLES.register
