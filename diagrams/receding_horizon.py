"""The paper's second experiment: obstacles that become known on the way.

Run it with ``python -m diagrams.receding_horizon``.
"""

from dtmpc_drake.experiments.simulate import Experiment, run
from dtmpc_drake.scenario import load_scenario


def main() -> Experiment:
    """Runs the experiment; files go to ``out/receding_horizon``."""
    return run(load_scenario("receding_horizon"))


if __name__ == "__main__":
    print(main())
