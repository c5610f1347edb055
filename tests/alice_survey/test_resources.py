"""Processor time and memory of a process with all that it has started."""

import subprocess
import sys

from alice_survey.core.run.resources import Meter, cpu_s, family, memory_mib, versions

BUSY = """
import sys, time
block = bytearray(100 << 20)
for i in range(0, len(block), 4096):
    block[i] = 1
started = time.process_time()
while time.process_time() - started < 0.3:
    pass
print("ready", flush=True)
sys.stdin.read()
"""


def test_descendants_count_while_they_run_and_after_they_ended() -> None:
    meter = Meter()
    child = subprocess.Popen(
        [sys.executable, "-c", BUSY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    (process,) = (found for found in family() if found.pid == child.pid)
    during = meter.look()
    assert 100 < memory_mib(process) < 200
    assert during["peak_mib"] > memory_mib(process)
    assert 0.3 <= during["cpu_s"] < 5
    child.communicate()
    assert process not in family()
    after = meter.look()
    assert after["cpu_s"] >= during["cpu_s"]
    assert after["peak_mib"] >= during["peak_mib"]
    assert after["took_s"] > during["took_s"]
    assert (memory_mib(process), cpu_s(process)) == (0.0, 0.0)
    assert family(child.pid) == []


def test_versions_are_those_that_are_imported() -> None:
    import numba
    import numpy as np

    assert versions()["numpy"] == np.__version__
    assert versions()["numba"] == numba.__version__
