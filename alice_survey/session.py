"""One run of the command line: who is told of it, and how it ends."""

import contextlib
import errno
import os
import platform
import select
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from alice_survey.display import display_on_stderr
from alice_survey.errors import WorkspaceError, known_fault
from alice_survey.events import EventFile, LogFile
from alice_survey.progress import Run, told_to
from alice_survey.resources import versions

INTERRUPTED = 128 + signal.SIGINT
_GRACE_S = 5.0
"""Between Ctrl-C and the end of a run that is deep in a library."""


@contextlib.contextmanager
def session(
    arguments: Sequence[str], *, quiet: bool, log_file: Path | None, events: Path | None
) -> Iterator[None]:
    """Within this block a command does its work.

    Args:
        arguments: of the command line, without the program's name.
        quiet: show warnings and errors alone.
        log_file: to add lines to.
        events: file to add events to.

    Raises:
        WorkspaceError: a file cannot be written; nothing is done then.
        SystemExit: with 130 after Ctrl-C.
    """
    run = Run(display_on_stderr(quiet=quiet), _opened(log_file, events), quiet=quiet)
    command = shlex.join(["alice-survey", *arguments])
    told = {"python": platform.python_version(), **versions()}
    with _answers_ctrl_c(lambda: _finish(run, INTERRUPTED)):
        try:
            with told_to(run):
                run.tell(
                    "run_started", command=command, folder=str(Path.cwd()), versions=told,
                    process=os.getpid(),
                )  # fmt: skip
                code = 1
                try:
                    yield
                    code = 0
                except BaseException as error:
                    code = _told_end(run, error)
                    raise
                finally:
                    run.tell("run_finished", exit_code=code)
        except KeyboardInterrupt:
            sys.stderr.write(_farewell(run))
            raise SystemExit(INTERRUPTED) from None


def _opened(log_file: Path | None, events: Path | None) -> list[LogFile | EventFile]:
    for path, option in ((log_file, "--log-file"), (events, "--events")):
        if path == Path("-"):
            raise WorkspaceError(
                f"{option} -: standard output is for results; give a file or a named pipe, or "
                "/dev/stderr"
            )
    if log_file is not None and events is not None and log_file.resolve() == events.resolve():
        raise WorkspaceError(f"{events}: give --log-file and --events a file each")
    sinks: list[LogFile | EventFile] = []
    if log_file is not None:
        sinks.append(LogFile(log_file))
    if events is not None:
        sinks.append(EventFile(events))
    return sinks


def _told_end(run: Run, error: BaseException) -> int:
    """Tell why a run ends early; the exit code it ends with."""
    if isinstance(error, KeyboardInterrupt):
        run.tell("error", "interrupted")
        return INTERRUPTED
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    code = getattr(error, "exit_code", None)  # of typer's own: an end, or a wrong option
    if isinstance(code, int):
        if code and str(error) not in ("", str(code)):
            run.tell("error", str(error))
        return code
    if isinstance(error, OSError) and error.errno == errno.EPIPE:
        return 1  # nobody reads the result any more, and nobody needs to be told
    fault = known_fault(error)
    if fault is not None:
        run.tell("error", fault)
    else:
        text = "".join(traceback.format_exception(error))
        run.tell("error", f"{type(error).__name__}: {error}", traceback=text)
    return 1


def _farewell(run: Run) -> str:
    goes_on = "; the same command goes on from here" if run.stages_begun else ""
    return f"interrupted{goes_on}\n"


def _finish(run: Run, code: int) -> None:
    """End a run whose main thread does not answer."""
    run.tell("error", "interrupted")
    run.tell("run_finished", exit_code=code)
    run.close()
    sys.stderr.write(_farewell(run))
    sys.stderr.flush()


@contextlib.contextmanager
def _answers_ctrl_c(finish: Callable[[], None]) -> Iterator[None]:
    """End the process some seconds after Ctrl-C, or at a second one, whatever it is deep in.

    Python raises KeyboardInterrupt only between its own instructions, and an adjustment of a large
    model may take minutes. What is broken off then is as after a kill, which loses nothing.

    Args:
        finish: tells of the end.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    ended = threading.Event()

    def watch() -> None:
        while (told := os.read(reader, 1)) != b"":
            if told[0] != signal.SIGINT:
                continue
            select.select([reader], [], [], _GRACE_S)  # a second one, or the end, or neither
            if ended.is_set():
                return
            telling = threading.Thread(target=finish, daemon=True)
            telling.start()
            telling.join(1.0)  # the main thread may hold what is needed for it
            os._exit(INTERRUPTED)

    before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    watcher = threading.Thread(target=watch, name="ctrl-c", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before)
        os.close(writer)
        watcher.join()
        os.close(reader)
