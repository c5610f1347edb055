"""What happens during a run, as events, and the files that can take them down.

An events file holds one JSON object a line, a log file one line of text an event; both are only
ever added to, and a file that can no longer be written costs a warning, never the run.
"""

import contextlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from alice_survey.base.errors import WorkspaceError

_LOGGED_EVERY_S = 30.0
_LEVELS = {"warning": "WARNING", "error": "ERROR"}


@dataclass(frozen=True, kw_only=True)
class Event:
    """One thing that has happened."""

    name: str
    time_s: float
    """Seconds since 1970, UTC."""
    stage: str | None = None
    step: str | None = None
    step_number: int | None = None
    """Of the steps of a run, from 1 on: what tells two of the same name apart."""
    done: int | None = None
    total: int | None = None
    elapsed_s: float | None = None
    """Of the step, the stage or the run, whichever the event is of."""
    remaining_s: float | None = None
    message: str | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    """What else there is to say, as JSON values."""

    @property
    def time_utc(self) -> str:
        """To the millisecond, as ISO 8601."""
        told = datetime.fromtimestamp(self.time_s, UTC).isoformat(timespec="milliseconds")
        return told.replace("+00:00", "Z")

    def to_json(self) -> dict[str, Any]:
        """What is known, in the order of the documentation."""
        told: dict[str, Any] = {
            "time_utc": self.time_utc,
            "event": self.name,
            "stage": self.stage,
            "step": self.step,
            "step_number": self.step_number,
            "done": self.done,
            "total": self.total,
            "elapsed_s": None if self.elapsed_s is None else round(self.elapsed_s, 3),
            "remaining_s": None if self.remaining_s is None else round(self.remaining_s, 1),
            "message": self.message,
        }
        return {**{key: value for key, value in told.items() if value is not None}, **self.facts}


class Sink(Protocol):
    """Takes events down."""

    def hear(self, event: Event) -> None:
        """Take one down; called in order, from one thread at a time.

        Raises:
            OSError: it cannot be written.
        """

    def close(self) -> None:
        """Nothing more comes."""


class _Appended:
    """A file to whose end whole lines are written, at once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
            self._file = os.open(path, flags, 0o666)
            with contextlib.suppress(OSError), path.open("rb") as file:
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":  # a line that a full disk has cut
                    os.write(self._file, b"\n")
        except OSError as error:
            raise WorkspaceError(
                f"{path} cannot be written: {(error.strerror or str(error)).lower()}"
            ) from None

    def write(self, line: str) -> None:
        rest = memoryview(line.encode("utf-8", "backslashreplace"))
        while rest:
            rest = rest[os.write(self._file, rest) :]

    def close(self) -> None:
        os.close(self._file)


class EventFile:
    """Events as JSON lines."""

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            WorkspaceError: it cannot be written.
        """
        self._file = _Appended(path)

    def __str__(self) -> str:
        return f"events file {self._file.path}"

    def hear(self, event: Event) -> None:
        """Write a line."""
        self._file.write(json.dumps(event.to_json(), allow_nan=False) + "\n")

    def close(self) -> None:
        """Close it."""
        self._file.close()


class LogFile:
    """Events as lines of time, level and text."""

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            WorkspaceError: it cannot be written.
        """
        self._file = _Appended(path)
        self._last_s: dict[int | None, float] = {}

    def __str__(self) -> str:
        return f"log file {self._file.path}"

    def hear(self, event: Event) -> None:
        """Write what a reader wants to know."""
        if event.name == "step_progress":
            elapsed_s = event.elapsed_s or 0.0
            if elapsed_s - self._last_s.get(event.step_number, 0.0) < _LOGGED_EVERY_S:
                return
            self._last_s[event.step_number] = elapsed_s
        level = _LEVELS.get(event.name, "INFO")
        first, *more = described(event).splitlines() or [""]
        lines = [f"{event.time_utc} {level} {first}", *(f"    {line}" for line in more)]
        self._file.write("\n".join(lines) + "\n")

    def close(self) -> None:
        """Close it."""
        self._file.close()


def described(event: Event) -> str:
    """An event in words; further lines are details."""
    text = event.message or ""
    facts = event.facts
    of_stage = f"{event.stage}: " if event.stage else ""
    match event.name:
        case "run_started":
            told = ", ".join(f"{name} {number}" for name, number in facts["versions"].items())
            return f"run started: {facts['command']}\nin {facts['folder']}, with {told}"
        case "run_finished":
            return (
                f"run finished: exit code {facts['exit_code']} after {event.elapsed_s or 0:.1f} s"
            )
        case "stage_started":
            return f"stage {text}" + (", resumed" if facts.get("resumed") else "")
        case "stage_skipped":
            return f"{of_stage}up to date"
        case "stage_finished":
            return (
                f"{of_stage}finished in {facts['took_s']:.1f} s, {facts['cpu_s']:.1f} s of "
                f"processor time, {facts['peak_mib']:.0f} MiB at most"
            )
        case "step_started":
            return f"{of_stage}{event.step} ..."
        case "step_progress":
            return f"{of_stage}{how_far(event)}"
        case "step_finished":
            return f"{of_stage}{finished(event)}"
        case "error" if "traceback" in facts:
            return f"{text}\n{facts['traceback'].rstrip()}"
    return text


def how_far(event: Event) -> str:
    """A step that runs: how far, how long already, how long still."""
    count = ""
    if event.done is not None:
        count = f" {event.done}" + ("" if event.total is None else f" of {event.total}")
    left = "" if event.remaining_s is None else f", about {duration(event.remaining_s)} left"
    return f"{event.step}{count} after {duration(event.elapsed_s or 0.0)}{left}"


def finished(event: Event) -> str:
    """A step that has ended, or was given up."""
    took = f"{event.elapsed_s or 0.0:.1f} s"
    count = "" if event.done is None else f"{event.done} "
    how = "done in" if event.facts.get("complete", True) else "given up after"
    return f"{event.step}: {count}{how} {took}"


def duration(seconds: float) -> str:
    """A length of time in words."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest:02} s"
    return f"{minutes // 60} h {minutes % 60:02} min"
