"""Engines that executors can run tasks on, and how a test waits for what others do.

Tasks in other processes import the module of their test: what this imports is paid for by each.
"""

import pickle
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Self, TypeVar

from alice_survey.core.executor import Executor

T = TypeVar("T")


def until(look: Callable[[], T | None], within_s: float = 60.0) -> T:
    """The first thing seen that counts as true."""
    end_s = time.monotonic() + within_s
    while not (found := look()):
        assert time.monotonic() < end_s, f"it did not happen: {found}"
        time.sleep(0.05)
    return found


class PicklingThreads:
    """Threads, each with a blank context, that get and give pickles alone."""

    def __init__(self, workers: int) -> None:
        self._threads = ThreadPoolExecutor(workers)
        self.executor = Executor(workers=workers, pool=self)
        self.tasks = 0
        self.largest_task = 0
        """Bytes of it."""

    def submit(self, function: Callable[..., Any], /, *args: Any) -> "Future[Any]":
        self.tasks += 1
        task = pickle.dumps((function, args))
        self.largest_task = max(self.largest_task, len(task))
        return self._threads.submit(_run, task)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown()


def _run(task: bytes) -> Any:
    function, args = pickle.loads(task)  # noqa: S301 (its own)
    return pickle.loads(pickle.dumps(function(*args)))  # noqa: S301
