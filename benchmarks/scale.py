"""What the serial parts of a reconstruction cost by the number of pictures: up to 100,000 of them.

    python -m benchmarks.scale --work FOLDER [--pictures 1000 5000 10000] [--only STEP ...]
        [--threads 1] [--points 100] [--unmatched 1000] [--quick] [--json FILE]

A calibrated stereo rig flies a lawnmower pattern over a rough plane; tracks, footprints and samples
of light are made from the truth, and no picture is rendered (`benchmarks.scale_steps`). Every step
runs in a process of its own, on what the steps before it left in FOLDER; one that is done for a
number of pictures is not run again. A row has seconds of computing and the peak of memory by
pictures, then the exponent of growth between the two largest surveys, and what that makes of
100,000 pictures.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from benchmarks.scale_steps import MAKE, MAPPED, MAPPED_POINTS, PLACING, STEPS, UNMATCHED

_MANY = 100_000
_MAX_GIB = 8.0
"""At that many pictures."""
_MAX_EXPONENT = 1.25
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, kw_only=True)
class StepCost:
    """What a step took."""

    step: str
    pictures: int
    cpu_s: float
    """Of the process and its workers."""
    peak_gib: float
    """Of the process, or of the largest of its workers."""
    amount: int
    """How many of what it works on: observations, pairs, samples."""


def measure(step: str, pictures: int, work: Path, threads: int, *more: str) -> StepCost | None:
    """Run a step, with more options of `scale_steps`, unless it is done; None if it failed."""
    file = work / f"{pictures}" / f"{step}.json"
    if not file.is_file():
        command = [sys.executable, "-m", "benchmarks.scale_steps", step, str(pictures)]
        # threads of libraries that wait for each other count as computing on a busy machine
        alone = {**os.environ, **dict.fromkeys(_THREADS, "1")}
        command += [str(work), str(threads), *more]
        ran = subprocess.run(command, check=False, env=alone)
        if ran.returncode:
            return None
    return StepCost(step=step, pictures=pictures, **json.loads(file.read_text()))


def growth(first: float, last: float, times: float) -> float:
    """Exponent of growth, from values of two surveys of which one is so many times as large."""
    return float(np.log(last / first) / np.log(times)) if first > 0 and last > 0 else np.nan


def figures_of(rows: Sequence[StepCost], *, judged: bool) -> list[Figure]:
    """Figures of one step, by rising number of pictures; small surveys are not judged."""
    name = rows[0].step
    found = [
        figure
        for row in rows
        for figure in (
            Figure(name=f"{name}: {row.pictures} pictures, time", value=row.cpu_s, unit="s"),
            Figure(name=f"{name}: {row.pictures} pictures, peak", value=row.peak_gib, unit="GiB"),
        )
    ]
    if len(rows) == 1:
        return found
    first, last = rows[-2:]
    times, left = last.pictures / first.pictures, _MANY / last.pictures
    power = growth(first.cpu_s, last.cpu_s, times)
    slope = (last.peak_gib - first.peak_gib) / (last.pictures - first.pictures)
    peak = last.peak_gib + max(slope, 0.0) * (_MANY - last.pictures)
    print(f"{'':14}exponent {power:.2f}; at {_MANY} pictures {last.cpu_s * left**power:.0f} s, "
          f"{peak:.1f} GiB", flush=True)  # fmt: skip
    return [
        *found,
        Figure(name=f"{name}: exponent", value=power, unit="",
               goal=Goal(maximum=_MAX_EXPONENT) if judged else None),
        Figure(name=f"{name}: peak at {_MANY} pictures", value=peak, unit="GiB",
               goal=Goal(maximum=_MAX_GIB) if judged else None),
    ]  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = Parser(
        __doc__, quick="200 and 400 pictures of the demo's rig", work="keeps surveys and results"
    )
    parser.add_argument("--pictures", type=int, nargs="+", default=[1000, 5000, 10000], metavar="N")
    parser.add_argument("--only", nargs="+", default=[], choices=STEPS, metavar="STEP")
    parser.add_argument("--threads", type=int, default=1, help="workers")
    parser.add_argument(
        "--points", type=int, default=MAPPED_POINTS, help="of a station in `map` and `placing`"
    )
    parser.add_argument(
        "--unmatched", type=int, default=UNMATCHED, help="keypoints of a picture in `placing`"
    )
    options, about = parser.begin("numpy", "scipy")
    if options.quick:
        options.pictures = [200, 400]
    rows: dict[str, list[StepCost]] = {}
    failed = []
    more = ("--points", str(options.points), "--unmatched", str(options.unmatched))
    wanted = {*(options.only or STEPS), MAKE}
    if PLACING in wanted:
        wanted.add(MAPPED)
    for step in [s for s in STEPS if s in wanted]:
        for pictures in sorted(options.pictures):
            spent = measure(step, pictures, options.work, options.threads, *more)
            if spent is None:
                failed.append(f"{step} of {pictures} pictures")
                continue
            rows.setdefault(step, []).append(spent)
    figures = [
        figure
        for step, row in rows.items()
        if step not in (MAKE, MAPPED)
        for figure in figures_of(row, judged=not options.quick)
    ]
    findings = Findings(figures=tuple(figures), failed=tuple(failed))
    kept = {step: [asdict(row) for row in row_of] for step, row_of in rows.items()}
    sys.exit(hand_over(options, about, findings, {"steps": kept}))


if __name__ == "__main__":
    main()
