"""Commands that the studio runs in its workspace: one at a time, each a process of its own.

A job writes what happens into an events file below `.studio/jobs/NUMBER/`, and this reads it: so a
page that is loaded again, or a studio that was killed and started again, finds the job where it is.
A job is the leader of a process group and has no terminal. It ends with the studio or by `stop`,
both as Ctrl-C ends a command: its stages resume where they were.
"""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psutil
from filelock import FileLock
from pydantic import Field, ValidationError

from alice_survey.app.commands import COMMANDS
from alice_survey.app.commands.base import CommandModel
from alice_survey.app.pipeline import init_survey, is_locked
from alice_survey.app.stages import STAGES
from alice_survey.core.artefacts import JsonRecord, refuse_links
from alice_survey.core.contents import as_line, first_fault
from alice_survey.core.errors import NOT_GOOD_ENOUGH, AliceError, ConfigError, WorkspaceError, why
from alice_survey.core.run.events import Event, event_text
from alice_survey.core.run.interrupts import for_other_programs
from alice_survey.core.settings_text import Values

RECORD, OUTPUT, ERRORS, EVENTS = "job.json", "output.txt", "errors.txt", "events.jsonl"
"""Files of a job."""
FOLDER = Path(".studio", "jobs")
_NUMBER = re.compile("[0-9]{4,9}")
"""Names of jobs' folders."""
_KEPT_JOBS = 20
_POLL_S = 0.1
_PUBLISH_EVERY_S = 0.25
_ALIVE_EVERY_S = 2.0
"""Time after which a silent job is published again."""
_HARDER_S = (8.0, 5.0)
"""Time to wait after Ctrl-C, then after SIGTERM, before the next harder way to end a job."""
_ENDING_S = 3.0
"""Time to wait for a job where the studio ends; the job ends within some more by itself."""
_LOCK_S = 2.0
"""Longest wait for what holds the workspace for a moment."""
_CREATED_S = 0.5
"""Difference of a process's start as two readings of it may give it."""
_CODES_OF_STOP = (130, 143, 129)
_OUTPUT_TAIL = 8192
_PROGRAM = (sys.executable, "-P", "-m", "alice_survey")
"""This program, without modules of the folder that it is started in."""
TRIAL: Values = {
    "seafloor": {"grid_m": 0.02},
    "imaging": {"scale": 6, "pool_views": 12},
    "reconstruct": {"max_features": 1200},
}
"""Settings that take a few square metres from plan to report within minutes; the number of features
is what pictures of a quarter of a megapixel hold."""

KEPT_LINES = 2000
_KEPT_WARNINGS = 100
_LOGGED_EVERY_S = 30.0
_MAX_LINE = 4000
_CHUNK = 1 << 20

Publish = Callable[[str, Any], None]
OFFERED: Mapping[str, type[CommandModel]] = {one.name: one for one in COMMANDS if one.title}
"""The commands that the studio may start."""


def command_of(name: str, arguments: Mapping[str, Any], workspace: Path) -> CommandModel:
    """A command that a page asks for.

    Args:
        name: one of `OFFERED`.
        arguments: JSON values by the names of its fields.
        workspace: folder to work in.

    Raises:
        ConfigError: there is no such command, or an argument is not what it takes.
    """
    if name not in OFFERED:
        raise ConfigError(f"there is no command {name!r}: {', '.join(OFFERED)}")
    kind = OFFERED[name]
    given = {field: value for field, value in arguments.items() if value is not None}
    if refused := sorted(given.keys() - set(kind.offered)):
        raise ConfigError(f"{name}: {refused[0]}: cannot be set by a page")
    given["workspace"] = str(workspace.resolve())
    try:
        command = kind.model_validate(given)
    except ValidationError as error:
        raise ConfigError(f"{name}: {first_fault(error, 'arguments')}") from None
    for field in kind.offered:
        value = getattr(command, field)
        for one in value if isinstance(value, list) else [value]:
            if not str(one).isprintable():
                raise ConfigError(f"{name}: {field}: {as_line(str(one))} is not one printable line")
            if isinstance(one, Path):
                if not one.is_absolute():
                    raise ConfigError(f"{name}: {field}: {one} is not a whole path")
                if not one.exists():
                    raise ConfigError(f"{name}: {field}: {one}: no such file or folder")
    return command


