"""Run pure functions over pictures, pairs and tiles: in order, parallel, with a bounded queue."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sized
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from alice_survey.base.errors import AliceError, Level, say, shown_by, warn
from alice_survey.base.run.progress import counted, current, keep_silent, step

_PR_SET_PDEATHSIG = 1
_TOLD = "told_in_worker"
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
        yield from counted(map(function, items), label, total, 1)
        return
    kept = _kept.get()
    if kept is not None:
        if threads not in kept:
            kept[threads] = _workers(threads)
        done = _in_order(kept[threads], function, items, 3 * threads)
        yield from counted(done, label, total, threads)
        return
    with _ended(_workers(threads)) as pool:
        yield from counted(_in_order(pool, function, items, 3 * threads), label, total, threads)


@contextlib.contextmanager
def kept_workers() -> Iterator[None]:
    """Within this block all calls of `parallel_map` share their processes.

    To start one and to load its libraries takes about two seconds of computing.
    """
    kept: dict[int, ProcessPoolExecutor] = {}
    token = _kept.set(kept)
    try:
        yield
    except BaseException:
        for pool in kept.values():
            _end(pool)
        raise
    finally:
        _kept.reset(token)
    for pool in kept.values():
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _ended(pool: ProcessPoolExecutor) -> Iterator[ProcessPoolExecutor]:
    """Wait for the processes of a pool at the end; where work is broken off, end them at once."""
    try:
        yield pool
    except BaseException:
        _end(pool)
        raise
    pool.shutdown()


def _end(pool: ProcessPoolExecutor) -> None:
    """End a pool whatever it is doing.

    Its processes are killed, since COLMAP's log answers a termination with a stack trace. What is
    queued is not cancelled one by one: the thread that tends the pool fails on items that were,
    when it finds its processes gone.
    """
    for process in list((pool._processes or {}).values()):
        process.kill()
    pool.shutdown(cancel_futures=True)


def _workers(threads: int) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())  # Python's tracker of semaphores lifts it
    try:
        return ProcessPoolExecutor(threads, mp_context=context, initializer=_start_worker)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@dataclass(frozen=True)
class _Answer(Generic[Result]):
    """What comes back from another process."""

    result: Result
    told: list[tuple[Level, str]] = field(default_factory=list)


@dataclass(frozen=True)
class _Call(Generic[Item, Result]):
    """A function whose notes and warnings come back with its result."""

    function: Callable[[Item], Result]
    quiet: bool

    def __call__(self, item: Item) -> _Answer[Result]:
        told: list[tuple[Level, str]] = []

        def show(level: Level, text: str) -> None:
            told.append((level, text))
            if level == "note" and not self.quiet:  # it says why the next minute is long
                say(text)

        with shown_by(show):
            try:
                return _Answer(self.function(item), told)
            except Exception as error:
                vars(error)[_TOLD] = told
                raise


def _in_order(
    pool: ProcessPoolExecutor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    queued: int,
) -> Iterator[Result]:
    call = _Call(function, current().quiet)
    waiting: deque[Future[_Answer[Result]]] = deque()
    try:
        for item in items:
            with _as_workers_start():  # a process starts when there is something for it to do
                waiting.append(pool.submit(call, item))
            if len(waiting) >= queued:
                yield _result(waiting.popleft())
        while waiting:
            yield _result(waiting.popleft())
    except BrokenProcessPool:
        raise AliceError(
            "a process that worked for this one was ended from outside, most likely because memory "
            "ran out: give fewer --threads, or close other programs; the same command goes on from "
            "here"
        ) from None


def _result(future: "Future[_Answer[Result]]") -> Result:
    """What an item gave, once what its work told is told here."""
    try:
        answer = future.result()
    except Exception as error:
        _tell(vars(error).pop(_TOLD, []))
        raise
    _tell(answer.told)
    return answer.result


def _tell(told: list[tuple[Level, str]]) -> None:
    for level, text in told:
        if level == "warning":
            warn(text)
        else:
            current().tell("note", text, shown=True)


@contextlib.contextmanager
def _as_workers_start() -> Iterator[None]:
    """Have processes started meanwhile take one core each, and leave Ctrl-C to this one."""
    before = {name: os.environ.get(name) for name in _CORES}
    os.environ.update(dict.fromkeys(_CORES, "1"))
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _start_worker() -> None:
    """Use one core, and end with the process that started this one, even if that is killed."""
    import cv2

    cv2.setNumThreads(1)
    keep_silent()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def progress(items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Pass items through while standard error shows how far the work on them is.

    Args:
        items: each of which whoever takes it then works on.
        label: what is done, in a few words.
        total: how many items, if that is known.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with step(label, total) as counter:
        for item in items:
            yield item
            counter.advance()
