"""A run of the command line: its options, its files, and how it ends."""

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import psutil
import pytest
import typer
from typer.testing import CliRunner

from alice_survey.app.cli import main as cli
from alice_survey.app.commands.base import ReportCommand, option
from alice_survey.core.errors import PlanError, note, warn
from alice_survey.core.executor import local_executor
from alice_survey.core.run import interrupts, progress
from tests.engines import until


class Works(ReportCommand):
    """Work hard."""

    name = "work-hard"
    length: int = option(1, "How long.")
    work: ClassVar[Callable[[], None]]

    def run(self) -> tuple[str, object]:
        type(self).work()
        return f"done {self.length}", {"done": self.length}


def made(work: Callable[[], None]) -> typer.Typer:
    """An app of one command, and of a group with one below it."""
    names = ("work-hard", "group", "group below")
    return cli.make_app(
        [type("Works", (Works,), {"name": name, "work": staticmethod(work)}) for name in names]
    )


def events_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def worked(work: Callable[[], None], folder: Path) -> tuple[Any, list[dict[str, Any]]]:
    """How a run of the command ends, and its events."""
    file = folder / "events.jsonl"
    done = CliRunner().invoke(made(work), ["work-hard", "--length", "7", "--log-file", str(file)])
    return done, events_of(file)


def test_events_follow_a_run_from_its_beginning_to_its_end(tmp_path: Path) -> None:
    def work() -> None:
        with progress.step("count", 2) as counter:
            counter.advance()
            warn("odd")
            note("compiling")
            counter.advance()

    done, found = worked(work, tmp_path)
    assert (done.exit_code, done.stdout) == (0, "done 7\n")
    assert done.stderr == "warning: odd\ncompiling\n"
    assert [event["event"] for event in found] == [
        "run_started", "step_started", "warning", "note", "step_finished", "result", "run_finished",
    ]  # fmt: skip
    assert found[0]["versions"].keys() >= {"python", "alice-survey", "numpy", "pycolmap"}
    assert found[0]["process"] == os.getpid()
    assert found[-1]["exit_code"] == 0
    assert [event["time_utc"] for event in found] == sorted(event["time_utc"] for event in found)


def _by_ctrl_c() -> SystemError:
    """A fault that a library makes of Ctrl-C, as numba does while it loads a kernel."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize(
    ("error", "code", "message", "traced"),
    [
        (PlanError("no way"), 1, "no way", False),
        (FileNotFoundError(2, "No such file", "a.txt"), 1, "a.txt: No such file", False),
        (ZeroDivisionError("by zero"), 1, "ZeroDivisionError: by zero", True),
        (typer.Exit(3), 3, None, False),
        (SystemExit(4), 4, None, False),
        (_by_ctrl_c(), 130, "interrupted", False),
    ],
)
def test_the_end_of_a_run_is_reported(
    error: BaseException, code: int, message: str | None, traced: bool, tmp_path: Path
) -> None:
    def work() -> None:
        raise error

    done, (*_, before, last) = worked(work, tmp_path)
    assert done.exit_code == code
    assert (last["event"], last["exit_code"]) == ("run_finished", code)
    if message is None:
        assert before["event"] == "run_started"
    else:
        assert (before["event"], before["message"]) == ("error", message)
    assert ("traceback" in before) == traced


@pytest.mark.parametrize("path", ["-", "FOLDER", "FILE/below", "/dev/full"])
def test_a_file_that_cannot_be_written_ends_the_run_before_it_begins(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("FOLDER").mkdir()
    Path("FILE").write_text("a file")
    monkeypatch.setattr(sys, "argv", ["alice-survey", "init", "new", "--log-file", path])
    if path == "/dev/full":  # it opens: the run goes on with a warning
        _exits(0)
        assert path in capsys.readouterr().err
        assert Path("new").exists()
        return
    _exits(1)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert not Path("new").exists()


def _exits(code: int) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert (stopped.value.code or 0) == code


def test_options_go_behind_the_last_command(tmp_path: Path) -> None:
    worked: list[int] = []
    app, file = made(lambda: worked.append(1)), str(tmp_path / "events.jsonl")
    assert CliRunner().invoke(app, ["group", "--log-file", file, "below"]).exit_code == 2
    assert not worked
    assert CliRunner().invoke(app, ["group", "below", "--log-file", file]).exit_code == 0
    assert CliRunner().invoke(app, ["group", "--log-file", file]).exit_code == 0
    assert worked == [1, 1]
    names = [event["event"] for event in events_of(Path(file))]
    assert names == ["run_started", "result", "run_finished"] * 2


def _warns(item: int) -> int:
    warn(f"item {item} is odd")
    if item == 2:
        raise PlanError("item 2 is impossible")
    return item


@pytest.mark.parametrize("threads", [1, 2])
def test_warnings_of_other_processes_are_reported_in_order(
    threads: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def work() -> None:
        for _ in local_executor(threads).map(_warns, range(3), label="look"):
            pass

    done, events = worked(work, tmp_path)
    assert isinstance(done.exception, PlanError)
    warnings = [event["message"] for event in events if event["event"] == "warning"]
    assert warnings == ["item 0 is odd", "item 1 is odd", "item 2 is odd"]
    assert done.stderr.splitlines() == [f"warning: {line}" for line in warnings]
    assert capfd.readouterr().err == ""  # the other processes say nothing themselves


SCRIPT = """
import hashlib, sys, time
from pathlib import Path
import typer
from alice_survey.core.run import interrupts
from alice_survey.core.artefacts import Stage, run_stage
from alice_survey.app.cli.main import make_app
from alice_survey.app.commands.base import CommandModel, argument
from alice_survey.core.executor import local_executor
import sleeping

