"""How much memory and work a scenario asks for, before any of it is done.

What planning needs is estimated from the sizes of the largest arrays, in numbers of
eight bytes.  With n, m, N, o the order, the outputs, the intervals and the obstacles,
C the steps in which the tube is linearised, M those in which it is propagated and K
the intervals of the certificate, there are at one time about

    2 M m (13 + 5 n)                 values along one iterate,
    12 C m (n + 1)²                  differences of the tube's equation, axis by axis,
    7 C m² (2 n + 2)²                or of all pairs, where Δ varies,
    6 m² (N + n + 1)²                in the dense matrices of the program's cost,
    8 (2 n + 3) N m³                 differences of the input,
    10 N o c (m (3 n + 5) + r)       in the half-planes' rows, if all pieces are near
                                     all obstacles; c control points, r rows of H,
    K m (30 + 25 n + 2 m) + 30 M o r in the certificate.

The factors were measured.  Of what is not near an obstacle there are less, so fields
of many obstacles need less than that; otherwise the estimate is right within a factor
of two.  A search for sides holds some programs at once, and its ways; a flight its log.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np

from dtmpc_drake.disturbances.base import DISTURBANCES, LOOK
from dtmpc_drake.errors import ScenarioError, require
from dtmpc_drake.scenario.schema import Scenario

MEMORY = 4 * 2**30
"""Bytes that planning, a flight or a batch of flights may take."""
TUBE_STEPS = 120_000
"""Steps of a plan's tube, which is propagated often, up to a second each time.  Half as
many where Δ varies, for then it is propagated several times to be found once."""
EVENTS = 5_000_000
"""Steps, looks or new values in one flight: about an hour of work."""
REPLANS = 100_000
"""Plans in one flight; about as much work."""
TRIAL_STEPS = 10**10
"""Steps of all flights together, which fly side by side: about half a day."""

REPORT_PERIOD, SAMPLE_PERIOD = 0.05, 0.005
"""Of what is kept of many flights at least, and of a saved plan, in s."""
SIZES = "planner.intervals", "model.num_outputs", "model.order"


@dataclasses.dataclass(frozen=True)
class Part:
    """Some of the memory that a scenario asks for.

    Attributes:
        numbers: of eight bytes.
        fields: of the scenario that make it so, the first most of all.
    """

    numbers: float
    fields: tuple[str, ...]


def tube_steps(scenario: Scenario) -> tuple[int, int]:
    """Steps of the tube in each interval: as it is propagated, and linearised.

    No step is longer than half the time constant of the fastest filter, 1 / (α + nλ);
    of a stiff one, only than half that of the bandwidth.
    """
    interval = scenario.duration / scenario.planner.intervals
    rates = _rates(scenario)

    def steps(rate: float) -> int:
        return int(2 * 2 ** math.ceil(math.log2(max(rate * interval, 2.0))))

    bandwidth = sum(v for name, v in rates.items() if name != "controller.slope")
    least = 16 if scenario.model.error_bound_varies and bandwidth * interval > 1 else 8
    finest, slow = steps(sum(rates.values())), steps(bandwidth)
    return max(least, finest), slow if finest > 4 * slow else finest


def _rates(scenario: Scenario) -> dict[str, float]:
    """What the fastest filter's rate is the sum of, the largest first, in 1/s."""
    bandwidth = scenario.controller.bandwidth
    rates = {"controller.slope": scenario.model.order * max(scenario.controller.slope)}
    name = "max" if bandwidth.fixed is None else "fixed"
    rates[f"controller.bandwidth.{name}"] = bandwidth.interval()[1]
    return dict(sorted(rates.items(), key=lambda item: -item[1]))


def certificate_intervals(scenario: Scenario) -> int:
    """Intervals of the finest certificate; see `planning.proof.enclosure`."""
    count = scenario.planner.intervals * tube_steps(scenario)[0]
    duration = scenario.duration / scenario.own_units().time
    longest = max(5e-4, min(16e-3, duration / 2**19))
    finer = math.ceil(math.log2(max(duration / count / longest, 1.0)))
    return int(count * 2**finer)


