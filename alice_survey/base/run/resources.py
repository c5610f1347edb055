"""What work takes: processor time and memory of a process with all its descendants."""

import contextlib
import ctypes
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

_EVERY_S = 1.0
_TOLD_EVERY_S = 5.0
_PACKAGES = {
    "alice-survey": "alice-survey",
    "numpy": "numpy",
    "scipy": "scipy",
    "opencv": "opencv-contrib-python-headless",
    "pycolmap": "pycolmap",
    "open3d": "open3d",
    "numba": "numba",
    "rasterio": "rasterio",
}
"""Those that decide results, and the distributions that hold them."""


@dataclass(frozen=True, kw_only=True)
class Spent:
    """What work has taken so far."""

    took_s: float = 0.0
    cpu_s: float = 0.0
    """User and system time of this process and of those it has started."""
    peak_mib: float = 0.0
    """Largest sum of their proportional memory, seen about once a second."""

    def after(self, earlier: "Spent") -> "Spent":
        """Both together, one after the other."""
        return Spent(
            took_s=self.took_s + earlier.took_s,
            cpu_s=self.cpu_s + earlier.cpu_s,
            peak_mib=max(self.peak_mib, earlier.peak_mib),
        )

    def to_json(self) -> dict[str, float]:
        """Rounded, for files."""
        return {
            "took_s": round(self.took_s, 3),
            "cpu_s": round(self.cpu_s, 2),
            "peak_mib": round(self.peak_mib, 1),
        }

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> "Spent":
        """What `to_json` wrote.

        Raises:
            KeyError, TypeError, ValueError: it is something else.
        """
        return Spent(**{name: float(data[name]) for name in ("took_s", "cpu_s", "peak_mib")})


class Meter:
    """Counts what this process and its descendants spend, from its making on."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._started, self._cpu_s = clock(), cpu_s(os.getpid())
        self._peak_mib = 0.0
        self._lock = threading.Lock()

    def look(self) -> Spent:
        """What has been spent until now."""
        family = family_of(os.getpid())
        memory_mib = sum(memory_mib_of(pid) for pid in family)
        with self._lock:
            self._peak_mib = max(self._peak_mib, memory_mib)
            return Spent(
                took_s=self._clock() - self._started,
                cpu_s=max(0.0, cpu_s(os.getpid(), family) - self._cpu_s),
                peak_mib=self._peak_mib,
            )


@contextlib.contextmanager
def watched(meter: Meter, told: Callable[[Spent], None]) -> Iterator[None]:
    """Look at a meter about once a second from a thread of its own, and tell every few seconds.

    Args:
        meter: to look at.
        told: called from that thread.
    """
    stop = threading.Event()

    def look() -> None:
        since_s = 0.0
        while not stop.wait(_EVERY_S):
            spent = meter.look()
            since_s += _EVERY_S
            if since_s >= _TOLD_EVERY_S:
                since_s = 0.0
                told(spent)

    thread = threading.Thread(target=look, name="meter", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def family_of(root: int) -> list[int]:
    """A process and all its descendants."""
    family, waiting = [], [root]
    while waiting:
        pid = waiting.pop()
        family.append(pid)
        try:
            for task in Path(f"/proc/{pid}/task").iterdir():
                waiting += [int(child) for child in (task / "children").read_text().split()]
        except OSError:
            continue  # it has ended meanwhile
    return family


def memory_mib_of(pid: int) -> float:
    """Proportional set size: what is shared counts once; 0 of a process that has ended."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return 0.0
    return next((int(s.split()[1]) / 1024 for s in text.splitlines() if s.startswith("Pss:")), 0.0)


def release_memory() -> None:
    """Give memory back to the system that was freed but is kept for later, where libc can."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def cpu_s(root: int, family: list[int] | None = None) -> float:
    """User and system time of a process, of its descendants and of those that have ended."""
    return sum(_cpu_s_of(pid) for pid in family or family_of(root))


def _cpu_s_of(pid: int) -> float:
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0.0
    fields = text.rsplit(")", 1)[1].split()
    return sum(int(ticks) for ticks in fields[11:15]) / os.sysconf("SC_CLK_TCK")


@cache
def versions() -> dict[str, str]:
    """Versions of the packages that decide results; without those that are not installed."""
    found = {}
    for name, distribution in _PACKAGES.items():
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(distribution)
    return found