class RunState:
    """State of a run, from the events that it has reported."""

    def __init__(self) -> None:
        """Nothing is reported yet."""
        self.stage, self.title = "", ""
        self.finished: list[str] = []
        """Stages that it has finished or found up to date."""
        self.warnings: deque[str] = deque(maxlen=_KEPT_WARNINGS)
        self.warned = 0
        self.error, self.result = "", ""
        self.exit_code: int | None = None
        self.lines: deque[dict[str, str]] = deque(maxlen=KEPT_LINES)
        self.lines_n = 0
        """Lines of the log so far, also those that are no longer kept."""
        self._steps: dict[int, Event] = {}
        self._logged_s: dict[int, float] = {}

    def update(self, events: Iterable[Event]) -> bool:
        """Take more events, in their order; whether there were any."""
        any_new = False
        for event in events:
            any_new = True
            # An events file that was damaged, or written by another version, has other values.
            with contextlib.suppress(TypeError, ValueError):
                self._update(event)
        return any_new

    @property
    def steps(self) -> list[dict[str, Any]]:
        """The steps that run, outer ones first."""
        kept = ("step", "done", "total", "elapsed_s", "remaining_s")
        return [{key: step.get(key) for key in kept} for step in self._steps.values()]

    def log(self, after: int = 0) -> list[dict[str, str]]:
        """Lines of the log that are kept, after some number of them."""
        dropped = self.lines_n - len(self.lines)
        return list(self.lines)[max(0, after - dropped) :]

    def _update(self, event: Event) -> None:
        name, text = event.get("event"), str(event.get("message", ""))
        number, elapsed_s = int(event.get("step_number", 0)), float(event.get("elapsed_s", 0.0))
        match name:
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
                self._steps.clear()
                self.exit_code = int(event["exit_code"])
        if name == "step_progress":
            if elapsed_s - self._logged_s.get(number, 0.0) < _LOGGED_EVERY_S:
                return
            self._logged_s[number] = elapsed_s
        try:
            text = event_text(event)
        except (KeyError, TypeError, ValueError):  # of another version of the program
            text = text or str(name)
        kind = str(name) if name in ("warning", "error") else "note"
        time_utc = str(event.get("time_utc", ""))
        self.lines.append({"time_utc": time_utc, "kind": kind, "text": text[:_MAX_LINE]})
        self.lines_n += 1


class EventsTail:
    """The whole lines that are added to an events file."""

    def __init__(self, path: Path) -> None:
        """Take a file that may not be there yet."""
        self._path, self._at, self._rest = path, 0, b""

    def read(self) -> list[Event]:
        """Events since the last call; a damaged line is left out."""
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


class BusyError(AliceError):
    """Another command is working in the workspace."""


class JobRecord(JsonRecord):
    """`job.json` of a job: a command that the studio has started."""

    number: int = Field(ge=1, lt=10**9)
    name: str
    title: str
    command: str
    """As a terminal takes it."""
    started_utc: str
    process: int = Field(ge=1, lt=1 << 31)
    created_s: float
    """When the process began, as the system counts: tells it from another of the same number."""
    ended_utc: str | None = None
    state: str = "running"
    """running; done, failed, stopped by a person, or killed without a word."""
    exit_code: int | None = None
    line: str = ""
    """Why it failed, or its result's first line."""
    arguments: dict[str, Any] = Field(default_factory=dict)
    stage: str = ""
    """The stage that it came to last."""
    finished: tuple[str, ...] = ()
    """Stages that it has made or found up to date."""

    def is_alive(self) -> bool:
        """Whether its process still runs."""
        with contextlib.suppress(psutil.Error):
            process = psutil.Process(self.process)
            same = abs(process.create_time() - self.created_s) < _CREATED_S
            return same and process.status() != psutil.STATUS_ZOMBIE
        return False


class _Job:
    """A job that is followed until its end."""

    def __init__(
        self, folder: Path, record: JobRecord, process: subprocess.Popen[bytes] | None
    ) -> None:
        self.folder, self.record = folder, record
        self.run, self.stopping = RunState(), False
        self.ended = threading.Event()
        self._process, self._tail = process, EventsTail(folder / EVENTS)

    @property
    def is_own(self) -> bool:
        """Whether this studio has started it."""
        return self._process is not None

    def is_alive(self) -> bool:
        """Whether it runs; of one that this studio has started, what it leaves is taken away."""
        return self.record.is_alive() if self._process is None else self._process.poll() is None

    def read_events(self) -> bool:
        """Take what it has reported since; whether there was anything."""
        return self.run.update(self._tail.read())

    def end_record(self) -> JobRecord:
        """The record of its end."""
        run = self.run
        code = run.exit_code
        if code is None and self._process is not None:
            code = self._process.returncode
        is_done = code in (0, NOT_GOOD_ENOUGH)
        state = "killed" if code is None or code < 0 else "done" if is_done else "failed"
        if code in _CODES_OF_STOP or (self.stopping and state != "done"):
            state = "stopped"
        line = run.error or ("" if state == "done" else _last_line(self.folder / ERRORS))
        if state == "done":
            line = _main_line(run.result or _output(self.folder / OUTPUT), run.finished)
        elif state == "stopped":
            line = "stopped: the same command goes on from where it was"
        elif state == "killed" and not run.error:
            line = (
                "it ended without a word, as a program does that was killed or that the system "
                "had no memory for: start it again, with fewer threads if that happens again"
            )
        return self.record.model_copy(
            update={
                "state": state, "exit_code": code, "line": line, "stage": run.stage,
                "finished": tuple(run.finished),
                "ended_utc": _now(),
            }
        )  # fmt: skip

    def send(self, number: int) -> None:
        """Signal its process group; where there are none, end the process."""
        with contextlib.suppress(OSError):
            if self.is_alive():
                if hasattr(os, "killpg"):
                    os.killpg(self.record.process, number)
                else:
                    psutil.Process(self.record.process).terminate()

    def stop(self) -> None:
        """Ask it to end, ever more firmly; returns when it has."""
        for number, patience_s in zip((_first_signal(), signal.SIGTERM), _HARDER_S, strict=True):
            self.send(number)
            if self.ended.wait(patience_s):
                return
        self.send(getattr(signal, "SIGKILL", signal.SIGTERM))

    def to_json(self) -> dict[str, Any]:
        """As a page takes it."""
        record, run = self.record, self.run
        began = datetime.fromisoformat(record.started_utc)
        kept = {"number", "name", "title", "command", "state", "started_utc"}
        return {
            **record.model_dump(include=kept), **({"state": "stopping"} if self.stopping else {}),
            "elapsed_s": round((datetime.now(UTC) - began).total_seconds(), 1),
            "stage": run.stage, "stage_title": run.title, "finished": list(run.finished),
            "steps": run.steps, "warned": run.warned, "warnings": list(run.warnings)[-5:],
            "lines": run.lines_n,
        }  # fmt: skip