def planning(scenario: Scenario) -> list[Part]:
    """The memory of one plan, without its certificate."""
    model, planner = scenario.model, scenario.planner
    n, m, N = model.order, model.num_outputs, planner.intervals
    o, r = len(scenario.obstacles), _rows(scenario)
    steps, linearised = tube_steps(scenario)
    M, C = N * steps, N * linearised
    if model.error_bound_varies:
        differences = 7 * C * m**2 * (2 * n + 2) ** 2
    else:
        differences = 12 * C * m * (n + 1) ** 2
    tube = 2 * M * m * (13 + 5 * n) + differences
    program = 60 * (2 * n + 3) * N * m**2
    planes = 10 * N * o * max(n + 2, 4) * (m * (3 * n + 5) + r)
    # Two steps an interval are the least.
    fast = (*_rates(scenario), "duration") if linearised > 4 else ()
    parts = [
        Part(tube, (*fast, *SIZES)),
        Part(program, SIZES),
        Part(planes, ("obstacles", *SIZES)),
    ]
    if planner.initial_guess == "best_side" and o:
        parts = [Part(4 * part.numbers, part.fields) for part in parts]
        parts += _search(scenario, M)
    return parts


def certificate(scenario: Scenario) -> list[Part]:
    """The memory of a plan's certificate, at its finest."""
    n, m = scenario.model.order, scenario.model.num_outputs
    M = scenario.planner.intervals * tube_steps(scenario)[0]
    K = certificate_intervals(scenario)
    fast = tuple(_rates(scenario))
    fields = (*fast, "duration", *SIZES) if K == M else ("duration", *fast, *SIZES)
    obstacles = 30 * M * len(scenario.obstacles) * _rows(scenario)
    return [
        Part(K * m * (30 + 25 * n + 2 * m), fields),
        Part(obstacles, ("obstacles", *fields)),
    ]


def _search(scenario: Scenario, steps: int) -> list[Part]:
    """The memory of a search for sides; see `planning.search`.

    It is for all the ways that its budget buys, 0.3 m from point to point, for the
    coarse plan of each, and for the pairs of obstacles.
    """
    planner, m, n = scenario.planner, scenario.model.num_outputs, scenario.model.order
    o, r = len(scenario.obstacles), _rows(scenario)
    price = 0.2 if scenario.model.error_bound_varies else 0.05
    ways = max(2.0, 2 / 3 * planner.time_budget * 56 / planner.intervals / price)
    # With as many sides as there are there may be fewer.
    ways = min(ways, 4.0 ** min(o, 30))
    length = float(np.linalg.norm(scenario.goal_state()[0] - scenario.start_state()[0]))
    points = max(41.0, length / 0.3)
    numbers = ways * points * (3 * m + 6 * o * r) + ways * steps * m * (2 * n + 3)
    fields = "goal.position", "planner.time_budget", "obstacles"
    if points < 1000:
        fields = fields[1], fields[0], fields[2]
    return [
        Part(numbers, fields),
        Part(20 * o**2, ("obstacles", "planner.initial_guess")),
    ]


def flight(scenario: Scenario) -> list[Part]:
    """The memory of one flight: its log, and its plan's samples."""
    m = scenario.model.num_outputs
    log = _samples(scenario) * _logged(scenario)
    fields = "duration", "simulation.log_period", "model.num_outputs", "obstacles"
    saved = scenario.duration / SAMPLE_PERIOD * 9 * m
    return [Part(log, fields), Part(saved, ("duration", "model.num_outputs"))]


def _samples(scenario: Scenario, least: float = 0.0) -> float:
    """How many samples a flight has; `least` is their shortest period, in s."""
    simulation = scenario.simulation
    period = max(simulation.log_period, simulation.max_step_size, least)
    return scenario.duration / period + 1