class Run(CommandModel):
    name = "run"
    kind: str = argument(..., "")
    folder: Path = argument(..., "")
    def run(self) -> None:
        make(self.kind, self.folder)

def make(kind, folder):
    def work(partial: Path) -> None:
        import pycolmap  # whose log has an answer of its own to some signals
        (partial / "half").touch()
        if kind == "deep":
            Path(folder, "begun0").touch()
            hashlib.pbkdf2_hmac("sha256", b"a", b"b", 1_000_000_000)
        else:
            list(local_executor(2).map(sleeping.stay, [folder] * 8, label="sleep"))
    run_stage(folder, Stage(name="made", version=1, settings={}), work)

if __name__ == "__main__":
    interrupts._GRACE_S = 0.5
    make_app([Run])()
"""
SLEEPING = """
import os, time
from pathlib import Path
def stay(folder):
    import pycolmap
    Path(folder, f"begun{os.getpid()}").touch()
    time.sleep(60)
"""


def sleeper(tmp_path: Path, kind: str, sleep_s: int = 60) -> tuple[Path, Path, list[str]]:
    """A workspace, a file of events, and the command of a run that sleeps in it."""
    (tmp_path / "sleeping.py").write_text(SLEEPING.replace("60", str(sleep_s)))
    (tmp_path / "script.py").write_text(SCRIPT)
    folder, file = tmp_path / "workspace", tmp_path / "events.jsonl"
    folder.mkdir()
    words = (tmp_path / "script.py", kind, folder, "--log-file", file)
    return folder, file, [sys.executable, *map(str, words)]


@pytest.mark.parametrize(
    ("kind", "workers", "number", "times"),
    [
        ("parallel", 2, signal.SIGINT, 1),
        ("deep", 1, signal.SIGINT, 2),
        ("parallel", 2, signal.SIGTERM, 1),
        ("deep", 1, signal.SIGHUP, 1),
    ],
)
def test_a_signal_ends_all_processes_and_says_how_to_go_on(
    kind: str, workers: int, number: signal.Signals, times: int, tmp_path: Path
) -> None:
    """Of Ctrl-C, a scheduler, and a terminal that closes; twice at once, as `timeout` sends it."""
    folder, file, command = sleeper(tmp_path, kind)
    run = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=_default_signals,
    )  # fmt: skip
    until(lambda: len(list(folder.glob("begun*"))) == workers)
    os.killpg(run.pid, number)  # a terminal sends it to all processes
    if times == 2:
        time.sleep(0.02)  # two that come while one is pending are one
        os.kill(run.pid, number)
    out, shown = run.communicate(timeout=20)
    by = "" if number == signal.SIGINT else f" by {number.name}"
    assert (run.returncode, out) == (128 + number, "")
    assert shown.splitlines() == ["made", f"interrupted{by}; the same command goes on from here"]
    until(lambda: not _of_session(run.pid))
    assert [p.name for p in folder.iterdir() if p.is_dir()] == ["made.partial"]
    *_, before, last = events_of(file)
    assert (before["event"], before["message"]) == ("error", f"interrupted{by}")
    assert (last["event"], last["exit_code"]) == ("run_finished", 128 + number)


@pytest.mark.parametrize("outlives", [False, True])
def test_a_terminal_that_closes_ends_what_was_not_meant_to_outlive_it(
    outlives: bool, tmp_path: Path
) -> None:
    """As `nohup` has it. Nothing reads what either writes any more."""
    folder, file, command = sleeper(tmp_path, "parallel", 2 if outlives else 60)
    run, terminal = pty.fork()
    if run == 0:
        signal.signal(signal.SIGHUP, signal.SIG_IGN if outlives else signal.SIG_DFL)
        os.execv(sys.executable, command)  # noqa: S606 (a fork's own end)
    until(lambda: len(list(folder.glob("begun*"))) == 2)
    os.close(terminal)
    _, status = os.waitpid(run, 0)
    code = 0 if outlives else 129
    assert os.waitstatus_to_exitcode(status) == code
    until(lambda: not _of_session(run))
    *_, before, last = events_of(file)
    assert (last["event"], last["exit_code"]) == ("run_finished", code)
    assert before.get("message") == (None if outlives else "interrupted by SIGHUP")
    assert (folder / "made" / "half").exists() == outlives


NOT_POSIX = """
import os, signal, sys
for name in ("sigwait", "pthread_sigmask", "pthread_kill", "SIGHUP", "SIGUSR1"):
    delattr(signal, name)
