"""Known faults: one line that says what is wrong, with the numbers and what to change."""

import contextlib
import sys
from collections.abc import Iterator
from contextvars import ContextVar

_listeners: ContextVar[tuple[list[str], ...]] = ContextVar("listeners", default=())


class AliceError(Exception):
    """A fault the user can mend; the command line prints it as one line and exits with 1."""


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
    sys.stderr.write(f"warning: {text}\n")
    for told in _listeners.get():
        told.append(text)


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
