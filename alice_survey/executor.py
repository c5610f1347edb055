"""Run pure functions over pictures, pairs and tiles: in order, parallel, with a bounded queue."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sized
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

_PR_SET_PDEATHSIG = 1
_WORTH_TELLING_S = 2.0
_CORES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

_kept: ContextVar[dict[int, ProcessPoolExecutor] | None] = ContextVar("kept", default=None)

Item = TypeVar("Item")
Result = TypeVar("Result")


def default_threads() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def parallel_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    threads: int,
    label: str,
    total: int | None = None,
) -> Iterator[Result]:
    """Yield `function(item)` for each item, in the order of the items, with a progress bar.

    With one thread the work runs here; else in local processes (spawned, so that threads of numeric
    libraries are never forked), of which each uses one core. At most three items per process are
    queued, so that memory stays bounded.

    Args:
        function: a module-level function (it travels to other processes).
        items: what to work on.
        threads: how many processes.
        label: what the progress bar says.
        total: how many items, when `items` has no length.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    if threads <= 1:
        yield from progress(map(function, items), label, total)
        return
    kept = _kept.get()
    if kept is not None:
        if threads not in kept:
            kept[threads] = _workers(threads)
        yield from progress(_in_order(kept[threads], function, items, 3 * threads), label, total)
        return
    with _workers(threads) as executor:
        yield from progress(_in_order(executor, function, items, 3 * threads), label, total)


@contextlib.contextmanager
def kept_workers() -> Iterator[None]:
    """Within this block all calls of `parallel_map` share their processes.

    To start one and to load its libraries takes about two seconds of computing.
    """
    kept: dict[int, ProcessPoolExecutor] = {}
    token = _kept.set(kept)
    try:
        yield
    finally:
        _kept.reset(token)
        for pool in kept.values():
            pool.shutdown(cancel_futures=True)


def _workers(threads: int) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(threads, mp_context=context, initializer=_start_worker)


def _in_order(
    executor: Executor, function: Callable[[Item], Result], items: Iterable[Item], queued: int
) -> Iterator[Result]:
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            with _one_core_each():  # a process starts when there is something for it to do
                waiting.append(executor.submit(function, item))
            if len(waiting) >= queued:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()


@contextlib.contextmanager
def _one_core_each() -> Iterator[None]:
    """Have processes started meanwhile load their numeric libraries for one core each."""
    before = {name: os.environ.get(name) for name in _CORES}
    os.environ.update(dict.fromkeys(_CORES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _start_worker() -> None:
    """Use one core, and end with the process that started this one, even if that is killed."""
    import cv2

    cv2.setNumThreads(1)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def progress(items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Pass items through while a bar on standard error shows how far the work is.

    On a terminal the bar moves; elsewhere one line says that work of some seconds is done.
    """
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import track

        yield from track(items, label, total=total, console=Console(stderr=True))
        return
    started, count = time.monotonic(), 0
    for item in items:
        count += 1
        yield item
    took_s = time.monotonic() - started
    if took_s > _WORTH_TELLING_S:
        sys.stderr.write(f"{label}: {count} done in {took_s:.1f} s\n")
