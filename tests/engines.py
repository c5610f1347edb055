"""Engines that executors can run tasks on, as those for many machines would."""

import pickle
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Self

from alice_survey.core.executor import Executor


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
