"""One flight, as the exported ports of a closed loop said it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.records import verdict
from dtmpc_drake.records.archive import DAMAGE, read_array, require_archive
from dtmpc_drake.records.plan import Plan
from dtmpc_drake.records.replan import Replan, flown_plan
from dtmpc_drake.records.saved_flight import check_arrays, read_replans, read_status
from dtmpc_drake.scenario import Scenario

LOGGED = (
    "state",
    "control",
    "reference",
    "disturbance",
    "tube_ratios",
    "clearance",
)
"""Ports of a closed loop whose values are kept."""
_OF_EACH_TRIAL = [name for name in LOGGED if name != "reference"]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Flight:
    """What the exported ports said, once in every `log_period` and at the end.

    Only `record` looks more often: at every step of the integrator.

    The log of many trials has an axis for them after the time, except in
    `reference`, which they share.

    Attributes:
        time: ``(K,)``, in s.
        state: x of the plant, ``(K, n, m)``.
        control: u, ``(K, m)``.
        reference: y* and its derivatives, ``(K, n + 1, m)``.
        disturbance: d, ``(K, m)``.
        tube_ratios: |s|/Φ, |ỹ|/Ω and |dỹ/dt|/W, ``(K, 3, m)``.
        clearance: to each obstacle, ``(K, obstacles)`` in m; one column of
            infinities without obstacles.
        record: of `records.verdict`, ``(6, 8)``: the worst of everything that was
            seen at any step of the integrator, and what broke first.
        status: of the planner at the end.
        known_since: when each obstacle became known, ``(obstacles,)`` in s;
            infinite where it never was.
        replans: every time that was planned on the way, the start included; none
            if there could only be one plan.
    """

    time: Array
    state: Array
    control: Array
    reference: Array
    disturbance: Array
    tube_ratios: Array
    clearance: Array
    record: Array
    status: str
    known_since: Array
    replans: tuple[Replan, ...] = ()

    @property
    def position(self) -> Array:
        """Where the plant was, ``(K, m)``."""
        return self.state[..., 0, :]

    def trial(self, row: int) -> Flight:
        """The log of one of many trials."""
        names = (*_OF_EACH_TRIAL, "record")
        own = {name: getattr(self, name)[:, row] for name in names}
        return dataclasses.replace(self, **own)

    def extremes(self) -> dict[str, float]:
        """The worst that was seen at any step of the integrator, by name.

        The speed is the largest along any axis, as in the scenario's limit; it
        is taken from differences of the position where it is no state (n = 1).
        """
        return verdict.extremes(self.record)

    def breaches(self, scenario: Scenario) -> tuple[verdict.Breach, ...]:
        """What a single flight broke, the first before all else; none if it is well.

        Args:
            scenario: that was flown.
        """
        return verdict.breaches(
            self.record,
            limits=scenario.limits,
            model=scenario.model,
            replans=self.replans,
        )

    def flown_plan(self) -> Plan | None:
        """The plan that was in force at each time, if there could be several."""
        return flown_plan(self.replans) if self.replans else None

    def save(self, path: str | Path) -> None:
        """Writes all arrays as ``.npz``, under their names here.

        `replans` is a text in JSON; the plan of its entry i is in the arrays
        ``plan<i>_<field of Plan>``.
        """
        arrays = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        arrays["replans"] = json.dumps([r.summary() for r in self.replans])
        for i, one in enumerate(self.replans):
            if one.plan is not None:
                for field in dataclasses.fields(Plan):
                    arrays[f"plan{i}_{field.name}"] = getattr(one.plan, field.name)
        with open(path, "wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Flight:
        """Reads what `save` wrote of a single flight.

        What was logged of a flight that diverged is loaded as it was, so states and
        what follows from them may be infinite or not a number.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a saved log, or anything in it is wrong;
                it names the file and the field.
        """
        require_archive(path, "log")
        reading = "the archive: "
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays: dict[str, Any] = {}
                for field in dataclasses.fields(cls):
                    reading = f"{field.name}: "
                    arrays[field.name] = read_array(data, field.name)
                reading = ""  # what is wrong begins with the field
                check_arrays(arrays)
                reading = "status: "
                texts: dict[str, Any] = {"status": read_status(arrays["status"])}
                reading = "replans: "
                texts["replans"] = read_replans(arrays["replans"], data)
        except DAMAGE as error:
            why = " ".join(str(error).split())
            raise ValueError(f"{path}: not a saved log ({reading}{why})") from None
        return cls(**arrays | texts)

    def __repr__(self) -> str:
        """Names what a reader wants to know first."""
        seen = self.extremes()
        return (
            f"Flight({len(self.time)} samples over {self.time[-1]:g} s, "
            f"worst |s|/Φ {seen['worst_layer_ratio']:.3f}, "
            f"|ỹ|/Ω {seen['worst_position_ratio']:.3f}, "
            f"clearance {seen['smallest_clearance']:.3f}, plan {self.status})"
        )
