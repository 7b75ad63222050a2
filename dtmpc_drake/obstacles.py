"""Obstacles ``‖H r - p_c‖ < r_o`` and the distances to them.

Each class is one shape of the scenario file.  `ObstacleSet` stacks any mix of
them into arrays, so that every distance is one batched expression.
"""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, Union, get_args

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_SWEEPS = 20
"""At most, of the search for the nearest point of a tube."""


@dataclasses.dataclass
class Cylinder:
    """A cylinder along z (a disc for a planar vehicle).

    Attributes:
        center: x and y of the axis, in m.
        radius: in m.
        known_from: when the vehicle learns of it, in s; if left out, from the start
            or, with a sensor, as soon as that reaches it.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0])
    radius: float = 1.0
    known_from: float | None = None

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, which drops all but the first two outputs."""
        return np.eye(2, num_outputs)


@dataclasses.dataclass
class Sphere:
    """A ball in all outputs.

    Attributes:
        center: one coordinate per output, in m.
        radius: in m.
        known_from: when the vehicle learns of it, in s; if left out, from the start
            or, with a sensor, as soon as that reaches it.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    radius: float = 1.0
    known_from: float | None = None

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, the identity."""
        return np.eye(num_outputs)


@dataclasses.dataclass
class Ellipsoid:
    """The general shape: all r with ``‖H (r - center)‖ < radius``.

    Attributes:
        center: one coordinate per output, in m.
        shape: H, as rows; distances are measured in this metric.
        radius: r_o, in the unit of ``H r``.
        known_from: when the vehicle learns of it, in s; if left out, from the start
            or, with a sensor, as soon as that reaches it.
    """

    center: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    shape: list[list[float]] = dataclasses.field(
        default_factory=lambda: np.eye(3).tolist()
    )
    radius: float = 1.0
    known_from: float | None = None

    def shape_matrix(self, num_outputs: int) -> FloatArray:
        """H, as given."""
        return np.asarray(self.shape, dtype=float)


Obstacle = Union[Cylinder, Sphere, Ellipsoid]  # noqa: UP007, Drake's YAML wants it


@dataclasses.dataclass(frozen=True)
class ObstacleSet:
    """Obstacles as stacked arrays.

    Attributes:
        shape: H, ``(num_obstacles, rows, m)``, padded with zero rows.
        center: p_c in the image of H, ``(num_obstacles, rows)``.
        radius: r_o, ``(num_obstacles,)``.
        index: of each in the scenario, ``(num_obstacles,)``.
    """

    shape: FloatArray
    center: FloatArray
    radius: FloatArray
    index: npt.NDArray[np.intp]

    __hash__: ClassVar[None]  # type: ignore[assignment]

    @classmethod
    def stack(cls, obstacles: Sequence[Obstacle], num_outputs: int) -> "ObstacleSet":
        """Stacks the obstacles of a scenario with `num_outputs` outputs.

        Raises:
            TypeError: if one is of no class that is known here, a subclass included.
        """
        for o in obstacles:
            if type(o) not in get_args(Obstacle):
                known = ", ".join(kind.__name__ for kind in get_args(Obstacle))
                raise TypeError(f"{type(o).__name__} is no obstacle; there are {known}")
        matrices = [o.shape_matrix(num_outputs) for o in obstacles]
        rows = max((len(H) for H in matrices), default=1)
        shape = np.zeros((len(obstacles), rows, num_outputs))
        center = np.zeros((len(obstacles), rows))
        for i, (H, o) in enumerate(zip(matrices, obstacles, strict=True)):
            shape[i, : len(H)] = H
            c = np.asarray(o.center, dtype=float)
            # A cylinder's centre is already in the image of H.
            center[i, : len(H)] = c if isinstance(o, Cylinder) else H @ c
        radius = np.array([o.radius for o in obstacles], dtype=float)
        return cls(shape, center, radius, np.arange(len(obstacles)))

    def subset(self, chosen: npt.NDArray[np.bool_]) -> "ObstacleSet":
        """Those obstacles for which `chosen`, ``(num_obstacles,)``, is true."""
        return ObstacleSet(
            shape=self.shape[chosen],
            center=self.center[chosen],
            radius=self.radius[chosen],
            index=self.index[chosen],
        )

    def __len__(self) -> int:
        """The number of obstacles."""
        return len(self.radius)

    def offsets(self, position: FloatArray) -> FloatArray:
        """``H r - p_c`` for every obstacle.

        Args:
            position: r, shape ``(..., m)``.

        Returns:
            Shape ``(..., num_obstacles, rows)``.
        """
        return np.asarray(
            np.einsum("oij,...j->...oi", self.shape, position) - self.center
        )

    def tube_radii(self, position_tube: FloatArray) -> FloatArray:
        """``|H| Ω``: the box that holds ``H r̃``; shapes as `offsets`."""
        return np.asarray(
            np.einsum("oij,...j->...oi", np.abs(self.shape), position_tube)
        )

    def nearest_offset(
        self, offset: FloatArray, position_tube: FloatArray
    ) -> FloatArray:
        """The offset that is nearest to each centre, anywhere in the tube.

        Minimises ``‖offset + H r̃‖`` over ``|r̃| <= Ω``, one coordinate of r̃ after
        the other.  One sweep is exact where H has orthogonal columns.

        Args:
            offset: as from `offsets`, ``(..., num_obstacles, rows)``.
            position_tube: Ω, ``(..., m)``.

        Returns:
            The same shape as `offset`.
        """
        square = np.maximum((self.shape**2).sum(axis=1), 1e-300)
        error = np.zeros((*offset.shape[:-1], self.shape.shape[2]))
        nearest = np.array(offset)
        for _ in range(_SWEEPS):
            change = 0.0
            for j in range(error.shape[-1]):
                column, limit = self.shape[:, :, j], position_tube[..., None, j]
                along = np.einsum("...oi,oi->...o", nearest, column) / square[:, j]
                step = np.clip(error[..., j] - along, -limit, limit) - error[..., j]
                nearest += step[..., None] * column
                error[..., j] += step
                change = max(change, np.abs(step).max(initial=0.0))
            if change < 1e-6:
                break
        return nearest

    def clearance(
        self,
        position: FloatArray,
        position_tube: FloatArray | float = 0.0,
        margin: str = "norm",
    ) -> FloatArray:
        """Distance from each obstacle's surface to the tube around a position.

        Args:
            position: r*, shape ``(..., m)``.
            position_tube: Ω, the same shape.
            margin: ``norm`` takes ``‖|H| Ω‖`` off the distance (the paper's);
                ``support`` measures to the tube's box itself, which is tight.

        Returns:
            Shape ``(..., num_obstacles)``, negative inside.
        """
        # Column-major, for which NumPy adds much faster along the short last axis.
        offset = np.asfortranarray(self.offsets(position))
        tube = np.broadcast_to(position_tube, np.shape(position))
        if not np.any(position_tube):
            distance = np.linalg.norm(offset, axis=-1)
        elif margin == "norm":
            radii = self.tube_radii(tube)
            distance = np.linalg.norm(offset, axis=-1) - np.linalg.norm(radii, axis=-1)
        else:
            distance = np.linalg.norm(self.nearest_offset(offset, tube), axis=-1)
        return np.asarray(distance - self.radius)
