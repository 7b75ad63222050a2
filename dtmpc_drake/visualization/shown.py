"""A flight as a replay shows it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from dtmpc_drake.numerics.arrays import FloatArray
from dtmpc_drake.records.flight import Flight
from dtmpc_drake.records.replan import Replan


@dataclasses.dataclass(frozen=True, eq=False)
class ShownFlight:
    """Where a vehicle was, and what is said of it.

    Attributes:
        time: ``(K,)``, in s, increasing.
        position: y of the vehicle, ``(K, m)``, in m.
        status: one line for the legend, such as the plan's status.
        clouds: more flights of the same plan at the same times by the name of
            their group, ``(flights, K, m)``.
        replans: every time that was planned, if there was more than one.
        known_since: of each obstacle, ``(o,)``, in s; from the start if left out.
    """

    time: FloatArray
    position: FloatArray
    status: str = ""
    clouds: Mapping[str, FloatArray] = dataclasses.field(default_factory=dict)
    replans: Sequence[Replan] = ()
    known_since: FloatArray | None = None

    @classmethod
    def of(cls, flight: Flight, status: str = "") -> ShownFlight:
        """A flight that was simulated."""
        return cls(
            time=flight.time,
            position=flight.position,
            status=status,
            replans=flight.replans,
            known_since=flight.known_since,
        )

    @property
    def found(self) -> dict[int, float]:
        """When each obstacle became known that was not so from the start, in s."""
        since = np.zeros(0) if self.known_since is None else self.known_since
        return {int(i): float(since[i]) for i in np.flatnonzero(since > 0)}

    def require_fit(self, num_outputs: int) -> None:
        """Refuses arrays that do not fit each other and a vehicle.

        Raises:
            ValueError: if they do not.
        """
        count, shape = len(self.time), np.shape(self.position)
        if count < 2 or shape != (count, num_outputs):
            raise ValueError(
                f"position: got shape {shape}, but it must be"
                f" (len(time), {num_outputs}) with at least two times"
            )
