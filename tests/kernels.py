"""Record which kernels the stages compile on a fresh machine, and how long each takes.

    python -m tests.kernels

Commands of the smallest survey, each with no kernel kept. Seconds are those of a kernel without
others of ours that are compiled on the way, and with numba's own.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from alice_survey.core.compiled import TABLE
from tests.small_survey import settings_in

COMMANDS = ("plan", "fly", "image", "calibrate", "reconstruct")
_INNER = """
import json, runpy, sys, time
from collections import defaultdict
from numba.core import event
from alice_survey.core.run import progress
class Listener(event.Listener):
    began, inner, found = [], [0.0], defaultdict(lambda: defaultdict(float))
    def on_start(self, one):
        self.began.append(time.thread_time())
        self.inner.append(0.0)
    def on_end(self, one):
        took, kernel = time.thread_time() - self.began.pop(), one.data["dispatcher"].py_func
        own = took - self.inner.pop()
        if kernel.__module__.startswith("numba."):
            took -= own
        else:
            stages = progress.current()._stages
            stage = self.found[stages[-1][0] if stages else ""]
            stage[f"{kernel.__module__}.{kernel.__qualname__}"] += own
        self.inner[-1] += took
event.register("numba:compile", Listener())
try:
    sys.argv[0] = "alice-survey"
    runpy.run_module("alice_survey", run_name="__main__")
finally:
    with open("kernels.json", "w") as file:
        json.dump(Listener.found, file)
"""


def compiled_by(command: str, workspace: Path, kept: Path) -> dict[str, dict[str, float]]:
    """Seconds of the kernels that a command compiles, by stage and name."""
    threads = [] if command in ("plan", "fly") else ["--threads=1"]
    call = [sys.executable, "-c", _INNER, command, "-w", str(workspace), *threads]
    places = {"NUMBA_CACHE_DIR": str(kept), "PYTHONPATH": str(Path(__file__).parents[1])}
    subprocess.run(
        call, cwd=workspace, env=os.environ | places, check=True, stdout=subprocess.DEVNULL
    )
    found: dict[str, dict[str, float]] = json.loads((workspace / "kernels.json").read_text())
    return found


def main() -> None:
    """Write the table."""
    with tempfile.TemporaryDirectory() as scratch:
        survey, table = settings_in(Path(scratch) / "survey"), dict[str, dict[str, float]]()
        for command in COMMANDS:
            table |= compiled_by(command, survey, Path(scratch) / command)
    rounded = {
        stage: {name: max(0.01, round(seconds, 2)) for name, seconds in sorted(part.items())}
        for stage, part in table.items()
    }
    TABLE.write_text(json.dumps(rounded, indent=1) + "\n")


if __name__ == "__main__":
    main()
