"""How far work is and how long it will still take, on a clock that the test turns by hand."""

import io
import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.artefacts import Stage, run_stage
from alice_survey.core.errors import keep_warnings, warn
from alice_survey.core.executor import progress as counted
from alice_survey.core.run import progress
from alice_survey.core.run.events import Console, Event, EventFile, event_of
from alice_survey.core.run.progress import Run


class Clock:
    """Stands still until it is turned."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class Kept(logging.Handler):
    """Keeps every event."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[Event] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.events.append(event_of(record))

    def named(self, name: str) -> list[Event]:
        return [event for event in self.events if event["event"] == name]


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def kept() -> Kept:
    return Kept()


@pytest.fixture
def run(clock: Clock, kept: Kept) -> Iterator[Run]:
    """A run whose thread does not tick, so that the test does."""
    begun = Run(Console(clock=clock), [kept], clock=clock, ticks=False)
    with progress.reported_to(begun):
        yield begun


@pytest.mark.parametrize("total", [10, 80])
@pytest.mark.parametrize("item_s", [0.1, 7.0])
def test_remaining_time_is_within_a_factor_of_two_from_a_fifth_on(
    total: int, item_s: float, run: Run, clock: Clock
) -> None:
    """Steady work, after a start that takes as long as three items."""
    rng = np.random.default_rng(total)
    took_s = item_s * rng.uniform(0.8, 1.2, total)
    took_s[0] += 3 * item_s
    with progress.step("match", total) as counter:
        assert counter.remaining_s is None
        for done, each_s in enumerate(took_s, 1):
            clock.now_s += each_s
            counter.advance()
            truth_s = took_s[done:].sum()
            if done >= max(2, 0.2 * total):
                assert counter.remaining_s is not None
                assert truth_s / 2 - item_s <= counter.remaining_s <= 2 * truth_s + 1.0
    assert counter.remaining_s == 0.0


def test_steps_are_reported_in_order_with_their_counts(run: Run, kept: Kept, clock: Clock) -> None:
    with progress.step("sort", 40) as counter:
        for _ in range(40):
            clock.now_s += 0.2
            counter.advance()
    started, *moved, ended = kept.events
    assert (started["event"], started["total"], started["done"]) == ("step_started", 40, 0)
    assert (ended["event"], ended["done"], ended["elapsed_s"]) == ("step_finished", 40, 8.0)
    assert ended["complete"] is True
    assert {event["event"] for event in moved} == {"step_progress"}
    assert [event["done"] for event in moved] == sorted(event["done"] for event in moved)
    times = [event["elapsed_s"] for event in moved]
    assert min(np.diff(times)) >= 0.5  # at most two a second
    assert len(moved) == 13
    assert moved[-1]["remaining_s"] == pytest.approx(0.2 * (40 - moved[-1]["done"]), abs=1.0)


@pytest.mark.parametrize("slower", [2.0, 8.0])
def test_time_left_to_compile_goes_by_the_kernels_compiled_so_far(
    slower: float, run: Run, kept: Kept, clock: Clock
) -> None:
    """The longest is last, and one is not needed; this machine takes another time than others."""
    left = {"unused": 1.0} | {f"k{n}": 0.2 * n for n in range(1, 21)}
    run.watch_kernels("plan", dict(left))
    for done in range(1, 21):
        clock.now_s += slower * left.pop(f"k{done}")
        run.watch_kernels("plan", dict(left))
        event = kept.events[-1]
        if done == 10:
            clock.now_s += 4.0  # of other work
        if done > 4:
            assert (event["done"], event["total"]) == (done, 21)
            assert event["remaining_s"] == pytest.approx(
                slower * sum(left.values()), rel=0.25, abs=1.0
            )
    for _ in range(30):  # nothing is compiled any more
        clock.now_s += 1.0
        run.watch_kernels("plan", left)
    run.watch_kernels("flight", {})  # one of another stage has not been compiled
    (end,) = kept.named("step_finished")
    assert end["done"] == 20
    # Without the pause, and without the first kernel, with whose end the step begins.
    assert end["elapsed_s"] == pytest.approx(slower * 0.2 * (sum(range(2, 21))), rel=0.1)


def test_a_stage_that_ends_well_ends_the_compiling_with_it_but_no_step_left_open(
    run: Run, kept: Kept, clock: Clock
) -> None:
    with run.stage("plan", "planning") as report:
        run.watch_kernels("plan", {"one": 1.0, "two": 1.0})
        clock.now_s += 1.0
        run.watch_kernels("plan", {"two": 1.0})
        run.begin_step("left by its consumer", 3)
        report(took_s=1.0)
    ends = {event["step"]: event["complete"] for event in kept.named("step_finished")}
    assert sorted(ends.values()) == [False, True] and not ends["left by its consumer"]


