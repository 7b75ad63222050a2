"""What is left of every limit of a plan, for all times."""

from __future__ import annotations

import dataclasses

import numpy as np

from dtmpc_drake.method.margin import Margin, worst

SAMPLED = "the model's bounds over a box are sampled, not proven"
OF_THE_ENDS = ("continuity", "time", "ends", "hand_over")
"""Margins that no finer interval can change."""
_OF_THE_PLAN = ("tube", *OF_THE_ENDS)
"""Margins that say how far a plan agrees with itself and its problem: no limits."""


@dataclasses.dataclass(frozen=True)
class Certificate:
    """Every margin of a plan.

    Attributes:
        margins: by name.
        bounds_proven: whether the model's bounds over a box are proven; if they
            were sampled, no plan is certified.
        faults: what makes it no plan of this problem at all, one line each; there
            are no margins then.
    """

    margins: dict[str, Margin]
    bounds_proven: bool
    faults: tuple[str, ...] = ()

    @property
    def kept(self) -> bool:
        """Whether all limits are kept, if the model's bounds are true."""
        return not self.faults and all(m.kept for m in self.margins.values())

    @property
    def certified(self) -> bool:
        """Whether all limits are kept and the bounds are proven."""
        return self.kept and self.bounds_proven

    @property
    def broken(self) -> tuple[str, ...]:
        """Names of the margins that are not kept."""
        return tuple(name for name, m in self.margins.items() if not m.kept)

    @property
    def worst(self) -> tuple[str, Margin]:
        """The smallest margin and its name, among limits where all are kept.

        Raises:
            ValueError: if there are `faults`, and so no margins.
        """
        broken = {name: self.margins[name] for name in self.broken}
        limits = {n: m for n, m in self.margins.items() if n not in _OF_THE_PLAN}
        among = broken or limits
        margin = worst(among.values())
        return next(name for name, m in among.items() if m is margin), margin

    @property
    def reason(self) -> str:
        """One line: why there is no certificate, or what its smallest margin is."""
        if self.faults:
            return self.faults[0]
        name, margin = self.worst
        if not margin.kept:
            return margin.named(name)
        if not self.bounds_proven:
            return SAMPLED
        return f"smallest margin: {margin.named(name)}"

    def __str__(self) -> str:
        """One line a fault or margin."""
        lines = [*self.faults]
        for name, margin in self.margins.items():
            finite = np.isfinite(margin.value)
            lines.append(f"{name:<20} {margin}" if finite else margin.named(name))
        if not self.bounds_proven:
            lines.append(SAMPLED)
        return "\n".join(lines)
