"""A plan is a reported status within its time, whatever the solvers do."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.obstacles import Cylinder
from dtmpc_drake.planning import plan, plan_problem, replan
from dtmpc_drake.planning.backend import Effort, backend_of
from dtmpc_drake.planning.deadline import Deadline
from dtmpc_drake.planning.ipopt import solver as nlp
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.scenario import Planner, Scenario, Waypoint, load_scenario, validate
from tests.models_for_tests import make_problem


def blocked(**planner) -> Scenario:
    """A wall that no plan passes, which takes many programs to find out."""
    return Scenario(
        start=Waypoint(position=[0.0, 0.0, 0.0]),
        goal=Waypoint(position=[0.0, 10.0, 0.0]),
        duration=6.0,
        obstacles=[Cylinder([0.9 * x, 5.0], 0.5) for x in range(-8, 9)],
        planner=Planner(**planner),
    )


@pytest.mark.parametrize("backend", ["clarabel", "ipopt"])
def test_a_plan_ends_at_its_time_limit_and_says_so(backend):
    scenario = blocked(backend=backend, intervals=24, time_limit=0.05)
    begin = time.perf_counter()
    result = plan(scenario)
    assert result.status == "failed"
    assert "planner.time_limit = 0.05 s" in result.message
    assert "cannot keep" in result.message  # what the best iterate lacks
    assert result.plan is None and result.attempt is not None
    assert result.certificate is not None
    # Without a limit either takes seconds.
    assert time.perf_counter() - begin < 20


@pytest.mark.parametrize("guess", ["straight_line", "best_side"])
@pytest.mark.parametrize("limit", [1e-6, 0.01, 0.03, 0.1, 0.3])
def test_whatever_the_limit_the_status_is_an_honest_one(guess, limit):
    scenario = load_scenario("known_environment")
    scenario.planner.initial_guess = guess
    scenario.planner.time_limit = limit
    result = plan(scenario)
    assert result.certified or "planner.time_limit" in result.message
    assert result.certified == (result.plan is not None)


def test_an_iterate_that_is_good_enough_is_certified_when_the_time_is_over():
    problem = make_problem(IntegratorChain(2, 2))
    good = plan_problem(problem, Planner(intervals=16))
    result = plan_problem(
        problem, Planner(intervals=16, time_limit=1e-9), warm_start=good.plan
    )
    assert result.certified and not result.history
    assert "stopped after planner.time_limit" in result.message


@pytest.mark.parametrize("backend", ["clarabel", "ipopt"])
def test_no_program_is_begun_after_the_deadline(backend):
    transcription = Transcription(make_problem(IntegratorChain(2, 2)), 16)
    found = []
    result = backend_of(backend).refine(
        transcription,
        straight_line(transcription),
        effort=Effort(10, tolerance=1e-9),
        report=found.append,
        deadline=Deadline.after(0.0),
    )
    assert result.out_of_time and not found


def test_all_tries_on_the_way_share_one_limit():
    scenario = blocked(intervals=24, time_limit=0.05)
    free = dataclasses.replace(scenario, obstacles=[], planner=Planner(intervals=24))
    old = plan(free).plan
    begin = time.perf_counter()
    decision = replan(
        scenario,
        old,
        known=np.ones(17, dtype=bool),
        measured_at=2.0,
        state=old.reference(2.0)[:2],
        start=2.2,
    )
    assert decision.status == "unsafe"
    assert time.perf_counter() - begin < 20


def test_a_time_limit_must_be_positive():
    with pytest.raises(ScenarioError, match=r"planner\.time_limit.*0 s"):
        validate(blocked(time_limit=0.0))


def test_ipopt_says_that_it_diverges_and_keeps_what_was_best(monkeypatch):
    """A real solve whose cost was given no least value, of one more variable."""

    class Bottomless(nlp._Program):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            (free,) = self.program.NewContinuousVariables(1)
            self.program.AddCost(-(free**3))
            self.program.SetInitialGuess(free, 1.0)

    monkeypatch.setattr(nlp, "_Program", Bottomless)
    problem = make_problem(IntegratorChain(2, 2), duration=3.0)
    result = plan_problem(problem, Planner(intervals=8, backend="ipopt"))
    assert "the solver stopped with IPOPT's 'Divergent iterates'" in result.message
    assert np.isfinite(result.attempt.coefficients).all()


def test_a_warm_start_of_another_kind_is_refused(known_result):
    for model in (IntegratorChain(3, 3), IntegratorChain(2, 2)):
        with pytest.raises(
            ValueError, match="warm_start: got a plan of order 2 with 3"
        ):
            plan_problem(make_problem(model), Planner(), warm_start=known_result.plan)
