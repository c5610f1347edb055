"""An executor whose tasks run on the workers of a Dask scheduler.

A task that its worker cannot do, because the worker died, no longer sees the files or hangs, runs
again on another: tasks are pure functions that write their files whole, so that results are the
same. Dask moves tasks of workers that it misses; the rest is here.
"""

import contextlib
import itertools
import os
import pickle
import shutil
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from alice_survey.core.artefacts import refuse_links
from alice_survey.core.cluster.connection import Connection, connect
from alice_survey.core.cluster.worker import (
    Answer,
    RunSite,
    check_worker,
    code_and_versions,
    run_task,
)
from alice_survey.core.errors import AliceError, WorkspaceError, note, warn, why
from alice_survey.core.executor import Executor, Item, Result, TaskResult, default_threads, in_order
from alice_survey.core.run import progress
from alice_survey.core.run.resources import count_elsewhere

if TYPE_CHECKING:
    from distributed import Client, Future

STORE = ".cluster"
"""Folder of a workspace for values that tasks share, while a run lasts."""
_LOCK = ".lock"
"""Ending of the file next to these that a run locks."""
_WAIT_S = 30.0
"""For the first worker of a scheduler, and before a missing worker is reported."""
_LOOK_EVERY_S = 2.0
_CHECKED_AT_ONCE = 32
"""Workers that are asked at once, before the work."""
_PATIENCE_S, _TIMES_LONGEST = 600.0, 20.0
"""A task hangs that takes longer than this, and than so many times the longest of its kind."""
_GOES_ON = "the same command goes on from here"
_MEMORY = "MEMORY"
"""Resource of workers that Dask's documentation gives that name, in bytes."""


def max_in_flight(workers: int) -> int:
    """Tasks sent whose results are not taken: enough that a long one holds few others back."""
    return 32 + 4 * workers


@contextlib.contextmanager
def cluster_executor(
    workspace: Path, scheduler: str | None, file: Path | None
) -> Iterator["ClusterExecutor"]:
    """Within this block, an executor on a Dask cluster.

    Args:
        workspace: folder that the tasks read and write, and that all workers see.
        scheduler: address of the scheduler.
        file: a cluster file instead of it.

    Raises:
        ConfigError: the cluster file is wrong.
        WorkspaceError: Dask is missing, no scheduler or worker answers, or a worker does not see
            the workspace, has other code, or runs several tasks at a time.
    """
    with (
        warnings.catch_warnings(),
        connect(scheduler, file) as connection,
        _store(workspace) as store,
    ):
        warnings.filterwarnings("ignore", "Sending large graph")
        site = RunSite(
            folder=str(Path.cwd()),
            store=store,
            host=socket.gethostname(),
            process=os.getpid(),
            code=code_and_versions(),
        )
        cluster = Cluster(connection, site)
        cluster.check()
        yield ClusterExecutor(workers=default_threads(), cluster=cluster)


@contextlib.contextmanager
def _store(workspace: Path) -> Iterator[Path]:
    """A new folder for shared values, with a mark in it; it goes at the end.

    Those of runs that were killed go now: what holds their locks has ended.
    """
    refuse_links(workspace, workspace / STORE)
    folder = (workspace / STORE).resolve() / os.urandom(6).hex()
    lock = FileLock(folder.with_suffix(_LOCK), timeout=0)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        for left in folder.parent.glob(f"*{_LOCK}"):
            with contextlib.suppress(Timeout), FileLock(left, timeout=0):
                shutil.rmtree(left.with_suffix(""), ignore_errors=True)
                left.unlink()
        lock.acquire()
        folder.mkdir()
        (folder / "mark").write_text(folder.name)
    except OSError as error:
        raise WorkspaceError(f"{workspace} cannot be written: {why(error)}") from None
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # another run has its own in it
            folder.with_suffix(_LOCK).unlink()
            lock.release()
            folder.parent.rmdir()


@dataclass(frozen=True, kw_only=True)
class ClusterExecutor(Executor):
    """An executor on a cluster; its `workers` are the cores of this machine."""

    cluster: "Cluster"

    @contextlib.contextmanager
    def start(self) -> Iterator[Executor]:
        """The same: its workers run already."""
        yield self

    def _results(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        total: int | None,
        label: str,
        task_mib: float,
    ) -> Iterator[TaskResult[Result]]:
        tasks = _Tasks(self.cluster, label, task_mib)
        yield from in_order(tasks, function, items, tasks.max_queued)


