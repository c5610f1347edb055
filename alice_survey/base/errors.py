"""Known faults: one line that says what is wrong, with the numbers and what to change."""

import contextlib
import errno
import os
import stat
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Literal

Level = Literal["note", "warning"]
Show = Callable[[Level, str], None]

_listeners: ContextVar[tuple[list[str], ...]] = ContextVar("listeners", default=())
_shows: list[Show] = []
"""Where notes and warnings go, the last one; to standard error while there is none."""


class AliceError(Exception):
    """A fault the user can mend; the command line prints it as one line and exits with 1.

    Example:
        >>> import alice_survey as alice
        >>> try:
        ...     alice.load_config("nowhere.toml")
        ... except alice.AliceError as error:
        ...     print(type(error).__name__)
        ConfigError
    """

    def __str__(self) -> str:
        """The line, without what names in files could do to a terminal."""
        text = super().__str__()
        return "".join(c if c.isprintable() or c == "\n" else "\ufffd" for c in text)


class ConfigError(AliceError):
    """A setting is missing, unknown or out of range."""


class WorkspaceError(AliceError):
    """A workspace lacks a stage or a file that a command needs."""


class PlanError(AliceError):
    """No plan meets what was asked for."""


class VehicleError(AliceError):
    """A vehicle, its sea or its controller is described wrongly, or cannot do what is asked."""


class ImageError(AliceError):
    """Pictures are missing, unreadable or do not fit together."""


class NavigationError(AliceError):
    """A navigation log cannot be used."""


class CalibrationError(AliceError):
    """A rig cannot be calibrated from the views given, or its file is wrong."""


class ReconstructionError(AliceError):
    """The pictures do not give a model."""


def warn(text: str) -> None:
    """Tell the user, in one line on standard error, of something that work goes on without."""
    _show("warning", text)
    for told in _listeners.get():
        told.append(text)


def note(text: str) -> None:
    """Tell the user, in one line on standard error, why it takes long."""
    _show("note", text)


def say(text: str) -> None:
    """Write a line on standard error, if anybody still takes it."""
    with outliving():
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


@contextlib.contextmanager
def outliving() -> Iterator[None]:
    """Write to standard error within this block: when nobody takes it any more, the work goes on.

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


def _show(level: Level, text: str) -> None:
    if _shows:
        _shows[-1](level, text)
    else:
        say(f"warning: {text}" if level == "warning" else text)


@contextlib.contextmanager
def shown_by(show: Show) -> Iterator[None]:
    """Have notes and warnings of all threads shown by a function meanwhile."""
    _shows.append(show)
    try:
        yield
    finally:
        _shows.remove(show)


@contextlib.contextmanager
def heard() -> Iterator[list[str]]:
    """Also keep what is warned of meanwhile, to write it down."""
    told: list[str] = []
    token = _listeners.set((*_listeners.get(), told))
    try:
        yield told
    finally:
        _listeners.reset(token)


def why(error: Exception) -> str:
    """What went wrong with a file, without numbers of the operating system."""
    if isinstance(error, FileNotFoundError):
        return "no such file"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error)


_ON = ", and the same command goes on from here"
_FEWER = f": give fewer --threads, or close other programs{_ON}"
_MENDS = {
    errno.ENOSPC: f": free some of the disk{_ON}",
    errno.EDQUOT: f": free some of your share of the disk{_ON}",
    errno.EROFS: ": choose a workspace that can be written, with -w",
    errno.EACCES: ": take the rights to it, or choose another workspace with -w",
}
"""What to do about faults of the system, by their numbers."""


_NO_MEMORY = (
    "insufficient memory", "out of memory", "cannot allocate memory", "bad_alloc",
    "failed to map segment",
)  # fmt: skip
"""What libraries say whose faults have types of their own, in small letters."""


def memory_shortage(path: Path) -> AliceError:
    """What to raise where a file is well and there is no room for what it holds."""
    return AliceError(f"memory ran out while {path} was read{_FEWER}")


def known_fault(error: BaseException) -> str | None:
    """The line that tells the user of a fault which is no bug; None for a bug."""
    if isinstance(error, AliceError):
        return str(error)
    said = str(error).lower()
    if isinstance(error, MemoryError) or any(words in said for words in _NO_MEMORY):
        return f"memory ran out{_FEWER}"
    if isinstance(error, OSError):  # a full disk, a folder where a file should be, no permission
        where = error.filename2 or error.filename
        text = error.strerror or str(error)
        line = text if where is None else f"{where}: {text}"
        return line + _MENDS.get(error.errno or 0, "")
    return None
