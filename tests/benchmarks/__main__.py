"""Runs all benchmarks: ``python -m tests.benchmarks [--json FILE]``."""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from tests.benchmarks import (
    bench_monte_carlo,
    bench_replan,
    bench_safe_plan,
    bench_scaling,
    bench_tube_price,
)
from tests.benchmarks.bench_common import Section


def main() -> None:
    """Measures, prints tables and writes the numbers behind them."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks")
    parser.add_argument("--scenario", default="known_environment")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument(
        "--ipopt-repeats",
        type=int,
        default=1,
        help="of our slower backend; 0 leaves it out",
    )
    parser.add_argument(
        "--only",
        choices=("replan", "safe", "scaling", "tube", "monte-carlo"),
        action="append",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers")
    args = parser.parse_args()
    benchmarks: dict[str, Callable[[], Section]] = {
        "replan": lambda: bench_replan.run(
            args.scenario, args.repeats, args.ipopt_repeats
        ),
        "safe": lambda: bench_safe_plan.run(args.scenario, args.repeats),
        "scaling": lambda: bench_scaling.run(args.scenario, args.repeats),
        "tube": lambda: bench_tube_price.run(args.scenario, args.repeats),
        "monte-carlo": lambda: bench_monte_carlo.run(args.scenario, args.repeats),
    }
    machine = {
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        "drake": version("drake"),
        "casadi": version("casadi"),
    }
    print(", ".join(f"{name} {value}" for name, value in machine.items()))
    data = {"machine": machine}
    for name in args.only or benchmarks:
        section = benchmarks[name]()
        print(f"\n{section}", flush=True)
        data[name] = section.data
    if args.json is not None:
        args.json.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
