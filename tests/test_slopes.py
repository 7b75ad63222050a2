"""The derivatives that are written out are those of the functions themselves."""

from __future__ import annotations

import numpy as np
import pytest
from dtmpc_drake.planning.scp.slopes import feedforward_slopes, limit_slopes

from dtmpc_drake.numerics.arrays import Array, jacobian
from dtmpc_drake.numerics.differences import differences
from dtmpc_drake.planning.transcription import Local, Transcription
from tests.models_for_tests import every_model, make_problem, name_of


def some_instants(n: int, m: int, count: int = 40) -> Local:
    """Anywhere, but not at rest, where models have kinks."""
    random = np.random.default_rng(7)
    away = random.choice([-1.0, 1.0], (count, n, m)) * random.uniform(
        0.1, 2.0, (count, n, m)
    )
    return Local(
        state=away,
        highest=random.normal(size=(count, m)),
        layer=random.uniform(0.05, 1.0, (count, m)),
        bandwidth=random.uniform(0.5, 4.0, (count, m)),
        error_bound=random.uniform(0.0, 0.5, (count, n, m)),
    )


@pytest.mark.parametrize("model", every_model(), ids=name_of)
def test_slopes_at_one_instant_are_those_of_the_transcription(model):
    transcription = Transcription(make_problem(model), 16)
    n, m = model.order, model.num_outputs
    local = some_instants(n, m)
    flat = local.pack()

    def of(function):
        return jacobian(lambda x: function(Local.unpack(x, n, m)), flat, 1e-5)

    slopes = limit_slopes(transcription.problem, local, 1e-5)
    close = {"rtol": 1e-6, "atol": 1e-6}
    np.testing.assert_allclose(
        feedforward_slopes(model, local, 1e-5), of(transcription.feedforward), **close
    )
    np.testing.assert_allclose(
        slopes.along(slopes.steepest),
        of(lambda at: transcription.used_input(at)[..., None])[:, 0],
        **close,
    )
    if n == 1:
        np.testing.assert_allclose(
            slopes.used_rate, of(transcription.used_rate), **close
        )
    np.testing.assert_allclose(
        slopes.error_margin,
        of(lambda at: transcription.error_margin(at.state, at.error_bound)),
        **close,
    )


def test_differences_see_a_kink_from_both_sides_and_skip_what_does_not_matter():
    calls: list[int] = []

    def function(state: Array, radius: Array) -> Array:
        calls.append(int(np.prod(state.shape[:-2])))
        return np.abs(state[..., 1, :]) + 2 * radius[..., 0, :]

    state = np.array([[[5.0, 5.0], [0.0, 0.1]]])
    found = differences(function, state, np.ones((1, 2, 2)), 0.2)
    np.testing.assert_allclose(found.value, [[2.0, 2.1]])
    by_state, by_radius = found.slope[0, :, :4], found.slope[0, :, 4:]
    np.testing.assert_allclose(by_state, [[0, 0, 0, 0], [0, 0, 0, 0.5]], atol=1e-12)
    np.testing.assert_allclose(by_radius, [[2, 0, 0, 0], [0, 2, 0, 0]], atol=1e-8)
    np.testing.assert_allclose(
        found.bend[0], [[0, 0, 1.0, 0], [0, 0, 0, 0.5]], atol=1e-12
    )
    # Two of four rows matter, with two axes each: ahead and behind.
    assert calls == [5, 8]
