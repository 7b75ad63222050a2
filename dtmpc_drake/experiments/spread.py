"""Work in batches, spread over processes as Dask tasks."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from dtmpc_drake.errors import ScenarioError
from dtmpc_drake.logs import quiet
from dtmpc_drake.plugins import load_plugins, loaded_plugins

PATIENCE = 10.0
"""How long an existing scheduler may take to answer, in s."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def batches(count: int, size: int) -> list[range]:
    """The numbers of `count` trials in batches; the last may be smaller.

    Raises:
        ScenarioError: if there would be none, or they would be empty.
    """
    for field, value in (("trials", count), ("batch-size", size)):
        if value < 1:
            raise ScenarioError(field, value, "at least 1")
    return [range(i, min(i + size, count)) for i in range(0, count, size)]


def spread(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    scheduler: str | None = None,
    done: Callable[[Item], None] | None = None,
) -> list[Result]:
    """Calls a function on every item as Dask tasks.

    A task whose worker dies is run again by another.  Without a scheduler the
    workers are processes of this machine, one a core; a single item is computed
    in this process then.  As with any such processes, a script that calls this
    must guard its main part by ``if __name__ == "__main__"``.

    Args:
        function: must be importable where the workers run, and give the same
            for the same item, since it may be called twice.  Plugins that are loaded
            here are loaded there, from the same paths.
        items: one a task.
        scheduler: address of an existing cluster, such as
            ``tcp://127.0.0.1:8786``.
        done: is called with every item whose result is there.

    Returns:
        The results in the order of the items.

    Raises:
        ScenarioError: if no scheduler answers at the address.
    """
    done = done or (lambda _: None)
    if scheduler is None and len(items) == 1:
        results = [function(items[0])]
        done(items[0])
        return results

    # Only here: importing it takes longer than flying a few trials.
    from distributed import as_completed
    from distributed.protocol.pickle import dumps

    with _connected(scheduler, tasks=len(items)) as client:
        # Every task carries all it needs: what is scattered dies with a worker.
        plugins = loaded_plugins()
        futures = [
            client.submit(_task, plugins, dumps((function, item)), pure=False)
            for item in items
        ]
        if scheduler is not None:
            _wait_for_workers(client, scheduler)
        numbers = {future.key: i for i, future in enumerate(futures)}
        collected: dict[int, Result] = {}
        for future, result in as_completed(futures, with_results=True):
            collected[numbers[future.key]] = result
            done(items[numbers[future.key]])
    return [collected[i] for i in range(len(items))]


def _task(plugins: Sequence[str], call: bytes) -> Any:
    """What a worker does: the item may be of classes that a plugin has."""
    from distributed.protocol.pickle import loads

    load_plugins(plugins)
    function, item = loads(call)
    return function(item)


@contextlib.contextmanager
def _connected(scheduler: str | None, *, tasks: int) -> Iterator[Any]:
    """A client of an existing cluster, or of one that lives as long as it does."""
    from distributed import Client, LocalCluster

    with contextlib.ExitStack() as stack:
        stack.enter_context(quiet("distributed"))
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout=PATIENCE)
            except (OSError, ValueError, TypeError) as error:
                raise ScenarioError(
                    "scheduler",
                    scheduler,
                    f"the address of a Dask scheduler that answers ({error})",
                ) from None
        else:
            cluster = LocalCluster(
                n_workers=min(tasks, os.cpu_count() or 1),
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",  # any free port; nobody looks
                # A task that fails raises here; what else workers say, such as that
                # the scheduler is gone when all is done, is nobody's business.
                silence_logs=logging.CRITICAL,
            )
            client = Client(stack.enter_context(cluster))
        yield stack.enter_context(client)


def _wait_for_workers(client: Any, scheduler: str) -> None:
    try:
        client.wait_for_workers(1, timeout=6 * PATIENCE)
    except TimeoutError:
        allowed = f"a scheduler with workers: none came in {6 * PATIENCE:g} s"
        raise ScenarioError("scheduler", scheduler, allowed) from None
