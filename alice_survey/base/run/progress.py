"""What a run is doing, how far it is and how long it still takes.

Work is told of through three context managers, `part`, `stage` and `step`, wherever it is done.
What is told becomes events, which the screen, a log and an events file take down.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import replace
from typing import Any, TypeVar

from alice_survey.base.errors import Level, is_in_task, shown_by
from alice_survey.base.run.display import Display, display_on_stderr
from alice_survey.base.run.events import Event, Sink

_TOLD_EVERY_S = 0.5
"""Between two events of how far a step is."""
_ALIVE_EVERY_S = 5.0
"""Between two such events where nothing moves."""
_TICK_S = 1.0
_KEPT = 256

Item = TypeVar("Item")
Clock = Callable[[], float]


class Remaining:
    """How long work of equal items still takes, from when items were done.

    The first items tell nothing: processes start, kernels are compiled. Time is counted from the
    first done on, and of it the last half, so that a slow start and a change of pace are forgotten.
    Items that are worked on side by side end together: fewer of them than that tell nothing.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._seen: list[tuple[float, int]] = []

    def note(self, done: int, now_s: float) -> None:
        """So many are done by now."""
        if len(self._seen) >= _KEPT:  # every other one tells as much
            del self._seen[1:-1:2]
        self._seen.append((now_s, done))

    def left_s(self, total: int, now_s: float) -> float | None:
        """How long the rest takes; None as long as nothing can be said."""
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
    """A part of a stage that is going on."""

    def __init__(
        self, label: str, number: int, total: int | None, width: int, clock: Clock
    ) -> None:
        self.label, self.number, self.expected = label, number, total
        self.done = 0
        self.counted = total is not None
        self.told_s = self.started_s = clock()
        self._clock = clock
        self._remaining = Remaining(width)

    def count(self, items: int) -> None:
        """So many more are done."""
        self.done += items
        self.counted = True
        self._remaining.note(self.done, self._clock())

    @property
    def total(self) -> int | None:
        """How many items are expected, as long as there are no more."""
        return None if self.expected is None or self.done > self.expected else self.expected

    @property
    def elapsed_s(self) -> float:
        """Since it began."""
        return self._clock() - self.started_s

    @property
    def remaining_s(self) -> float | None:
        """How long it still takes; None where nothing can be said."""
        total = self.total
        return None if total is None else self._remaining.left_s(total, self._clock())


class Counter:
    """Counts what is done of a step."""

    def __init__(self, run: "Run", step: Step) -> None:
        self._run, self._step = run, step

    def advance(self, items: int = 1) -> None:
        """So many more are done."""
        self._run.advance(self._step, items)


