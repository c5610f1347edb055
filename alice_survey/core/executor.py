"""Run pure functions over pictures, pairs and tiles: in order, in parallel, on any engine."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sized
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any, Generic, ParamSpec, Protocol, TypeVar

from alice_survey.core.errors import AliceError, Level, collected_by, note, say, warn
from alice_survey.core.run.progress import TaskSpent, current, step

_PR_SET_PDEATHSIG = 1
_MESSAGES = "messages_of_task"
_CORES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_MAX_COUNTED = 1000
"""Times that one step is counted on: a count takes as long as writing a message of a bag."""
_QUEUED = 3
"""Tasks in flight for each one running: enough to keep all busy, few enough to bound memory."""

Item = TypeVar("Item")
Result = TypeVar("Result")
P = ParamSpec("P")


class Pending(Protocol):
    """The part of `concurrent.futures.Future` that a pool must provide."""

    def result(self) -> Any:
        """Wait for the result, or raise the error of the function."""

    def cancel(self) -> Any:
        """Forget it."""


class Pool(Protocol):
    """The part of `concurrent.futures.Executor` that an engine must provide."""

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Pending:
        """Run `function(*args)` in the background; both are picklable, and so is the result."""


@dataclass(frozen=True, kw_only=True)
class Executor:
    """Where tasks run: in this process, in local processes, or on an engine for many machines.

    A task is a module-level function of one picklable value: settings, arrays and paths. It may
    rely on nothing else of the process that submits it, and has its worker to itself. What it
    reports with `warn` and `note` travels back with its result.
    """

    workers: int = 1
    """How many tasks run at once; with one and no pool they run in this process."""
    pool: Pool | None = None
    """An engine that is running; without one, local processes start where there are tasks."""
    uses_gpu: bool = False
    """Whether tasks may use the GPU of this machine."""
    task_mib: float = 0.0
    """Memory that any task takes at least, where it is known."""

    @property
    def local_cores(self) -> int:
        """How many cores work in this process, outside of tasks, may use."""
        return self.workers if self._is_local else default_threads()

    @property
    def _is_local(self) -> bool:
        return self.pool is None or isinstance(self.pool, _Processes)

    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        *,
        label: str,
        total: int | None = None,
        task_mib: float = 0.0,
    ) -> Iterator[Result]:
        """Yield `function(item)` for each item, in the order of the items, with a progress bar.

        At most three items per worker are in flight, so that memory stays bounded.

        Args:
            function: a task, see the class.
            items: what to work on.
            label: text of the progress bar.
            total: how many items, when `items` has no length.
            task_mib: memory that one task takes, where that is known to be larger than
                `self.task_mib`: in local processes as many run at once as there is memory for.

        Raises:
            AliceError: a worker was ended from outside.
        """
        if total is None and isinstance(items, Sized):
            total = len(items)
        with step(label, total) as counter:
            maximum = max(task_mib, self.task_mib)
            for found in self._results(function, items, total, label, maximum):
                yield found.result
                counter.advance(spent=found.spent)

    @contextlib.contextmanager
    def start(self) -> Iterator["Executor"]:
        """Within this block all calls of `map` share their processes.

        Starting one and loading its libraries takes about two seconds of processor time. No more
        start than there is memory for.
        """
        workers = min(self.workers, _fitting(self.task_mib))
        if self.pool is not None or self.workers <= 1:
            yield self
            return
        if workers < self.workers:
            note(
                f"{workers} of {self.workers} processes work, of {self.task_mib:.0f} MiB each: "
                "memory has no room for more"
            )
        if workers <= 1:
            yield replace(self, workers=1)
            return
        with _Processes(workers) as pool:
            yield replace(self, pool=pool, workers=workers)

    def _results(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        total: int | None,
        label: str,
        task_mib: float,
    ) -> "Iterator[TaskResult[Result]]":
        """What tasks give, in the order of the items."""
        workers = self.workers
        if self._is_local:
            workers = min(workers, _fitting(task_mib), workers if total is None else max(1, total))
        if workers <= 1 and self._is_local:
            yield from map(Task(function, collects=False), items)
        elif self.pool is not None:
            is_limited = workers < self.workers
            queued = workers if is_limited else _QUEUED * workers
            yield from in_order(self.pool, function, items, lambda: queued)
        else:
            with _Processes(workers) as pool:
                yield from in_order(pool, function, items, lambda: _QUEUED * workers)


SERIAL = Executor()
"""Runs tasks in this process, one after the other."""


def local_executor(threads: int | None = None) -> Executor:
    """Processes on this machine, as many as given; one for each core when None."""
    return Executor(workers=threads or default_threads())


def default_threads() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_apart(function: Callable[[Item], Result], item: Item) -> Result:
    """Run a task in a local process of its own, which faults in native code may end.

    Raises:
        BrokenExecutor: they did.
    """
    with _Processes(1) as pool:
        answer: TaskResult[Result] = _result(pool.submit(Task(function), item))
        return answer.result


def _fitting(task_mib: float) -> int:
    """How many tasks the memory of this machine has room for, at least one."""
    if task_mib <= 0:
        return sys.maxsize
    import psutil

    return max(1, int(psutil.virtual_memory().available / (task_mib * 2**20)))


class _Processes(ProcessPoolExecutor):
    """Local processes of one core each, spawned, so that threads of libraries are never forked."""

    def __init__(self, workers: int) -> None:
        with _signals_restored():  # Python's tracker of semaphores changes the mask
            super().__init__(
                workers, mp_context=multiprocessing.get_context("spawn"), initializer=_start_worker
            )

    def submit(
        self, function: Callable[P, Result], /, *args: P.args, **kwargs: P.kwargs
    ) -> "Future[Result]":
        """Queue a task; a process starts when there is something for it to do."""
        with _as_workers_start():
            return super().submit(function, *args, **kwargs)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Wait for the processes; where work is broken off, end them whatever they are doing.

        They are killed then, since COLMAP's log answers a termination with a stack trace. What is
        queued is not cancelled one by one: the thread that tends the pool fails on items that
        were, when it finds its processes gone.
        """
        if kind is not None:
            for process in list((self._processes or {}).values()):
                process.kill()
        self.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class TaskResult(Generic[Result]):
    """Result of a task, with its notes and warnings."""

    result: Result
    spent: TaskSpent
    messages: list[tuple[Level, str]] = field(default_factory=list)