class Cluster:
    """Workers of a scheduler that take the tasks of one run."""

    def __init__(self, connection: Connection, site: RunSite) -> None:
        self.client: Client = connection.client
        self.site = site
        self.numbers = itertools.count()
        self._connection = connection
        self._unfit: set[str] = set()
        self._known: dict[str, Any] = {}
        self._known_s = -1e9
        self._begun: dict[int, tuple[float, str]] = {}
        self._lock = threading.Lock()
        self.client.subscribe_topic(site.store.name, self._note_begin)

    @property
    def where(self) -> str:
        """Address of the scheduler."""
        return self._connection.address

    def check(self) -> None:
        """Wait for workers, check each, and report them.

        Raises:
            WorkspaceError: there are none, or one is unfit.
        """
        checked: dict[str, Any] = {}
        while not checked:
            found = self._first_workers()
            with (
                progress.step("checking workers", len(found)) as counter,
                ThreadPoolExecutor(_CHECKED_AT_ONCE) as waiting,
            ):
                reasons = waiting.map(self.why_unfit, found)
                for (address, about), why_unfit in zip(found.items(), reasons, strict=True):
                    if why_unfit:
                        raise WorkspaceError(f"worker {_worker_name(address, about)}: {why_unfit}")
                    if why_unfit is not None:
                        checked[address] = about
                    counter.advance()
        with self.report_loss():
            services = self.client.scheduler_info(n_workers=0)["services"]
        shown = f"; dashboard: {self.client.dashboard_link}" if "dashboard" in services else ""
        count = f"{len(checked)} worker{'s' if len(checked) > 1 else ''}"
        note(f"{count} at {self.where}{shown}")

    def _first_workers(self) -> dict[str, Any]:
        with progress.step("waiting for workers"):
            began_s = time.monotonic()
            while not self.workers():
                if not self._connection.is_own and time.monotonic() - began_s > _WAIT_S:
                    raise WorkspaceError(
                        f"no worker is connected to the scheduler at {self.where}: start some, one "
                        f"for each core: dask worker {self.where} --nthreads 1 --nworkers -1"
                    )
                time.sleep(0.2)
        return self.workers()

    def why_unfit(self, address: str) -> str | None:
        """Why a worker is unfit, empty where it is fit; None where it has ended.

        Its answer waits for whatever it is doing.
        """
        reply = f"reply{next(self.numbers)}"
        about = self.workers().get(address)
        if about is not None and why_threads(about):
            return why_threads(about)
        try:
            if self._ask(address, import_module, check_worker.__module__) is None:
                return None
            found: str | None = self._ask(address, check_worker, self.site, reply)
        except ImportError as error:
            return f"alice-survey cannot be imported ({error}): install the same version there"
        if found == "" and not (self.site.store / reply).exists():
            return f"{self.site.store} is another folder there"
        return found

    def _ask(self, address: str, function: Callable[..., Any], *args: Any) -> Any:
        """Result of a function on one worker; None where it has ended."""
        with self.report_loss():
            future = self.client.submit(function, *args, workers=[address], pure=False)
            while address in self.workers():
                with contextlib.suppress(TimeoutError):
                    return future.result(timeout=_LOOK_EVERY_S)
        return None

    def workers(self) -> dict[str, Any]:
        """What is known of each worker, by its address; a few seconds old at most."""
        if time.monotonic() - self._known_s > _LOOK_EVERY_S:
            with self.report_loss():
                self._known = self.client.scheduler_info(n_workers=-1)["workers"]
            self._known_s = time.monotonic()
        return self._known

    def fit(self) -> dict[str, Any]:
        """Those that may get tasks."""
        for address, about in self.workers().items():
            why_unfit = why_threads(about)
            if why_unfit:
                self.exclude(address, why_unfit)
        return {a: about for a, about in self.workers().items() if a not in self._unfit}

    @property
    def is_any_unfit(self) -> bool:
        """Whether a worker may get none."""
        return bool(self._unfit)

    def exclude(self, address: str, reason: str) -> None:
        """Give a worker no more tasks."""
        if address not in self._unfit:
            self._unfit.add(address)
            about = self.workers().get(address, {})
            warn(f"worker {_worker_name(address, about)} gets no more tasks: {reason}")

    def retire(self, address: str, reason: str) -> None:
        """Have a worker ended; the scheduler gives its tasks to others."""
        self.exclude(address, reason)
        with self.report_loss():
            self.client.retire_workers([address])

    def begun(self, number: int) -> tuple[float, str] | None:
        """When a task has begun, and the worker; None while it waits for one."""
        with self._lock:
            return self._begun.get(number)

    def forget(self, number: int) -> None:
        """A task is done."""
        with self._lock:
            self._begun.pop(number, None)

    def _note_begin(self, event: tuple[float, dict[str, Any]]) -> None:
        _, facts = event
        with self._lock:
            self._begun[facts["task"]] = time.monotonic(), facts["worker"]

    @contextlib.contextmanager
    def report_loss(self) -> Iterator[None]:
        """Report a scheduler that no longer answers.

        Raises:
            AliceError: it does not.
        """
        try:
            yield
        except (CancelledError, OSError) as error:
            raise AliceError(
                f"the scheduler at {self.where} was lost ({type(error).__name__}): start it and "
                f"its workers again; {_GOES_ON}"
            ) from None


