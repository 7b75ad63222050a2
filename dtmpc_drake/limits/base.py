"""What a limit answers about itself.

A limit is one class in one file.  Whoever has to do with limits (the evaluation of an
iterate, both backends, the certificate, messages, figures) asks each in turn, and knows
none of them.  There are two families beside the obstacles: what is a function of one
instant (`SampledLimit`), and what is convex in one derivative of the output
(`ConvexLimit`, and `LinearLimit` of these), which holds between knots, too, where it
holds at control points.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import ClassVar

import numpy as np

from dtmpc_drake.checks import Part
from dtmpc_drake.method.chains import Chains
from dtmpc_drake.method.enclosure import Enclosure
from dtmpc_drake.method.margin import Margin, smallest
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant, deviation_bound
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array, BoolArray
from dtmpc_drake.numerics.differences import differences
from dtmpc_drake.registry import Registry

WEIGHED = 1.6
"""Parts of a limit's size that weigh like an own unit of length of an obstacle."""
STEP = 1e-6
"""Half-width of the differences along y*^(n) and along the gain."""


class Limit(Part, abc.ABC):
    """Something that a plan must keep for all times, whatever pushes the vehicle."""

    name: ClassVar[str]
    """Of its margin in a certificate; a word that no other limit has."""

    @abc.abstractmethod
    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """What is left of the limit at an instant, anywhere in the tube.

        Args:
            law: the controller.
            at: the instant, batched over leading axes.

        Returns:
            ``(..., q)``, in `unit`; negative where the limit may be broken.
        """

    @abc.abstractmethod
    def proven(self, enclosure: Enclosure) -> Array:
        """Lower bounds of the margins for all times of every interval, ``(K, q)``.

        The proof may rest on the enclosure and on the pointwise mathematics alone.
        """

    @abc.abstractmethod
    def unit(self, law: SlidingLaw, column: int | None = None) -> str:
        """Of the margins, for messages: of one column, or of all."""

    def where(self, law: SlidingLaw, column: int) -> str:
        """What a column of the margins is about, ``axis x`` or nothing."""
        return ""

    def flown(self, state: Array, control: Array) -> Array | None:
        """What is left of it at an instant of a flight; None where that says nothing.

        Args:
            state: x, ``(..., n, m)``.
            control: u, ``(..., m)``.

        Returns:
            ``(..., q)``, in `unit`.
        """
        return None

    @property
    def title(self) -> str:
        """What it is called in a sentence."""
        return f"{self.name.replace('_', ' ')} limit"

    def in_units(self, units: Units, order: int) -> Limit | None:
        """The same limit in other units; None if it leaves that to `limits.in_units`.

        Args:
            units: the new ones in the user's.
            order: n.
        """
        return None

    def worth(self, units: Units, order: int) -> float:
        """What a margin of one is in the user's unit; arguments as `in_units`."""
        return 1.0

    def certify(self, enclosure: Enclosure) -> dict[str, Margin]:
        """Its margins of a certificate, by name, in the user's units."""
        values, units = self.proven(enclosure), enclosure.corridor.units
        law, time = enclosure.law, enclosure.time * units.time
        worth, columns = self.worth(units, law.order), range(values.shape[1])
        places = [self.where(law, column) for column in columns]
        units_ = [self.unit(law, column) for column in columns]
        return {self.name: smallest(time, values, units_, places, worth)}


LIMITS: Registry[Limit] = Registry(Limit, "register_limit")
register_limit = LIMITS.register


@dataclasses.dataclass(frozen=True, eq=False)
class Slopes:
    """First derivatives of R rows.

    Attributes:
        by_model: by x* and by R_0 ... R_(n-1), ``(R, 2 n m)``.
        by_highest: by y*^(n), ``(R, m)``.
        by_gain: by κ = αΦ, ``(R, m)``.
    """

    by_model: Array
    by_highest: Array
    by_gain: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Facets:
    """Where one slope of a convex function is not enough, and along what it is cut.

    Attributes:
        place: indices of instants, ``(c,)``.
        direction: unit vectors, ``(c, m)``.
    """

    place: Array
    direction: Array


class SampledLimit(Limit):
    """A limit on a function of one instant, looked at wherever it is nearly broken."""

    @property
    def scale(self) -> float:
        """So much violation weighs like an own unit of length of an obstacle."""
        return WEIGHED * float(np.max(self.size))

    between_knots: ClassVar[bool] = True
    """Whether programs look at it between knots, and only where it is near; else they
    do at all knots."""

    @property
    @abc.abstractmethod
    def size(self) -> Array | float:
        """What is limited is about so large: the limit itself, ``(q,)`` or a number.

        Above 0 for limits that are looked at between knots, where they are near.
        """

    def slopes(
        self, law: SlidingLaw, at: Instant, secant: float, facets: Facets
    ) -> Slopes:
        """Of the margins at K instants, row by row, and then of the facets' margins.

        By differences, unless a limit knows better.

        Args:
            law: the controller.
            at: K instants, batched over one axis.
            secant: half-width of the differences along the state.
            facets: from `facets`.
        """

        def of_box(state: Array, radius: Array) -> Array:
            moved = dataclasses.replace(at, state=state, error_bound=radius)
            return self.margins(law, moved)

        count = len(at.state)

        def along(name: str) -> Array:
            value = getattr(at, name)
            moves = STEP * np.eye(value.shape[1])[:, None]
            ahead, behind = (
                self.margins(
                    law, dataclasses.replace(at, **{name: value + sign * moves})
                )
                for sign in (1.0, -1.0)
            )
            slope = (ahead - behind) / (2 * STEP)  # may not depend on it at all
            slope = np.broadcast_to(slope, (len(moves), count, slope.shape[-1]))
            return np.moveaxis(slope, 0, -1).reshape(-1, len(moves))

        found = differences(of_box, at.state, at.error_bound, secant)
        return Slopes(
            by_model=found.slope.reshape(-1, found.slope.shape[2]),
            by_highest=along("highest"),
            by_gain=along("gain"),
        )

    def facets(self, law: SlidingLaw, at: Instant) -> Facets:
        """Where the margin, of one column, needs more slopes than one; nowhere."""
        return Facets(np.zeros(0, dtype=int), np.zeros((0, at.highest.shape[-1])))

    def facet_margins(
        self, law: SlidingLaw, at: Instant, margins: Array, facets: Facets
    ) -> Array:
        """Margins with the facets in place of what they cut, ``(c,)``."""
        return np.zeros(0)

    def curvature(self, at: Instant) -> Array | None:
        """The Hessian by y*^(n) of the convex part, ``(..., m, m)``, if it has one."""
        return None


