"""From a scenario to a certified plan: the one function that plans."""

from dtmpc_drake.planning.certificate import Certificate, certify
from dtmpc_drake.planning.margins import Margin
from dtmpc_drake.planning.planner import PlanningResult, plan, plan_problem
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.replanning import Decision, replan, shortest_duration
from dtmpc_drake.planning.scp import Iteration

__all__ = [
    "Certificate",
    "Decision",
    "Iteration",
    "Margin",
    "PlanningResult",
    "Problem",
    "certify",
    "plan",
    "plan_problem",
    "replan",
    "shortest_duration",
]
