"""A rendered harbour with steep and overhanging surfaces: reconstruct it and judge the result.

    .venv/bin/python -m benchmarks.harbour --work FOLDER [--quick] [--json FILE]
        [--step 0.3] [--scale 8] [--judge]

A stereo rig looks level at a wall with a ladder, at a ship's hull, also from below, and at a pile
from around, obliquely at the foot of the wall and straight down at floor and boulders; fish swim
and weed sways between the stations. Pictures are rendered into FOLDER/pictures (kept: a second run
takes them as they are), imported and reconstructed by the two commands a user types into
FOLDER/survey, and compared with the harbour's closed form. `--judge` only judges what is there.
"""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from alice_survey.core.executor import local_executor
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over, plain
from benchmarks.harbour_judge import judge, true_harbour
from benchmarks.harbour_survey import Shoot, import_survey, quick_stations, render_survey, stations
from benchmarks.measured import measured

_GOALS = {
    "complete": Goal(minimum=0.97),
    "rms in pixels": Goal(maximum=1.0),
    "error over sigma": Goal(minimum=0.8, maximum=1.5),
    "beyond 5 sigma": Goal(maximum=0.003),
    "both surfaces": Goal(minimum=0.97),
    "mosaic": Goal(maximum=1.5),
    "masks, recall": Goal(minimum=0.8),
    "masks, precision": Goal(minimum=0.6),
    "masks, still": Goal(maximum=0.01),
}


def main() -> None:
    """Render, reconstruct, judge; the exit code is 1 when a goal is missed."""
    parser = Parser(
        __doc__,
        quick="16 stations before the wall at a twelfth of the resolution",
        work="keeps pictures and workspace",
    )
    parser.add_argument("--step", type=float, default=0.3, help="between stations of a row, metres")
    parser.add_argument("--scale", type=int, default=8, help="sensor's pixels to one of a picture")
    parser.add_argument("--judge", action="store_true", help="judge the workspace that is there")
    options, about = parser.begin("numpy")
    planned = tuple(quick_stations() if options.quick else stations(options.step))
    scale = 12 if options.quick else options.scale
    shoot = Shoot(folder=options.work / "pictures", planned=planned, scale=scale)
    workspace = options.work / "survey"
    findings = Findings() if options.judge else _reconstruct(shoot, workspace, options.work)
    rows: dict[str, Any] = {}
    if not findings.failed or (workspace / "sparse" / "track.csv").exists():
        found = judge(workspace, true_harbour(planned, scale))
        (options.work / "judged.json").write_text(json.dumps(plain(found), indent=1) + "\n")
        findings += Findings(
            figures=figures(found, quick=options.quick),
            left_out=tuple(f"{name}: not made" for name in found["left_out"]),
        )
        rows["harbour"] = found
    sys.exit(hand_over(options, about, findings, rows))


def _reconstruct(shoot: Shoot, workspace: Path, work: Path) -> Findings:
    render_survey(shoot, local_executor())
    shutil.rmtree(workspace, ignore_errors=True)
    print(import_survey(shoot.folder, workspace))
    line = [sys.executable, "-m", "alice_survey", "reconstruct", "-w", str(workspace)]
    line += ["--plane", "level", "--plane", "wall=facing 180"]
    cost = measured(line, work / "reconstruct.log")
    took = (
        Figure(name="reconstruct, computing", value=cost.cpu_s, unit="s"),
        Figure(name="reconstruct, memory", value=cost.peak_mib, unit="MiB"),
    )
    failed = () if cost.ok else (f"reconstruct: {cost.last_line()}",)
    return Findings(figures=took, failed=failed)


def figures(found: dict[str, Any], *, quick: bool) -> tuple[Figure, ...]:
    """The figures that have goals, of cloud, DEM and mesh, and the cameras' errors."""
    goals = {} if quick else _GOALS
    made = [
        Figure(name="cameras, rms", value=found["cameras"]["rms_mm"], unit="mm"),
        Figure(name="cameras, scale", value=found["cameras"]["scale_error_ppm"], unit="ppm"),
        Figure(name="registered", value=found["cameras"]["registered"] / found["pictures"],
               unit=""),
    ]  # fmt: skip

    def add(name: str, value: float | None, goal: str) -> None:
        if value is not None:
            made.append(Figure(name=name, value=value, unit="", goal=goals.get(goal)))

    for name, spread in (
        ("cloud", found.get("cloud", {}).get("all")),
        ("DEM, heights", found.get("dem", {}).get("height")),
        ("mesh", found.get("mesh", {}).get("faces", {}).get("all")),
    ):
        if not spread or not spread["count"]:
            continue
        add(f"{name}: rms in pixels", spread["rms_mm"] / found["pixel_mm"], "rms in pixels")
        add(f"{name}: error over sigma", spread.get("over_sigma_rms"), "error over sigma")
        add(f"{name}: beyond 5 sigma", spread.get("beyond_5_sigma"), "beyond 5 sigma")
    for name in ("cloud", "mesh"):
        if name in found:
            twice = found[name]["complete"]["two or more instants"]
            add(f"{name}: complete", twice["complete"], "complete")
            add(f"{name}: both surfaces", found[name]["overhangs"].get("both"), "both surfaces")
    if "masks" in found:
        masks = found["masks"]
        add("masks: fish seen behind by two others", masks["recall_seen_behind"], "masks, recall")
        add("masks: right", masks["precision"], "masks, precision")
        add("masks: of what stays and is lit", masks["still_masked"], "masks, still")
    for name in ("mosaic", "mosaic of the wall"):
        if name in found:
            add(f"{name}: shift, rms in pixels", found[name]["all"].get("rms_px"), "mosaic")
    return tuple(made)


if __name__ == "__main__":
    main()
