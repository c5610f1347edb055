"""Progress of a run: what it is doing, how much is done and the remaining time.

Work is reported through three context managers, `part`, `stage` and `step`, wherever it is done.
Reports become events, records of the package's logger, which the screen, a log and an events file
take from there.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, TypeVar

from alice_survey.base.errors import LOG, is_in_task
from alice_survey.base.run.display import Bars, Console
from alice_survey.base.run.events import Event

_REPORTED_EVERY_S = 0.5
"""Time between two progress events of a step."""
_ALIVE_EVERY_S = 5.0
"""Time between two such events where nothing changes."""
_TICK_S = 1.0
_KEPT = 256
_LEVELS = {"warning": logging.WARNING, "error": logging.ERROR}

Item = TypeVar("Item")
Clock = Callable[[], float]


class Remaining:
    """Remaining time of work on equal items, from when items were done.

    The first items say nothing: processes start, kernels are compiled. Time is counted from the
    first done on, and of it the last half, so that a slow start and a change of pace are forgotten.
    Items that are worked on in parallel end together: fewer of them than that say nothing.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._seen: list[tuple[float, int]] = []

    def note(self, done: int, now_s: float) -> None:
        """This number is done by now."""
        if len(self._seen) >= _KEPT:  # every other one says as much
            del self._seen[1:-1:2]
        self._seen.append((now_s, done))

    def left_s(self, total: int, now_s: float) -> float | None:
        """Remaining time; None as long as it cannot be estimated."""
        if not self._seen:
            return None
        last_s, done = self._seen[-1]
        waited_s = now_s - last_s
        if done >= total:
            return 0.0
        since_s, count = self._reference(now_s)
        if done - count < self._width:
            return None
        each_s = (last_s - since_s) / (done - count)
        if waited_s > each_s:  # the next one takes longer than those before
            each_s = (now_s - since_s) / (done - count + 1)
        return max(0.0, (total - done) * each_s - min(waited_s, each_s))

    def _reference(self, now_s: float) -> tuple[float, int]:
        """The last time before half of it all after which enough was done."""
        first_s, _ = self._seen[0]
        done = self._seen[-1][1]
        middle_s = first_s + (now_s - first_s) / 2
        found = self._seen[0]
        for at_s, count in self._seen:
            if at_s > middle_s or done - count < 2 * self._width:
                break
            found = (at_s, count)
        return found


