"""Pictures of plans and flights: a replay in Meshcat, figures in matplotlib."""

from dtmpc_drake.visualization.candidates import plot_candidates
from dtmpc_drake.visualization.cloud import plot_quantiles
from dtmpc_drake.visualization.figures import plot_histories, plot_plan
from dtmpc_drake.visualization.receding import plot_receding_horizon, plot_replans
from dtmpc_drake.visualization.replay import write_replay

__all__ = [
    "plot_candidates",
    "plot_histories",
    "plot_plan",
    "plot_quantiles",
    "plot_receding_horizon",
    "plot_replans",
    "write_replay",
]
