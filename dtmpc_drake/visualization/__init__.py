"""Pictures of plans and flights: a replay in Meshcat, figures in matplotlib.

They read records and scenarios; nothing is planned, judged or flown here.
"""

from dtmpc_drake.visualization.figures.candidates import plot_candidates
from dtmpc_drake.visualization.figures.histories import plot_histories
from dtmpc_drake.visualization.figures.plan import plot_plan
from dtmpc_drake.visualization.figures.plans import Panel, plot_plans
from dtmpc_drake.visualization.figures.quantiles import plot_quantiles
from dtmpc_drake.visualization.figures.receding_horizon import plot_receding_horizon
from dtmpc_drake.visualization.figures.replans import plot_replans
from dtmpc_drake.visualization.replay import write_replay
from dtmpc_drake.visualization.shown import ShownFlight

__all__ = [
    "Panel",
    "ShownFlight",
    "plot_candidates",
    "plot_histories",
    "plot_plan",
    "plot_plans",
    "plot_quantiles",
    "plot_receding_horizon",
    "plot_replans",
    "write_replay",
]
