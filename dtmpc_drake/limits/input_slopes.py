"""How the input's range answers to state, tube, reference and gain."""

from __future__ import annotations

import numpy as np

from dtmpc_drake.limits.base import Slopes
from dtmpc_drake.method.sliding import SlidingLaw
from dtmpc_drake.method.tightening import Instant
from dtmpc_drake.numerics.arrays import Array, magnitude
from dtmpc_drake.numerics.differences import Parts


class InputSlopes:
    """First derivatives of `tightening.input_range` at K instants.

    Only the model is differentiated by differences, once for all that is made of it;
    the rest is written out.

    Args:
        law: the controller.
        at: K instants, batched over one axis.
        secant: half-width of the differences along the state.

    Attributes:
        nominal: the range's middle B⁻¹ y*^(n), ``(K, m)``.
        spread: how far from it the input may be, ``(K, m)``.
    """

    def __init__(self, law: SlidingLaw, at: Instant, secant: float) -> None:
        model, n, m = law.model, law.order, law.num_outputs
        parts = Parts(
            {
                "drift_bound_over": model.drift_bound_over,
                "own": lambda x, _: model.model_error_bound(x),
                "largest": model.model_error_bound_over,
                "inverse": lambda x, _: model.inverse_input_matrix(x),
                "deviation": model.inverse_input_deviation,
            },
            at.state,
            at.error_bound,
            secant,
        )
        # Theorem 2, as in `tightening.feedback_bound`.
        largest, by_largest = parts["largest"]
        own, by_own = parts["own"]
        limit, by_limit = parts["drift_bound_over"]
        c = law.coefficients
        excess = at.gain - own + largest / 2
        size = magnitude(excess)
        self._sign = excess / size
        feedback = limit + largest / 2 + size
        feedback = feedback + (c[:-1] * at.error_bound[:, 1:]).sum(axis=1)
        by_feedback = by_limit + by_largest / 2
        by_feedback += self._sign[:, :, None] * (by_largest / 2 - by_own)
        axes = np.arange(m)
        for k in range(1, n):
            by_feedback[:, axes, (n + k) * m + axes] += c[k - 1]
        self._feedback, self._by_feedback = feedback, by_feedback

        # Corollary 2, as in `tightening.input_range`.
        self._highest, self._away = at.highest, magnitude(at.highest)
        self._inverse, self._by_inverse = parts["inverse"]
        self._deviation, self._by_deviation = parts["deviation"]
        self._reaction = np.abs(self._inverse) + self._deviation
        self.nominal = (self._inverse * at.highest[:, None]).sum(axis=-1)
        self.spread = (
            self._deviation * self._away[:, None] + self._reaction * feedback[:, None]
        ).sum(axis=-1)

    def through_spread(self, by_spread: Array) -> tuple[Array, Array, Array]:
        """Of what answers to the spread, by model, y*^(n) and gain.

        Args:
            by_spread: ``(K, q, m)``.

        Returns:
            As the fields of `Slopes`, ``(K, q, ...)`` each.
        """
        through = by_spread @ self._reaction
        by_model = through @ self._by_feedback
        if self._by_inverse.any() or self._by_deviation.any():
            changes = np.sign(self._inverse)[..., None] * self._by_inverse
            changes = changes + self._by_deviation
            by_model += np.einsum(
                "kpi,kijl,kj->kpl", by_spread, changes, self._feedback
            )
            by_model += np.einsum(
                "kpi,kijl,kj->kpl", by_spread, self._by_deviation, self._away
            )
        turned = (self._highest / self._away)[:, None]
        by_highest = by_spread @ self._deviation * turned
        return by_model, by_highest, through * self._sign[:, None]

    def through_nominal(self, each: Array, by_nominal: Array) -> tuple[Array, Array]:
        """Of what answers to the middle, by model and by y*^(n).

        Args:
            each: at which instants, ``(R,)``.
            by_nominal: ``(R, m)``.

        Returns:
            ``(R, 2 n m)`` and ``(R, m)``.
        """
        changes = np.einsum("kijl,kj->kil", self._by_inverse, self._highest)[each]
        along = by_nominal[:, None]
        return (along @ changes)[:, 0], (along @ self._inverse[each])[:, 0]

    def of_rows(self, by_nominal: Array, by_spread: Array) -> Slopes:
        """Of q functions of the range at every instant, row by row.

        Args:
            by_nominal: their derivatives by the middle, ``(K, q, m)``.
            by_spread: and by the spread, the same shape.
        """
        K, q, m = by_nominal.shape
        by_model, by_highest, by_gain = self.through_spread(by_spread)
        each = np.arange(K).repeat(q)
        own_model, own_highest = self.through_nominal(each, by_nominal.reshape(-1, m))
        return Slopes(
            by_model=by_model.reshape(K * q, -1) + own_model,
            by_highest=by_highest.reshape(K * q, m) + own_highest,
            by_gain=by_gain.reshape(K * q, m),
        )
