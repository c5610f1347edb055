"""Known faults: one line that states what is wrong, with the numbers and what to change."""

import contextlib
import csv
import errno
import logging
import os
import re
import shlex
import stat
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Literal

Level = Literal["note", "warning"]

_listeners: ContextVar[tuple[list[str], ...]] = ContextVar("listeners", default=())
_collector: ContextVar[Callable[[Level, str], None] | None] = ContextVar("collector", default=None)


class AliceError(Exception):
    """A fault the user can fix; the command line prints it as one line and exits with 1.

    Example:
        >>> import alice_survey as alice
        >>> try:
        ...     alice.load_config("nowhere.toml")
        ... except alice.AliceError as error:
        ...     print(type(error).__name__)
        ConfigError
    """

    def __str__(self) -> str:
        """The line, with unprintable characters from file names replaced."""
        text = super().__str__()
        return "".join(c if c.isprintable() or c == "\n" else "\ufffd" for c in text)


class ConfigError(AliceError):
    """A setting is missing, unknown or out of range."""


class WorkspaceError(AliceError):
    """A workspace lacks a stage or a file that a command needs."""


class PlanError(AliceError):
    """No plan meets what was requested."""


class VehicleError(AliceError):
    """A vehicle, its sea or its controller is described wrongly, or a request is infeasible."""


class ImageError(AliceError):
    """Pictures are missing, unreadable or do not fit together."""


class NavigationError(AliceError):
    """A navigation log cannot be used."""


class CalibrationError(AliceError):
    """A rig cannot be calibrated from the views given, or its file is wrong."""


class ReconstructionError(AliceError):
    """The pictures do not give a model."""


class _OnStderr(logging.Handler):
    """Shows notes and warnings where no run takes them."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line."""
        prefix = "warning: " if record.levelno >= logging.WARNING else ""
        say(prefix + record.getMessage())


LOG = logging.getLogger("alice_survey")
"""Where notes and warnings go, and what else happens during a run."""
LOG.setLevel(logging.INFO)
LOG.propagate = False
LOG.addHandler(_OnStderr())


def warn(text: str) -> None:
    """Report, in one line on standard error, a fault that does not stop the work."""
    _report("warning", text)
    for warnings in _listeners.get():
        warnings.append(text)


def note(text: str) -> None:
    """Report, in one line on standard error, why it takes long."""
    _report("note", text)


def _report(level: Level, text: str) -> None:
    collect = _collector.get()
    if collect is not None:
        collect(level, text)
    else:
        LOG.log(logging.WARNING if level == "warning" else logging.INFO, "%s", text)


@contextlib.contextmanager
def collected_by(collect: Callable[[Level, str], None]) -> Iterator[None]:
    """Pass notes and warnings of this task alone to a function: they go with its result."""
    token = _collector.set(collect)
    try:
        yield
    finally:
        _collector.reset(token)


def is_in_task() -> bool:
    """Whether this is the work of a task, whose notes and warnings are collected."""
    return _collector.get() is not None


@contextlib.contextmanager
def keep_warnings() -> Iterator[list[str]]:
    """Also keep the warnings reported meanwhile, to write them down."""
    warnings: list[str] = []
    token = _listeners.set((*_listeners.get(), warnings))
    try:
        yield warnings
    finally:
        _listeners.reset(token)


def say(text: str) -> None:
    """Write a line on standard error, if it is still open."""
    with outliving():
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


@contextlib.contextmanager
def outliving() -> Iterator[None]:
    """Write to standard error within this block: if it is closed, the work goes on.

    From then on it goes nowhere, and so does standard output if that was the same terminal: what
    Python cannot flush at its end would otherwise turn success into failure.
    """
    try:
        yield
    except (OSError, ValueError):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            error, output = sys.stderr.fileno(), sys.stdout.fileno()
            gone, other = os.fstat(error), os.fstat(output)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, error)
            if stat.S_ISCHR(gone.st_mode) and gone.st_rdev == other.st_rdev:
                os.dup2(nowhere, output)
            os.close(nowhere)


def why(error: Exception) -> str:
    """Cause of a file error, without error numbers of the operating system."""
    if isinstance(error, FileNotFoundError):
        return "no such file"
    if isinstance(error, NotADirectoryError):
        return "it is a file, not a folder"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error)


@contextlib.contextmanager
def file_faults(path: Path, fault: type[AliceError], verb: str = "read") -> Iterator[None]:
    """Raise as a known fault that a file cannot be read, or written, and why."""
    try:
        yield
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise fault(f"{path}: cannot be {verb}: {why(error)}") from None


def offer(command: str, *words: object) -> str:
    """A command of this program, to be offered as a shell takes it: spaces are quoted."""
    return shlex.join(["alice-survey", *command.split(), *map(str, words)])


def extra(name: str) -> str:
    """The command that installs what an extra of this package names, all of which PyPI has."""
    from importlib.metadata import requires

    of_extra = re.compile(rf"(.*?)\s*;.*\bextra == ['\"]{name}['\"]")
    found = map(of_extra.fullmatch, requires("alice-survey") or ())
    return shlex.join(["pip", "install", *(match[1] for match in found if match)])


NOT_GOOD_ENOUGH = 3
"""Exit code of a command that has done its work, whose result is not good enough."""

_ON = ", and the same command goes on from here"
_FEWER = f": give fewer --threads, or close other programs{_ON}"
_REMEDIES = {
    errno.ENOSPC: f": free some of the disk{_ON}",
    errno.EDQUOT: f": free some of your share of the disk{_ON}",
    errno.EFBIG: f": raise the largest size of a file that is allowed (ulimit -f){_ON}",
    errno.EROFS: ": choose a workspace that can be written, with -w",
    errno.EACCES: ": take the rights to it, or choose another workspace with -w",
}
"""Advice on errors of the operating system, by error number."""


_NO_MEMORY = (
    "insufficient memory", "out of memory", "cannot allocate memory", "bad_alloc",
    "failed to map segment",
)  # fmt: skip
"""Messages, in lower case, of libraries with error types of their own."""


def memory_shortage(path: Path) -> AliceError:
    """Error to raise where a file is valid but does not fit into memory."""
    return AliceError(f"memory ran out while {path} was read{_FEWER}")


def known_fault(error: BaseException) -> str | None:
    """The line to show for a fault that is not a bug; None for a bug."""
    if isinstance(error, AliceError):
        return str(error)
    said = str(error).lower()
    if isinstance(error, MemoryError) or any(words in said for words in _NO_MEMORY):
        return f"memory ran out{_FEWER}"
    if "singular" in said or "positive definite" in said:  # SuperLU, LAPACK, CHOLMOD
        cause = "are left and right exchanged, or too few pictures linked to the others?"
        return f"what was given leaves the equations without one solution ({said}): {cause}"
    if isinstance(error, OSError):  # a full disk, a folder where a file should be, no permission
        where = error.filename2 or error.filename
        text = error.strerror or str(error)
        line = text if where is None else f"{where}: {text}"
        return line + _REMEDIES.get(error.errno or 0, "")
    return None
