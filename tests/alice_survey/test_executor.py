"""Results keep their order whatever the number of processes; a killed run leaves none behind."""

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from alice_survey.core.errors import AliceError, keep_warnings, note, warn
from alice_survey.core.executor import SERIAL, Executor, local_executor
from alice_survey.core.run import progress
from tests.engines import PicklingThreads, until

WORKERS = """
import os, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import sleeping
from alice_survey.core.executor import local_executor
if __name__ == "__main__":
    list(local_executor(2).map(sleeping.stay, [sys.argv[1]] * 8, label="sleep"))
"""
SLEEPING = """
import os, time
from pathlib import Path
def stay(folder):
    Path(folder, str(os.getpid())).touch()
    time.sleep(60)
"""


@pytest.mark.parametrize("threads", [1, 2])
def test_results_come_in_order(threads: int) -> None:
    assert list(local_executor(threads).map(abs, range(-20, 20), label="abs")) == [
        abs(i) for i in range(-20, 20)
    ]


def test_processes_do_not_run_a_users_script(tmp_path: Path) -> None:
    """A script need not guard its work by `if __name__ == "__main__"`."""
    script = tmp_path / "script.py"
    script.write_text(
        "from alice_survey.core.executor import local_executor\n"
        "print(list(local_executor(2).map(abs, [-3, 2], label='abs')), __file__)\n"
    )
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert ended.stdout == f"[3, 2] {script}\n"


def _process(_: int) -> int:
    time.sleep(0.05)
    return os.getpid()


def test_kept_workers_are_the_same_from_call_to_call_and_end_with_their_block() -> None:
    with local_executor(2).start() as started:
        first, second = (set(started.map(_process, range(8), label="ids")) for _ in range(2))
        with pytest.raises(TypeError):
            list(started.map(abs, [1, "a", 2], label="abs"))  # type: ignore[arg-type]
        third = set(started.map(_process, range(8), label="ids"))
    assert len(first) == 2
    assert first == second == third
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in first), 10.0)
    assert set(local_executor(2).map(_process, range(8), label="ids")).isdisjoint(first)


class Elsewhere:
    """An engine as of other machines: all that reaches a task is its pickle, in a new process."""

    def submit(self, function: Callable[..., Any], /, *args: Any) -> "Future[Any]":
        code = (
            "import pickle, sys\n"
            "function, args = pickle.load(sys.stdin.buffer)\n"
            "try: done = (function(*args), None)\n"
            "except Exception as error: done = (None, error)\n"
            "sys.stdout.buffer.write(pickle.dumps(done))"
        )
        ran = subprocess.run(
            [sys.executable, "-c", code], input=pickle.dumps((function, args)),
            capture_output=True, check=True, cwd=Path(__file__).parents[2],
        )  # fmt: skip
        assert ran.stderr == b""
        result, error = pickle.loads(ran.stdout)  # noqa: S301 (its own)
        future: Future[Any] = Future()
        future.set_result(result) if error is None else future.set_exception(error)
        return future


def looked_at(number: int) -> int:
    """A task that reports all it can."""
    with progress.step("unseen"), progress.step("unseen either", 2) as counter:
        counter.advance()
        note(f"note {number}")
        warn(f"{number} is odd" if number % 2 else f"{number} is even")
    if number == 3:
        raise AliceError(f"{number} is too much")
    return number * number


def reported(executor: Executor, capsys: pytest.CaptureFixture[str]) -> tuple[list[int], list[str]]:
    """Results until a fault, and all that a user saw."""
    results = []
    with keep_warnings() as warnings, pytest.raises(AliceError):
        results.extend(executor.map(looked_at, [0, 1, 2], label="look"))
        results.extend(executor.map(looked_at, [3], label="look again"))
    assert warnings == ["0 is even", "1 is odd", "2 is even", "3 is odd"]
    lines = capsys.readouterr().err.splitlines()
    return results, [line for line in lines if "done in" not in line]  # slow steps say so


def test_an_engine_elsewhere_gives_the_same_results_and_reports(
    capsys: pytest.CaptureFixture[str],
) -> None:
    here = reported(SERIAL, capsys)
    assert here[0] == [0, 1, 4]
    assert reported(Executor(workers=2, pool=Elsewhere()), capsys) == here
    with PicklingThreads(2) as threads:
        assert reported(threads.executor, capsys) == here


@pytest.mark.slow
def test_as_many_tasks_run_and_processes_start_as_there_is_memory_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    memory = psutil.virtual_memory()._replace(available=1000 * 2**20)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)

    def tasks(task_mib: float) -> set[int]:
        return set(local_executor(3).map(_process, range(9), label="ids", task_mib=task_mib))

    assert tasks(2000.0) == {os.getpid()}  # one runs, whatever it takes
    assert len(tasks(450.0)) == 2
    assert os.getpid() not in tasks(450.0)

    def processes(task_mib: float) -> set[int]:
        with replace(local_executor(3), task_mib=task_mib).start() as started:
            return set(started.map(_process, range(12), label="ids"))

    assert processes(2000.0) == {os.getpid()}
    assert "1 of 3 processes work, of 2000 MiB each" in capsys.readouterr().err
    assert len(processes(450.0)) == 2
    assert "2 of 3 processes work" in capsys.readouterr().err
    assert len(processes(100.0)) == 3
    assert "processes work" not in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's parent-death signal is Linux's")
def test_workers_die_with_a_killed_parent(tmp_path: Path) -> None:
    """Otherwise they would go on writing into a workspace that a new run works in."""
    (tmp_path / "sleeping.py").write_text(SLEEPING)
    (tmp_path / "workers.py").write_text(WORKERS)
    seen = tmp_path / "seen"
    seen.mkdir()
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "workers.py"), str(seen), str(tmp_path)]
    )
    until(lambda: len(list(seen.iterdir())) == 2, 30.0)
    pids = [int(path.name) for path in seen.iterdir()]
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    until(lambda: not any(psutil.pid_exists(pid) and _runs(pid) for pid in pids), 5.0)


def _runs(pid: int) -> bool:
    return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
