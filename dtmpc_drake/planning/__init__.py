"""From a scenario to a certified plan: problem, search, proof.

`problem` is what is asked; `transcription` and `starts` turn it into numbers; a
`backend` (`scp`, `ipopt`) searches; `proof` certifies, and never looks at the search.
No drawing and no simulation may enter here.
"""

from dtmpc_drake.planning.backend import Backend, register_backend
from dtmpc_drake.planning.hold import hold_plan
from dtmpc_drake.planning.ipopt.solver import Ipopt
from dtmpc_drake.planning.planner import plan, plan_problem
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.proof.certify import certify
from dtmpc_drake.planning.replanning import replan, shortest_duration
from dtmpc_drake.planning.scp.algorithm import SequentialConvex

__all__ = [
    "Backend",
    "Ipopt",
    "Problem",
    "SequentialConvex",
    "certify",
    "hold_plan",
    "plan",
    "plan_problem",
    "register_backend",
    "replan",
    "shortest_duration",
]