def test_more_items_than_expected_and_none_leave_their_number_open(run: Run, kept: Kept) -> None:
    with progress.step("fly", 2) as counter:
        counter.advance(2)
        assert counter.remaining_s == 0.0
        counter.advance()
        assert counter.remaining_s is None
    assert kept.events[-1]["done"] == 3
    assert "total" not in kept.events[-1]
    assert list(counted(iter("abc"), "letters")) == ["a", "b", "c"]
    assert kept.events[-1]["done"] == 3
    assert "total" not in kept.events[-1]


def test_steps_within_steps_keep_their_numbers(run: Run, kept: Kept) -> None:
    with progress.step("outer"), progress.step("inner"):
        pass
    assert [(e["event"], e["step"], e["step_number"]) for e in kept.events] == [
        ("step_started", "outer", 1),
        ("step_started", "inner", 2),
        ("step_finished", "inner", 2),
        ("step_finished", "outer", 1),
    ]
    assert "done" not in kept.events[0]  # nothing is counted


def test_a_step_that_fails_is_not_reported_as_done(
    run: Run, kept: Kept, clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        clock.now_s += 9.0
        raise ValueError

    with pytest.raises(ValueError), progress.step("break"):
        fail()
    assert kept.events[-1]["complete"] is False
    assert capsys.readouterr().err == ""


def test_who_takes_no_more_items_ends_the_step_and_so_does_its_stage(run: Run, kept: Kept) -> None:
    items = counted(iter(range(9)), "search", 9)
    assert next(items) == 0
    del items
    assert kept.events[-1]["event"] == "step_finished"
    assert kept.events[-1]["complete"] is True
    kept.events.clear()
    items = counted(iter(range(9)), "search", 9)
    with progress.stage("sparse") as finish:
        next(items)
        finish(took_s=1.0, cpu_s=1.0, peak_mib=1.0)
    assert [event["event"] for event in kept.events] == [
        "stage_started", "step_started", "step_finished", "stage_finished",
    ]  # fmt: skip
    del items
    assert len(kept.events) == 4


def test_what_hangs_is_reported_every_five_seconds(run: Run, kept: Kept, clock: Clock) -> None:
    with progress.step("solve"):
        for _ in range(20):
            clock.now_s += 1.0
            run.tick()
    assert [e["elapsed_s"] for e in kept.named("step_progress")] == [5.0, 10.0, 15.0, 20.0]


def test_a_display_of_warnings_alone(
    clock: Clock, kept: Kept, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(Console(quiet=True, clock=clock), [kept], clock=clock, ticks=False)
    with progress.reported_to(run), keep_warnings() as warnings, progress.step("long"):
        clock.now_s += 100.0
        run.tick()
        warn("it is late")
    shown = capsys.readouterr()
    assert (shown.out, shown.err) == ("", "warning: it is late\n")
    assert warnings == ["it is late"]
    assert [event["message"] for event in kept.named("warning")] == ["it is late"]


def test_standard_error_that_nobody_reads_does_not_stop_the_work(
    run: Run, kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(sys, "stderr", Gone())
    warn("one")
    warn("two")
    assert [event["message"] for event in kept.named("warning")] == ["one", "two"]


class Full(io.StringIO):
    """A file on a disk that is full after some lines."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room

    def write(self, text: str) -> int:
        self.room -= 1
        if self.room < 0:
            raise OSError(28, "No space left on device")
        return super().write(text)


@pytest.mark.parametrize("room", [0, 1, 5])
def test_a_full_disk_of_the_log_costs_one_warning(
    room: int, clock: Clock, kept: Kept, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = EventFile(tmp_path / "run.log")
    log.setStream(Full(room))  # type: ignore[arg-type]
    with progress.reported_to(Run(Console(clock=clock), [log, kept], clock=clock, ticks=False)):
        for name in ("one", "two"):
            run_stage(
                tmp_path,
                Stage(name=name, version=1, settings={}),
                lambda folder: (folder / "a").write_text("a") and None,
            )
    (warning,) = kept.named("warning")
    assert str(tmp_path / "run.log") in warning["message"]
    assert capsys.readouterr().err.count(str(tmp_path / "run.log")) == 1
    assert len(kept.named("stage_finished")) == 2


def test_without_a_run_there_is_one_that_shows(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.step("quick"):
        warn("odd")
    assert capsys.readouterr().err == "warning: odd\n"
