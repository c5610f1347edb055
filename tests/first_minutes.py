"""What each command of the tutorial computes, on a fresh machine and again, and what it compiles.

    python -m tests.first_minutes --work FOLDER [--python PYTHON] [--json FILE]

PYTHON may be one with an installed wheel. The tutorial's survey is made with no kernel kept, then
made again; each command runs in a process of its own with one thread. CPU seconds are those of user
and system. Seconds of compiling include those of numba's own functions, which are not counted.
"""

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

COMMANDS = ("plan", "fly", "image", "calibrate", "reconstruct", "evaluate", "report", "status")
INNER = """
import json, sys, time, runpy
from numba.core import event
from alice_survey.core.run import progress
class Listener(event.Listener):
    began, inner, found = [], [0.0], {}
    def on_start(self, one):
        self.began.append(time.thread_time())
        self.inner.append(0.0)
    def on_end(self, one):
        took, kernel = time.thread_time() - self.began.pop(), one.data["dispatcher"].py_func
        own = took - self.inner.pop()
        if kernel.__module__.startswith("numba."):
            took -= own
        else:
            stage = next((one for one, _ in progress.current()._stages[-1:]), "")
            part = self.found.setdefault(stage, {})
            part.setdefault(f"{kernel.__module__}.{kernel.__qualname__}", []).append(own)
        self.inner[-1] += took
event.register("numba:compile", Listener())
try:
    sys.argv[0] = "alice-survey"
    runpy.run_module("alice_survey", run_name="__main__")
finally:
    with open("kernels.json", "w") as file:
        json.dump(Listener.found, file)
"""


def cpu_s() -> float:
    """Computing of all children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Print a row a command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    shutil.rmtree(options.work, ignore_errors=True)
    options.work.mkdir(parents=True)
    page = (Path(__file__).parents[1] / "docs" / "tutorial.md").read_text()
    script = "".join(re.findall(r"^```bash\n(.*?)^```", page, re.M | re.S)[:2])
    inner = ["-c", INNER]
    rows = {}
    home = {"HOME": str(options.work), "NUMBA_CACHE_DIR": str(options.work / "kernels")}
    bin_ = f"{Path(options.python).parent}{os.pathsep}{os.environ['PATH']}"
    for turn in ("cold", "warm"):
        survey = options.work / turn
        survey.mkdir()
        where = {"cwd": survey, "env": {**os.environ, **home, "PATH": bin_}, "check": True}
        subprocess.run(["/bin/bash", "-euc", script], **where, stdout=subprocess.DEVNULL)
        for command in COMMANDS:
            before = cpu_s()
            threads = ["--threads", "1"] if command in ("image", "calibrate", "reconstruct") else []
            call = [options.python, *inner, command, "-w", "reef", *threads]
            subprocess.run(call, **where, capture_output=True)
            found = json.loads((survey / "kernels.json").read_text())
            each = [part for stage in found.values() for part in stage.values()]
            seconds, kernels, versions = sum(map(sum, each)), len(each), sum(map(len, each))
            rows[f"{command}, {turn}"] = (cpu_s() - before, seconds, kernels, versions)
            line = f"{cpu_s() - before:.1f} CPU s, compiling {seconds:.1f} s, {kernels} kernels"
            sys.stdout.write(f"{command}, {turn}: {line} in {versions} versions\n")
            sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
