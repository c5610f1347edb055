"""One run of the command line: who is told of it, and how it ends."""

import contextlib
import errno
import os
import platform
import shlex
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

from alice_survey.base.errors import WorkspaceError, known_fault, say
from alice_survey.base.run import interrupts
from alice_survey.base.run.display import display_on_stderr
from alice_survey.base.run.events import EventFile, LogFile
from alice_survey.base.run.progress import Run, told_to
from alice_survey.base.run.resources import versions


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
        SystemExit: with 130 after Ctrl-C, 143 or 129 after SIGTERM or SIGHUP.
    """
    run = Run(display_on_stderr(quiet=quiet), _opened(log_file, events), quiet=quiet)
    command = shlex.join(["alice-survey", *arguments])
    told = {"python": platform.python_version(), **versions()}
    with interrupts.heeded(lambda error: _finish(run, error)):
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
                    reason = interrupts.behind(error) or error
                    code = _told_end(run, reason)
                    if reason is not error:
                        raise reason from None
                    raise
                finally:
                    run.tell("run_finished", exit_code=code)
        except KeyboardInterrupt as error:
            _bid_farewell(run, error)
            raise SystemExit(interrupts.exit_code(error)) from None


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
        run.tell("error", interrupts.words(error))
        return interrupts.exit_code(error)
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


def _bid_farewell(run: Run, error: KeyboardInterrupt) -> None:
    goes_on = "; the same command goes on from here" if run.stages_begun else ""
    say(f"{interrupts.words(error)}{goes_on}")


def _finish(run: Run, error: KeyboardInterrupt) -> None:
    """End a run whose main thread does not answer."""
    run.tell("error", interrupts.words(error))
    run.tell("run_finished", exit_code=interrupts.exit_code(error))
    run.close()
    _bid_farewell(run, error)