class Step:
    """A running part of a stage."""

    def __init__(self, run: "Run", label: str, number: int, total: int | None, width: int) -> None:
        self._run, self._expected = run, total
        self.label, self.number = label, number
        self.done = None if total is None else 0
        self.reported_s = self.started_s = run.clock()
        self._remaining = Remaining(width)

    def advance(self, items: int = 1) -> None:
        """Count more items as done."""
        self.done = (self.done or 0) + items
        self._remaining.note(self.done, self._run.clock())
        self._run.moved(self)

    @property
    def total(self) -> int | None:
        """How many items are expected, unless there are more already."""
        return None if (self.done or 0) > (self._expected or 0) else self._expected

    @property
    def left_s(self) -> float | None:
        """Remaining time; None where it cannot be estimated."""
        total = self.total
        return None if total is None else self._remaining.left_s(total, self._run.clock())


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
        self._bars: Bars | None = console.bars if console else None
        self._started_s = clock()
        self._stages: list[tuple[str, float]] = []
        self._steps: list[Step] = []
        self._steps_begun = 0
        self._lock = threading.RLock()
        self._ticks, self._closed = ticks, threading.Event()
        self._ticking: threading.Thread | None = None

    @property
    def is_quiet(self) -> bool:
        """Whether the user wants to see warnings alone."""
        return self._console is None or self._console.quiet

    def take(self, log: logging.Logger) -> None:
        """Route all records of a logger to this run."""
        log.handlers[:] = self._handlers
        log.filters[:] = [self._complete]

    def close(self) -> None:
        """Report nothing more."""
        self._closed.set()
        ticking = self._ticking
        if ticking is not None:
            ticking.join()
        with self._lock:
            for handler in self._handlers:
                handler.close()

    def report(self, name: str, message: str | None = None, **facts: Any) -> None:
        """Report something that is neither a stage nor a step."""
        elapsed_s = self.clock() - self._started_s
        self._emit(self._event(name, elapsed_s=elapsed_s, message=message, **facts))

    def skip_stage(self, name: str) -> None:
        """A stage is up to date."""
        elapsed_s = self.clock() - self._started_s
        self._emit({**self._event("stage_skipped", elapsed_s=elapsed_s), "stage": name})

    def begin_stage(self, name: str, title: str, facts: Mapping[str, Any]) -> None:
        """A stage begins; the user sees its title."""
        with self._lock:
            self._stages.append((name, self.clock()))
            self.stages_begun += 1
            self._emit(self._event("stage_started", elapsed_s=0.0, message=title, **facts))
            if self._bars:
                self._bars.show(self._stages[-1], name)
            self._tick_on()

    def end_stage(self, facts: Mapping[str, Any] | None) -> None:
        """It ends; without facts it has failed."""
        with self._lock:
            for step in list(self._steps):  # of generators that nobody went on with
                self.end_step(step, complete=False)
            if facts is not None:
                elapsed_s = self.clock() - self._stages[-1][1]
                self._emit(self._event("stage_finished", elapsed_s=elapsed_s, **facts))
            ended = self._stages.pop()
            if self._bars:
                self._bars.remove(ended)

    def begin_step(self, label: str, total: int | None, width: int) -> Step:
        """A step begins."""
        with self._lock:
            if self._console:
                self._console.rest()
            self._steps_begun += 1
            step = Step(self, label, self._steps_begun, total, width)
            self._steps.append(step)
            self._emit_step("step_started", step)
            self._tick_on()
            return step

    def moved(self, step: Step) -> None:
        """Report more of a step as done."""
        if self.clock() - step.reported_s >= _REPORTED_EVERY_S:
            with self._lock:
                self._emit_step("step_progress", step)

    def end_step(self, step: Step, *, complete: bool) -> None:
        """End it, successful or not; a second call has no effect."""
        with self._lock:
            if step not in self._steps:
                return
            self._emit_step("step_finished", step, complete=complete)
            self._steps.remove(step)
            if self._bars:
                self._bars.remove(step)

    def tick(self) -> None:
        """Report steps that have been silent for a while."""
        with self._lock:
            now_s = self.clock()
            for step in self._steps:
                self._show(step)
                if now_s - step.reported_s >= _ALIVE_EVERY_S:
                    self._emit_step("step_progress", step)
            if self._console and self._steps:
                self._console.tick(self._event_of("step_progress", self._steps[-1]))
            elif self._console and self._stages:
                elapsed_s = now_s - self._stages[-1][1]
                self._console.tick(self._event("stage_runs", elapsed_s=elapsed_s))

    def _event(self, name: str, **known: Any) -> Event:
        utc = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        stage = self._stages[-1][0] if self._stages else None
        if known.get("elapsed_s") is not None:
            known["elapsed_s"] = round(known["elapsed_s"], 3)
        event = {"time_utc": utc, "event": name, "stage": stage, **known}
        return {key: value for key, value in event.items() if value is not None}

    def _event_of(self, name: str, step: Step, **facts: Any) -> Event:
        left_s = step.left_s if name == "step_progress" else None
        return self._event(
            name,
            step=step.label,
            step_number=step.number,
            done=step.done,
            total=step.total,
            elapsed_s=self.clock() - step.started_s,
            remaining_s=None if left_s is None else round(left_s, 1),
            **facts,
        )

    def _emit_step(self, name: str, step: Step, **facts: Any) -> None:
        step.reported_s = self.clock()
        self._emit(self._event_of(name, step, **facts))
        self._show(step)

    def _emit(self, event: Event) -> None:
        level = _LEVELS.get(event["event"], logging.INFO)
        with self._lock:
            self._log.log(level, event.get("message", ""), extra={"event": event})

    def _complete(self, record: logging.LogRecord) -> bool:
        """Convert a record that is only a message, a note or a warning, to an event."""
        if "event" not in vars(record):
            name = "note" if record.levelno < logging.WARNING else "warning"
            elapsed_s = self.clock() - self._started_s
            record.event = self._event(name, elapsed_s=elapsed_s, message=record.getMessage())
        return True

    def _show(self, step: Step) -> None:
        if self._bars and step in self._steps:
            self._bars.show(step, step.label, step.done, step.total, step.left_s)

    def _tick_on(self) -> None:
        if self._ticks and self._ticking is None:
            self._ticking = threading.Thread(target=self._tick_often, name="ticks", daemon=True)
            self._ticking.start()

    def _tick_often(self) -> None:
        while not self._closed.wait(_TICK_S):
            with self._lock:
                if not self._steps and not self._stages:
                    self._ticking = None
                    return
                self.tick()


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


@contextlib.contextmanager
def stage(name: str, **facts: Any) -> Iterator[Callable[..., None]]:
    """A stage is worked on; what is yielded takes the facts to report at its end.

    Args:
        name: name of its folder.
        facts: to report at its beginning, as JSON values.
    """
    whole = _part.get()
    title = whole if whole.split(" (")[0] == name else f"{whole}: {name}" if whole else name
    run, last = current(), dict[str, Any]()
    run.begin_stage(name, title, facts)
    complete = False
    try:
        yield last.update
        complete = True
    finally:
        run.end_stage(last if complete else None)


def skipped(name: str) -> None:
    """A stage is up to date."""
    current().skip_stage(name)


@contextlib.contextmanager
def step(label: str, total: int | None = None, *, width: int = 1) -> Iterator[Step]:
    """A step of a stage, or of a command without stages, is worked on; its items are counted on it.

    Args:
        label: what it does, in a few words.
        total: how many items are to be done, if they are counted.
        width: how many are worked on in parallel.
    """
    run = current()
    begun = run.begin_step(label, total, width)
    complete = False
    try:
        yield begun
        complete = True
    except GeneratorExit:  # the consumer has enough items
        complete = True
        raise
    finally:
        run.end_step(begun, complete=complete)


def counted(items: Iterable[Item], label: str, total: int | None, width: int) -> Iterator[Item]:
    """Pass on items that took work to produce, and count them."""
    with step(label, total, width=width) as begun:
        for item in items:
            begun.advance()
            yield item
