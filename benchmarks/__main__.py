"""All benchmarks in one run, and one table of their figures.

    .venv/bin/python -m benchmarks --work FOLDER [--quick] [--repeat N] [--only NAME ...]
        [--data ../shared/data] [--demo WORKSPACE] [--pyorthomosaic PYTHON]
        [--mitsuba PYTHON]

Each part runs in a process of its own, in a fixed order: three times where that takes less than
ten minutes on two cores, once where it takes more (marked long in `parts.py`) and with `--quick`.
FOLDER gets `table.md` and `table.json`, renewed after each part, all that parts say in `logs/`,
and their workspaces in `work/`. What cannot run is listed with its reason. Ends with exit code 1
when a part failed or missed a goal.
"""

import argparse
import datetime as dt
import json
import math
import shlex
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.machine import commit, load, machine
from benchmarks.measured import measured, python
from benchmarks.parts import PARTS, SHORT_REPEATS, Part, Settings, chosen
from benchmarks.table import LEFT_OUT, Outcome, Run, outcome, write


def main() -> int:
    """Run what is requested, write the table, return whether all is well."""
    options = _options()
    passed = ("quick", "data", "demo", "pyorthomosaic", "mitsuba")
    given = {name: getattr(options, name) for name in passed}
    settings = Settings(work=options.work / "work", **given)
    about: dict[str, Any] = {
        "date": dt.datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]]),
        "quick": options.quick,
        "commit": commit(),
        "machine": machine(("alice-survey",)),
    }
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    outcomes: list[Outcome] = []
    try:
        for number, part in enumerate(options.parts, 1):
            where = f"[{number}/{len(options.parts)}] {part.name}"
            outcomes.append(_outcome(part, settings, options, where))
            write(options.work, about, outcomes)
    except KeyboardInterrupt:
        _say(f"broken off; {len(outcomes)} of {len(options.parts)} parts are in {options.work}")
        return 130
    print(options.work / "table.md")
    return 0 if all(part.good for part in outcomes) else 1


def _outcome(part: Part, settings: Settings, options: argparse.Namespace, where: str) -> Outcome:
    """Run a part as often as requested, up to the first time that it fails."""
    command = part.command(settings)
    alone = shlex.join(["python", *command])
    reason = part.reason_to_leave_out(settings)
    if reason is not None:
        _say(f"{where}: left out: {reason}")
        return Outcome(name=part.name, command=alone, state=LEFT_OUT, reason=reason)
    (settings.work / part.name).mkdir(parents=True, exist_ok=True)
    repeats = options.repeat or (1 if settings.quick or part.long else SHORT_REPEATS)
    runs: list[Run] = []
    for repeat in range(1, repeats + 1):
        log = options.work / "logs" / f"{part.name}-{repeat}.log"
        _say(f"{where}, run {repeat} of {repeats}: what it says is in {log}")
        runs.append(_run(command, log))
        _say(f"{where}, run {repeat} of {repeats}: ended after {runs[-1].cost.wall_s:.0f} s")
        if runs[-1].trouble is not None:
            break
    found = outcome(part.name, alone, runs)
    _say(f"{where}: {found.state}" + ("" if found.reason is None else f": {found.reason}"))
    return found


def _run(command: Sequence[str], log: Path) -> Run:
    """Run a benchmark and read what it hands over."""
    figures, before = log.with_suffix(".json"), load()
    figures.unlink(missing_ok=True)
    cost = measured(python(*command, "--json", str(figures)), log, timeout_s=math.inf)
    report = json.loads(figures.read_text()) if figures.exists() else None
    return Run(cost=cost, load_before=before, report=report)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=(__doc__ or "").splitlines()[0]
    )
    names = ", ".join(part.name for part in PARTS)
    parser.add_argument("--work", type=Path, required=True, help="folder for tables and logs")
    parser.add_argument("--quick", action="store_true", help="small cases, to see that all runs")
    parser.add_argument(
        "--repeat",
        type=_count,
        metavar="N",
        help=f"runs of each part (default {SHORT_REPEATS}, long ones and with --quick 1)",
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help=names)
    parser.add_argument("--data", type=Path, default=Settings.data, help="real pictures")
    parser.add_argument("--demo", type=Path, help="workspace with the demo's rendered pictures")
    parser.add_argument("--pyorthomosaic", metavar="PYTHON", help="a Python that has pyOrthomosaic")
    parser.add_argument("--mitsuba", metavar="PYTHON", help="a Python that has Mitsuba")
    options = parser.parse_args()
    try:
        options.parts = chosen(options.only)
    except ValueError as error:
        parser.error(str(error))
    return options


def _count(text: str) -> int:
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError("at least 1")
    return count


if __name__ == "__main__":
    sys.exit(main())
