"""Which side of each obstacle: the straight line against a search for the best sides.

Run it with ``python diagrams/which_side.py``; it takes a minute or two.  The
paper's first field is planned from both starts and the better plan flown; then thirty
fields that nobody tuned are planned, one process a core.
"""

from pathlib import Path

import dtmpc_drake as dtmpc
from dtmpc_drake.experiments.random_fields import SEEDS, plan_fields
from dtmpc_drake.visualization import plot_candidates

OUT = Path("out/diagrams")


def main() -> None:
    """Plans, flies, draws and counts."""
    straight = dtmpc.plan(dtmpc.load_scenario("known_environment"))
    scenario = dtmpc.load_scenario("best_side")
    search = dtmpc.plan(scenario)
    print(search.candidates_table())
    print(f"straight line {straight.cost:.2f}, search {search.cost:.2f}")
    flight = dtmpc.Simulate(scenario, plan=search.plan)
    print(flight)
    OUT.mkdir(parents=True, exist_ok=True)
    plot_candidates(
        scenario=scenario, plan=search.plan, candidates=search.candidates
    ).savefig(OUT / "which_side.png")
    print(f"see {OUT / 'which_side.png'}")

    print("\nrandom fields    straight line            best side")
    fields = plan_fields(SEEDS)
    for field in fields:
        print(field)
    before = sum(field.straight.certified for field in fields)
    after = sum(field.search.certified for field in fields)
    print(f"certified        {before} of {len(fields)}{'':16}{after} of {len(fields)}")


if __name__ == "__main__":  # worker processes import this file
    main()