def why_threads(about: dict[str, Any]) -> str:
    """Why a worker runs more than one task at a time; empty where it does not."""
    threads = about["nthreads"]
    if threads == 1:
        return ""
    return (
        f"it runs {threads} tasks in one process, which share libraries that need one each: start "
        "it with --nthreads 1 (and --nworkers for its cores; threads_per_worker or processes in a "
        "cluster file)"
    )


def _worker_name(address: str, about: dict[str, Any]) -> str:
    name = str(about.get("name", address))
    return address if name == address else f"{name} ({address})"


class _Tasks:
    """A pool for tasks of one kind."""

    def __init__(self, cluster: Cluster, label: str, task_mib: float) -> None:
        self.cluster = cluster
        self.label = label
        self.max_s = 0.0
        self._memory = task_mib * 2**20
        self._function: Any = None
        self._packed: bytes | str = b""

    def max_queued(self) -> int:
        """How many tasks may be in flight."""
        return max_in_flight(len(self.cluster.fit()))

    def submit(self, function: Callable[..., Any], /, *args: Any) -> "_Submitted":
        """Send a task to the scheduler."""
        from alice_survey.core.cluster.shared_values import pack, pack_once

        store = self.cluster.site.store
        if function is not self._function:
            self._function, self._packed = function, pack_once(function, store)
        return _Submitted(self, self._packed, pack(args, store))

    def send(
        self, number: int, function: bytes | str, arguments: bytes
    ) -> "tuple[Future[Any], set[str]] | None":
        """Send a task to workers that are fit for it.

        Returns:
            Its future, and the addresses that it may go to, all of which may end (none where any
            may have it); None where no worker is fit now.

        Raises:
            AliceError: none has the memory.
        """
        cluster = self.cluster
        options: dict[str, Any] = {}
        fit = cluster.fit()
        large = {a: w for a, w in fit.items() if not 0 < w["memory_limit"] < self._memory}
        if fit and not large:
            maximum = max(about["memory_limit"] for about in fit.values())
            raise AliceError(
                f"{self.label!r} takes {self._memory / 2**20:.0f} MiB a task, and no worker has "
                f"more than {maximum / 2**20:.0f} MiB: start fewer workers on each machine"
            )
        allowed = set(large) if cluster.is_any_unfit or len(large) < len(fit) else set()
        if allowed:
            options["workers"] = sorted(allowed)
        elif cluster.is_any_unfit:
            return None
        if self._memory and large and all(_MEMORY in w["resources"] for w in large.values()):
            options["resources"] = {_MEMORY: self._memory}
        with cluster.report_loss():
            future = cluster.client.submit(
                run_task, cluster.site, number, function, arguments,
                key=f"{self.label}-{cluster.site.store.name}-{next(cluster.numbers)}",
                pure=False, **options,
            )  # fmt: skip
        return future, allowed


