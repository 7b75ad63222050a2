"""Two thousand spoilt scenario files: one line of complaint, or a plan's first step."""

from __future__ import annotations

import re
import signal
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import numpy as np
import pytest

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.planning.problem import Problem
from dtmpc_drake.planning.starts import straight_line
from dtmpc_drake.planning.transcription import Transcription
from dtmpc_drake.scenario import SHIPPED, Scenario, parse_scenario, shipped_scenarios
from dtmpc_drake.scenario.size import MEMORY

TEXTS, TASKS = 2000, 20
LONGEST = 5  # s; one that takes longer hangs

OTHERS = (
    "model: !IntegratorChain {num_outputs: 2, order: 7, error_bound: 0.1}\n"
    "disturbance: !ColoredWind {bound: [0.01, 0.02], correlation_time: 2.0}\n"
    "controller: {slope: [1.0, 1.5]}\n"
    "limits: {input: 1000, speed: 100}\n"
    "start: {position: [0, 0], velocity: [1, 0], acceleration: [0, 0.1]}\n"
    "goal: {position: [1, 1]}\n"
    "initial_error: {position: [1e-4, 0]}\n"
    "obstacles: [!Ellipsoid {center: [0.5, 4], shape: [[1, 0.5], [0, 2]], radius: 1}]\n"
    "planner: {tube_margin: support, velocity_bound: paper, intervals: 24}\n"
    "duration: 20\n",
    "name: line\n"
    "model: !IntegratorChain {num_outputs: 1, order: 1}\n"
    "plant: {model_error: 0}\n"
    "disturbance: !WorstCase {bound: [0.1]}\n"
    "controller: {slope: [1.0], bandwidth: {min: 1, max: 2, rate_max: 1, fixed: 2}}\n"
    "start: {position: [0]}\n"
    "goal: {position: [3], soft: [position]}\n"
    "cost: {input: [1], bandwidth: [[0]], bandwidth_rate: 0, terminal: {position: 2},\n"
    "  state: {position: 1, line: {point: [0], direction: [1]}}}\n"
    "obstacles: [!Sphere {center: [9], radius: 1, known_from: 1.5}]\n"
    "sensing: {range: 20.0, period: 0.1}\n"
    "planner: {intervals: 12, replan_period: 0.5, initial_guess: best_side}\n"
    "simulation: {integration_scheme: explicit_euler, max_step_size: 1e-2, seed: 7}\n"
    "duration: 4\n",
)
HOSTILE = (
    *("1e400", "-1e400", "1e308", "1e200", "1e30", "1e12", "1e9", "1e6", "1000", "-1"),
    *("0", "-0.0", "1e-3", "1e-9", "1e-30", "5e-324", ".nan", "nan", ".inf", "-.inf"),
    *("9" * 500, "9" * 5000, "0x" + "f" * 300, "1:59:59", "1_0", "0b1", "2020-13-45"),
    *("null", "true", "~", "''", '"\\ud800"', '"\\UFFFFFFFF"', '"a\\nb"', "é", "\x07"),
    *("[]", "{}", "[[[1]]]", "{a: 1}", "- 1", "? ", "!!int x", "!!binary aGk=", "|"),
    *("!!set {a}", "!!python/name:os.system", "!Cube {}", "!WorstCase", "&a", "*a"),
    *("&a [*a, *a]", "<<", "!<x>", "%", "%YAML 9.9", "---", "...", "'", "#", "\t", "﻿"),
    *("[" * 3000, "{a: " * 300, "- " * 3000, "a" * 300_000, "[1," * 200 + "1" * 9),
)
Random = np.random.Generator


def choice(g: Random, options: list[str] | tuple[str, ...]) -> str:
    return options[int(g.integers(len(options)))]


def tokens(text: str) -> list[str]:
    """Words, numbers, signs and white space, one after the other."""
    return re.findall(r"\s+|[\[\]{},:]|[^\s\[\]{},:]+", text)


