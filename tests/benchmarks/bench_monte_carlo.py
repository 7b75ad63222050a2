"""How the time of many trials grows, in one process."""

from __future__ import annotations

import time
from collections.abc import Callable

from dtmpc_drake.diagrams import Simulate
from dtmpc_drake.experiments.monte_carlo import Batch, fly
from dtmpc_drake.planning import plan
from dtmpc_drake.scenario import load_scenario
from tests.benchmarks.bench_common import Section, interleaved, median

TRIALS = (1, 10, 100, 1000, 2000)
REPEATS = 3
"""At most: the largest batch takes long."""


def run(scenario_name: str, repeats: int) -> Section:
    """Measures one closed-loop simulation and batches of trials in turn."""
    scenario = load_scenario(scenario_name)
    chosen = plan(scenario).plan
    if chosen is None:
        raise ValueError(f"{scenario_name} has no plan to fly")

    def timed(call: Callable[[], object]) -> float:
        start = time.perf_counter()
        call()
        return time.perf_counter() - start

    def flown(count: int) -> Callable[[int], float]:
        batch = Batch(scenario_name, scenario, chosen, range(count))
        return lambda _: timed(lambda: fly(batch))

    single = "one simulation"
    runs: dict[str, Callable[[int], float]] = {
        single: lambda _: timed(lambda: Simulate(scenario, plan=chosen))
    }
    for count in TRIALS:
        runs[f"{count} trials"] = flown(count)
    repeats = min(repeats, REPEATS)
    times = interleaved(runs, dict.fromkeys(runs, repeats))
    seconds = {name: median(values) for name, values in times.items()}
    counts = [1, *TRIALS]
    rows = [
        [
            name,
            f"{value:.2f}",
            f"{value / seconds[single]:.2f}",
            f"{1e3 * value / count:.1f}",
        ]
        for (name, value), count in zip(seconds.items(), counts, strict=True)
    ]
    return Section(
        title=f"Monte Carlo, {scenario_name}, one process, one diagram",
        columns=["", "s", "this/one simulation", "ms a trial"],
        rows=rows,
        notes=[
            f"Medians of {repeats} repeats, interleaved; {scenario.duration:g} s at "
            f"{1e3 * scenario.simulation.max_step_size:g} ms, report included.",
        ],
        data={"times": times, "median": seconds},
    )
