"""The quadratic programs: banded costs, equations apart, a second try, and reuse."""

from __future__ import annotations

import logging
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from dtmpc_drake.planning.deadline import Deadline
from dtmpc_drake.planning.scp import clarabel as qp
from dtmpc_drake.planning.scp.clarabel import Layout, QuadraticProgram, Window, borrowed
from dtmpc_drake.planning.scp.rows import Rows


def dense(layout: Layout, name: str, blocks: np.ndarray) -> np.ndarray:
    """The Hessian that a banded cost stands for, summed entry by entry."""
    window = dict(layout.costs)[name]
    result = np.zeros((layout.size, layout.size))
    for i, block in enumerate(blocks):
        at = window.start + i * window.stride
        result[at : at + window.width, at : at + window.width] += block
    return result


@pytest.mark.parametrize("count", [1, 5, 16, 17, 40])
@pytest.mark.parametrize(("width", "stride"), [(1, 1), (2, 2), (6, 2), (9, 3), (4, 3)])
def test_a_banded_cost_is_the_sum_over_its_windows(count, width, stride):
    random = np.random.default_rng(count)
    size = 1 + (count - 1) * stride + width + 1
    layout = Layout(size, (("cost", Window(1, width, stride, count)),))
    half = random.normal(size=(count, width, width))
    blocks = half @ half.swapaxes(1, 2)
    linear = random.normal(size=(count, width))
    program = QuadraticProgram(layout)
    program.set_cost("cost", quadratic=blocks, linear=linear, diagonal=0.5)
    program.set_slack_cost(0.0)

    hessian = dense(layout, "cost", blocks)
    used = np.arange(1, size - 1)
    hessian[used, used] += 0.5
    gradient = np.zeros(size)
    for i in range(count):
        gradient[1 + i * stride : 1 + i * stride + width] += linear[i]
    rows = Rows(size)
    rows.equate(np.ones((1, 1)), np.array([[0]]), 0.0)
    more = Rows(size)
    more.add(np.ones((1, 1)), np.array([[size - 1]]), 0.0)
    program.set_rows(rows.assemble(), more.assemble())
    z = program.solve(accuracy=1e-9).z
    expected = -np.linalg.solve(hessian[1:-1, 1:-1], gradient[1:-1])
    np.testing.assert_allclose(z[1:-1], expected, atol=1e-5)


def mis_scaled(seed: int) -> tuple[QuadraticProgram, float]:
    """Rows over eight orders of magnitude, weights over twelve; and the optimum."""
    random = np.random.default_rng(seed)
    n, equations, inequalities = 12, 4, 10
    program = QuadraticProgram(Layout(n, (("all", Window(0, n, n, 1)),)))
    A = random.normal(size=(equations, n))
    known = random.normal(size=n)
    G = random.normal(size=(inequalities, n))
    unit = 10.0 ** random.uniform(-2, 2, n)
    of_equations = 10.0 ** random.uniform(-4, 4, equations)
    of_inequalities = 10.0 ** random.uniform(-4, 4, inequalities)
    same, more = Rows(n), Rows(n)
    columns = np.arange(n)[None]
    same.equate(
        of_equations[:, None] * A * unit,
        columns.repeat(equations, axis=0),
        of_equations * (A @ known),
    )
    more.add(
        of_inequalities[:, None] * G * unit,
        columns.repeat(inequalities, axis=0),
        of_inequalities * (G @ known - 0.1),
    )
    program.set_rows(same.assemble(), more.assemble())
    weight = 10.0 ** random.uniform(-6, 6, n)
    program.set_cost("all", quadratic=np.diag(weight * unit**2)[None])
    program.set_slack_cost(0.0)
    z = program.solve(accuracy=5e-4).z
    assert z is not None
    x = z * unit
    off = max(np.abs(A @ (x - known)).max(), (-G @ (x - known) - 0.1).max())
    return program, float(off)


