"""Tasks for a cluster, some of which end their worker the first time."""

import os
import signal
import time
from pathlib import Path

from alice_survey.core.errors import AliceError, warn


def is_first(mark: Path) -> bool:
    """Whether nobody has been here, on whatever machine."""
    try:
        mark.touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def square(number: int) -> int:
    warn(f"{number} is odd" if number % 2 else f"{number} is even")
    if number == 30:
        raise AliceError(f"{number} is too much")
    return number * number


def end_worker_once(task: tuple[Path, int]) -> int:
    mark, number = task
    time.sleep(0.02)
    if number == 7 and is_first(mark):
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def end_worker(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def stop_worker_once(task: tuple[Path, int]) -> int:
    mark, number = task
    if number == 3 and is_first(mark):
        os.kill(os.getpid(), signal.SIGSTOP)
    return number * number


def read_when_allowed(task: tuple[Path, Path, int]) -> int:
    folder, file, number = task
    (folder / f"{os.getpid()}.begun").touch()
    while not (folder / "go").exists():
        time.sleep(0.05)
    return int(file.read_text()) * number


def compute(seconds: float) -> None:
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass
