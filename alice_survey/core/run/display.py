"""Output of a run on standard error: progress bars on a terminal, else a few lines."""

import logging
import sys
import time
from collections.abc import Callable
from typing import Any, TextIO, cast

from rich.console import Console as Terminal
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as RemainingColumn

from alice_survey.core.errors import outliving, say
from alice_survey.core.run.events import Event, duration, event_of, how_far, step_end_text

_LONG_S = 2.0
"""A step or a stage that took less gets no line."""
_ALIVE_EVERY_S = 30.0
_PACE_S = 300.0
"""Recent time that the remaining time of a step is estimated from."""


class Console(logging.Handler):
    """Plain lines: warnings, notes, stages, and steps that took long."""

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
        event = event_of(record)
        silent = self._clock() - self._last_s >= _ALIVE_EVERY_S
        if event["event"] == "step_started" and silent:
            self._last_s = self._clock()  # nothing was running until now
        text = _line_of(event, alive=silent and not self.has_bars)
        if text is not None:
            say(text)
            self._last_s = self._clock()


def _line_of(event: Event, *, alive: bool) -> str | None:
    """Permanent text of an event on the screen, if any.

    Args:
        event: what has happened, or the progress of running work.
        alive: whether that progress is shown too.
    """
    match event["event"]:
        case "warning":
            return f"warning: {event['message']}"
        case "note":
            return None if event.get("shown") else str(event["message"])
        case "stage_started":
            return str(event["message"]) + (", resumed" if event.get("resumed") else "")
        case "step_progress" if alive:
            return (f"{event['stage']}: " if "stage" in event else "") + how_far(event)
        case "stage_runs" if alive:
            return f"{event['stage']}: working for {duration(event['elapsed_s'])}"
        case "step_finished" if event["elapsed_s"] > _LONG_S:
            return step_end_text(event) if event["complete"] else None
        case "stage_finished" if event["took_s"] > _LONG_S:
            return f"{event['stage']}: done in {duration(event['took_s'])}"
    return None


class _OutlivedTerminal:
    """A terminal that may close while the work goes on."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> int:
        with outliving():
            self._file.write(text)
        return len(text)

    def flush(self) -> None:
        with outliving():
            self._file.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def progress_bars(clock: Callable[[], float], *, shown: bool) -> Progress:
    """Progress of running stages and steps, each a bar at the foot of a terminal if shown."""
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[count]}"),
        TimeElapsedColumn(),
        RemainingColumn(compact=True),
        console=Terminal(file=cast(TextIO, _OutlivedTerminal(sys.stderr))),
        transient=True,
        redirect_stdout=False,
        refresh_per_second=8,
        speed_estimate_period=_PACE_S,
        get_time=clock,
        disable=not shown,
    )
