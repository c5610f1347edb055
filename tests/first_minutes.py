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
_INNER = """
import json, sys, time, runpy
from collections import Counter
from numba.core import event
class Listener(event.Listener):
    depth, began, seconds, versions = 0, 0.0, 0.0, Counter()
    def on_start(self, one):
        self.began = self.began if self.depth else time.process_time()
        self.depth += 1
    def on_end(self, one):
        self.depth -= 1
        kernel = one.data["dispatcher"].py_func
        if not kernel.__module__.startswith("numba."):
            self.versions[f"{kernel.__module__}.{kernel.__qualname__}"] += 1
        self.seconds += 0.0 if self.depth else time.process_time() - self.began
heard = Listener()
event.register("numba:compile", heard)
try:
    sys.argv[0] = "alice-survey"
    runpy.run_module("alice_survey", run_name="__main__")
finally:
    with open("compiled.json", "w") as file:
        json.dump([heard.seconds, len(heard.versions), heard.versions.total()], file)
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
    inner = ["-c", _INNER]
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
            seconds, kernels, versions = json.loads((survey / "compiled.json").read_text())
            rows[f"{command}, {turn}"] = (cpu_s() - before, seconds, kernels, versions)
            line = f"{cpu_s() - before:.1f} CPU s, compiling {seconds:.1f} s, {kernels} kernels"
            sys.stdout.write(f"{command}, {turn}: {line} in {versions} versions\n")
            sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
