"""The direction of a gust, from noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import LeafSystem

from dtmpc_drake.models import Array


class GustDirection(LeafSystem):
    """Makes of Gaussian noise one direction for all outputs.

    .. pydrake_system::

        name: GustDirection
        input_ports:
        - noise
        output_ports:
        - push

    `noise` is ``(m + 1,)`` and `push` is ``(m,)``, its largest element -1 or 1.  The
    sign of the last number decides whether it is a corner of the cube or any
    direction, all alike.  With `trials`, both have one more axis in front.
    """

    def __init__(self, *, num_outputs: int, trials: int | None = None) -> None:
        """Constructs the system.

        Args:
            num_outputs: m.
            trials: how many plants; one, without the axis, if left out.
        """
        LeafSystem.__init__(self)
        count = 1 if trials is None else trials
        self._columns = num_outputs + 1
        self._noise = self.DeclareVectorInputPort("noise", count * self._columns)
        self.DeclareVectorOutputPort(
            "push",
            count * num_outputs,
            self._calc_push,
            prerequisites_of_calc={self._noise.ticket()},
        )

    def _calc_push(self, context: Any, output: Any) -> None:
        noise: Array = self._noise.Eval(context).reshape(-1, self._columns)
        way, choice = noise[:, :-1], noise[:, -1:]
        corner = np.where(way < 0, -1.0, 1.0)
        largest = np.abs(way).max(axis=1, keepdims=True)
        sphere = way / np.maximum(largest, np.finfo(float).tiny)
        output.SetFromVector(np.where(choice < 0, sphere, corner).ravel())
