"""First derivatives of what enters the programs at one instant.

Only the model is differentiated by differences, once for all that is made of it;
the rest is written out.  Along the state the differences are secants: model errors
often have a kink at rest, which a derivative would not see.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from dtmpc_drake.models import ConstantUncertainty, Model
from dtmpc_drake.numerics.arrays import Array, euclidean_norm, magnitude
from dtmpc_drake.numerics.differences import differences
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.transcription import Local


@dataclasses.dataclass(frozen=True, eq=False)
class LimitSlopes:
    """Derivatives by `Local.pack`, whose width is L, at K instants.

    Attributes:
        nominal: B⁻¹(x*) y*^(n) itself, ``(K, m)``.
        by_nominal: its derivative, ``(K, m, L)``.
        by_reaction: of the rest of the input's bound, ``(K, L)``.
        used_rate: of the velocity error's bound if n = 1, else ``(K, 0, L)``.
        error_margin: of `Transcription.error_margin`, ``(K, 0 or m, L)``.
    """

    nominal: Array
    by_nominal: Array
    by_reaction: Array
    used_rate: Array
    error_margin: Array

    @property
    def steepest(self) -> Array:
        """The direction in which ‖B⁻¹ y*^(n)‖ grows, ``(K, m)``; see `along`."""
        return np.asarray(self.nominal / euclidean_norm(self.nominal)[:, None])

    def rows(self, which: Array) -> LimitSlopes:
        """Those at some of the instants."""
        fields = dataclasses.fields(self)
        return LimitSlopes(**{f.name: getattr(self, f.name)[which] for f in fields})

    def along(self, direction: Array) -> Array:
        """Of the input's bound with u'B⁻¹ y*^(n) for its first norm, ``(K, L)``.

        Args:
            direction: unit vectors u, ``(K, m)``; with `steepest` it is the bound's
                own derivative.
        """
        nominal = (direction[:, None] @ self.by_nominal)[:, 0]
        return np.asarray(nominal + self.by_reaction)


def feedforward_slopes(model: Model, local: Local, secant: float) -> Array:
    """Derivatives of u* = B⁻¹ (y*^(n) - F̂(x*)), ``(K, m, L)``; see `limit_slopes`."""
    parts = _Parts(
        {
            "drift": lambda x, _: model.drift(x),
            "inverse": lambda x, _: model.inverse_input_matrix(x),
        },
        local,
        secant,
    )
    drift, by_drift = parts["drift"]
    inverse, by_inverse = parts["inverse"]
    by_model = -inverse @ by_drift
    if by_inverse.any():
        missing = local.highest - drift
        by_model += np.einsum("kijl,kj->kil", by_inverse, missing)
    return _by_local(local, by_model, inverse, 0.0 * inverse)


def limit_slopes(problem: Problem, local: Local, secant: float) -> LimitSlopes:
    """Derivatives of what `Transcription` compares with limits at one instant.

    Args:
        problem: whose input, rate and error margin are meant.
        local: at K instants, batched over one axis.
        secant: see `differences`.
    """
    model, n, m = problem.model, problem.model.order, problem.model.num_outputs

    def true(x: Array, radius: Array) -> Array:
        if isinstance(model, ConstantUncertainty) and model.covers:
            return model.model.model_error_bound_over(x, radius)
        return np.zeros((*x.shape[:-2], 0))

    parts = _Parts(
        {
            "drift_bound_over": model.drift_bound_over,
            "own": lambda x, _: model.model_error_bound(x),
            "largest": model.model_error_bound_over,
            "true": true,
            "inverse": lambda x, _: model.inverse_input_matrix(x),
            "deviation": model.inverse_input_deviation,
        },
        local,
        secant,
    )

    # Theorem 2, as in `tightening.feedback_bound`.
    largest, by_largest = parts["largest"]
    own, by_own = parts["own"]
    limit, by_limit = parts["drift_bound_over"]
    c = problem.law.coefficients
    excess = local.bandwidth * local.layer - own + largest / 2
    size = magnitude(excess)
    sign = excess / size
    feedback = limit + largest / 2 + size
    feedback = feedback + (c[:-1] * local.error_bound[:, 1:]).sum(axis=1)
    by_feedback = by_limit + by_largest / 2
    by_feedback += sign[:, :, None] * (by_largest / 2 - by_own)
    axes = np.arange(m)
    for k in range(1, n):
        by_feedback[:, axes, (n + k) * m + axes] += c[k - 1]

    # Corollary 2, as in `tightening.input_bound`.
    highest, away = local.highest, magnitude(local.highest)
    inverse, by_inverse = parts["inverse"]
    deviation, by_deviation = parts["deviation"]
    reaction = np.abs(inverse) + deviation
    nominal = (inverse * highest[:, None]).sum(axis=-1)
    worst = (deviation * away[:, None] + reaction * feedback[:, None]).sum(axis=-1)
    against = (worst / euclidean_norm(worst)[:, None])[:, None]
    through = against @ reaction
    by_model = through @ by_feedback
    if by_inverse.any() or by_deviation.any():
        changes = np.sign(inverse)[..., None] * by_inverse + by_deviation
        by_model += np.einsum("kpi,kijl,kj->kpl", against, changes, feedback)
        by_model += np.einsum("kpi,kijl,kj->kpl", against, by_deviation, away)
    by_highest = against @ deviation * (highest / away)[:, None]
    reacting = _by_local(local, by_model, by_highest, through * sign[:, None])
    nothing = 0.0 * inverse
    by_model = np.einsum("kijl,kj->kil", by_inverse, highest)
    by_nominal = _by_local(local, by_model, inverse + nothing, nothing)

    # Corollary 1, as in `tightening.rate_bound`; beyond n = 1 it is a state.
    of_rate = slice(m if n == 1 else 0)
    by_rate = (2 * by_largest - by_own)[:, of_rate]
    _, by_true = parts["true"]
    none = nothing[:, : by_true.shape[1]]
    return LimitSlopes(
        nominal=nominal,
        by_nominal=by_nominal,
        by_reaction=reacting[:, 0],
        used_rate=_by_local(
            local, by_rate, nothing[:, of_rate], (nothing + np.eye(m))[:, of_rate]
        ),
        error_margin=_by_local(local, -by_true, none, none),
    )


def _by_local(
    local: Local, by_model: Array, by_highest: Array, by_gain: Array
) -> Array:
    """From x* and R, y*^(n) and κ = αΦ to `Local.pack`, ``(K, r, L)``."""
    split = local.state[0].size
    return np.concatenate(
        [
            by_model[..., :split],
            by_highest,
            by_gain * local.bandwidth[:, None],
            by_gain * local.layer[:, None],
            by_model[..., split:],
        ],
        axis=-1,
    )


class _Parts:
    """What a model says of K boxes around states, each part with its slope."""

    def __init__(
        self,
        functions: dict[str, Callable[[Array, Array], Array]],
        local: Local,
        secant: float,
    ) -> None:
        one = {
            name: function(local.state[:1], local.error_bound[:1])[0]
            for name, function in functions.items()
        }
        self._shape = {name: value.shape for name, value in one.items()}
        ends = np.cumsum([value.size for value in one.values()])
        self._where = {
            name: slice(end - value.size, end)
            for (name, value), end in zip(one.items(), ends, strict=True)
        }

        def flat(state: Array, radius: Array) -> Array:
            lead = state.shape[:-2]
            values = [function(state, radius) for function in functions.values()]
            return np.concatenate([v.reshape(*lead, -1) for v in values], axis=-1)

        self._found = differences(flat, local.state, local.error_bound, secant)

    def __getitem__(self, name: str) -> tuple[Array, Array]:
        """Value ``(K, ...)`` and slope ``(K, ..., 2 n m)``."""
        where, shape = self._where[name], self._shape[name]
        value, slope = self._found.value[:, where], self._found.slope[:, where]
        K = len(value)
        return value.reshape(K, *shape), slope.reshape(K, *shape, slope.shape[-1])