def test_what_fast_options_cannot_solve_clarabels_own_can(monkeypatch):
    statuses: list[str] = []
    solve = qp.SolveInParallel

    def noted(**arguments):
        results = solve(**arguments)
        statuses.append(str(results[0].get_solver_details().status))
        return results

    monkeypatch.setattr(qp, "SolveInParallel", noted)
    seeds, again = range(60), 0
    for seed in seeds:
        statuses.clear()
        _, off = mis_scaled(seed)
        assert statuses[-1] in ("Solved", "AlmostSolved")
        if len(statuses) > 1:
            again += 1
            assert off < 1e-2
    assert 0 < again < len(seeds)


def test_a_program_that_may_be_infeasible_is_not_tried_again(monkeypatch):
    calls = []
    solve = qp.SolveInParallel
    monkeypatch.setattr(
        qp, "SolveInParallel", lambda **a: calls.append(1) or solve(**a)
    )
    program = QuadraticProgram(Layout(2, (("all", Window(0, 2, 2, 1)),)))
    same, more = Rows(2), Rows(2)
    same.equate(np.ones((1, 1)), np.array([[0]]), 0.0)
    more.add(np.ones((1, 1)), np.array([[0]]), 1.0)
    program.set_rows(same.assemble(), more.assemble())
    program.set_cost("all", quadratic=np.eye(2)[None])
    for doubtful, tries in ((True, 1), (False, 2)):
        calls.clear()
        solution = program.solve(accuracy=1e-6, doubtful=doubtful)
        assert solution.z is None and "Infeasible" in solution.status
        assert len(calls) == tries


def test_a_multiplier_is_the_price_of_its_bound():
    program = QuadraticProgram(Layout(2, (("all", Window(0, 2, 2, 1)),)))
    same, more = Rows(2), Rows(2)
    same.equate(np.ones((1, 1)), np.array([[1]]), 0.0)
    more.add(np.ones((2, 1)), np.array([[0], [0]]), np.array([3.0, -5.0]))
    program.set_rows(same.assemble(), more.assemble())
    program.set_cost("all", quadratic=2 * np.eye(2)[None])  # x², so 2 x is the price
    solution = program.solve(accuracy=1e-9)
    np.testing.assert_allclose(solution.multipliers, [6.0, 0.0], atol=1e-4)


def test_many_threads_may_read_multipliers_at_once():
    """As a search for sides does; see `QuadraticProgram`."""
    program = QuadraticProgram(Layout(400, (("all", Window(0, 400, 400, 1)),)))
    same, more = Rows(400), Rows(400)
    same.equate(np.ones((1, 1)), np.array([[1]]), 0.0)
    more.add(np.ones((399, 1)), np.delete(np.arange(400), 1)[:, None], np.ones(399))
    program.set_rows(same.assemble(), more.assemble())
    program.set_cost("all", quadratic=np.eye(400)[None])
    solution = program.solve(accuracy=1e-6)

    def read() -> None:
        for _ in range(1000):
            assert solution.multipliers.shape == (399,)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            for done in [pool.submit(read) for _ in range(4)]:
                done.result()
    finally:
        sys.setswitchinterval(interval)


def test_a_program_is_used_again_but_never_by_two_at_once():
    layout = Layout(3, (("all", Window(0, 3, 3, 1)),))
    with borrowed(layout) as first, borrowed(layout) as second:
        assert first is not second
    with borrowed(Layout(3, (("all", Window(0, 3, 3, 1)),))) as third:
        assert third in (first, second)
    for size in range(4, 4 + 2 * qp.WAITING):
        with borrowed(Layout(size, (("all", Window(0, 3, 3, 1)),))):
            pass
    assert len(qp._waiting) <= qp.WAITING


def test_what_drake_says_of_a_program_is_dropped_only_while_it_is_solved(caplog):
    program, _ = mis_scaled(0)
    logger = logging.getLogger("drake")
    with caplog.at_level(logging.DEBUG, logger="drake"):
        late = program.solve(accuracy=1e-9, deadline=Deadline.after(0.0))
        assert late.status == "MaxTime"  # of which Drake would tell
        logger.info("Clarabel returns, says somebody else")
    assert caplog.messages == ["Clarabel returns, says somebody else"]
    assert logger.filters == []
