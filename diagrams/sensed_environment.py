"""The same field seen by a sensor with a range.

Run it with ``python -m diagrams.sensed_environment``.
"""

from dtmpc_drake.experiments.simulate import Experiment, run
from dtmpc_drake.scenario import load_scenario


def main() -> Experiment:
    """Runs the experiment; files go to ``out/sensed_environment``."""
    return run(load_scenario("sensed_environment"))


if __name__ == "__main__":
    print(main())