def in_tokens(change: Callable[[Random, str], str]) -> Callable[[Random, str], str]:
    """A mutation of one token that is no white space."""

    def mutate(g: Random, text: str) -> str:
        parts = tokens(text)
        seen = [i for i, part in enumerate(parts) if part.strip()]
        if seen:
            i = seen[int(g.integers(len(seen)))]
            parts[i] = change(g, parts[i])
        return "".join(parts)

    return mutate


def scale_a_number(g: Random, text: str) -> str:
    numbers = list(re.finditer(r"(?<![\w.-])-?\d+\.?\d*(?![\w.])", text))
    if not numbers:
        return text
    found = numbers[int(g.integers(len(numbers)))]
    scale = float(
        choice(g, ("0", "1e-6", "1e-3", "0.1", "0.5", "2", "30", "1e3", "1e6"))
    )
    sign = -1 if g.random() < 0.2 else 1
    value = f"{sign * scale * float(found[0]):.6g}"
    return text[: found.start()] + value + text[found.end() :]


def in_lines(
    change: Callable[[list[str], int, int], None],
) -> Callable[[Random, str], str]:
    """A mutation of two lines."""

    def mutate(g: Random, text: str) -> str:
        lines = text.splitlines(keepends=True)
        if lines:
            i, j = (int(k) for k in g.integers(len(lines), size=2))
            change(lines, i, j)
        return "".join(lines)

    return mutate


def swap(lines: list[str], i: int, j: int) -> None:
    lines[i], lines[j] = lines[j], lines[i]


def random_bytes(g: Random, text: str) -> str:
    data = bytearray(text.encode())
    for i in g.integers(max(len(data), 1), size=int(g.integers(1, 9))):
        data[i : i + 1] = g.bytes(1)
    return bytes(data).decode(errors="replace")


MUTATIONS: tuple[Callable[[Random, str], str], ...] = (
    in_tokens(lambda g, token: ""),
    in_tokens(lambda g, token: f"{token} {token}"),
    in_tokens(lambda g, token: choice(g, HOSTILE)),
    in_tokens(lambda g, token: f"{choice(g, HOSTILE)} {token}"),
    in_tokens(lambda g, token: choice(g, tokens(OTHERS[0] + OTHERS[1]))),
    *[scale_a_number] * 8,
    in_lines(lambda lines, i, j: lines.pop(i) and None),
    in_lines(lambda lines, i, j: lines.insert(i, lines[j])),
    in_lines(swap),
    lambda g, text: text[: int(g.integers(len(text) + 1))],
    random_bytes,
)


def spoilt(index: int) -> str:
    """A shipped scenario after one to three mutations; the same for the same index."""
    g = np.random.default_rng([2024, index])
    shipped = [(SHIPPED / f"{n}.yaml").read_text() for n in shipped_scenarios()]
    text = choice(g, [*shipped, *OTHERS * 3])
    for _ in range(int(g.integers(1, 4))):
        text = MUTATIONS[int(g.integers(len(MUTATIONS)))](g, text)
    return text


@contextmanager
def no_longer_than(seconds: int) -> Iterator[None]:
    def stop(signum: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def first_step(scenario: Scenario) -> None:
    """What any plan begins with."""
    problem = Problem.from_scenario(scenario)
    transcription = Transcription(problem, scenario.planner.intervals)
    transcription.evaluate(*straight_line(transcription))


@pytest.mark.slow
@pytest.mark.parametrize("task", range(TASKS))
def test_a_spoilt_scenario_is_refused_in_a_line_or_has_a_first_step(task: int) -> None:
    accepted = 0
    for index in range(task, TEXTS, TASKS):
        text = spoilt(index)
        with no_longer_than(LONGEST), warnings.catch_warnings():
            warnings.simplefilter("error")
            tracemalloc.start()
            try:
                scenario = parse_scenario(text)
                accepted += 1
                first_step(scenario)
            except ScenarioError as error:
                assert str(error).isprintable() and len(str(error)) < 1000
            except Exception as error:
                error.add_note(f"scenario {index}:\n{text[:5000]}")
                raise
            finally:
                _, peak = tracemalloc.get_traced_memory()
                tracemalloc.stop()
        assert peak < MEMORY
    # Else nothing but complaints was tried.
    assert 5 < accepted < TEXTS / TASKS - 5