@dataclass(frozen=True)
class Task(Generic[Item, Result]):
    """A function whose notes and warnings come back with its result."""

    function: Callable[[Item], Result]
    collects: bool = True
    """Whether they do; else they are reported at once."""
    says_notes: bool = False
    """Show notes at once as well: they say why the next minute is long."""

    def __call__(self, item: Item) -> TaskResult[Result]:
        """Call the function."""
        began_s = time.process_time()
        if not self.collects:
            result = self.function(item)
            return TaskResult(result, TaskSpent(time.process_time() - began_s))
        messages: list[tuple[Level, str]] = []

        def collect(level: Level, text: str) -> None:
            messages.append((level, text))
            if level == "note" and self.says_notes:
                say(text)

        with collected_by(collect):
            try:
                result = self.function(item)
                spent = TaskSpent(time.process_time() - began_s)
                return TaskResult(result, spent, messages)
            except Exception as error:  # whatever it raises takes its messages along
                vars(error)[_MESSAGES] = messages
                raise


def in_order(
    pool: Pool,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    max_queued: Callable[[], int],
) -> Iterator[TaskResult[Result]]:
    """Run a task for each item on a pool, and yield what they give in the order of the items.

    Args:
        pool: where tasks run.
        function: a task.
        items: what to work on.
        max_queued: how many may be in flight, now.
    """
    local = isinstance(pool, _Processes)
    says_notes = local and not current().is_quiet
    task = Task(function, says_notes=says_notes)
    waiting: deque[Pending] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(task, item))
            while len(waiting) >= max_queued():
                yield _result(waiting.popleft(), shown=says_notes)
        while waiting:
            yield _result(waiting.popleft(), shown=says_notes)
    except BrokenExecutor:
        raise AliceError(
            "a process that worked for this one was ended from outside, most likely because memory "
            "ran out: give fewer --threads, or close other programs; the same command goes on from "
            "here"
        ) from None
    finally:
        if not local:
            for future in waiting:
                future.cancel()


def _result(future: Pending, *, shown: bool = False) -> TaskResult[Any]:
    """What a task gives, once its notes and warnings are reported here."""
    try:
        answer: TaskResult[Any] = future.result()
    except Exception as error:  # any that the task raised, as above
        _report(vars(error).pop(_MESSAGES, []), shown=shown)
        raise
    _report(answer.messages, shown=shown)
    return answer


def _report(messages: list[tuple[Level, str]], *, shown: bool) -> None:
    for level, text in messages:
        if level == "warning":
            warn(text)
        elif shown:
            current().report("note", text, shown=True)
        else:
            note(text)


@contextlib.contextmanager
def _signals_restored() -> Iterator[None]:
    """Restore the mask of blocked signals at the end, where the system has one."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextlib.contextmanager
def _as_workers_start() -> Iterator[None]:
    """Have processes started meanwhile take one core each, and leave Ctrl-C to this one.

    They do not run the user's script, which would start them again.
    """
    before = {name: os.environ.get(name) for name in _CORES}
    os.environ.update(dict.fromkeys(_CORES, "1"))
    script = vars(sys.modules["__main__"])
    path = script.pop("__file__", None) if script.get("__spec__") is None else None
    try:
        with _signals_restored():
            if hasattr(signal, "pthread_sigmask"):
                signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            yield
    finally:
        if path is not None:
            script["__file__"] = path
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
    """Pass items through while standard error shows the progress of the work on them.

    Args:
        items: what the caller works on, one by one, or results that took work to produce.
        label: what is done, in a few words.
        total: how many items, if that is known.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with step(label, total) as counter:
        every = max(1, (total or 0) // _MAX_COUNTED)
        number = 0
        for number, item in enumerate(items, 1):
            yield item
            if number % every == 0:
                counter.advance(every)
        if number % every:
            counter.advance(number % every)
