"""The paper's first experiment: known drag, optimised bandwidth.

Run it with ``python -m diagrams.known_environment``.
"""

from dtmpc_drake.experiments.simulate import Experiment, run
from dtmpc_drake.scenario import load_scenario


def main() -> Experiment:
    """Runs the experiment; files go to ``out/known_environment``."""
    return run(load_scenario("known_environment"))


if __name__ == "__main__":
    print(main())
