"""Scenarios that nobody tuned: an honest status, and plans a stranger confirms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.obstacles import Cylinder, Ellipsoid, Sphere
from dtmpc_drake.planning import plan
from dtmpc_drake.scenario import Scenario, Waypoint

SEEDS = range(12)


def random_scenario(seed: int) -> Scenario:
    """A flight along y through up to six obstacles of mixed kinds."""
    g = np.random.default_rng(seed)
    length = g.uniform(8, 20)
    scenario = Scenario(
        start=Waypoint(position=[0.0, 0.0, 1.0], velocity=[0.0, g.uniform(0, 1), 0.0]),
        goal=Waypoint(position=[g.normal(), length, 1.0]),
        duration=length / g.uniform(1.0, 1.7),
    )
    scenario.model.drag_error_bound = float(g.choice([0.0, 0.05, 0.1]))
    scenario.disturbance.bound = g.uniform(0.1, 0.6, 3).tolist()
    scenario.controller.slope = g.uniform(1.5, 3, 3).tolist()
    scenario.planner.intervals = int(g.integers(24, 61))
    scenario.planner.tube_margin = str(g.choice(["norm", "support"]))
    for _ in range(g.integers(0, 7)):
        x, y = g.normal(scale=1.5), g.uniform(2.5, length - 2.5)
        kind, radius = g.integers(3), g.uniform(0.3, 0.8)
        if kind == 0:
            scenario.obstacles.append(Cylinder([x, y], radius))
        elif kind == 1:
            scenario.obstacles.append(Sphere([x, y, 1.0], radius))
        else:
            H = np.diag(g.uniform(0.7, 1.3, 3)) + 0.1 * g.normal(size=(3, 3))
            scenario.obstacles.append(Ellipsoid([x, y, 1.0], H.tolist(), radius))
    return scenario


@pytest.fixture(scope="module")
def results():
    found = {}
    for seed in SEEDS:
        scenario = random_scenario(seed)
        try:
            found[seed] = scenario, plan(scenario)
        except ScenarioError:  # such as a goal inside an obstacle
            continue
    return found


def test_every_result_has_an_honest_status(results):
    for scenario, result in results.values():
        assert result.status in ("certified", "not_certified", "infeasible", "failed")
        assert (result.plan is None) == (result.status in ("infeasible", "failed"))
        assert "\n" not in result.message
        del scenario


def test_most_open_fields_are_solved(results):
    certified = [result.certified for _, result in results.values()]
    assert np.mean(certified) > 0.7


@pytest.mark.parametrize("seed", SEEDS)
def test_a_stranger_confirms_every_certified_plan(results, seed):
    if seed not in results or not results[seed][1].certified:
        return  # nothing is claimed
    scenario, result = results[seed]
    s = result.plan.sample()
    time, D = s["time"], np.array(scenario.disturbance.bound)
    slope, eta = np.array(scenario.controller.slope), scenario.controller.reaching_rate
    bound = scenario.model.drag_error_bound

    def at(t, name):
        return np.array([np.interp(t, time, column) for column in s[name].T])

    def rates(t, x):
        layer, tube = x.reshape(2, 3)
        v = at(t, "velocity")
        delta = bound * np.linalg.norm(v) * np.abs(v)
        rate = -at(t, "bandwidth") * layer + delta + D + eta
        return np.concatenate([rate, layer - slope * tube])

    layer0 = np.full(3, scenario.controller.initial_boundary_layer)
    solution = scipy.integrate.solve_ivp(
        rates,
        (time[0], time[-1]),
        np.concatenate([layer0, np.zeros(3)]),
        t_eval=time[::20],
        rtol=1e-7,
        atol=1e-9,
        max_step=0.1,
    ).y.T
    np.testing.assert_allclose(s["boundary_layer"][::20], solution[:, :3], atol=1e-3)
    np.testing.assert_allclose(s["position_tube"][::20], solution[:, 3:], atol=1e-3)

    # No corner of the tube's box is inside an obstacle.
    corners = np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3)
    where = s["position"][:, None] + corners * s["position_tube"][:, None]
    for obstacle in scenario.obstacles:
        H = obstacle.shape_matrix(3)
        center = np.array(obstacle.center)
        middle = center if isinstance(obstacle, Cylinder) else H @ center
        distance = np.linalg.norm(where @ H.T - middle, axis=-1)
        assert distance.min() >= obstacle.radius
    limit = scenario.limits.speed
    assert (np.abs(s["velocity"]) + s["velocity_tube"]).max() <= limit
    b = scenario.controller.bandwidth
    assert s["bandwidth"].min() >= b.min and s["bandwidth"].max() <= b.max
    rate = np.diff(s["bandwidth"], axis=0) / np.diff(time)[:, None]
    assert np.abs(rate).max() <= b.rate_max
    np.testing.assert_allclose(s["position"][-1], scenario.goal.position, atol=1e-6)
