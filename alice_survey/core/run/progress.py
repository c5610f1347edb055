"""Progress of a run: what it is doing, how much is done and the remaining time.

Work is reported through three context managers, `part`, `stage` and `step`, wherever it is done.
Reports become events, records of the package's logger, which the screen and an events file take
from there.
"""

import contextlib
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, TextIO, cast

from rich.console import Console as Terminal
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from alice_survey.core.errors import LOG, is_in_task, outliving
from alice_survey.core.run.events import Console, Event

_REPORTED_EVERY_S = 0.5
"""Time between two progress events of a step."""
_ALIVE_EVERY_S = 5.0
"""Time between two such events where nothing changes."""
_TICK_S = 1.0
_PACE_S = 300.0
"""Recent time that the remaining time of a step is estimated from."""
_COMPILES = "compiling (once on this machine)"
_IDLE_S = 5.0
"""Besides twice the time of the longest kernel: no more is compiled then."""
_LEVELS = {"warning": logging.WARNING, "error": logging.ERROR}

_QUANTILES = 101
"""Processor times of a step's tasks that are reported, where it has more."""

Clock = Callable[[], float]


@dataclass(frozen=True)
class TaskSpent:
    """What a task has cost."""

    cpu_s: float
    sent_bytes: int = 0
    """Its arguments, where they went to another machine."""
    received_bytes: int = 0
    """Its result, from there."""


class Step:
    """A running part of a stage."""

    def __init__(self, run: "Run", label: str, number: int, total: int | None) -> None:
        self._run = run
        self.label, self.number, self.total = label, number, total
        self.done = None if total is None else 0
        self.task = run.begin_task(label, total)
        self.reported_s = run.clock()
        self.begun_s = 0.0
        """Time spent so far on an item that is not done, where it is known."""
        self._spent: list[TaskSpent] = []

    def advance(self, items: int = 1, *, spent: TaskSpent | None = None) -> None:
        """Count more items as done, one of them a task that has cost something."""
        if spent is not None:
            self._spent.append(spent)
        self.done = (self.done or 0) + items
        if self.total is not None and self.done > self.total:
            self.total = self.task.total = None  # more than expected: their number is open
        self._run.advance(self, items)

    @property
    def cost(self) -> dict[str, Any]:
        """What the tasks have cost, as facts of an event; nothing where there were none."""
        if not self._spent:
            return {}
        times = sorted(one.cpu_s for one in self._spent)
        shown = min(len(times), _QUANTILES)
        picked = [times[round(n * (len(times) - 1) / max(shown - 1, 1))] for n in range(shown)]
        return {
            "tasks": len(times),
            "cpu_s": round(sum(times), 3),
            "task_cpu_s": [round(time_s, 4) for time_s in picked],
            "sent_bytes": sum(one.sent_bytes for one in self._spent) or None,
            "received_bytes": sum(one.received_bytes for one in self._spent) or None,
        }

    @property
    def remaining_s(self) -> float | None:
        """Remaining time, from the pace of the last minutes; None where it cannot be estimated."""
        left_s = None if self.total is None else self.task.time_remaining
        return None if left_s is None else max(0.0, left_s - self.begun_s)


