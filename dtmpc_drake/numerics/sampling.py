"""When a flight is looked at: after every step of its grid, and for its samples."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from dtmpc_drake.numerics.arrays import Array


def step_times(duration: float, step: float) -> Array:
    """Where steps of the integrator end, whatever else shortens some of them.

    They do not depend on when a flight is sampled, and so neither does the flight.

    Args:
        duration: in s.
        step: the longest, in s.

    Returns:
        All multiples of `step` from zero on, and the end, ``(S + 1,)``, in s.
    """
    count = math.ceil(duration / step - 1e-6)
    return np.append(step * np.arange(count), duration)


def samples(times: Array, period: float) -> npt.NDArray[np.intp]:
    """Which times are samples: the first in every period, and the last of all.

    Args:
        times: increasing from zero, in s.
        period: in s; where it is shorter than the steps, all times are samples.

    Returns:
        Their indices.
    """
    number = np.floor(np.round(times / period, 6))
    first = np.flatnonzero(np.diff(number, prepend=-1) > 0)
    return np.union1d(first, len(times) - 1)
