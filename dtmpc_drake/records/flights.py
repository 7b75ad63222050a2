"""Many flights of one plan: what is kept and reported of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.records import verdict

REPORT_PERIOD = 0.05
"""Between two samples that are kept of a flight at least, in s."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
RATIOS = ("layer", "position", "velocity")
"""What |s|/Φ, |ỹ|/Ω and |dỹ/dt|/W are shares of."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Flights:
    """What is kept of T trials that flew one plan through one disturbance.

    Attributes:
        index: numbers of the trials, ``(T,)``.
        seed: of each trial, ``(T,)``.
        parameters: true parameters by name, ``(T,)`` each.
        record: of `records.verdict`, ``(T, 6, 8)``: the worst of everything that
            was seen at any step of the integrator, and what broke first.
        effort: ∫‖u‖² dt, ``(T,)``.
        time: ``(K,)``, in s, `REPORT_PERIOD` apart, or the scenario's log period if
            that is longer.
        position: ``(T, K, m)``.
        position_ratio: |ỹ|/Ω of the worst axis, the largest since the sample
            before, ``(T, K)``; infinite where it is no number.
    """

    index: Array
    seed: Array
    parameters: dict[str, Array]
    record: Array
    effort: Array
    time: Array
    position: Array
    position_ratio: Array

    @classmethod
    def concatenate(cls, parts: Sequence[Flights]) -> Flights:
        """All trials of some batches, in their order."""

        def join(name: str) -> Array:
            return np.concatenate([getattr(part, name) for part in parts])

        shared = {"time", "parameters"}
        names = {field.name for field in dataclasses.fields(cls)} - shared
        parameters = {
            name: np.concatenate([part.parameters[name] for part in parts])
            for name in parts[0].parameters
        }
        return cls(
            time=parts[0].time, parameters=parameters, **{n: join(n) for n in names}
        )

    def __len__(self) -> int:
        """T."""
        return len(self.index)

    @property
    def worst_ratios(self) -> Array:
        """The largest |s|/Φ, |ỹ|/Ω and |dỹ/dt|/W, ``(T, 3)``."""
        ratios = slice(verdict.LAYER, verdict.VELOCITY + 1)
        return self.record[:, verdict.WORST, ratios]

    @property
    def smallest_clearance(self) -> Array:
        """To any obstacle, ``(T,)``, in m."""
        return -self.record[:, verdict.WORST, verdict.OBSTACLES]

    @property
    def broken(self) -> Array:
        """Which of `verdict.QUANTITIES` each trial broke, ``(T, 8)``."""
        return verdict.broken(self.record.swapaxes(0, 1))

    @property
    def violations(self) -> dict[str, int]:
        """How many trials broke anything but an obstacle, by its name."""
        counts = map(int, self.broken.sum(axis=0))
        named = dict(zip(verdict.QUANTITIES, counts, strict=True))
        del named["obstacles"]
        return named

    def what_broke(self) -> str:
        """How many trials broke what, in words; empty if none broke anything."""
        counts = {
            name.replace("_", " "): int(count)
            for name, count in zip(
                verdict.QUANTITIES, self.broken.sum(axis=0), strict=True
            )
        }
        broken = [f"{name} {count}" for name, count in counts.items() if count]
        return f"of {len(self)} flights broke: {', '.join(broken)}" if broken else ""

    @property
    def outside(self) -> int:
        """How many trials broke any of `violations`."""
        others = np.arange(len(verdict.QUANTITIES)) != verdict.OBSTACLES
        return int(self.broken[:, others].any(axis=1).sum())

    @property
    def collisions(self) -> int:
        """How many trials touched an obstacle."""
        return int(self.broken[:, verdict.OBSTACLES].sum())

    @property
    def finite(self) -> Array:
        """Which trials have a position at every time, ``(T,)``."""
        return np.asarray(np.isfinite(self.position).all(axis=(1, 2)))

    @property
    def hardest(self) -> int:
        """The row of the trial that used most of its tube, among `finite` ones."""
        return int(np.where(self.finite, self.worst_ratios[:, 1], -1.0).argmax())

    @property
    def distinct(self) -> int:
        """How many different flights there are, to the last bit of a position."""
        return len({flight.tobytes() for flight in self.position})

    @property
    def safe(self) -> bool:
        """Whether there are trials, and none broke or touched anything."""
        return len(self) > 0 and not self.broken.any()

    def quantiles(self) -> Array:
        """Of |ỹ|/Ω over the trials, at every time, ``(len(QUANTILES), K)``."""
        # Between a finite and an infinite one there is nothing to interpolate.
        finite = bool(np.isfinite(self.position_ratio).all())
        method: Literal["linear", "higher"] = "linear" if finite else "higher"
        return np.quantile(self.position_ratio, QUANTILES, axis=0, method=method)

    def arrays(self) -> dict[str, Array]:
        """Everything as arrays by name, to be saved."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        parameters = fields.pop("parameters")
        for name in ("worst_ratios", "smallest_clearance"):
            fields[name] = getattr(self, name)
        return fields | {f"parameter_{n}": v for n, v in parameters.items()}

    def summary(self) -> dict[str, Any]:
        """Plain numbers: counts, extremes and the trials that reached them."""
        closest = int(self.smallest_clearance.argmin())
        worst = int(self.worst_ratios[:, 1].argmax())
        return {
            "trials": len(self),
            "distinct": self.distinct,
            "violations": self.violations,
            "trials_with_violations": self.outside,
            "collisions": self.collisions,
            "worst_ratios": dict(
                zip(RATIOS, map(float, self.worst_ratios.max(axis=0)), strict=True)
            ),
            "worst_position_trial": int(self.index[worst]),
            "smallest_clearance": float(self.smallest_clearance[closest]),
            "closest_trial": int(self.index[closest]),
            "effort": _quantiles(self.effort),
            # One number a trial: how much of its tube it ever used.
            "largest_position_ratio": _quantiles(self.worst_ratios[:, 1]),
        }

    def __repr__(self) -> str:
        """Names what a reader wants to know first."""
        layer, position, velocity = self.worst_ratios.max(axis=0)
        return (
            f"Flights({len(self)} trials, {self.distinct} distinct, "
            f"{self.outside} with violations, "
            f"{self.collisions} collisions, worst |s|/Φ {layer:.3f}, |ỹ|/Ω "
            f"{position:.3f}, |dỹ/dt|/W {velocity:.3f}, clearance "
            f"{self.smallest_clearance.min():.3f})"
        )


def _quantiles(values: Array) -> dict[str, float]:
    """Of those that are finite; no numbers if none is."""
    names = ["smallest", "median", "largest"]
    finite = values[np.isfinite(values)]
    found = np.quantile(finite, (0, 0.5, 1)) if len(finite) else np.full(3, np.nan)
    return dict(zip(names, map(float, found), strict=True))


def save_flights(path: str | Path, flights: Mapping[str, Flights]) -> None:
    """Writes flights by the name of their disturbance, as ``<name>_<field>``.

    Args:
        path: of the ``.npz`` file.
        flights: by name.

    Raises:
        OSError: if the file cannot be written.
    """
    arrays: dict[str, Any] = {
        f"{kind}_{name}": array
        for kind, flown in flights.items()
        for name, array in flown.arrays().items()
    }
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)