class Run:
    """State of a run, reported to the handlers of a logger."""

    def __init__(
        self,
        console: Console | None = None,
        files: Sequence[logging.Handler] = (),
        *,
        log: logging.Logger = LOG,
        clock: Clock = lambda: time.monotonic(),
        ticks: bool = True,
    ) -> None:
        """Begin.

        Args:
            console: what the user sees.
            files: where events also go.
            log: the logger of the events.
            clock: monotonic, s.
            ticks: whether a thread reports now and then on what takes long.
        """
        self.clock = clock
        self.stages_begun = 0
        self._console, self._log = console, log
        self._handlers = [*([console] if console else []), *files]
        self._bars = _progress_bars(clock, shown=console is not None and console.has_bars)
        self._started_s = clock()
        self._stages: list[tuple[str, Task]] = []
        self._steps: list[Step] = []
        self._steps_begun = 0
        self._lock = threading.RLock()
        self._ticks, self._closed = ticks, threading.Event()
        self._compiling: Step | None = None
        self._left: tuple[str, dict[str, float]] = "", {}
        self._compiled_s = 0.0

    @property
    def is_quiet(self) -> bool:
        """Whether the user wants to see warnings alone."""
        return self._console is None or self._console.quiet

    def take(self, log: logging.Logger) -> None:
        """Route all records of a logger to this run."""
        log.handlers[:] = self._handlers
        log.filters[:] = [self._complete]

    def close(self) -> None:
        """Report nothing more, and restore the terminal."""
        self._closed.set()
        with self._lock:
            if not self._bars.disable:
                self._bars.stop()
            for handler in self._handlers:
                handler.close()

    @contextlib.contextmanager
    def paused_bars(self) -> Iterator[None]:
        """Take the bars off the terminal while the caller writes to it."""
        with self._lock:
            if self._bars.disable:
                yield
                return
            self._bars.stop()
            yield
            self._bars.start()

    def report(self, name: str, message: str | None = None, **facts: Any) -> None:
        """Report an event; its time is that of the run unless the facts say otherwise."""
        with self._lock:
            event = self._event(name, message, **facts)
            text = event.get("message", "")
            self._log.log(_LEVELS.get(name, logging.INFO), text, extra={"event": event})

    @contextlib.contextmanager
    def stage(self, name: str, title: str, **facts: Any) -> Iterator[Callable[..., None]]:
        """A stage is worked on; the user sees its title. It has failed without facts at its end."""
        last = dict[str, Any]()
        with self._lock:
            task = self.begin_task(name, None)
            self._stages.append((name, task))
            self.stages_begun += 1
            self.report("stage_started", title, elapsed_s=0.0, **facts)
        complete = False
        try:
            yield last.update
            complete = True
        finally:
            with self._lock:
                for step in list(self._steps):  # of abandoned generators, or compiling
                    self.end_step(step, complete=complete and step is self._compiling)
                if complete:
                    self.report("stage_finished", elapsed_s=task.elapsed, **last)
                self._stages.pop()
                self._end_task(task)

    def begin_step(self, label: str, total: int | None) -> Step:
        """A step begins."""
        with self._lock:
            self._steps_begun += 1
            step = Step(self, label, self._steps_begun, total)
            self._steps.append(step)
            self._report_step("step_started", step)
            return step

    def advance(self, step: Step, items: int, pace: float | None = None) -> None:
        """Count more items of a step as done, at its pace; report it now and then."""
        count = f"{step.done}" if step.total is None else f"{step.done} of {step.total}"
        with self._lock:
            if step in self._steps:
                pace = items if pace is None else pace
                self._bars.update(step.task.id, advance=pace, count=count)
            if self.clock() - step.reported_s >= _REPORTED_EVERY_S:
                self._report_step("step_progress", step)

    def end_step(self, step: Step, *, complete: bool) -> None:
        """End it, successful or not; a second call has no effect."""
        with self._lock:
            if step in self._steps:
                self._report_step("step_finished", step, complete=complete, **step.cost)
                self._steps.remove(step)
                self._end_task(step.task)

    def tick(self) -> None:
        """Report steps, or a stage without one, that have been silent for a while."""
        with self._lock:
            for step in self._steps:
                if self.clock() - step.reported_s >= _ALIVE_EVERY_S:
                    self._report_step("step_progress", step)
            if self._stages and not self._steps and self._console and not self.is_quiet:
                event = self._event("stage_runs", elapsed_s=self._stages[-1][1].elapsed)
                self._console.emit(logging.makeLogRecord({"event": event}))

    def begin_task(self, label: str, total: int | None) -> Task:
        """Start a clock, and on a terminal a bar."""
        if self._ticks:  # not before: signals are blocked by now, also in this thread
            threading.Thread(target=self._tick_often, name="ticks", daemon=True).start()
            self._ticks = False
        self._bars.start()
        self._bars.add_task(label, total=total, count="" if total is None else f"0 of {total}")
        return self._bars.tasks[-1]

    def _end_task(self, task: Task) -> None:
        self._bars.remove_task(task.id)
        if not self._bars.tasks and not self._bars.disable:
            self._bars.stop()

    def _event(self, name: str, message: str | None = None, **facts: Any) -> Event:
        utc = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        stage = self._stages[-1][0] if self._stages else None
        elapsed_s = facts.pop("elapsed_s", self.clock() - self._started_s)
        known = {"time_utc": utc, "event": name, "stage": stage} | facts
        known |= {"elapsed_s": round(elapsed_s, 3), "message": message}
        return {key: value for key, value in known.items() if value is not None}

    def _report_step(self, name: str, step: Step, **facts: Any) -> None:
        step.reported_s = self.clock()
        remaining_s = step.remaining_s if name == "step_progress" else None
        self.report(
            name, step=step.label, step_number=step.number, done=step.done, total=step.total,
            elapsed_s=step.task.elapsed, remaining_s=remaining_s, **facts,
        )  # fmt: skip

    def _complete(self, record: logging.LogRecord) -> bool:
        """Convert a record that is only a message, a note or a warning, to an event."""
        if "event" not in vars(record):
            name = "note" if record.levelno < logging.WARNING else "warning"
            record.event = self._event(name, record.getMessage())
        return True

    def watch_kernels(self, stage: str, left: dict[str, float]) -> None:
        """Show, as a step, that kernels are compiled, in this process or in another.

        Args:
            stage: that needs them.
            left: those that are still to compile, and the seconds that each takes.
        """
        with self._lock:
            (last, before), self._left = self._left, (stage, left)
            done = {name: s for name, s in before.items() if name not in left and stage == last}
            step = self._compiling
            if done:
                last_s, self._compiled_s, seconds = (
                    self._compiled_s,
                    self.clock(),
                    sum(done.values()),
                )
                if step is not None and step.task.start_time is not None:  # a pause does not count
                    pause_s = self._compiled_s - last_s - seconds / (step.task.speed or 1.0)
                    step.task.start_time += max(pause_s, 0.0)
                step = self._compiling = step or self.begin_step(_COMPILES, len(before))
                step.done = (step.done or 0) + len(done)
                step.total = step.done + len(left)
                step.task.total = step.task.completed + seconds + sum(left.values())
                self.advance(step, 0, seconds)
            if step is not None:
                kernel_s = max(left.values(), default=0.0) / (step.task.speed or 1.0)
                idle_s = self.clock() - self._compiled_s
                step.begun_s = min(idle_s, kernel_s)
                if not left or stage != last or idle_s > _IDLE_S + 2.0 * kernel_s:
                    step.task.stop_time = self._compiled_s
                    self.end_step(step, complete=True)
                    self._compiling = None

    def _tick_often(self) -> None:
        while not self._closed.wait(_TICK_S):
            with self._lock:
                stage = self._stages[-1][0] if self._stages else ""
            self.watch_kernels(stage, left_to_compile(stage))
            self.tick()


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


