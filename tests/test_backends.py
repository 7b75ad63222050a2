"""A solver is one class; everything before and after it is the same for all."""

from __future__ import annotations

import pytest

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.models import IntegratorChain
from dtmpc_drake.planning import Backend, backend, plan, plan_problem, register_backend
from dtmpc_drake.planning.backend import Solution, backend_of
from dtmpc_drake.scenario import Planner, load_scenario, schema, validate
from tests.models_for_tests import make_problem


@pytest.fixture(autouse=True)
def forgotten(monkeypatch):
    monkeypatch.setattr(backend, "_BACKENDS", dict(backend._BACKENDS))
    names = list(schema.BACKENDS)
    yield
    schema.BACKENDS[:] = names


class Patient(Backend):
    """Takes the start for the solution, whatever it is."""

    name = "patient"

    def refine(self, transcription, decisions, *, effort, report, deadline):
        iterate = transcription.evaluate(*decisions)
        return Solution(transcription, iterate, transcription.violation(iterate))


def test_a_solver_of_ones_own_plans_and_its_plan_is_judged_like_any_other():
    register_backend(Patient)
    problem = make_problem(IntegratorChain(2, 2))
    result = plan_problem(problem, Planner(intervals=16, backend="patient"))
    assert result.certified and result.backend == "patient"
    best = plan_problem(problem, Planner(intervals=16))
    assert best.cost < result.cost
    # Straight through the pillars: nothing that it says makes that a plan.
    scenario = load_scenario("known_environment")
    scenario.planner.backend = "patient"
    refused = plan(scenario)
    assert refused.status == "infeasible" and refused.plan is None
    assert "cannot keep obstacle" in refused.message


def test_a_search_asks_the_solver_that_was_chosen():
    asked = []

    class Counted(type(backend_of("clarabel"))):
        name = "counted"

        def refine(self, transcription, decisions, **given):
            asked.append(transcription.intervals)
            return super().refine(transcription, decisions, **given)

    register_backend(Counted)
    scenario = load_scenario("best_side")
    scenario.planner.backend, scenario.planner.time_budget = "counted", 0.1
    scenario.planner.initial_guess = "best_side"
    result = plan(scenario)
    assert result.candidates and asked
    assert set(asked) == {scenario.planner.intervals // 2}


def test_a_name_that_nobody_has_is_refused_and_one_that_somebody_has_is_taken():
    scenario = load_scenario("known_environment")
    scenario.planner.backend = "patient"
    with pytest.raises(ScenarioError, match=r"backend: got 'patient', .* clarabel"):
        validate(scenario)
    register_backend(Patient)
    register_backend(Patient)  # the same once more, as when a cell runs again
    validate(scenario)

    class Other(Patient):
        """Of the same name."""

    with pytest.raises(ValueError, match="another 'patient'"):
        register_backend(Other)
