"""The paper's experiment with unknown drag: slow is safe, so it slows down.

Run it with ``python -m diagrams.state_dependent_uncertainty``.
"""

from dtmpc_drake.experiments.simulate import Experiment, run
from dtmpc_drake.scenario import load_scenario


def main() -> Experiment:
    """Runs the experiment; files go to ``out/state_dependent_uncertainty``."""
    return run(load_scenario("state_dependent_uncertainty"))


if __name__ == "__main__":
    print(main())
