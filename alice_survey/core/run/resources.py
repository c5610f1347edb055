"""Resource usage: processor time and memory of a process with all its descendants."""

import contextlib
import ctypes
import errno
import os
import platform
import sys
import threading
import time
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING

from filelock import FileLock

if TYPE_CHECKING:
    import psutil

_EVERY_S = 1.0
_MAX_SHARE = 0.01
"""Of a core's time, for reading."""
_PACKAGES = {
    "alice-survey": "alice-survey",
    "numpy": "numpy",
    "scipy": "scipy",
    "opencv-contrib-python-headless": "opencv",
    "pycolmap": "pycolmap",
    "open3d": "open3d",
    "open3d-cpu": "open3d",
    "numba": "numba",
    "rasterio": "rasterio",
}
"""Distributions of the packages that affect results, and their names."""


_elsewhere_s = 0.0
"""Processor time of tasks on other machines, since this process began."""


def count_elsewhere(cpu_s: float) -> None:
    """Count the processor time of a task that another machine has done for this process."""
    global _elsewhere_s
    _elsewhere_s += cpu_s


class Meter:
    """Meter of the resources this process and its descendants use since its creation."""

    def __init__(self) -> None:
        self._started_s, self._cpu_s = time.monotonic(), sum(map(cpu_s, family())) + _elsewhere_s
        self._peak_mib = 0.0
        self._lock = threading.Lock()

    def look(self) -> dict[str, float]:
        """Time, processor time and most memory until now, as files hold them.

        User and system time of this process, of those it has started, and of tasks elsewhere; the
        largest sum of their proportional memory that a look has seen.
        """
        processes = family()
        memory = sum(map(memory_mib, processes))
        with self._lock:
            self._peak_mib = max(self._peak_mib, memory)
            return {
                "took_s": round(time.monotonic() - self._started_s, 3),
                "cpu_s": round(
                    max(0.0, sum(map(cpu_s, processes)) + _elsewhere_s - self._cpu_s), 2
                ),
                "peak_mib": round(self._peak_mib, 1),
            }


@contextlib.contextmanager
def watch_meter() -> Iterator[Meter]:
    """A meter that a thread of its own reads about once a second.

    Memory that many files are mapped to takes long to count: then it is read less often.
    """
    stop, meter = threading.Event(), Meter()

    def look() -> None:
        wait_s = _EVERY_S
        while not stop.wait(wait_s):
            began_s = time.thread_time()
            meter.look()
            wait_s = max(_EVERY_S, (time.thread_time() - began_s) / _MAX_SHARE)

    thread = threading.Thread(target=look, name="meter", daemon=True)
    thread.start()
    try:
        yield meter
    finally:
        stop.set()
        thread.join()


def family(root: int | None = None) -> "list[psutil.Process]":
    """A process, this one if none is given, and all its descendants."""
    import psutil

    try:
        process = psutil.Process(root)
        return [process, *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def memory_mib(process: "psutil.Process") -> float:
    """Proportional set size, where what is shared counts once; elsewhere than on Linux all of it.

    0 of a process that has ended.
    """
    import psutil

    with contextlib.suppress(psutil.Error):
        if psutil.LINUX:
            return float(process.memory_full_info().pss / 2**20)
        return float(process.memory_info().rss / 2**20)
    return 0.0


def cpu_s(process: "psutil.Process") -> float:
    """User and system time of a process and of its children that have ended (on Linux only)."""
    import psutil

    with contextlib.suppress(psutil.Error):
        return float(sum(process.cpu_times()[:4]))
    return 0.0


def release_memory() -> None:
    """Return freed memory that libc keeps for later to the system, where libc can."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def user_lock(name: str, max_wait_s: float = -1.0) -> FileLock:
    """A lock that all processes of a user on this machine share; it is in no folder of a network.

    Args:
        name: of what is locked.
        max_wait_s: for another process, after which `filelock.Timeout` is raised; below 0
            there is no end.
    """
    return FileLock(user_folder("locks") / f"{name}.lock", timeout=max_wait_s)


def user_folder(name: str) -> Path:
    """A folder on this machine that this user alone may read and write, made when it is missing.

    Raises:
        PermissionError: it belongs to someone else, who could have put into it what is run.
    """
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(gettempdir()) / f"alice-survey-{name}-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if hasattr(os, "getuid") and (folder.stat().st_uid, folder.stat().st_mode & 0o077) != (user, 0):
        raise PermissionError(errno.EPERM, "others may write to it", str(folder))
    return folder


@cache
def processor() -> str:
    """Name of the processor."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        lines = information.read_text(encoding="utf-8", errors="replace").splitlines()
        names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
        return next(names, platform.machine())
    return platform.processor() or platform.machine()


@cache
def versions() -> dict[str, str]:
    """Versions of the installed packages that affect results."""
    found = {}
    for distribution, name in _PACKAGES.items():
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(distribution)
    return found