class Run:
    """What is going on, and who is told."""

    def __init__(
        self,
        display: Display | None,
        sinks: Sequence[Sink] = (),
        *,
        clock: Clock = lambda: time.monotonic(),
        wall_clock: Clock = lambda: time.time(),
        quiet: bool = False,
        ticks: bool = True,
    ) -> None:
        """Begin.

        Args:
            display: what the user sees.
            sinks: files.
            clock: that only goes forward, s.
            wall_clock: seconds since 1970.
            quiet: other processes show nothing either.
            ticks: whether a thread tells now and then of what takes long.
        """
        self.display = display
        self.quiet = quiet
        self.stages_begun = 0
        self._sinks = list(sinks)
        self._clock, self._wall_clock = clock, wall_clock
        self._started_s = clock()
        self._stages: list[tuple[str, float]] = []
        self._steps: list[Step] = []
        self._begun = 0
        self._lock = threading.RLock()
        self._ticks, self._ticker = ticks, threading.Event()
        self._ticking: threading.Thread | None = None

    @property
    def elapsed_s(self) -> float:
        """Since it began."""
        return self._clock() - self._started_s

    def tell(self, name: str, message: str | None = None, **facts: Any) -> None:
        """Tell of something that is neither a stage nor a step."""
        with self._lock:
            self._emit(self._event(name, elapsed_s=self.elapsed_s, message=message, facts=facts))

    def skip_stage(self, name: str) -> None:
        """A stage is up to date."""
        with self._lock:
            event = self._event("stage_skipped", elapsed_s=self.elapsed_s)
            self._emit(replace(event, stage=name))

    def show(self, level: Level, text: str) -> None:
        """Tell of a note or a warning."""
        self.tell(level, text)

    def begin_stage(self, name: str, title: str, facts: Mapping[str, Any]) -> None:
        """A stage begins; what it is called before the user is its title."""
        with self._lock:
            self._stages.append((name, self._clock()))
            self.stages_begun += 1
            self._emit_stage("stage_started", title, facts)
            self._tick_on()

    def end_stage(self, facts: Mapping[str, Any] | None) -> None:
        """It ends; without facts it has failed."""
        with self._lock:
            for step in list(self._steps):  # of generators that nobody went on with
                self.end_step(step, complete=False)
            if facts is not None:
                self._emit_stage("stage_finished", None, facts)
            self._stages.pop()
            if self.display is not None:
                self.display.stage_ended()

    def begin_step(self, label: str, total: int | None, width: int) -> Step:
        """A step begins."""
        with self._lock:
            self._begun += 1
            step = Step(label, self._begun, total, width, self._clock)
            self._steps.append(step)
            if self.display is not None:
                self.display.step_began(step)
            self._emit_step("step_started", step)
            self._tick_on()
            return step

    def advance(self, step: Step, items: int) -> None:
        """Some more of a step is done."""
        step.count(items)
        if self._clock() - step.told_s >= _TOLD_EVERY_S:
            with self._lock:
                self._emit_step("step_progress", step)

    def end_step(self, step: Step, *, complete: bool) -> None:
        """It ends, well or not; a second time means nothing."""
        with self._lock:
            if step not in self._steps:
                return
            self._steps.remove(step)
            self._emit_step("step_finished", step, complete=complete)
            if self.display is not None:
                self.display.step_ended(step)

    def tick(self) -> None:
        """Tell of what nothing has been heard of for a while."""
        with self._lock:
            now_s = self._clock()
            for step in self._steps:
                if now_s - step.told_s >= _ALIVE_EVERY_S:
                    self._emit_step("step_progress", step)
            if self.display is not None and (self._steps or self._stages):
                of_stage_s = now_s - self._stages[-1][1] if self._stages else 0.0
                if self._steps:
                    innermost = self._event_of("step_progress", self._steps[-1])
                else:
                    innermost = self._event("stage_runs", elapsed_s=of_stage_s)
                self.display.tick(innermost)

    def close(self) -> None:
        """Nothing more is told."""
        self._ticker.set()
        ticking = self._ticking
        if ticking is not None:
            ticking.join()
        with self._lock:
            if self.display is not None:
                self.display.close()
            for sink in self._sinks:
                sink.close()
            self._sinks.clear()

    @property
    def _stage(self) -> str | None:
        return self._stages[-1][0] if self._stages else None

    def _event(self, name: str, **known: Any) -> Event:
        return Event(name=name, time_s=self._wall_clock(), stage=self._stage, **known)

    def _event_of(self, name: str, step: Step, **facts: Any) -> Event:
        return self._event(
            name,
            step=step.label,
            step_number=step.number,
            done=step.done if step.counted else None,
            total=step.total,
            elapsed_s=step.elapsed_s,
            remaining_s=step.remaining_s if name == "step_progress" else None,
            facts=facts,
        )

    def _emit_step(self, name: str, step: Step, **facts: Any) -> None:
        step.told_s = self._clock()
        self._emit(self._event_of(name, step, **facts))

    def _emit_stage(self, name: str, title: str | None, facts: Mapping[str, Any]) -> None:
        elapsed_s = self._clock() - self._stages[-1][1]
        self._emit(self._event(name, elapsed_s=elapsed_s, message=title, facts=facts))

    def _emit(self, event: Event) -> None:
        if self.display is not None:
            self.display.hear(event)
        for sink in list(self._sinks):
            try:
                sink.hear(event)
            except OSError as error:
                self._sinks.remove(sink)
                sink.close()
                why = (error.strerror or str(error)).lower()
                self.tell("warning", f"the {sink} is written no further: {why}")

    def _tick_on(self) -> None:
        if self._ticks and self._ticking is None:
            self._ticking = threading.Thread(target=self._tick_often, name="ticks", daemon=True)
            self._ticking.start()

    def _tick_often(self) -> None:
        while not self._ticker.wait(_TICK_S):
            with self._lock:
                if not self._steps and not self._stages:
                    self._ticking = None
                    return
                self.tick()


_runs: list[Run] = []
"""The last one is told of what happens in this process."""
_SILENT = Run(None, quiet=True, ticks=False)
"""Of tasks, whose own steps nobody sees."""
_part: ContextVar[str] = ContextVar("part", default="")


def current() -> Run:
    """The run that is told; one that only shows on standard error when none was begun."""
    if is_in_task():
        return _SILENT
    if not _runs:
        _runs.append(Run(display_on_stderr()))
    return _runs[-1]


@contextlib.contextmanager
def told_to(run: Run) -> Iterator[None]:
    """Within this block what happens, warnings included, is told to a run; then it is closed."""
    _runs.append(run)
    try:
        with shown_by(run.show):
            yield
    finally:
        _runs.remove(run)
        run.close()


@contextlib.contextmanager
def part(name: str, number: int, of: int) -> Iterator[None]:
    """Within this block stages are told of as a part of a longer run."""
    token = _part.set(f"{name} ({number} of {of})" if of > 1 else name)
    try:
        yield
    finally:
        _part.reset(token)


@contextlib.contextmanager
def stage(name: str, **facts: Any) -> Iterator[Callable[..., None]]:
    """A stage is worked on; what is yielded takes the facts to tell at its end.

    Args:
        name: of its folder.
        facts: to tell at its beginning, as JSON values.
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
def step(label: str, total: int | None = None, *, width: int = 1) -> Iterator[Counter]:
    """A step of a stage, or of a command without stages, is worked on.

    Args:
        label: what it does, in a few words.
        total: how many items are to be done, if they are counted.
        width: how many are worked on side by side.
    """
    run = current()
    begun = run.begin_step(label, total, width)
    complete = False
    try:
        yield Counter(run, begun)
        complete = True
    except GeneratorExit:  # whoever takes the items has enough
        complete = True
        raise
    finally:
        run.end_step(begun, complete=complete)


def counted(items: Iterable[Item], label: str, total: int | None, width: int) -> Iterator[Item]:
    """Pass on items that took work to make, and count them."""
    with step(label, total, width=width) as counter:
        for item in items:
            counter.advance()
            yield item
