"""From a scenario to a certified plan: the one function that plans."""

from dtmpc_drake.planning.hold import hold_plan
from dtmpc_drake.planning.planner import plan, plan_problem
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.certify import certify
from dtmpc_drake.planning.replanning import replan, shortest_duration
from dtmpc_drake.records.certificate import Certificate
from dtmpc_drake.records.replan import Decision
from dtmpc_drake.records.result import Iteration, PlanningResult

__all__ = [
    "Certificate",
    "Decision",
    "Iteration",
    "Margin",
    "PlanningResult",
    "Problem",
    "certify",
    "hold_plan",
    "plan",
    "plan_problem",
    "replan",
    "shortest_duration",
]
