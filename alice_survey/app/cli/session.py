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
from typing import Any

from alice_survey.core.errors import WorkspaceError, known_fault, say
from alice_survey.core.run import interrupts
from alice_survey.core.run.events import Console, EventFile
from alice_survey.core.run.progress import Run, reported_to
from alice_survey.core.run.resources import versions


@contextlib.contextmanager
def session(arguments: Sequence[str], *, quiet: bool, files: Sequence[Path]) -> Iterator[None]:
    """Within this block a command does its work.

    Args:
        arguments: arguments of the command line, without the program's name.
        quiet: show warnings and errors alone.
        files: to add events to.

    Raises:
        WorkspaceError: a file cannot be written; nothing is done then.
        SystemExit: with 130 after Ctrl-C, 143 or 129 after SIGTERM or SIGHUP.
    """
    if Path("-") in files:
        raise WorkspaceError("--log-file -: standard output is for results; give a file")
    run = Run(Console(quiet=quiet), [EventFile(path) for path in files])
    command = shlex.join(["alice-survey", *arguments])
    packages = {"python": platform.python_version(), **versions()}
    end = _End(run)
    with interrupts.handle_signals(end.report), reported_to(run):
        run.report(
            "run_started", command=command, folder=str(Path.cwd()), versions=packages,
            process=os.getpid(),
        )  # fmt: skip
        try:
            yield
        except BaseException as error:
            reason = interrupts.behind(error) or error
            end.report(reason)
            if isinstance(reason, KeyboardInterrupt):
                raise SystemExit(interrupts.exit_code(reason)) from None
            raise
        end.report(None)


class _End:
    """The end of a run, which is reported once.

    Where it was interrupted that is done by its main thread, or by another one where that takes too
    long; it may be only slow.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._lock, self._is_reported = run, threading.Lock(), False

    def report(self, error: BaseException | None) -> None:
        """Report why a run ends, and its exit code; to the user only if it was interrupted."""
        with self._lock:
            if self._is_reported:
                return
            self._is_reported = True
        code, message, facts = _fault_of(error)
        if message:
            self._run.report("error", message, **facts)
        self._run.report("run_finished", exit_code=code)
        if isinstance(error, KeyboardInterrupt):
            self._run.close()
            goes_on = "; the same command goes on from here" if self._run.stages_begun else ""
            say(f"{message}{goes_on}")


def _fault_of(error: BaseException | None) -> tuple[int, str, dict[str, Any]]:
    """Exit code of a run, the fault that ended it, and more facts of that."""
    if isinstance(error, KeyboardInterrupt):
        return interrupts.exit_code(error), interrupts.words(error), {}
    if error is None or isinstance(error, SystemExit):
        code = None if error is None else error.code
        return code if isinstance(code, int) else int(code is not None), "", {}
    code = getattr(error, "exit_code", None)  # of typer's own: an end, or a wrong option
    if isinstance(code, int):
        return code, "" if str(error) == str(code) else str(error), {}
    if isinstance(error, OSError) and error.errno == errno.EPIPE:
        return 1, "", {}  # nobody reads the result any more, nor a report of it
    text = "".join(traceback.format_exception(error))
    fault = known_fault(error)
    return 1, fault or f"{type(error).__name__}: {error}", {} if fault else {"traceback": text}
