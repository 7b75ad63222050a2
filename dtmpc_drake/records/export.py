"""Plans as text that other programs read."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable

import numpy as np

from dtmpc_drake.errors import require
from dtmpc_drake.records.plan import Plan

_AXES = ("x", "y", "z", "yaw")
_POWERS = 8  # of every axis


def to_quadrotor_csv(plan: Plan) -> str:
    """The reference as the piecewise polynomials that small quadrotors read.

    It is the format of ``uav_trajectories``, Crazyswarm and Crazyswarm2: a header, and
    a line for each of the plan's own pieces, with its duration in s and then the
    coefficients of x, y, z (m) and yaw (rad), in powers 0 to 7 of the time since the
    piece began.  An axis that the plan has no output for is zero, and so is the yaw.
    The file says neither when the plan starts nor how wide its tube is.

    Args:
        plan: of at most three outputs, which are taken for x, y and z in m, and of
            order six at most.

    Raises:
        ScenarioError: if the plan does not fit into the format.
    """
    m, powers = plan.num_outputs, plan.coefficients.shape[1]
    outputs = "at most 3 in this format: the x, y and z of a quadrotor"
    require("plan.num_outputs", m, m < len(_AXES), outputs)
    order = f"at most {_POWERS - 2} in this format, whose pieces have degree 7 at most"
    require("plan.order", plan.order, powers <= _POWERS, order)
    pieces = np.zeros((len(plan.coefficients), len(_AXES), _POWERS))
    pieces[:, :m, :powers] = plan.coefficients.swapaxes(1, 2)
    rows = np.column_stack([np.diff(plan.knots), pieces.reshape(len(pieces), -1)])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    powers_of = (f"{axis}^{power}" for axis in _AXES for power in range(_POWERS))
    writer.writerow(["duration", *powers_of])
    writer.writerows(rows.tolist())
    return text.getvalue()


FORMATS: dict[str, Callable[[Plan], str]] = {"csv": to_quadrotor_csv}
"""What ``dtmpc export`` writes, by the name of the format."""
