"""Events of a run, and the files that record them.

An events file holds one JSON object a line, a log file one line of text an event; both are only
ever added to, and a file that can no longer be written costs a warning, never the run.
"""

import contextlib
import json
import logging
import os
import sys
import threading
from pathlib import Path
from typing import Any, ClassVar

from alice_survey.core.errors import WorkspaceError, warn, why

_LOGGED_EVERY_S = 30.0
_LOCK = threading.RLock()
"""Lock of all files: one that cannot be written warns, and the others record that."""

Event = dict[str, Any]
"""One thing that has happened: the keys and JSON values of a line of an events file, in the order
of the documentation; what is not known is left out."""


def event_of(record: logging.LogRecord) -> Event:
    """The event that a run has put into a record."""
    event: Event = vars(record)["event"]
    return event


class _LinesFile(logging.FileHandler):
    """A file to whose end whole lines are written, at once."""

    kind: ClassVar[str]

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            WorkspaceError: it cannot be written.
        """
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            super().__init__(path, encoding="utf-8", errors="backslashreplace")
            with contextlib.suppress(OSError), path.open("rb") as file:
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n" and self.stream:  # a line that a full disk has cut
                    self.stream.write("\n")
        except OSError as error:
            raise WorkspaceError(f"{path} cannot be written: {why(error)}") from None

    def createLock(self) -> None:  # noqa: N802 (a name of logging)
        """Share one lock."""
        self.lock = _LOCK

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (a name of logging)
        """Write no further."""
        error = sys.exception()
        if not isinstance(error, OSError):
            super().handleError(record)
            return
        self.setLevel(logging.CRITICAL + 1)
        warn(f"the {self.kind} file {self.path} is written no further: {why(error)}")

    def close(self) -> None:
        """Close it; what a full disk could not take is lost."""
        with contextlib.suppress(OSError):
            super().close()


class EventFile(_LinesFile):
    """Events as JSON lines."""

    kind = "events"

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        return json.dumps(event_of(record), allow_nan=False)


class LogFile(_LinesFile):
    """Events as lines of time, level and text."""

    kind = "log"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._last_s: dict[int, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Write the events that matter to a reader."""
        event = event_of(record)
        if event["event"] == "step_progress":
            number, elapsed_s = event["step_number"], event["elapsed_s"]
            if elapsed_s - self._last_s.get(number, 0.0) < _LOGGED_EVERY_S:
                return
            self._last_s[number] = elapsed_s
        super().emit(record)

    def format(self, record: logging.LogRecord) -> str:
        """A line of time, level and text; details are indented."""
        event = event_of(record)
        lines = event_text(event).splitlines() or [""]
        return f"{event['time_utc']} {record.levelname} " + "\n    ".join(lines)


def event_text(event: Event) -> str:
    """An event in words; further lines are details."""
    text = event.get("message", "")
    of_stage = f"{event['stage']}: " if "stage" in event else ""
    match event["event"]:
        case "run_started":
            versions = ", ".join(f"{name} {number}" for name, number in event["versions"].items())
            return f"run started: {event['command']}\nin {event['folder']}, with {versions}"
        case "run_finished":
            return f"run finished: exit code {event['exit_code']} after {event['elapsed_s']:.1f} s"
        case "stage_started":
            return f"stage {text}" + (", resumed" if event.get("resumed") else "")
        case "stage_skipped":
            return f"{of_stage}up to date"
        case "stage_finished":
            return (
                f"{of_stage}finished in {event['took_s']:.1f} s, {event['cpu_s']:.1f} s of "
                f"processor time, {event['peak_mib']:.0f} MiB at most"
            )
        case "step_started":
            return f"{of_stage}{event['step']} ..."
        case "step_progress":
            return f"{of_stage}{how_far(event)}"
        case "step_finished":
            return f"{of_stage}{step_end_text(event)}"
        case "error" if "traceback" in event:
            return f"{text}\n{event['traceback'].rstrip()}"
    return str(text)


def how_far(event: Event) -> str:
    """Progress of a running step, its elapsed time and its remaining time."""
    count = f" {event['done']}" if "done" in event else ""
    total = f" of {event['total']}" if count and "total" in event else ""
    left = f", about {duration(event['remaining_s'])} left" if "remaining_s" in event else ""
    return f"{event['step']}{count}{total} after {duration(event['elapsed_s'])}{left}"


def step_end_text(event: Event) -> str:
    """A step that has ended, or was given up."""
    count = f"{event['done']} " if "done" in event else ""
    how = "done in" if event.get("complete", True) else "given up after"
    return f"{event['step']}: {count}{how} {event['elapsed_s']:.1f} s"


def duration(seconds: float) -> str:
    """A duration in words."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest:02} s"
    return f"{minutes // 60} h {minutes % 60:02} min"
