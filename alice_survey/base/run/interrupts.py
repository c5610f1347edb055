"""Signals that end a run: it ends cleanly and soon, whatever code is running."""

import contextlib
import os
import select
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import cast

_GRACE_S = 5.0
"""Time between such a signal and the end of a run that is inside a library."""
_IS_POSIX = hasattr(signal, "sigwait")
"""Elsewhere Ctrl-C alone ends a run early, whenever Python gets to it."""
ASKING = frozenset({signal.SIGTERM, signal.SIGHUP} if _IS_POSIX else {signal.SIGTERM})
"""Signals of a scheduler, a system that shuts down, or a terminal that closes."""
_FORWARD = signal.SIGUSR1 if _IS_POSIX else signal.SIGTERM
"""Sent on to the main thread for these: one whose handler COLMAP's log does not replace."""


class Interrupted(KeyboardInterrupt):
    """A signal other than that of Ctrl-C has requested the end of the run."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def exit_code(error: KeyboardInterrupt) -> int:
    """Exit code of a program that a signal has ended, as a shell expects it."""
    return 128 + (error.number if isinstance(error, Interrupted) else signal.SIGINT)


def words(error: KeyboardInterrupt) -> str:
    """Reason why the run ended, for the user."""
    if isinstance(error, Interrupted):
        return f"interrupted by {signal.Signals(error.number).name}"
    return "interrupted"


def behind(error: BaseException) -> KeyboardInterrupt | None:
    """The interruption that led to an error, if any: libraries in C may turn it into an error."""
    found: BaseException | None = error
    while found is not None and not isinstance(found, KeyboardInterrupt):
        found = found.__cause__ or found.__context__
    return found


@contextlib.contextmanager
def heeded(finish: Callable[[KeyboardInterrupt], None]) -> Iterator[None]:
    """Within this block Ctrl-C raises KeyboardInterrupt, and other such signals `Interrupted`.

    Python raises them only between its own instructions, and an adjustment of a large model may
    take minutes. Some seconds later, or at a second signal, the process therefore ends whatever it
    is deep in. What is broken off then is as after a kill, which loses nothing.

    Args:
        finish: reports the end where the main thread does not.
    """
    if not _IS_POSIX or threading.current_thread() is not threading.main_thread():
        yield
        return
    heeding = _Heeding(finish)
    with _forwards(heeding), _ends_late(heeding):  # threads of the second block what the first does
        yield


@contextlib.contextmanager
def for_other_programs() -> Iterator[None]:
    """Within this block start programs that handle these signals in their usual way."""
    if not _IS_POSIX:
        yield
        return
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, ASKING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


class _Heeding:
    """State of signal handling so far."""

    def __init__(self, finish: Callable[[KeyboardInterrupt], None]) -> None:
        self._finish = finish
        self.asked: KeyboardInterrupt = KeyboardInterrupt()

    def raise_it(self, number: int, _: FrameType | None) -> None:
        """In the main thread."""
        if not isinstance(self.asked, Interrupted):
            self.asked = Interrupted(number)
        raise self.asked

    def end(self) -> None:
        """From any thread."""
        reporting = threading.Thread(target=self._finish, args=(self.asked,), daemon=True)
        reporting.start()
        reporting.join(1.0)  # the main thread may hold what is needed for it
        os._exit(exit_code(self.asked))


@contextlib.contextmanager
def _ends_late(heeding: _Heeding) -> Iterator[None]:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    ended = threading.Event()

    def watch() -> None:
        while (number := os.read(reader, 1)) != b"":
            if number[0] not in (signal.SIGINT, _FORWARD):
                continue
            select.select([reader], [], [], _GRACE_S)  # a second one, or the end, or neither
            if ended.is_set():
                return
            heeding.end()

    before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    watcher = threading.Thread(target=watch, name="late end", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before)
        os.close(writer)
        watcher.join()
        os.close(reader)


@contextlib.contextmanager
def _forwards(heeding: _Heeding) -> Iterator[None]:
    """Handle the signals that end a run in a thread of their own.

    They are blocked everywhere else, also in processes started within: COLMAP's log answers them
    with a trace of its stack, in whatever process has loaded it.
    """
    asking = {number for number in ASKING if signal.getsignal(number) == signal.SIG_DFL}
    main = threading.get_ident()
    ended, ending = threading.Event(), threading.Lock()

    def wait() -> None:
        while True:
            number = signal.sigwait(asking)
            with ending:
                if ended.is_set():
                    return
                heeding.asked = Interrupted(number)
                signal.pthread_kill(main, _FORWARD)

    handler = signal.signal(_FORWARD, heeding.raise_it)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, asking)
    waiter = threading.Thread(target=wait, name="signals", daemon=True)
    if asking:  # nohup has the system ignore one of them
        waiter.start()
    try:
        yield
    finally:
        with ending:
            ended.set()
            if asking:
                signal.pthread_kill(cast(int, waiter.ident), next(iter(asking)))
        if asking:
            waiter.join()
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        signal.signal(_FORWARD, handler)
