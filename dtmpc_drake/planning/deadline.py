"""How long planning may take by the clock on the wall."""

from __future__ import annotations

import dataclasses
import math
import time


@dataclasses.dataclass(frozen=True)
class Deadline:
    """A time after which no new work is begun.

    Attributes:
        limit: that was given, in s.
        end: of the monotonic clock, in s.
    """

    limit: float
    end: float

    @classmethod
    def after(cls, limit: float) -> Deadline:
        """The deadline that many seconds from now."""
        return cls(limit, time.perf_counter() + limit)

    @property
    def left(self) -> float:
        """In s, not negative."""
        return max(0.0, self.end - time.perf_counter())

    @property
    def passed(self) -> bool:
        """Whether it is too late."""
        return time.perf_counter() >= self.end

    def __str__(self) -> str:
        """For a message."""
        return f"planner.time_limit = {self.limit:g} s"


NEVER = Deadline(math.inf, math.inf)
"""All the time in the world."""
