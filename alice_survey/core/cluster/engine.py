"""An executor whose tasks run on the workers of a Dask scheduler.

A task that its worker cannot do, because the worker died or no longer sees the files, runs again on
another: tasks are pure functions that write their files whole, so that results are the same. Dask
moves tasks of workers that it misses; those that are unfit for a run are left out here.
"""

import contextlib
import itertools
import logging
import os
import pickle
import shutil
import socket
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from filelock import FileLock, Timeout
from pydantic import Field, ValidationError, model_validator

from alice_survey.core.artefacts import refuse_links
from alice_survey.core.cluster.worker import Answer, RunSite, code_and_versions, run_task, why_unfit
from alice_survey.core.config import Config
from alice_survey.core.contents import first_fault, ordinary_file, parse_toml
from alice_survey.core.errors import (
    AliceError,
    ConfigError,
    WorkspaceError,
    extra,
    file_faults,
    note,
    warn,
    why,
)
from alice_survey.core.executor import Executor, Item, Result, TaskResult, default_threads, in_order
from alice_survey.core.run import progress
from alice_survey.core.run.resources import count_elsewhere

if TYPE_CHECKING:
    from distributed import Client, Future

STORE = ".cluster"
"""Folder of a workspace for values that tasks share, while a run lasts."""
_LOCK = ".lock"
"""Ending of the file next to these that a run locks."""
_CONNECT_S = 20
_WAIT_S = 30.0
"""For the first worker of a scheduler, and before a missing worker is reported."""
_LOOK_EVERY_S = 2.0
_GOES_ON = "the same command goes on from here"
_LOOPBACK = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}
"""Options of a local cluster without which its pages can be opened from other machines."""


class ClusterConfig(Config):
    """A cluster file: one of the first three."""

    address: str | None = None
    """Of a scheduler that runs."""
    scheduler_file: Path | None = None
    """Dask's own JSON file of such a scheduler."""
    start: str | None = None
    """Class of a cluster to start, such as `dask_jobqueue.SLURMCluster`."""
    workers: int | None = Field(None, ge=1)
    """With `start`: how many workers to ask for."""
    options: dict[str, Any] = Field(default_factory=dict)
    """With `start`: arguments of the class."""

    @model_validator(mode="after")
    def _one_cluster(self) -> Self:
        given = [self.address, self.scheduler_file, self.start]
        if sum(value is not None for value in given) != 1:
            raise ValueError("give one of address, scheduler_file and start")
        if self.start is None and (self.workers or self.options):
            raise ValueError("workers and options are of a cluster to start: give start too")
        return self


