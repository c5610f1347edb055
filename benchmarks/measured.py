"""Wall time and peak memory of a command with all its children."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from alice_survey.core.run.resources import family, memory_mib

_EVERY_S, _SURELY_EVERY_S = 0.2, 2.0
"""Between looks at the memory of a command; it takes the kernel 6 ms a process to share it out, so
that it is only used where the plain sum has grown, and now and then."""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a command took."""

    wall_s: float
    cpu_s: float
    """Of all its processes: on a busy machine a fairer measure than the wall."""
    peak_mib: float
    """Largest sum of the proportional memory of all its processes."""
    code: int
    log: Path
    stopped: bool = False
    """Whether it took longer than it was given."""

    @property
    def ok(self) -> bool:
        """Whether it ended well."""
        return self.code == 0

    def last_line(self) -> str:
        """The end of what it said: the error, if there was one."""
        if self.stopped:
            return f"stopped after {self.wall_s:.0f} s"
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1][:160] if lines else ""


def measured(command: Sequence[str], log: Path, timeout_s: float = 7200.0) -> Cost:
    """Run a command; what it says goes to a log."""
    log.parent.mkdir(parents=True, exist_ok=True)
    before = os.times()
    started, peak, late = time.perf_counter(), 0.0, False
    looked, maximum = -_SURELY_EVERY_S, 0.0
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        try:
            while process.poll() is None:
                running, now = family(process.pid), time.perf_counter() - started
                plain = sum(map(_resident_mib, running))
                if plain > maximum or now > looked + _SURELY_EVERY_S:
                    peak = max(peak, sum(map(memory_mib, running)))
                    looked, maximum = now, max(maximum, plain)
                if late := now > timeout_s:
                    break
                time.sleep(_EVERY_S)
        finally:
            if process.poll() is None:
                for child in family(process.pid):
                    child.terminate()
                process.wait()
    after = os.times()
    return Cost(
        wall_s=time.perf_counter() - started,
        cpu_s=after.children_user + after.children_system
        - before.children_user - before.children_system,
        peak_mib=peak,
        code=process.returncode,
        log=log,
        stopped=late,
    )  # fmt: skip


def _resident_mib(process: psutil.Process) -> float:
    """Resident memory of a process, what it shares included; 0 of one that has ended."""
    try:
        return float(process.memory_info().rss / 2**20)
    except psutil.Error:
        return 0.0


def python(*arguments: str) -> list[str]:
    """A command for this interpreter."""
    return [sys.executable, *arguments]
