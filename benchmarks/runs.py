"""Running a part in a process of its own: its log, its figures, and how far it is."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.machine import load

_LINE_EVERY_S, _SCREEN_EVERY_S = 30.0, 1.0
_PATIENCE_S = 10.0
"""How long a process has to end when it is signalled."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of a part."""

    code: int
    wall_s: float
    load_before: str
    load_after: str
    log: Path
    report: dict[str, Any] | None
    """What it handed over; None where it ended before."""

    @property
    def trouble(self) -> str | None:
        """Why it is not a measurement, though goals may be missed; None where it is one."""
        if self.report is None:
            return f"ended with exit code {self.code}: {_last_line(self.log)}"
        if self.report["failed"]:
            return "; ".join(self.report["failed"])
        if self.code and not self.report["missed"]:
            return f"ended with exit code {self.code} after its figures: {_last_line(self.log)}"
        return None


def run(command: Sequence[str], logs: Path, name: str, on_wait: Callable[[float], None]) -> Run:
    """Run a benchmark and read what it hands over.

    Args:
        command: for this Python; `--json` is added.
        logs: folder for what it says, `<name>.log`, and its figures, `<name>.json`.
        name: of the run.
        on_wait: called with the seconds so far, now and then.
    """
    logs.mkdir(parents=True, exist_ok=True)
    log, figures = logs / f"{name}.log", logs / f"{name}.json"
    figures.unlink(missing_ok=True)
    before, started = load(), time.perf_counter()
    every_s = _SCREEN_EVERY_S if sys.stderr.isatty() else _LINE_EVERY_S
    with log.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, *command, "--json", str(figures)],
            stdout=file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            while True:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    code = process.wait(every_s)
                    break
                on_wait(time.perf_counter() - started)
        finally:
            _end(process)
    return Run(
        code=code,
        wall_s=time.perf_counter() - started,
        load_before=before,
        load_after=load(),
        log=log,
        report=json.loads(figures.read_text()) if figures.exists() else None,
    )


def report(text: str, *, passing: bool = False) -> None:
    """Say on standard error what goes on; on a screen, a passing line gives way to the next."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="" if passing else "\n", file=sys.stderr, flush=True)
    else:
        print(text, file=sys.stderr, flush=True)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process that still runs, with all its children."""
    if process.poll() is not None:
        return
    os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else "it said nothing"