class Tightened(abc.ABC):
    """What is left of a limit on some z, which may be anywhere in a box."""

    @abc.abstractmethod
    def left(self, value: Array, spread: Array) -> Array:
        """What is left where z is within some distance of a value.

        Args:
            value: of z, ``(..., m)``.
            spread: the distance, element by element, ``(..., m)``.

        Returns:
            ``(..., q)``; concave in both, and falling in the second.
        """

    @abc.abstractmethod
    def left_slopes(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """Derivatives of `left` by value and by spread, ``(..., q, m)`` each."""


class ConvexLimit(Tightened, Limit):
    """A limit on one derivative of the output that is convex in it.

    It holds between knots, too, where it holds at control points: in the derivative of
    the reference and in the tube, in which it grows, it is at most a mean of those.
    """

    @property
    @abc.abstractmethod
    def derivative(self) -> int:
        """k, at most n_i of every output that the limit looks at."""

    def reads(self, num_outputs: int) -> BoolArray:
        """Which outputs it looks at, ``(m,)``; all, unless it knows better."""
        return np.ones(num_outputs, dtype=bool)

    def is_of_states(self, chains: Chains) -> bool:
        """Whether all that it looks at are states, k < n_i."""
        k, read = self.derivative, self.reads(chains.num_outputs)
        return k < chains.order and not bool((read & (chains.each <= k)).any())

    @property
    @abc.abstractmethod
    def size(self) -> float | None:
        """What is limited is about so large; margins are near or far in parts of it.

        None if that is for the problem to say, as for positions.
        """

    def worth(self, units: Units, order: int) -> float:
        """See base class."""
        return units.of(self.derivative)

    def margins(self, law: SlidingLaw, at: Instant) -> Array:
        """See base class."""
        k = self.derivative
        value = law.chains.derivative_of(at.state, at.highest, k)
        return self.left(value, deviation_bound(law, at, k))

    def flown(self, state: Array, control: Array) -> Array | None:
        """See base class."""
        if self.derivative >= state.shape[-2]:
            return None
        value = state[..., self.derivative, :]
        return self.left(value, np.zeros_like(value))

    def proven(self, enclosure: Enclosure) -> Array:
        """See base class.

        All along an interval y^(k) is within tube and sag of the chord of y*^(k), on
        which what is left is least at one of its ends.
        """
        k = self.derivative
        deviation = deviation_bound(enclosure.law, enclosure.instant, k)
        spread = deviation + enclosure.sag(k)
        return self.left(enclosure.ends(k), spread).min(axis=0)


def flown(limit: Limit, chains: Chains, state: Array, control: Array) -> Array | None:
    """`Limit.flown`, or None where a limit looks at what is no state of an output.

    Args:
        limit: to ask.
        chains: the orders of the outputs.
        state: x, ``(..., n, m)``.
        control: u, ``(..., m)``.
    """
    if isinstance(limit, ConvexLimit) and not limit.is_of_states(chains):
        return None
    return limit.flown(state, control)


class Rows(Tightened):
    """Rows ``a'z <= b``."""

    @abc.abstractmethod
    def normals(self, num_outputs: int) -> Array:
        """The rows a, ``(q, m)``."""

    @property
    @abc.abstractmethod
    def bounds(self) -> Array | float:
        """The bounds b, ``(q,)`` or a number."""

    def left(self, value: Array, spread: Array) -> Array:
        """See base class; ``b - a'z - |a|'spread``."""
        normals = self.normals(value.shape[-1])
        return self.bounds - value @ normals.T - spread @ np.abs(normals).T

    def left_slopes(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """See base class."""
        normals = self.normals(value.shape[-1])
        shape = (*value.shape[:-1], *normals.shape)
        by_value, by_spread = -normals, -np.abs(normals)
        return np.broadcast_to(by_value, shape), np.broadcast_to(by_spread, shape)


class LinearLimit(Rows, ConvexLimit):
    """Limits ``a'y^(k) <= b``, tightened by ``|a|'R_k`` for the tube."""

    def reads(self, num_outputs: int) -> BoolArray:
        """See base class."""
        return np.asarray(self.normals(num_outputs).any(axis=0))
