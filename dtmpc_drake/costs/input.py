"""The cost of the input, uᵀQu."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import ClassVar

import numpy as np

from dtmpc_drake.costs.base import Cost
from dtmpc_drake.costs.weights import Weight, root_of, rooted, rooted_rows
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.units import Units
from dtmpc_drake.numerics.arrays import Array
from dtmpc_drake.numerics.differences import Parts


@dataclasses.dataclass(frozen=True, eq=False)
class InputCost(Cost):
    """``u*'Q u*`` with u* = B⁻¹ (y*^(n) - F̂(x*)).

    Attributes:
        weight: Q: a number, a list or a matrix; see `weights`.
    """

    weight: Weight

    title: ClassVar[str] = "input"

    @cached_property
    def _root(self) -> Array:
        return root_of(self.weight)

    def in_units(self, units: Units, worth: float) -> InputCost:
        """See base class; the unit of costs is chosen so that this is itself."""
        return self

    def residuals(self, law: SlidingLaw, state: Array, highest: Array) -> Array:
        """See base class."""
        u = law.model.input_for(state, highest - law.model.drift(state))
        return rooted(self._root, u)

    def slopes(
        self, law: SlidingLaw, state: Array, highest: Array, secant: float
    ) -> tuple[Array, Array]:
        """See base class; only the model is differentiated by differences."""
        model, size = law.model, state[0].size
        parts = Parts(
            {
                "drift": lambda x, _: model.drift(x),
                "inverse": lambda x, _: model.inverse_input_matrix(x),
            },
            state,
            np.zeros_like(state),
            secant,
        )
        drift, by_drift = parts["drift"]
        inverse, by_inverse = parts["inverse"]
        by_model = -inverse @ by_drift
        if by_inverse.any():
            by_model += np.einsum("kijl,kj->kil", by_inverse, highest - drift)
        root = self._root
        return rooted_rows(root, by_model[:, :, :size]), rooted_rows(root, inverse)
