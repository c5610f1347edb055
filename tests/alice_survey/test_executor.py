"""Results keep their order whatever the number of processes; a killed run leaves none behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from alice_survey.base.executor import local_executor

WORKERS = """
import os, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import sleeping
from alice_survey.base.executor import local_executor
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


def _process(_: int) -> int:
    time.sleep(0.05)
    return os.getpid()


def test_kept_workers_are_the_same_from_call_to_call_and_end_with_their_block() -> None:
    with local_executor(2).started() as started:
        first, second = (set(started.map(_process, range(8), label="ids")) for _ in range(2))
        with pytest.raises(TypeError):
            list(started.map(abs, [1, "a", 2], label="abs"))  # type: ignore[list-item]
        third = set(started.map(_process, range(8), label="ids"))
    assert len(first) == 2
    assert first == second == third
    for _ in range(100):
        if not any(Path(f"/proc/{pid}").exists() for pid in first):
            break
        time.sleep(0.1)
    assert not any(Path(f"/proc/{pid}").exists() for pid in first)
    assert set(local_executor(2).map(_process, range(8), label="ids")).isdisjoint(first)


def test_a_fault_of_the_work_reaches_the_caller() -> None:
    with pytest.raises(TypeError):
        list(local_executor(2).map(abs, [1, "a", 2], label="abs"))  # type: ignore[list-item]


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
    for _ in range(300):
        if len(list(seen.iterdir())) == 2:
            break
        time.sleep(0.1)
    pids = [int(path.name) for path in seen.iterdir()]
    assert len(pids) == 2
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    for _ in range(50):
        if not any(_alive(pid) for pid in pids):
            return
        time.sleep(0.1)
    pytest.fail("workers outlive their parent")


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    return status != "Z"
