"""The vehicle beside its peers: equations of motion, allocation, and whole missions.

    .venv/bin/python -m benchmarks.vehicle [--quick] [--json FILE] [--only PART ...]

Everything that is compared is measured in this run, but for the one figure that says otherwise.
Ends with exit code 1 when a goal is missed. All code is compiled afresh, into a folder of its own,
so that no kernel is older than the sources.
"""

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.machine import heading, load, machine

_PARTS = ("start", "dynamics", "accuracy", "allocation", "loop")
_QUOTED = (
    "PythonVehicleSimulator (T. I. Fossen), quoted, measured earlier on another machine: 187 us a "
    "step\nof forward Euler, one derivative, of a vehicle of its own."
)


def main() -> None:
    """Measure, print, and say which goals are missed."""
    options = _options()
    with TemporaryDirectory() as cache:
        # Before numba is imported, which reads it once.
        os.environ["NUMBA_CACHE_DIR"] = cache
        missed = _measure(options, Path(cache))
    for miss in missed:
        print(f"missed: {miss}")
    sys.exit(1 if missed else 0)


def _measure(options: argparse.Namespace, cache: Path) -> list[str]:
    from benchmarks import vehicle_allocation, vehicle_dynamics, vehicle_loop

    quick = options.quick
    report: dict[str, Any] = {"machine": machine(("numpy", "numba", "scipy")), "quick": quick}
    print(heading(report["machine"]), "\n", flush=True)
    missed: list[str] = []
    if "start" in options.only:
        starts = vehicle_loop.starts(cache)
        print(f"A fresh process waits:\n{vehicle_loop.starts_table(starts)}\n", flush=True)
        report["start"] = [asdict(row) for row in starts]
    if "dynamics" in options.only:
        rows = vehicle_dynamics.measure(20_000 if quick else 200_000, 3 if quick else 10)
        print(f"Equations of motion:\n{vehicle_dynamics.table(rows)}\n{_QUOTED}\n", flush=True)
        report["dynamics"] = [asdict(row) for row in rows]
        missed += [
            f"{row.what} ({row.case}): {row.us:.3g} us > {row.goal_us:g}"
            for row in rows
            if row.goal_us is not None and row.us > row.goal_us
        ]
    if "accuracy" in options.only:
        seconds = 12 if quick else 60
        errors = vehicle_dynamics.accuracy(seconds)
        print(f"Largest errors of Runge-Kutta steps over {seconds} s, all thrusters at work:")
        print(vehicle_dynamics.accuracy_table(errors), "\n", flush=True)
        report["accuracy"] = [asdict(row) for row in errors]
    if "allocation" in options.only:
        solves = vehicle_allocation.measure(2 if quick else 10)
        print(f"Allocation:\n{vehicle_allocation.table(solves)}\n", flush=True)
        report["allocation"] = [asdict(row) for row in solves]
        missed += [
            f"{row.solver} ({row.wrenches}): {row.us:.3g} us > {row.goal_us:g}"
            for row in solves
            if row.goal_us is not None and row.us > row.goal_us
        ]
    if "loop" in options.only:
        flights = vehicle_loop.measure(1 if quick else 5)
        print(f"Whole missions:\n{vehicle_loop.table(flights)}\n", flush=True)
        report["loop"] = [{**asdict(row), "factor": row.factor} for row in flights]
        for flight in flights:
            if flight.factor < flight.goal:
                missed.append(f"{flight.mission}: {flight.factor:.0f} < {flight.goal:g}")
            if not flight.complete:
                missed.append(f"{flight.mission}: was broken off")
    report["missed"] = missed
    print(f"load after: {load()}")
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    return missed


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Benchmarks of the vehicle.")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs")
    parser.add_argument("--only", nargs="+", choices=_PARTS, default=list(_PARTS))
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
