"""A real Dask cluster on the loopback: scheduler and workers in folders of their own."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

import psutil

PAUSE_S = "10 s"
"""After it the scheduler gives up a worker that has fallen silent."""


class Machines:
    """Processes of a cluster; they end with the block."""

    def __init__(self, folder: Path, workers: int = 2) -> None:
        self.folder = folder
        self.file = folder / "scheduler.json"
        self.environment = {
            **os.environ,
            "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": PAUSE_S,
            "PYTHONPATH": os.pathsep.join(sys.path),
        }
        self._wanted = workers
        self.scheduler: subprocess.Popen[bytes] | None = None
        self.workers: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        self.file.unlink(missing_ok=True)
        self.scheduler = self._spawn(
            "scheduler", "dask_scheduler", "--scheduler-file", str(self.file), "--port", "0",
            "--no-dashboard",
        )  # fmt: skip
        while not self.file.exists():
            assert self.scheduler.poll() is None
            time.sleep(0.05)
        for number in range(self._wanted):
            self.add(f"worker{number}")

    def add(
        self, name: str, *options: str, threads: int = 1, wrap: tuple[str, ...] = ()
    ) -> subprocess.Popen[bytes]:
        """Start a worker in a folder of its own, within a command that wraps it."""
        worker = self._spawn(
            name, "dask_worker", "--scheduler-file", str(self.file), "--nthreads", str(threads),
            "--name", name, "--no-dashboard", *options, wrap=wrap,
        )  # fmt: skip
        self.workers.append(worker)
        return worker

    def _spawn(
        self, name: str, module: str, *options: str, wrap: tuple[str, ...] = ()
    ) -> subprocess.Popen[bytes]:
        own = self.folder / name
        own.mkdir(parents=True, exist_ok=True)
        command = [*wrap, sys.executable, "-m", f"distributed.cli.{module}", *options]
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                [*command, "--host", "127.0.0.1"], cwd=own, env=self.environment,
                stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip

    @property
    def address(self) -> str:
        return str(json.loads(self.file.read_text())["address"])

    def stop(self) -> None:
        started = [*self.workers, *([self.scheduler] if self.scheduler else [])]
        for process in started:
            for one in [process.pid, *children(process.pid)]:
                kill(one)
            process.wait()
        self.workers, self.scheduler = [], None


def children(pid: int) -> list[int]:
    try:
        return [child.pid for child in psutil.Process(pid).children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def kill(pid: int, number: int = signal.SIGKILL) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def kill_work(nanny: subprocess.Popen[Any], number: int = signal.SIGKILL) -> None:
    """Send a signal to the processes that work, below the one that watches over them."""
    for pid in children(nanny.pid):
        kill(pid, number)
