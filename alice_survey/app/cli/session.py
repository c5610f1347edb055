"""One run of the command line: its reporting, and its end."""

import contextlib
import errno
import os
import platform
import shlex
import threading
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

from alice_survey.core.errors import WorkspaceError, known_fault, say
from alice_survey.core.run import interrupts
from alice_survey.core.run.display import Console
from alice_survey.core.run.events import EventFile, LogFile
from alice_survey.core.run.progress import Run, reported_to
from alice_survey.core.run.resources import versions


@contextlib.contextmanager
def session(arguments: Sequence[str], *, quiet: bool, files: Sequence[Path]) -> Iterator[None]:
    """Within this block a command does its work.

    Args:
        arguments: arguments of the command line, without the program's name.
        quiet: show warnings and errors alone.
        files: to add lines to; events to those whose name ends in .jsonl.

    Raises:
        WorkspaceError: a file cannot be written; nothing is done then.
        SystemExit: with 130 after Ctrl-C, 143 or 129 after SIGTERM or SIGHUP.
    """
    run = Run(Console(quiet=quiet), [_log_handler(path) for path in files])
    command = shlex.join(["alice-survey", *arguments])
    packages = {"python": platform.python_version(), **versions()}
    first = _Once()
    with interrupts.handle_signals(lambda error: _finish(run, error, first)):
        try:
            with reported_to(run):
                run.report(
                    "run_started", command=command, folder=str(Path.cwd()), versions=packages,
                    process=os.getpid(),
                )  # fmt: skip
                code = 1
                try:
                    yield
                    code = 0
                except BaseException as error:
                    reason = interrupts.behind(error) or error
                    code = _report_end(run, reason, first)
                    if reason is not error:
                        raise reason from None
                    raise
                finally:
                    if first("run_finished"):
                        run.report("run_finished", exit_code=code)
        except KeyboardInterrupt as error:
            _say_how_to_go_on(run, error, first)
            raise SystemExit(interrupts.exit_code(error)) from None


def _log_handler(path: Path) -> LogFile | EventFile:
    if path == Path("-"):
        raise WorkspaceError(
            "--log-file -: standard output is for results; give a file or a named pipe, or "
            "/dev/stderr"
        )
    return EventFile(path) if path.suffix == ".jsonl" else LogFile(path)


class _Once:
    """Whether something is done for the first time.

    The end of an interrupted run is reported by its main thread, or by another one where that
    takes too long; it may be only slow.
    """

    def __init__(self) -> None:
        self._done: set[str] = set()
        self._lock = threading.Lock()

    def __call__(self, what: str) -> bool:
        with self._lock:
            is_first = what not in self._done
            self._done.add(what)
        return is_first


def _report_end(run: Run, error: BaseException, first: _Once) -> int:
    """Report why a run ends early; return its exit code."""
    if isinstance(error, KeyboardInterrupt):
        if first("error"):
            run.report("error", interrupts.words(error))
        return interrupts.exit_code(error)
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    code = getattr(error, "exit_code", None)  # of typer's own: an end, or a wrong option
    if isinstance(code, int):
        if code and str(error) not in ("", str(code)):
            run.report("error", str(error))
        return code
    if isinstance(error, OSError) and error.errno == errno.EPIPE:
        return 1  # nobody reads the result any more, nor a report of it
    fault = known_fault(error)
    if fault is not None:
        run.report("error", fault)
    else:
        text = "".join(traceback.format_exception(error))
        run.report("error", f"{type(error).__name__}: {error}", traceback=text)
    return 1


def _say_how_to_go_on(run: Run, error: KeyboardInterrupt, first: _Once) -> None:
    goes_on = "; the same command goes on from here" if run.stages_begun else ""
    if first("said"):
        say(f"{interrupts.words(error)}{goes_on}")


def _finish(run: Run, error: KeyboardInterrupt, first: _Once) -> None:
    """End a run whose main thread does not respond."""
    code = _report_end(run, error, first)
    if first("run_finished"):
        run.report("run_finished", exit_code=code)
    run.close()
    _say_how_to_go_on(run, error, first)