del os.sched_getaffinity
sys.modules["fcntl"] = None
from pathlib import Path
from alice_survey.core.executor import local_executor
from alice_survey.app.cli.session import session
with session([], quiet=True, files=[Path(sys.argv[1])]):
    assert list(local_executor(1).map(abs, [-1, -2], label="abs")) == [1, 2]
"""


def test_a_run_needs_no_signals_of_posix(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", NOT_POSIX, str(tmp_path / "e.jsonl")], check=True)
    *_, last = events_of(tmp_path / "e.jsonl")
    assert (last["event"], last["exit_code"]) == ("run_finished", 0)


def test_other_programs_handle_signals_as_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    def masks() -> list[int]:
        script = "import signal; print(*sorted(signal.pthread_sigmask(signal.SIG_BLOCK, [])))"
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
        return [int(number) for number in done.stdout.split()]

    monkeypatch.setattr(signal, "getsignal", lambda _: signal.SIG_DFL)  # we may be deaf to one
    before = masks()
    with interrupts.handle_signals(lambda _: None):
        assert set(masks()) == {*before, *interrupts.SIGNALS}
        with interrupts.for_other_programs():
            assert masks() == before
    assert masks() == before


def _default_signals() -> None:
    """What a shell starts in the background, or nohup, is deaf, and so is what that starts."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def _of_session(leader: int) -> list[int]:
    """Processes that still run in the session of one that has ended."""
    found = []
    for process in psutil.process_iter(["status"]):
        with contextlib.suppress(ProcessLookupError):
            if os.getsid(process.pid) == leader and process.info["status"] != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


def test_a_result_that_nobody_reads_is_not_a_fault() -> None:
    command = f"{sys.executable} -m alice_survey camera | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout in ("1\n", "0\n")


def test_a_killed_worker_is_reported_in_one_line(tmp_path: Path) -> None:
    def work() -> None:
        list(local_executor(2).map(_dies, range(4), label="die"))

    done, events = worked(work, tmp_path)
    assert done.exit_code == 1
    (line,) = [event["message"] for event in events if event["event"] == "error"]
    assert "--threads" in line


def _dies(item: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return item
