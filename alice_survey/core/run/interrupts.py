"""Signals that end a run: it ends cleanly and soon, whatever code is running."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import cast

_GRACE_S = 5.0
"""Time between such a signal and the end of a run that is inside a library."""
_SAME_S = 0.5
"""Signals so close to the first are the same one: `timeout` sends it to a process and its group."""
_IS_POSIX = hasattr(signal, "sigwait")
"""Elsewhere Ctrl-C alone ends a run early, whenever Python gets to it."""
SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM} | ({signal.SIGHUP} if _IS_POSIX else set()))
"""Ctrl-C, and signals of a scheduler, a system that shuts down, or a terminal that closes."""
_FORWARD = signal.SIGUSR1 if _IS_POSIX else signal.SIGTERM
"""Sent on to the main thread for these: one whose handler COLMAP's log does not replace."""


class Interrupted(KeyboardInterrupt):
    """A signal has requested the end of the run."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def _number(error: KeyboardInterrupt) -> int:
    return error.number if isinstance(error, Interrupted) else signal.SIGINT


def exit_code(error: KeyboardInterrupt) -> int:
    """Exit code of a program that a signal has ended, as a shell expects it."""
    return 128 + _number(error)


def words(error: KeyboardInterrupt) -> str:
    """Reason why the run ended, for the user."""
    number = signal.Signals(_number(error))
    return "interrupted" if number == signal.SIGINT else f"interrupted by {number.name}"


def behind(error: BaseException) -> KeyboardInterrupt | None:
    """The interruption that led to an error, if any: libraries in C may turn it into an error."""
    found: BaseException | None = error
    while found is not None and not isinstance(found, KeyboardInterrupt):
        found = found.__cause__ or found.__context__
    return found


@contextlib.contextmanager
def handle_signals(finish: Callable[[KeyboardInterrupt], None]) -> Iterator[None]:
    """Within this block `SIGNALS` raise `Interrupted` in the main thread.

    A thread waits for them. They are blocked everywhere else, also in processes started within:
    COLMAP's log answers them with a trace of its stack, in whatever process has loaded it. Threads
    that run already, such as numpy's, keep their own mask: enter this block before them.

    Python raises only between its own instructions, and an adjustment of a large model may take
    minutes. Some seconds later, or at a second request, the process therefore ends whatever it is
    deep in. What is broken off then is as after a kill, which loses nothing. After this block an
    interrupted process is to end, and further signals no longer reach it.

    Args:
        finish: reports the end where the main thread does not.
    """
    usual = (signal.SIG_DFL, signal.default_int_handler)
    numbers = {n for n in SIGNALS if signal.getsignal(n) in usual}  # nohup ignores one of them
    is_main = threading.current_thread() is threading.main_thread()
    if not (_IS_POSIX and is_main and numbers):
        yield
        return
    main, requests = threading.get_ident(), list[Interrupted]()
    ended, ending = threading.Event(), threading.Lock()

    def raise_in_main(_number: int, _frame: FrameType | None) -> None:
        raise requests[-1]

    def end() -> None:
        reporting = threading.Thread(target=finish, args=(requests[-1],), daemon=True)
        reporting.start()
        reporting.join(1.0)  # the main thread may hold what is needed for it
        os._exit(exit_code(requests[-1]))

    def wait() -> None:
        number = signal.sigwait(numbers)
        with ending:
            if ended.is_set():
                return
            requests.append(Interrupted(number))
            signal.pthread_kill(main, _FORWARD)
        began_s = time.monotonic()
        late = threading.Timer(_GRACE_S, end)
        late.daemon = True
        late.start()
        signal.sigwait(numbers)  # a second one, or the end
        while not ended.is_set() and time.monotonic() < began_s + _SAME_S:
            signal.sigwait(numbers)
        if not ended.is_set():
            end()

    handler = signal.signal(_FORWARD, raise_in_main)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    waiter = threading.Thread(target=wait, name="signals", daemon=True)
    waiter.start()
    try:
        yield
    finally:
        with ending:
            ended.set()
            signal.pthread_kill(cast(int, waiter.ident), next(iter(numbers)))
        waiter.join()
        if not requests:  # else the process ends, and its exit code is to stay
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        signal.signal(_FORWARD, handler)


@contextlib.contextmanager
def for_other_programs() -> Iterator[None]:
    """Within this block start programs that handle these signals in their usual way."""
    if not _IS_POSIX:
        yield
        return
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
