"""What the command line runs: plan, fly, judge, draw and write files.

`simulate` is one flight, `monte_carlo` many flights of one plan, `compare` the plans
that parts of the method make, `random_fields` both initial guesses on fields that
nobody tuned.  Beside them: `spread` (over processes), `outputs` (files that take their
places at once) and `tables`.  Nothing below may import from here.
"""

from dtmpc_drake.experiments.compare import Comparison
from dtmpc_drake.experiments.compare import run as run_comparison
from dtmpc_drake.experiments.monte_carlo import MonteCarlo
from dtmpc_drake.experiments.monte_carlo import run as run_monte_carlo
from dtmpc_drake.experiments.simulate import Experiment
from dtmpc_drake.experiments.simulate import run as run_experiment

__all__ = [
    "Comparison",
    "Experiment",
    "MonteCarlo",
    "run_comparison",
    "run_experiment",
    "run_monte_carlo",
]
