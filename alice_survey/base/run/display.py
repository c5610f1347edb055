"""Output of a run on standard error: progress bars on a terminal, else a few lines."""

import logging
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TextIO, cast

from alice_survey.base.errors import outliving, say
from alice_survey.base.run.events import Event, duration, event_of, finished, how_far

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_LONG_S = 2.0
"""A step or a stage that took less gets no line."""
_ALIVE_EVERY_S = 30.0


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
        self.bars = Bars() if not quiet and sys.stderr.isatty() else None
        self._clock = clock
        self._last_s = clock()

    def emit(self, record: logging.LogRecord) -> None:
        """Write the line of an event, if it has one."""
        text = _line_of(event_of(record))
        if text is not None:
            self._write(text)

    def tick(self, event: Event) -> None:
        """Write the progress of the innermost work, if nothing was written for long.

        Args:
            event: `step_progress` of a step, or the name and time of a stage.
        """
        if self.quiet or self.bars or self._clock() - self._last_s < _ALIVE_EVERY_S:
            return
        of_stage = f"{event['stage']}: " if "stage" in event else ""
        how = how_far(event) if "step" in event else f"working for {duration(event['elapsed_s'])}"
        self._write(of_stage + how)

    def rest(self) -> None:
        """Reset the silence timer: nothing was running until now."""
        if self._clock() - self._last_s > _ALIVE_EVERY_S:
            self._last_s = self._clock()

    def close(self) -> None:
        """Restore the terminal."""
        if self.bars:
            self.bars.clear()
        super().close()

    def _write(self, text: str) -> None:
        (self.bars.write if self.bars else say)(text)
        self._last_s = self._clock()


def _line_of(event: Event) -> str | None:
    """Permanent text of an event on the screen, if any."""
    match event["event"]:
        case "warning":
            return f"warning: {event['message']}"
        case "note":
            return None if event.get("shown") else str(event["message"])
        case "stage_started":
            return str(event["message"]) + (", resumed" if event.get("resumed") else "")
        case "step_finished" if event["elapsed_s"] > _LONG_S:
            return finished(event) if event["complete"] else None
        case "stage_finished" if event["took_s"] > _LONG_S:
            return f"{event['stage']}: done in {duration(event['took_s'])}"
    return None


class Bars:
    """A progress bar at the foot of a terminal for each running stage and step."""

    def __init__(self) -> None:
        self._shown: Progress | None = None
        self._tasks: dict[object, TaskID] = {}

    def show(
        self,
        key: object,
        label: str,
        done: int | None = None,
        total: int | None = None,
        left_s: float | None = None,
    ) -> None:
        """Show the progress of a stage or step; only a spinner where nothing is counted."""
        if self._shown is None:
            self._shown = _bars()
            self._shown.start()
        if key not in self._tasks:
            self._tasks[key] = self._shown.add_task(label, total=None, count="", left="")
        self._shown.update(
            self._tasks[key],
            completed=done or 0,
            total=total,
            count="" if done is None else f"{done}" if total is None else f"{done} of {total}",
            left="" if left_s is None else f"about {duration(left_s)} left",
        )

    def remove(self, key: object) -> None:
        """Remove a bar."""
        if self._shown is not None and key in self._tasks:
            self._shown.remove_task(self._tasks.pop(key))
        if not self._tasks:
            self.clear()

    def clear(self) -> None:
        """Remove all bars and restore the terminal."""
        self._tasks.clear()
        if self._shown is not None:
            self._shown.stop()
            self._shown = None

    def write(self, text: str) -> None:
        """Write a line above the bars."""
        if self._shown is None:
            say(text)
        else:
            self._shown.console.print(text, markup=False, highlight=False, soft_wrap=True)


class _Outlived:
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


def _bars() -> "Progress":
    from rich.console import Console as Terminal
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[count]}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
        console=Terminal(file=cast(TextIO, _Outlived(sys.stderr))),
        transient=True,
        redirect_stdout=False,
        refresh_per_second=8,
    )
