"""The vehicle: equations of motion, allocation next to a peer, and whole missions.

    .venv/bin/python -m benchmarks.vehicle [--quick] [--json FILE] [--only PART ...]

Ends with exit code 1 when a goal is missed. All code is compiled afresh, into a folder of its own,
so that no kernel is older than the sources.
"""

import argparse
import os
import sys
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.figures import Findings, add_options, hand_over
from benchmarks.machine import heading, machine

_PARTS = ("start", "dynamics", "accuracy", "allocation", "loop", "seas")


def main() -> None:
    """Measure, print, and say which goals are missed."""
    options = _options()
    with TemporaryDirectory() as cache:
        # Before numba is imported, which reads it once.
        os.environ["NUMBA_CACHE_DIR"] = cache
        code = _measure(options, Path(cache))
    sys.exit(code)


def _measure(options: argparse.Namespace, cache: Path) -> int:
    from benchmarks import vehicle_allocation, vehicle_dynamics, vehicle_loop, vehicle_seas

    quick = options.quick
    about, report, findings = machine(("numpy", "numba", "scipy")), dict[str, Any](), Findings()
    print(heading(about), "\n", flush=True)
    if "start" in options.only:
        starts = vehicle_loop.starts(cache)
        print(f"A fresh process waits:\n{vehicle_loop.starts_table(starts)}\n", flush=True)
        report["start"] = [asdict(row) for row in starts]
        findings += Findings(figures=tuple(f for row in starts for f in row.figures()))
    if "dynamics" in options.only:
        rows = vehicle_dynamics.measure(20_000 if quick else 200_000, 3 if quick else 10)
        print(f"Equations of motion:\n{vehicle_dynamics.table(rows)}\n", flush=True)
        report["dynamics"] = [asdict(row) for row in rows]
        findings += Findings(figures=tuple(vehicle_dynamics.figures(rows)))
    if "accuracy" in options.only:
        seconds = 12 if quick else 60
        errors = vehicle_dynamics.accuracy(seconds)
        print(f"Largest errors of Runge-Kutta steps over {seconds} s, all thrusters at work:")
        print(vehicle_dynamics.accuracy_table(errors), "\n", flush=True)
        report["accuracy"] = [asdict(row) for row in errors]
        findings += Findings(figures=tuple(f for row in errors for f in row.figures()))
    if "allocation" in options.only:
        solves = vehicle_allocation.measure(2 if quick else 10)
        print(f"Allocation:\n{vehicle_allocation.table(solves)}\n", flush=True)
        report["allocation"] = [asdict(row) for row in solves]
        findings += Findings(figures=tuple(vehicle_allocation.figures(solves)))
    if "loop" in options.only:
        flights = vehicle_loop.measure(1 if quick else 5)
        print(f"Whole missions:\n{vehicle_loop.table(flights)}\n", flush=True)
        report["loop"] = [{**asdict(row), "factor": row.factor} for row in flights]
        findings += Findings(
            figures=tuple(flight.figure() for flight in flights),
            failed=tuple(f"{f.mission}: was broken off" for f in flights if not f.complete),
        )
    if "seas" in options.only:
        seas = vehicle_seas.measure(1 if quick else 5)
        print(f"The paper's mission in other seas:\n{vehicle_seas.table(seas)}\n", flush=True)
        report["seas"] = [asdict(row) for row in seas]
        findings += Findings(figures=tuple(vehicle_seas.figures(seas)))
    return hand_over(options, about, findings, report)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Benchmarks of the vehicle.")
    add_options(parser, quick="fewer and shorter runs")
    parser.add_argument("--only", nargs="+", choices=_PARTS, default=list(_PARTS))
    return parser.parse_args()


if __name__ == "__main__":
    main()
