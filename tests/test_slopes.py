"""The derivatives that are written out are those of the functions themselves."""

from __future__ import annotations

import numpy as np
import pytest

from dtmpc_drake.costs import Cost
from dtmpc_drake.limits import InputRange, SampledLimit
from dtmpc_drake.limits.base import Facets
from dtmpc_drake.limits.norms import InputNorm, Norm
from dtmpc_drake.numerics.arrays import Array, jacobian
from dtmpc_drake.numerics.differences import differences
from dtmpc_drake.planning.iterate import Local
from dtmpc_drake.planning.scp.limit_rows import by_local
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
def test_slopes_at_one_instant_are_those_of_margins_and_residuals(model):
    problem = make_problem(model)
    law, n, m = problem.law, model.order, model.num_outputs
    local = some_instants(n, m)
    at, flat, close = local.instant, local.pack(), {"rtol": 1e-6, "atol": 1e-6}

    def of(function):
        return jacobian(lambda x: function(Local.unpack(x, n, m)), flat, 1e-5)

    for cost in problem.costs:
        by_state, by_highest = cost.slopes(law, local.state, local.highest, 1e-5)
        exact = of(lambda at, c=cost: c.residuals(law, at.state, at.highest))
        size = n * m
        np.testing.assert_allclose(by_state, exact[:, :, :size], **close)
        np.testing.assert_allclose(by_highest, exact[:, :, size : size + m], **close)
        general = Cost.slopes(cost, law, local.state, local.highest, 1e-5)
        np.testing.assert_allclose(general[0], by_state, **close)
        np.testing.assert_allclose(general[1], by_highest, **close)
    none = Facets(np.zeros(0, dtype=int), np.zeros((0, m)))
    rng = np.random.default_rng(3)
    ranged = InputRange(
        min=[None] * (m - 1) + [-1.0], max=rng.uniform(1, 2, m).tolist()
    )
    norm = InputNorm(Norm(rng.normal(size=(2, m)), rng.normal(size=2), 3.0))
    for limit in (*problem.sampled, ranged, norm):
        exact = of(lambda at, each=limit: each.margins(law, at.instant))
        for kind in (type(limit), SampledLimit):  # its own, and those by differences
            slopes = kind.slopes(limit, law, at, 1e-5, none)
            rows = len(slopes.by_gain) // len(flat)
            parts = slopes.by_model, slopes.by_highest, slopes.by_gain
            found = by_local(
                local, *(part.reshape(len(flat), rows, -1) for part in parts)
            )
            np.testing.assert_allclose(found, exact, **close)


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
        found.second[0], [[0, 0, 1.0, 0], [0, 0, 0, 0.5]], atol=1e-12
    )
    # Two of four rows matter, with two axes each: ahead and behind.
    assert calls == [5, 8]