def read_cluster_file(path: Path) -> ClusterConfig:
    """Read a cluster file; one that ends with `.json` is Dask's file of a scheduler.

    Raises:
        ConfigError: it is missing, not TOML, or describes no cluster.
    """
    if path.suffix.lower() == ".json":
        return ClusterConfig(scheduler_file=path)
    with file_faults(path, ConfigError):
        text = ordinary_file(path).read_text(encoding="utf-8")
    try:
        return ClusterConfig.model_validate(parse_toml(text))
    except ValidationError as error:
        raise ConfigError(f"{path}: {first_fault(error)}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


@contextlib.contextmanager
def _connect(config: ClusterConfig) -> Iterator["Client"]:
    """Within this block, be a client of a scheduler; a cluster that was started ends with it."""
    try:
        from distributed import Client
    except ImportError:
        raise WorkspaceError(
            f"a cluster needs Dask: {extra('cluster')}, here and on the workers"
        ) from None
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what ends a run is reported here
    with contextlib.ExitStack() as stack:
        where: Any = config.address or config.scheduler_file
        given: dict[str, Any] = {"address": where}
        if config.start is not None:
            where = config.start
            given = {"address": stack.enter_context(_start_cluster(config))}
        elif config.scheduler_file is not None:
            given = {"scheduler_file": str(config.scheduler_file)}
            if not config.scheduler_file.is_file():
                raise ConfigError(f"{where}: no such file; 'dask scheduler' writes one")
        try:
            client = stack.enter_context(Client(**given, timeout=_CONNECT_S, set_as_default=False))
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise WorkspaceError(
                f"the scheduler at {where} does not answer ({why(error)}): start it with 'dask "
                "scheduler', or give the address that it prints"
            ) from None
        yield client


@contextlib.contextmanager
def _start_cluster(config: ClusterConfig) -> Iterator[Any]:
    module, _, name = str(config.start).rpartition(".")
    local = _LOOPBACK if name == "LocalCluster" else {}
    try:
        kind = getattr(import_module(module), name)
        cluster = kind(**local | config.options)
    except (ImportError, AttributeError, TypeError, ValueError, OSError, RuntimeError) as error:
        raise ConfigError(
            f"start = {config.start!r}: {why(error)}; give a class that can be imported here, such "
            "as 'dask_jobqueue.SLURMCluster' or 'distributed.LocalCluster', and its options"
        ) from None
    with cluster:
        if config.workers is not None:
            cluster.scale(config.workers)
        yield cluster


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
        file: a cluster file instead of it, or Dask's JSON file of a scheduler.

    Raises:
        ConfigError: the cluster file is wrong.
        WorkspaceError: Dask is missing, no scheduler or worker answers, or a worker does not see
            the workspace, has other code, or runs several tasks at a time.
    """
    config = ClusterConfig(address=scheduler) if file is None else read_cluster_file(file)
    with warnings.catch_warnings(), _connect(config) as client, _store(workspace) as store:
        warnings.filterwarnings("ignore", "Sending large graph")
        site = RunSite(
            folder=str(Path.cwd()),
            store=store,
            host=socket.gethostname(),
            process=os.getpid(),
            code=code_and_versions(),
        )
        cluster = Cluster(client, site)
        cluster.check(max_wait_s=None if config.start else _WAIT_S)
        yield ClusterExecutor(workers=default_threads(), cluster=cluster)


@contextlib.contextmanager
def _store(workspace: Path) -> Iterator[Path]:
    """A new folder for shared values, with a mark in it; it goes at the end.

    Those of runs that were killed go now: what holds their locks has ended.
    """
    refuse_links(workspace, workspace / STORE)
    folder = (workspace / STORE).resolve() / os.urandom(6).hex()
    lock = FileLock(folder.with_suffix(_LOCK), timeout=0)
    with file_faults(workspace, WorkspaceError, "written"):
        folder.parent.mkdir(parents=True, exist_ok=True)
        for left in folder.parent.glob(f"*{_LOCK}"):
            with contextlib.suppress(Timeout), FileLock(left, timeout=0):
                shutil.rmtree(left.with_suffix(""), ignore_errors=True)
                left.unlink()
        lock.acquire()
        folder.mkdir()
        (folder / "mark").write_text(folder.name)
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

    def __init__(self, client: "Client", site: RunSite) -> None:
        self.client, self.site = client, site
        self.numbers = itertools.count()
        self.unfit: set[str] = set()
        """Addresses of workers that may get no tasks."""
        self._known: dict[str, Any] = {}
        self._known_s = -1e9

    @property
    def where(self) -> str:
        """Address of the scheduler."""
        scheduler: Any = self.client.scheduler
        return str(scheduler.address)

    def check(self, max_wait_s: float | None) -> None:
        """Wait for workers, check each, and report them.

        Raises:
            WorkspaceError: there are none, or one is unfit.
        """
        with progress.step("waiting for workers"), self.report_loss():
            try:
                self.client.wait_for_workers(1, timeout=max_wait_s)
            except TimeoutError:
                raise WorkspaceError(
                    f"no worker is connected to the scheduler at {self.where}: start some, one "
                    f"for each core: dask worker {self.where} --nthreads 1 --nworkers -1"
                ) from None
        with progress.step("checking workers"), self.report_loss():
            found = self.client.run(why_unfit, self.site, on_error="return")
        for address, fault in found.items():
            if isinstance(fault, ImportError):
                fault = f"alice-survey cannot be imported ({fault}): install the same version there"
            elif isinstance(fault, OSError):  # it has ended
                continue
            if fault:
                raise WorkspaceError(f"worker {self._name(address)}: {fault}")
        note(f"{len(found)} worker{'s' if len(found) > 1 else ''} at {self.where}")

    def workers(self) -> dict[str, Any]:
        """What is known of each worker, by its address; a few seconds old at most."""
        if time.monotonic() - self._known_s > _LOOK_EVERY_S:
            with self.report_loss():
                self._known = self.client.scheduler_info(n_workers=-1)["workers"]
            self._known_s = time.monotonic()
        return self._known

    def fit(self) -> dict[str, Any]:
        """Those that may get tasks."""
        return {a: about for a, about in self.workers().items() if a not in self.unfit}

    def exclude(self, address: str, reason: str) -> None:
        """Give a worker no more tasks."""
        if address not in self.unfit:
            self.unfit.add(address)
            warn(f"worker {self._name(address)} gets no more tasks: {reason}")

    def _name(self, address: str) -> str:
        name = str(self.workers().get(address, {}).get("name", address))
        return address if name == address else f"{name} ({address})"

    @contextlib.contextmanager
    def report_loss(self) -> Iterator[None]:
        """Report a scheduler that no longer answers.

        Raises:
            AliceError: it does not.
        """
        from distributed.client import ClosedClientError

        try:
            yield
        except TimeoutError:
            raise
        except (CancelledError, ClosedClientError, OSError) as error:
            raise AliceError(
                f"the scheduler at {self.where} was lost ({type(error).__name__}): start it and "
                f"its workers again; {_GOES_ON}"
            ) from None


class _Tasks:
    """A pool for tasks of one kind."""

    def __init__(self, cluster: Cluster, label: str, task_mib: float) -> None:
        self.cluster = cluster
        self.label = label
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

    def send(self, function: bytes | str, arguments: bytes) -> "Future[Any]":
        """Send a task to workers that are fit for it, once there are any.

        Raises:
            AliceError: none has the memory, or none is fit.
        """
        cluster = self.cluster
        fit, waited_s = cluster.fit(), 0.0
        while cluster.unfit and not fit:
            if waited_s > _WAIT_S:
                raise AliceError(f"no worker at {cluster.where} is fit any more; {_GOES_ON}")
            time.sleep(_LOOK_EVERY_S)
            waited_s += _LOOK_EVERY_S
            fit = cluster.fit()
        large = {a: w for a, w in fit.items() if not 0 < w["memory_limit"] < self._memory}
        if fit and not large:
            maximum = max(about["memory_limit"] for about in fit.values())
            raise AliceError(
                f"{self.label!r} takes {self._memory / 2**20:.0f} MiB a task, and no worker has "
                f"more than {maximum / 2**20:.0f} MiB: start fewer workers on each machine"
            )
        options: dict[str, Any] = {}
        if cluster.unfit or len(large) < len(fit):
            options = {"workers": sorted(large), "allow_other_workers": True}  # once these ended
        key = f"{self.label}-{cluster.site.store.name}-{next(cluster.numbers)}"
        with cluster.report_loss():
            return cluster.client.submit(
                run_task, cluster.site, function, arguments, key=key, pure=False, **options
            )


class _Submitted:
    """A task that a worker does, or another when that one cannot."""

    def __init__(self, tasks: _Tasks, function: bytes | str, arguments: bytes) -> None:
        self._tasks, self._function, self._arguments = tasks, function, arguments
        self._future = tasks.send(function, arguments)

    def cancel(self) -> None:
        """Forget it; a worker that is doing it goes on to its end."""
        with contextlib.suppress(AliceError, TimeoutError), self._tasks.cluster.report_loss():
            self._future.cancel()

    def result(self) -> Any:
        """Wait for the result, or raise what the task raised.

        Raises:
            AliceError: the scheduler was lost, the task ends every worker, or none is fit.
        """
        answer = self._answer()
        while answer.unfit:
            self._tasks.cluster.exclude(answer.worker, answer.unfit)
            self._future = self._tasks.send(self._function, self._arguments)
            answer = self._answer()
        value = pickle.loads(answer.data)  # noqa: S301 (its own)
        if answer.failed:
            raise value
        if not answer.is_below:
            count_elsewhere(value.spent.cpu_s)
        sent, received = len(self._arguments), len(answer.data)
        return replace(value, spent=replace(value.spent, sent_bytes=sent, received_bytes=received))

    def _answer(self) -> Answer:
        """The answer of a worker; a warning says that it waits since there is none."""
        from distributed.scheduler import KilledWorker

        cluster, missing_s = self._tasks.cluster, 0.0
        while True:
            try:
                with cluster.report_loss():
                    found: Answer = self._future.result(timeout=_LOOK_EVERY_S)
                    return found
            except KilledWorker as error:
                raise AliceError(
                    f"{self._tasks.label!r}: {error.allowed_failures + 1} workers ended at this "
                    "task, most likely because their memory ran out: start fewer workers on each "
                    f"machine; {_GOES_ON}"
                ) from None
            except TimeoutError:
                missing_s = 0.0 if cluster.workers() else missing_s + _LOOK_EVERY_S
                if _WAIT_S <= missing_s < _WAIT_S + _LOOK_EVERY_S:
                    warn(f"no worker is left at {cluster.where}: waiting for one")