class _Submitted:
    """A task that a worker does, or another when that one cannot."""

    def __init__(self, tasks: _Tasks, function: bytes | str, arguments: bytes) -> None:
        self._tasks = tasks
        self._function, self._arguments = function, arguments
        self._number = next(tasks.cluster.numbers)
        self._future: Future[Any] | None = None
        self._allowed: set[str] = set()
        self._missing_s: float | None = None
        self._is_reported = False
        self._send()

    def cancel(self) -> None:
        """Forget it; a worker that is doing it goes on to its end."""
        if self._future is not None:
            with contextlib.suppress(CancelledError, OSError):
                self._future.cancel()

    def result(self) -> Any:
        """Wait for the result, or raise what the task raised.

        Raises:
            AliceError: the scheduler was lost, the task ends every worker, or none is fit.
        """
        cluster = self._tasks.cluster
        while True:
            answer = self._answer()
            if answer is None:
                continue
            if answer.failed:
                answer = replace(answer, unfit=self._recheck(answer.worker))
            if answer.unfit:
                cluster.exclude(answer.worker, answer.unfit)
                self._send()
                continue
            cluster.forget(self._number)
            self._tasks.max_s = max(self._tasks.max_s, answer.took_s)
            value = pickle.loads(answer.data)  # noqa: S301 (its own)
            if answer.failed:
                raise value
            if not answer.is_below:
                count_elsewhere(value.spent.cpu_s)
            sent = len(self._arguments)
            spent = replace(value.spent, sent_bytes=sent, received_bytes=len(answer.data))
            return replace(value, spent=spent)

    def _send(self) -> None:
        sent = self._tasks.send(self._number, self._function, self._arguments)
        self._future, self._allowed = sent or (None, set())

    def _answer(self) -> Answer | None:
        """The answer, or None where it is not there yet."""
        from distributed.scheduler import KilledWorker

        cluster = self._tasks.cluster
        if self._future is None:
            self._wait_for_worker()
            return None
        try:
            with cluster.report_loss(), contextlib.suppress(TimeoutError):
                found: Answer = self._future.result(timeout=_LOOK_EVERY_S)
                return found
        except KilledWorker as error:
            raise AliceError(
                f"{self._tasks.label!r}: {error.allowed_failures + 1} workers ended at this task, "
                "most likely because their memory ran out: start fewer workers on each machine; "
                f"{_GOES_ON}"
            ) from None
        self._look_after()
        return None

    def _wait_for_worker(self) -> None:
        """Send the task as soon as a worker is fit for it.

        Raises:
            AliceError: there are workers, but for a while none that is fit.
        """
        cluster, now_s = self._tasks.cluster, time.monotonic()
        self._missing_s = now_s if self._missing_s is None else self._missing_s
        if now_s - self._missing_s > _WAIT_S:
            if cluster.workers():
                raise AliceError(f"no worker at {cluster.where} is fit any more; {_GOES_ON}")
            if not self._is_reported:
                self._is_reported = True
                warn(f"no worker is left at {cluster.where}: waiting for one")
        self._send()
        if self._future is None:
            time.sleep(_LOOK_EVERY_S)
        else:
            self._missing_s = None

    def _look_after(self) -> None:
        """Look why the answer takes long."""
        cluster, tasks = self._tasks.cluster, self._tasks
        workers = cluster.workers()
        if not workers or (self._allowed and not self._allowed & set(workers)):
            self.cancel()
            self._future = None
            return
        begun = cluster.begun(self._number)
        if begun is None or begun[1] not in cluster.fit():
            return
        took_s = time.monotonic() - begun[0]
        if took_s > max(_PATIENCE_S, _TIMES_LONGEST * tasks.max_s):
            cluster.retire(
                begun[1],
                f"it hangs, {took_s:.0f} s in a task of {tasks.label!r}, others took "
                f"{tasks.max_s:.0f} s at most",
            )

    def _recheck(self, address: str) -> str:
        """Why a worker whose task failed is unfit, if it is."""
        found = self._tasks.cluster.why_unfit(address)
        return "it has ended" if found is None else found
