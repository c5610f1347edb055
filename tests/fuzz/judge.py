"""What a reader may do with any bytes: give a value, or refuse them in one line; and within limits.

A fault is another exception than `AliceError`, a message of several lines or of no measure, more
than 10 s, more than 1 GiB, or a file written or changed anywhere.
"""

import contextlib
import os
import re
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Literal

from alice_survey.core.errors import AliceError

MAX_S = 10.0
MAX_BYTES = 1 << 30
MAX_MESSAGE = 20_000
_ROOMS = ("alice_survey", "camera_calib", "missions", "reconstruct")
_CHECKOUT = Path(__file__).resolve().parents[2]
_NAME = re.compile(r"[\w.]+(?<!\.)")
_ROOM_TO_ALLOCATE = 3 << 29
"""Address space, bytes, that a reader may take: half as much again as it may use."""


class TooSlow(BaseException):
    """Not an `Exception`, so that no reader takes it for its own."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What a reader did with a file."""

    outcome: Literal["value", "refused", "fault"]
    message: str = ""
    """The message of a refusal; of a fault, what it is and where, the same for the same fault."""
    trace: str = ""
    """Of an exception that is a fault."""


class Sandbox:
    """A folder for the file and what belongs to it, from which nothing may get out."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.inside = root / "in"
        for folder in (self.inside, root / "cwd", root / "tmp"):
            folder.mkdir(parents=True, exist_ok=True)
        self._before: dict[str, tuple[int, int]] = {}

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Work in empty folders of the sandbox meanwhile."""
        home, temporary = Path.cwd(), tempfile.tempdir
        os.chdir(self.root / "cwd")
        tempfile.tempdir = str(self.root / "tmp")
        self._before = self._listed()
        try:
            yield
        finally:
            os.chdir(home)
            tempfile.tempdir = temporary

    def _listed(self) -> dict[str, tuple[int, int]]:
        found = {}
        for folder, _, names in os.walk(self.root):
            for name in names:
                path = os.path.join(folder, name)  # noqa: PTH118 - called for every execution
                stat = os.lstat(path)
                found[path] = (stat.st_size, stat.st_mtime_ns)
        return found

    @property
    def names(self) -> set[str]:
        """Of the files and folders that the reader was given."""
        inside = (Path(path).relative_to(self.root).parts[1:] for path in self._before)
        return {name for parts in inside for name in parts}

    def written(self) -> list[str]:
        """Files that are new, changed or gone since the sandbox was entered."""
        after = self._listed()
        return sorted(path for path, _ in self._before.items() ^ after.items())


def judge(
    read: Callable[[Path], object],
    path: Path,
    sandbox: Sandbox,
    *,
    max_bytes: int = MAX_BYTES,
    max_s: float = MAX_S,
) -> Verdict:
    """Let a reader read a file of the sandbox, and judge what it did."""
    started, before = time.monotonic(), _resident()
    outcome: Literal["value", "refused", "fault"] = "value"
    message = trace = place = ""
    try:
        with sandbox.entered(), bounded(max_s), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(path)
    except AliceError as error:
        outcome, message, place = "refused", str(error), _place(error)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a library in Rust that panics raises no Exception
        outcome = "fault"
        message, trace = _signature(error), "".join(traceback.format_exception(error))
    took_s, peak = time.monotonic() - started, max(0, _peak() - before)
    fault = _misworded(message, sandbox) if outcome == "refused" else ""
    if fault:
        trace, outcome, message = message, "fault", f"{fault} in {place}"
    if outcome != "fault" and took_s > max_s:
        outcome, message = "fault", f"took over {max_s:g} s"
    if outcome != "fault" and peak > max_bytes:
        outcome, message = "fault", f"took over {max_bytes >> 20} MiB"
    strays = sandbox.written()
    if strays:
        names = ", ".join(os.path.relpath(p, sandbox.root) for p in strays)
        outcome, message = "fault", f"wrote or changed {names}"
    return Verdict(outcome=outcome, message=message, trace=trace)


@contextlib.contextmanager
def bounded(max_s: float) -> Iterator[None]:
    """Less memory than there is, and an alarm.

    The alarm cannot stop a library's own loop.
    """

    def ring(_: int, __: FrameType | None) -> Any:
        raise TooSlow(f"took over {max_s:g} s")

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGALRM, ring)
    resource.setrlimit(resource.RLIMIT_AS, (_memory()[0] + _ROOM_TO_ALLOCATE, hard))
    signal.setitimer(signal.ITIMER_REAL, max_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, before)


def _misworded(message: str, sandbox: Sandbox) -> str:
    """What is wrong with the wording of a refusal."""
    if len(message.splitlines()) > 1 or "\x1b" in message:
        return "message of several lines"
    if len(message) > MAX_MESSAGE:
        return f"message of over {MAX_MESSAGE} characters"
    if not sandbox.names & set(_NAME.findall(message)):
        return "message that names no file"
    return ""


def _signature(error: BaseException) -> str:
    """The exception's type and the last place in the project that it passed."""
    if isinstance(error, TooSlow):
        return str(error)
    return f"{type(error).__name__} in {_place(error)}"


def _place(error: BaseException) -> str:
    place = "a library"
    for frame in traceback.extract_tb(error.__traceback__):
        file = Path(frame.filename)
        if file.is_relative_to(_CHECKOUT) and file.relative_to(_CHECKOUT).parts[0] in _ROOMS:
            place = f"{file.relative_to(_CHECKOUT)}:{frame.lineno} {frame.name}"
    return place


def _memory() -> list[int]:
    """Address space and resident part of it, among others, bytes."""
    pages = Path("/proc/self/statm").read_text(encoding="ascii").split()
    return [int(count) * resource.getpagesize() for count in pages]


def _resident() -> int:
    """Resident bytes now; also lets the peak count from here."""
    with contextlib.suppress(OSError):  # where it may not be reset it only grows: never hides
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return _memory()[1]


def _peak() -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) << 10
    raise RuntimeError("no VmHWM in /proc/self/status")