class Jobs:
    """The jobs of one workspace."""

    def __init__(
        self, workspace: Path, publish: Publish, program: Sequence[str] = _PROGRAM
    ) -> None:
        """Look for a job that an earlier studio has left running.

        Args:
            workspace: folder of the survey; it need not exist yet.
            publish: sends an event's name and its JSON values to all pages.
            program: what takes the arguments of `alice-survey`.
        """
        self._workspace, self._publish = workspace.resolve(), publish
        self._program = program
        self._lock = threading.RLock()
        self._job: _Job | None = None
        self._adopt()

    @property
    def folder(self) -> Path:
        """Where the jobs of the workspace are."""
        return self._workspace / FOLDER

    def start(self, name: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Start a command.

        Args:
            name: one of `OFFERED`.
            arguments: of it, as `command_of` takes them.

        Returns:
            The job, as `running` gives it.

        Raises:
            ConfigError: there is no such command, or an argument is wrong.
            BusyError: another command is working in the workspace.
            WorkspaceError: the workspace cannot be written.
        """
        words = command_of(name, arguments or {}, self._workspace).words()
        with self._lock:
            try:
                refuse_links(self._workspace, self.folder.parent)
                self.folder.mkdir(parents=True, exist_ok=True)
                with FileLock(self.folder / ".starting", timeout=_LOCK_S):
                    self._adopt()
                    self._check_free()
                    self._job = job = self._start(name, arguments or {}, words)
            except OSError as error:  # also of a lock that another studio holds too long
                raise WorkspaceError(f"{self.folder}: no job can start: {why(error)}") from None
        self._follow(job)
        return job.to_json()

    def stop(self) -> bool:
        """Ask the running job to end, as Ctrl-C would; False where none runs."""
        with self._lock:
            job = self._job
            if job is None or job.stopping:
                return job is not None
            job.stopping = True
        threading.Thread(target=job.stop, name="stop", daemon=True).start()
        self._publish("run", self.state())
        return True

    def close(self) -> None:
        """End the running job, if this studio has started it, and wait a little for its end."""
        job = self._job
        if job is not None and job.is_own:
            job.stopping = True
            job.send(_first_signal())
            job.ended.wait(_ENDING_S)

    def running(self) -> dict[str, Any] | None:
        """The job that runs now, by this studio or an earlier one; None without."""
        job = self._job
        return None if job is None else job.to_json()

    def state(self) -> dict[str, Any]:
        """The job that runs, the last one that ended, and whether another command is working."""
        with self._lock:
            self._adopt()
            running = self.running()
            last = next(iter(self.history()), None)
        return {
            "job": running,
            "last": last,
            "elsewhere": running is None and is_locked(self._workspace),
        }

    def history(self) -> list[dict[str, Any]]:
        """Jobs that have ended, the last one first."""
        return [one.to_json() for one in self._records() if one.ended_utc is not None]

    def log(self, number: int, after: int = 0) -> dict[str, Any]:
        """Lines of a job's log, and their number so far.

        Args:
            number: of the job.
            after: lines that are known already.

        Raises:
            FileNotFoundError: there is no such job.
        """
        job = self._job
        if job is not None and job.record.number == number:
            run, output = job.run, ""
        else:
            folder = self.folder / f"{number:04d}"
            if not (folder / RECORD).is_file():
                raise FileNotFoundError(folder)
            run, tail = RunState(), EventsTail(folder / EVENTS)
            run.update(tail.read())
            output = "" if run.lines_n else _output(folder / ERRORS)
        return {"lines": run.log(after), "total": run.lines_n, "output": output}

    def _check_free(self) -> None:
        if self._job is not None:
            raise BusyError(f"'{self._job.record.command}' is working here: wait for it or stop it")
        until_s = time.monotonic() + _LOCK_S
        while is_locked(self._workspace):
            if time.monotonic() > until_s:
                raise BusyError(f"another command is working in {self._workspace}: wait for it")
            time.sleep(_POLL_S)

    def _start(self, name: str, arguments: Mapping[str, Any], words: Sequence[str]) -> _Job:
        folders = self._folders()
        number = int(folders[0].name) + 1 if folders else 1
        for old in self._records()[_KEPT_JOBS - 1 :]:
            _remove(self.folder / f"{old.number:04d}")
        folder = self.folder / f"{number:04d}"
        folder.mkdir()
        command = [
            *self._program, *words[: len(name.split())],
            f"--log-file={folder / EVENTS}", *words[len(name.split()) :],
        ]  # fmt: skip
        with (
            (folder / OUTPUT).open("wb") as output,
            (folder / ERRORS).open("wb") as errors,
            for_other_programs(),
        ):
            process = subprocess.Popen(  # noqa: S603 (of a fixed list)
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=errors,
                start_new_session=True, env=_environment(),
            )  # fmt: skip
        try:
            created_s = psutil.Process(process.pid).create_time()
        except psutil.Error:  # it has ended already
            created_s = 0.0
        record = JobRecord(
            number=number, name=name, title=OFFERED[name].title, arguments=dict(arguments),
            command=shlex.join(["alice-survey", *words]), started_utc=_now(),
            process=process.pid, created_s=created_s,
        )  # fmt: skip
        record.write(folder / RECORD)
        return _Job(folder, record, process)

    def _adopt(self) -> None:
        """Follow the job of an earlier or of another studio; close the records of dead ones."""
        with self._lock:
            for record in self._records():
                if record.ended_utc is not None:
                    continue
                if self._job is not None and self._job.record.number == record.number:
                    continue
                job = _Job(self.folder / f"{record.number:04d}", record, None)
                if job.is_alive() and self._job is None:
                    self._job = job
                    self._follow(job)
                elif not job.is_alive():
                    job.read_events()
                    job.end_record().write(job.folder / RECORD)

    def _records(self) -> list[JobRecord]:
        """Records of all jobs, the last one first."""
        found = []
        for folder in self._folders():
            with contextlib.suppress(WorkspaceError):  # of one that is being written or is damaged
                record = JobRecord.read_existing(folder / RECORD)
                if record is not None and folder.name == f"{record.number:04d}":
                    found.append(record)
        return found

    def _folders(self) -> list[Path]:
        """Folders with a number, the highest first; none where links are among them."""
        try:
            refuse_links(self._workspace, self.folder)
            found = [path for path in self.folder.iterdir() if _NUMBER.fullmatch(path.name)]
        except (OSError, WorkspaceError):
            return []
        return sorted(found, key=lambda path: int(path.name), reverse=True)

    def _follow(self, job: _Job) -> None:
        threading.Thread(target=self._listen, args=(job,), name="job", daemon=True).start()

    def _listen(self, job: _Job) -> None:
        """Publish what a job reports until it ends."""
        published_s, is_news = 0.0, True
        while True:
            is_alive = job.is_alive()  # before its last events are read
            is_news |= job.read_events()
            if not is_alive:
                break
            since_s = time.monotonic() - published_s
            if (is_news and since_s >= _PUBLISH_EVERY_S) or since_s >= _ALIVE_EVERY_S:
                self._publish("run", {"job": job.to_json(), "last": None, "elsewhere": False})
                published_s, is_news = time.monotonic(), False
            time.sleep(_POLL_S)
        record = job.end_record()
        with contextlib.suppress(OSError, WorkspaceError):  # a full disk, a folder that was removed
            known = None if job.is_own else JobRecord.read_existing(job.folder / RECORD)
            if known is not None and known.ended_utc is not None:
                record = known  # by the studio that has started it, which knows its exit code
            else:
                record.write(job.folder / RECORD)
        with self._lock:
            self._job = None
        job.ended.set()
        self._publish(
            "run", {"job": None, "last": record.to_json(), "elsewhere": False, "ended": True}
        )


def compile_survey(ending: threading.Event) -> None:
    """Do the whole loop of a small survey where nobody sees it, so that its kernels are compiled.

    It takes what no other program computes with, on one core.

    Args:
        ending: set where it is to stop.
    """
    with tempfile.TemporaryDirectory() as folder:
        init_survey(Path(folder), values={**TRIAL, "area": {"length_m": 1.3, "width_m": 1.5}})
        command = [*_PROGRAM, "run", "--accept", "--threads=1", f"--workspace={folder}"]
        with for_other_programs():
            process = psutil.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL, start_new_session=True, env=_environment(),
            )  # fmt: skip
        process.nice(getattr(psutil, "IDLE_PRIORITY_CLASS", 19))
        while process.poll() is None and not ending.wait(_POLL_S):
            pass
        process.kill()
        process.wait()


def _remove(folder: Path) -> None:
    """Remove the files of a job, and its folder if it holds nothing else."""
    with contextlib.suppress(OSError):
        for name in (RECORD, OUTPUT, ERRORS, EVENTS):
            (folder / name).unlink(missing_ok=True)
        folder.rmdir()


def _first_signal() -> signal.Signals:
    """Ctrl-C; SIGTERM where this program ignores it, and so do those that it starts."""
    is_ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    return signal.SIGTERM if is_ignored else signal.SIGINT


def _environment() -> dict[str, str]:
    """This environment; modules are found where this program found its own."""
    places = [place or str(Path.cwd()) for place in sys.path]
    return os.environ | {"PYTHONPATH": os.pathsep.join(places)}


def _output(path: Path) -> str:
    """The end of what a job has printed."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _OUTPUT_TAIL))
            return file.read().decode(errors="replace").strip()
    except OSError:
        return ""


def _main_line(result: str, finished: Sequence[str]) -> str:
    """The line of the last stage of a result, else the first line."""
    lines = result.splitlines() or [""]
    names = [one.name for one in STAGES if {one.name, one.folder} & set(finished[-1:])]
    return next((x for x in lines if names and x.startswith(f"{names[0]}: ")), lines[0])


def _last_line(path: Path) -> str:
    """The last line that a job has printed, without what marks it as an error."""
    lines = [line.strip(" \u2502") for line in _output(path).splitlines()]
    return next((x for x in reversed(lines) if x and x[0] not in "╭╰"), "").removeprefix("error: ")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