def _logged(scenario: Scenario) -> int:
    """Numbers in one sample of a log."""
    n, m = scenario.model.order, scenario.model.num_outputs
    return (2 * n + 6) * m + max(len(scenario.obstacles), 1)


def _rows(scenario: Scenario) -> int:
    """Rows of the largest shape matrix, at most."""
    m = scenario.model.num_outputs
    return max([m, *(len(o.shape_matrix(m)) for o in scenario.obstacles)])


def require_affordable(scenario: Scenario) -> None:
    """Refuses what takes more than `MEMORY`, `TUBE_STEPS`, `EVENTS` or `REPLANS`.

    Raises:
        ScenarioError: naming the fields that make it so.
    """
    duration, own = scenario.duration, scenario.disturbance.periods()
    periods = {"simulation.max_step_size": scenario.simulation.max_step_size}
    periods |= {f"disturbance.{name}": period for name, period in own.items()}
    periods |= {"sensing.period": scenario.sensing.period}
    if scenario.planner.replan_period is not None:
        periods["planner.replan_period"] = scenario.planner.replan_period
    for field, period in periods.items():
        count = REPLANS if field == "planner.replan_period" else EVENTS
        least = duration / count
        why = f"there may be {count:g} of them in {duration:g} s, the duration"
        require(field, period, period >= least, f"at least {least:.3g} s: {why}")
    steps = scenario.planner.intervals * tube_steps(scenario)[0]
    most_steps = TUBE_STEPS // (2 if scenario.model.error_bound_varies else 1)
    if steps > most_steps:
        fields = (*_rates(scenario), "duration", SIZES[0])
        why = f"the tube has at most {most_steps} steps: it would have {steps}"
        raise _too_much(scenario, fields, why)
    for what, parts in (
        ("planning", planning(scenario)),
        ("the certificate", certificate(scenario)),
        ("a flight's log", flight(scenario)),
    ):
        needed = 8 * sum(part.numbers for part in parts)
        if needed > MEMORY:
            largest = max(parts, key=lambda part: part.numbers)
            raise _too_much(
                scenario,
                largest.fields,
                f"{what} takes at most {MEMORY / 2**30:g} GiB of memory: it would"
                f" take {needed / 2**30:.3g} GiB",
            )


def _too_much(scenario: Scenario, fields: Sequence[str], why: str) -> ScenarioError:
    first, *others = fields
    value: Any = reduce(getattr, first.split("."), scenario)
    if first == "obstacles":
        value = f"{len(value)} of them"
    return ScenarioError(first, value, f"such that with {', '.join(others)} {why}")


def require_trials(scenario: Scenario, count: int, batch_size: int = 250) -> None:
    """Refuses more flights than there is memory and time for.

    Args:
        scenario: the whole experiment.
        count: of flights through one disturbance.
        batch_size: flights side by side in one diagram.

    Raises:
        ScenarioError: naming ``trials`` or ``batch-size``.
    """
    m, length = scenario.model.num_outputs, scenario.duration
    batch = min(count, batch_size)
    # A batch draws all its noise before.
    hold = min(scenario.disturbance.periods().values(), default=length)
    draws = length / min(hold, LOOK) * (m + 1)
    report = _samples(scenario, REPORT_PERIOD) * (m + 1)
    one = 8 * (3 * report + draws)
    # Flights may go through all kinds, one after the other.
    kinds = sum(kind.short_name is not None for kind in DISTURBANCES)
    kept = 8 * 3 * kinds * report
    steps = length / scenario.simulation.max_step_size
    long = f"in flights of {length:g} s (duration)"
    for field, value, most, why in (
        ("batch-size", batch, MEMORY / one, "side by side need more memory"),
        ("trials", count, MEMORY / kept, "need more memory"),
        ("trials", count, TRIAL_STEPS / steps, f"are over {TRIAL_STEPS:g} steps"),
    ):
        if value > most:
            allowed = f"at most {max(math.floor(most), 0)}: more {why}, {long}"
            raise ScenarioError(field, value, allowed)