def _progress_bars(clock: Clock, *, shown: bool) -> Progress:
    """Progress of running stages and steps, each a bar at the foot of a terminal if shown."""
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[count]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(compact=True),
        console=Terminal(file=cast(TextIO, _OutlivedTerminal(sys.stderr))),
        transient=True,
        redirect_stdout=False,
        refresh_per_second=8,
        speed_estimate_period=_PACE_S,
        get_time=clock,
        disable=not shown,
    )


def left_to_compile(stage: str) -> dict[str, float]:
    """Kernels that a stage has still to compile; `core.compiled` replaces it once it is loaded."""
    return {}


_runs: list[Run] = []
"""Open runs; events of this process go to the last one."""
_UNSEEN = Run(log=logging.Logger("unseen", logging.CRITICAL + 1), ticks=False)
"""Run of tasks, whose own steps are not shown."""
_part: ContextVar[str] = ContextVar("part", default="")


def current() -> Run:
    """The current run; if none was begun, one that only shows on standard error."""
    if is_in_task():
        return _UNSEEN
    if not _runs:
        _runs.append(Run(Console()))
        _runs[0].take(LOG)
    return _runs[-1]


@contextlib.contextmanager
def reported_to(run: Run) -> Iterator[None]:
    """Within this block all events, warnings included, go to a run; then it is closed."""
    before = LOG.handlers[:], LOG.filters[:]
    _runs.append(run)
    run.take(LOG)
    try:
        yield
    finally:
        _runs.remove(run)
        LOG.handlers[:], LOG.filters[:] = before
        run.close()


@contextlib.contextmanager
def part(name: str, number: int, of: int) -> Iterator[None]:
    """Within this block stages are reported as a part of a longer run."""
    token = _part.set(f"{name} ({number} of {of})" if of > 1 else name)
    try:
        yield
    finally:
        _part.reset(token)


def stage(name: str, **facts: Any) -> contextlib.AbstractContextManager[Callable[..., None]]:
    """A stage is worked on; what is yielded takes the facts to report at its end.

    Args:
        name: name of its folder.
        facts: to report at its beginning, as JSON values.
    """
    whole = _part.get()
    title = whole if whole.split(" (")[0] == name else f"{whole}: {name}" if whole else name
    return current().stage(name, title, **facts)


@contextlib.contextmanager
def step(label: str, total: int | None = None) -> Iterator[Step]:
    """A step of a stage, or of a command without stages, is worked on; its items are counted on it.

    Args:
        label: what it does, in a few words.
        total: how many items are to be done, if they are counted.
    """
    run = current()
    begun = run.begin_step(label, total)
    complete = False
    try:
        yield begun
        complete = True
    except GeneratorExit:  # the consumer has enough items
        complete = True
        raise
    finally:
        run.end_step(begun, complete=complete)
