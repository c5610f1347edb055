"""What a user sees of a run, on standard error: moving bars on a terminal, else a few lines."""

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, TextIO, cast

from alice_survey.base.errors import outliving, say
from alice_survey.base.run.events import Event, duration, finished, how_far

if TYPE_CHECKING:
    from rich.progress import Progress

_WORTH_TELLING_S = 2.0
_ALIVE_EVERY_S = 30.0


class ShownStep(Protocol):
    """What a bar shows of a step."""

    label: str
    done: int
    counted: bool

    @property
    def total(self) -> int | None:
        """How many items are expected; None where that is not known."""

    @property
    def elapsed_s(self) -> float:
        """Since it began."""

    @property
    def remaining_s(self) -> float | None:
        """How long it still takes; None where nothing can be said."""


class Display(Protocol):
    """What the user sees. Its methods are called one at a time, from several threads."""

    def hear(self, event: Event) -> None:
        """Something has happened."""

    def step_began(self, step: ShownStep) -> None:
        """Before its first event."""

    def step_ended(self, step: ShownStep) -> None:
        """After its last event."""

    def stage_ended(self) -> None:
        """After its last event."""

    def tick(self, event: Event) -> None:
        """The innermost of what goes on still does."""

    def close(self) -> None:
        """Nothing more comes."""


def display_on_stderr(*, quiet: bool = False) -> Display:
    """What suits where standard error goes to."""
    if quiet:
        return Quiet()
    return Bars() if sys.stderr.isatty() else Lines()


def _line_of(event: Event) -> str | None:
    """What stays on the screen of an event, if anything."""
    match event.name:
        case "warning":
            return f"warning: {event.message}"
        case "note":
            return None if event.facts.get("shown") else event.message
        case "stage_started":
            return (event.message or "") + (", resumed" if event.facts.get("resumed") else "")
        case "step_finished" if (event.elapsed_s or 0.0) > _WORTH_TELLING_S:
            return finished(event) if event.facts.get("complete", True) else None
        case "stage_finished" if event.facts["took_s"] > _WORTH_TELLING_S:
            return f"{event.stage}: done in {duration(event.facts['took_s'])}"
    return None


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


class Quiet:
    """Warnings alone."""

    def hear(self, event: Event) -> None:
        """Write a warning."""
        if event.name == "warning":
            say(f"warning: {event.message}")

    def step_began(self, step: ShownStep) -> None:
        """Say nothing."""

    def step_ended(self, step: ShownStep) -> None:
        """Say nothing."""

    def stage_ended(self) -> None:
        """Say nothing."""

    def tick(self, event: Event) -> None:
        """Say nothing."""

    def close(self) -> None:
        """Say nothing."""


class Lines:
    """A line when a stage begins and ends, when a step has taken long, and every half minute."""

    def __init__(self, clock: Callable[[], float] = lambda: time.monotonic()) -> None:
        self._clock = clock
        self._last_s = clock()

    def hear(self, event: Event) -> None:
        """Write what stays."""
        text = _line_of(event)
        if text is not None:
            self._line(text)

    def step_began(self, step: ShownStep) -> None:
        """Say nothing."""
        if self._clock() - self._last_s > _ALIVE_EVERY_S:  # there was nothing to tell of
            self._last_s = self._clock()

    def step_ended(self, step: ShownStep) -> None:
        """Say nothing: its last event has said it."""

    def stage_ended(self) -> None:
        """Say nothing: its last event has said it."""

    def tick(self, event: Event) -> None:
        """Write how far the work is, if nothing has been written for long."""
        if self._clock() - self._last_s < _ALIVE_EVERY_S:
            return
        of_stage = f"{event.stage}: " if event.stage else ""
        if event.step is None:
            self._line(f"{event.stage}: working for {duration(event.elapsed_s or 0.0)}")
        else:
            self._line(of_stage + how_far(event))

    def close(self) -> None:
        """Say nothing."""

    def _line(self, text: str) -> None:
        say(text)
        self._last_s = self._clock()


class Bars:
    """A bar for each step that goes on, and above them what stays."""

    def __init__(self) -> None:
        self._bars: Progress | None = None
        self._tasks: dict[int, Any] = {}
        self._stage: Any = None

    def hear(self, event: Event) -> None:
        """Write what stays; begin the spinner of a stage."""
        text = _line_of(event)
        if text is not None and self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False, soft_wrap=True)
        elif text is not None:
            say(text)
        if event.name == "stage_started":
            self._stage = self._begun().add_task(event.stage or "", total=None)

    def step_began(self, step: ShownStep) -> None:
        """Show a bar, or a spinner where nothing is counted."""
        bars = self._begun()
        if self._stage is not None:
            bars.update(self._stage, visible=False)
        self._tasks[id(step)] = bars.add_task(step.label, total=step.total, step=step)

    def step_ended(self, step: ShownStep) -> None:
        """Take its bar away."""
        if self._bars is not None:
            self._bars.remove_task(self._tasks.pop(id(step)))
            if not self._tasks and self._stage is not None:
                self._bars.update(self._stage, visible=True)
        self._end_if_idle()

    def stage_ended(self) -> None:
        """Take its spinner away."""
        if self._bars is not None and self._stage is not None:
            self._bars.remove_task(self._stage)
        self._stage = None
        self._end_if_idle()

    def tick(self, event: Event) -> None:
        """Say nothing: the bars move by themselves."""

    def close(self) -> None:
        """Leave the terminal as it was."""
        self._tasks.clear()
        self._stage = None
        self._end_if_idle()

    def _begun(self) -> "Progress":
        if self._bars is None:
            self._bars = _bars()
            self._bars.start()
        return self._bars

    def _end_if_idle(self) -> None:
        if self._bars is not None and not self._tasks and self._stage is None:
            self._bars.stop()
            self._bars = None


def _bars() -> "Progress":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
    from rich.text import Text

    class Far(ProgressColumn):
        """How many are done, how long it has taken, how long it still takes."""

        def render(self, task: Task) -> Text:
            step: ShownStep | None = task.fields.get("step")
            if step is None:
                return Text(duration(task.elapsed or 0.0))
            count = ""
            if step.counted:
                total = step.total
                count = f"{step.done}, " if total is None else f"{step.done} of {total}, "
            left_s = step.remaining_s
            left = "" if left_s is None else f", about {duration(left_s)} left"
            return Text(f"{count}{duration(step.elapsed_s)}{left}")

    class Moving(BarColumn):
        """A bar where items are counted."""

        def render(self, task: Task) -> Any:
            step: ShownStep | None = task.fields.get("step")
            total = None if step is None else step.total
            if step is None or total is None:
                return Text("")
            task.completed, task.total = min(step.done, total), total
            return super().render(task)

    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        Moving(bar_width=30),
        Far(),
        console=Console(file=cast(TextIO, _Outlived(sys.stderr))),
        transient=True,
        redirect_stdout=False,
        refresh_per_second=8,
    )
