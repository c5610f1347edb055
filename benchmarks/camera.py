"""The camera, its peers and what theory allows: speed, absolute pose, calibration.

    .venv/bin/python -m benchmarks.camera [--quick] [--json FILE] [--only PART ...]

Everything that is compared is measured in this run. Ends with exit code 1 when a goal is missed.
"""

import sys
from dataclasses import asdict
from typing import Any

from alice_survey.core.executor import local_executor
from benchmarks import camera_calibration, camera_housings, camera_speed, target_calibration
from benchmarks.figures import Findings, Parser, hand_over
from tests.camera_calib.housing_scenes import KINDS

_PARTS = ("speed", "calibration", "target", "housings")


def main() -> None:
    """Measure, print, and say which goals are missed."""
    parser = Parser(__doc__, quick="fewer points and trials")
    parser.add_argument("--only", nargs="+", choices=_PARTS, default=list(_PARTS))
    parser.add_argument("--threads", type=int, default=1, help="processes for the trials")
    options, about = parser.begin("numpy", "numba", "opencv-contrib-python-headless", "pycolmap")
    report, findings = dict[str, Any](), Findings()
    if "speed" in options.only:
        speeds = camera_speed.measure(
            20_000 if options.quick else 100_000, 10 if options.quick else 40
        )
        report["speed"] = [{**asdict(row), "ratio": row.ratio} for row in speeds]
        findings += Findings(figures=tuple(row.figure() for row in speeds))
    if "calibration" in options.only:
        count = 40 if options.quick else 200
        modes = [
            camera_calibration.run_mode(mode, range(count), local_executor(options.threads))
            for mode in camera_calibration.MODES
        ]
        report["calibration"] = [asdict(mode) for mode in modes]
        # With fewer trials the figures themselves scatter too much for the goals.
        judged = not options.quick
        findings += Findings(
            figures=tuple(f for mode in modes for f in mode.figures(judged=judged))
        )
    if "target" in options.only:
        count = 20 if options.quick else 100
        cases = [
            target_calibration.run_case(name, range(count), local_executor(options.threads))
            for name in target_calibration.TARGETS
        ]
        report["target"] = [asdict(case) for case in cases]
        findings += Findings(
            figures=tuple(f for case in cases for f in case.figures(judged=not options.quick))
        )
    if "housings" in options.only:
        count, workers = 2 if options.quick else 20, local_executor(options.threads)
        rows = [r for k in KINDS for r in camera_housings.run_kind(k, range(count), workers)]
        report["housings"] = rows
        findings += Findings(figures=tuple(camera_housings.figures(rows)))
    sys.exit(hand_over(options, about, findings, report))


if __name__ == "__main__":
    main()
