"""What a run has reported so far, from the lines of its events file."""

import json
from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from alice_survey.core.run.events import Event, described

KEPT_LINES = 2000
_KEPT_WARNINGS = 100
_LOGGED_EVERY_S = 30.0
_MAX_LINE = 4000
_CHUNK = 1 << 20
_KINDS = {"warning": "warning", "error": "error"}


class Heard:
    """State of a run as its events tell it."""

    def __init__(self) -> None:
        """Nothing is heard yet."""
        self.process: int | None = None
        self.command = ""
        self.stage, self.title = "", ""
        self.finished: list[str] = []
        """Stages that it has finished or found up to date."""
        self.warnings: deque[str] = deque(maxlen=_KEPT_WARNINGS)
        self.warned = 0
        self.error = ""
        self.result = ""
        self.exit_code: int | None = None
        self.lines: deque[dict[str, str]] = deque(maxlen=KEPT_LINES)
        self.lines_n = 0
        """Lines of the log so far, also those that are no longer kept."""
        self._steps: dict[int, Event] = {}
        self._logged_s: dict[int, float] = {}

    def take(self, events: Iterable[Event]) -> bool:
        """Hear more events, in their order; tell whether there were any."""
        any_heard = False
        for event in events:
            any_heard = True
            self._take(event)
        return any_heard

    @property
    def steps(self) -> list[dict[str, Any]]:
        """The steps that run, outer ones first."""
        kept = ("step", "done", "total", "elapsed_s", "remaining_s")
        return [{key: step.get(key) for key in kept} for step in self._steps.values()]

    def log(self, after: int = 0) -> list[dict[str, str]]:
        """Lines of the log that are kept, after some number of them."""
        dropped = self.lines_n - len(self.lines)
        return list(self.lines)[max(0, after - dropped) :]

    def end(self) -> None:
        """The run is over, however it ended."""
        self._steps.clear()

    def _take(self, event: Event) -> None:
        name, text = event.get("event"), str(event.get("message", ""))
        number = int(event.get("step_number", 0))
        match name:
            case "run_started":
                self.process, self.command = event.get("process"), str(event.get("command", ""))
            case "stage_started":
                self.stage, self.title = str(event.get("stage", "")), text
            case "stage_finished" | "stage_skipped":
                self.finished.append(str(event.get("stage", "")))
            case "step_started" | "step_progress":
                self._steps[number] = event
            case "step_finished":
                self._steps.pop(number, None)
            case "warning":
                self.warnings.append(text)
                self.warned += 1
            case "error":
                self.error = text
            case "result":
                self.result = text
            case "run_finished":
                self.exit_code = event.get("exit_code")
        if name == "step_progress":
            elapsed_s = float(event.get("elapsed_s", 0.0))
            if elapsed_s - self._logged_s.get(number, 0.0) < _LOGGED_EVERY_S:
                return
            self._logged_s[number] = elapsed_s
        self._add_line(event)

    def _add_line(self, event: Event) -> None:
        try:
            text = described(event)
        except (KeyError, TypeError, ValueError):  # of another version of the program
            text = str(event.get("message", event.get("event", "")))
        self.lines.append(
            {
                "time_utc": str(event.get("time_utc", "")),
                "kind": _KINDS.get(str(event.get("event")), "note"),
                "text": text[:_MAX_LINE],
            }
        )
        self.lines_n += 1


class EventsTail:
    """The whole lines that are added to an events file."""

    def __init__(self, path: Path) -> None:
        """Take a file that may not be there yet."""
        self._path, self._at, self._rest = path, 0, b""

    def read(self) -> list[Event]:
        """Events that came since the last call; a line that is damaged is left out."""
        events: list[Event] = []
        try:
            with self._path.open("rb") as file:
                file.seek(self._at)
                while chunk := file.read(_CHUNK):
                    self._at += len(chunk)
                    *lines, self._rest = (self._rest + chunk).split(b"\n")
                    events += [event for line in lines if (event := _event_in(line))]
        except FileNotFoundError:
            return []
        return events


def _event_in(line: bytes) -> Event | None:
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return dict(event) if isinstance(event, Mapping) else None
