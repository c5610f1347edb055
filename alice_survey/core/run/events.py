"""Events of a run, and where they go: lines on standard error, and a file of JSON lines.

A file holds one JSON object a line and is only ever added to; one that can no longer be written
costs a warning, never the run.
"""

import contextlib
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from alice_survey.core.errors import WorkspaceError, say, warn, why

_LONG_S = 2.0
"""A step or a stage that took less gets no line."""
_ALIVE_EVERY_S = 30.0
_LOCK = threading.RLock()
"""Lock of all files: one that cannot be written warns, and the others record that."""

Event = dict[str, Any]
"""One thing that has happened: the keys and JSON values of a line of an events file, in the order
of the documentation; what is not known is left out."""


def event_of(record: logging.LogRecord) -> Event:
    """The event that a run has put into a record."""
    event: Event = vars(record)["event"]
    return event


class Console(logging.Handler):
    """Plain lines on standard error: warnings, notes, stages, and steps that took long."""

    def __init__(
        self, *, quiet: bool = False, clock: Callable[[], float] = lambda: time.monotonic()
    ) -> None:
        """Begin.

        Args:
            quiet: show warnings alone.
            clock: monotonic, s.
        """
        super().__init__(logging.WARNING if quiet else logging.INFO)
        self.quiet = quiet
        self.has_bars = not quiet and sys.stderr.isatty()
        self._clock = clock
        self._last_s = clock()

    def emit(self, record: logging.LogRecord) -> None:
        """Write the line of an event, if it has one."""
        event, now_s = event_of(record), self._clock()
        silent = now_s - self._last_s >= _ALIVE_EVERY_S
        match event["event"]:
            case "note":
                has_line = not event.get("shown")
            case "step_progress" | "stage_runs":
                has_line = silent and not self.has_bars
            case "step_finished":
                has_line = event["complete"] and event["elapsed_s"] > _LONG_S
            case "stage_finished":
                has_line = event["took_s"] > _LONG_S
            case name:
                has_line = name in ("warning", "stage_started")
        if has_line:
            say(("warning: " if event["event"] == "warning" else "") + event_text(event))
        if has_line or (silent and event["event"] == "step_started"):
            self._last_s = now_s  # before such a step nothing was running


class EventFile(logging.FileHandler):
    """A file to whose end events are written at once, each as a line of JSON."""

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            WorkspaceError: it cannot be written.
        """
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            super().__init__(path, encoding="utf-8")
            with contextlib.suppress(OSError), path.open("rb") as file:
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n" and self.stream:  # a line that a full disk has cut
                    self.stream.write("\n")
        except OSError as error:
            raise WorkspaceError(f"{path} cannot be written: {why(error)}") from None

    def createLock(self) -> None:  # noqa: N802 (a name of logging)
        """Share one lock."""
        self.lock = _LOCK

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        return json.dumps(event_of(record), allow_nan=False)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (a name of logging)
        """Write no further."""
        error = sys.exception()
        if not isinstance(error, OSError):
            super().handleError(record)
            return
        self.setLevel(logging.CRITICAL + 1)
        warn(f"the log file {self.path} is written no further: {why(error)}")

    def close(self) -> None:
        """Close it; what a full disk could not take is lost."""
        with contextlib.suppress(OSError):
            super().close()


def event_text(event: Event) -> str:
    """An event in words."""
    text, stage = str(event.get("message", "")), event.get("stage", "")
    of_stage = f"{stage}: " if stage else ""
    took_s: Any = event.get("took_s", event.get("elapsed_s", 0.0))
    match event["event"]:
        case "run_started":
            return f"run started: {event['command']}"
        case "run_finished":
            return f"run finished: exit code {event['exit_code']} after {duration(took_s)}"
        case "stage_started":
            return text + (", resumed" if event.get("resumed") else "")
        case "stage_skipped":
            return f"{of_stage}up to date"
        case "stage_runs":
            return f"{of_stage}working for {duration(took_s)}"
        case "stage_finished":
            return f"{of_stage}done in {duration(took_s)}, {event['peak_mib']:.0f} MiB at most"
        case "step_started" | "step_progress" | "step_finished":
            return of_stage + _step_text(event)
    return text


def _step_text(event: Event) -> str:
    """How far a step is, with its elapsed and its remaining time, or how it has ended."""
    step, took = event["step"], duration(event["elapsed_s"])
    count = f" {event['done']}" if "done" in event else ""
    total = f" of {event['total']}" if count and "total" in event else ""
    left = f", about {duration(event['remaining_s'])} left" if "remaining_s" in event else ""
    if event["event"] == "step_finished":
        return f"{step}:{count} {'done in' if event['complete'] else 'given up after'} {took}"
    return f"{step}{count}{total} after {took}{left}"


def duration(seconds: float) -> str:
    """A duration in words."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02} s" if minutes else f"{rest} s"
    return f"{minutes // 60} h {minutes % 60:02} min"
