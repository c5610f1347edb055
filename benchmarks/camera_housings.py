"""Ports and lenses chosen by `--lens auto` and `--port auto`, from all views and from halves.

A lens is chosen from 24 views in air, and with that start a port from 24 in water, of cameras that
`tests.camera_calib.housing_scenes` draws.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

from alice_survey.core.errors import AliceError
from alice_survey.core.executor import SERIAL, Executor
from benchmarks.figures import Figure, Goal
from benchmarks.target_calibration import SIZE
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.from_pictures import calibrate_task
from camera_calib.calibrate.options import CalibrateOptions, task_of
from camera_calib.calibration import TargetView
from camera_calib.rig import Rig
from camera_calib.targets.target import parse_target
from tests.camera_calib.housing_scenes import drawn_camera

_TARGET = parse_target("chessboard 9x7 30mm")
PARTS = {"all views": slice(None), "even half": slice(0, None, 2), "odd half": slice(1, None, 2)}


def run_trial(seed: int, kind: str) -> dict[str, Any]:
    """What is chosen of one camera, or why nothing is; the start in water is of all views."""
    camera, row = drawn_camera(kind, seed), dict[str, Any](kind=kind, seed=seed)
    start = _chosen(camera.dry, None)[0]
    for name, part in PARTS.items():
        lens = _chosen(camera.dry[part], None)[1]
        port = _chosen(camera.wet[part], start, water=True, port="auto", **camera.known)[2]
        right = lens == camera.lens and port in camera.ports
        row |= {name: f"{lens}, {port}", f"{name}: right": right}
    return row


def _chosen(
    views: Sequence[TargetView], start: Rig | None, **given: Any
) -> tuple[Rig | None, str, str]:
    """The likeliest rig, its lens and its port; or why there is none."""
    found = Detections(views=tuple(views), sizes={"camera": SIZE}, rejections=())
    try:
        task = task_of(CalibrateOptions(**given), {"camera": "corners"}, _TARGET, start)
        rig = calibrate_task(task, found).rig
    except AliceError as error:
        return None, str(error), str(error)
    camera = rig.cameras["camera"]
    return rig, camera.lens.model, camera.port.shape


def run_kind(kind: str, seeds: Sequence[int], executor: Executor = SERIAL) -> list[dict[str, Any]]:
    """All trials of a kind."""
    return list(executor.map(partial(run_trial, kind=kind), seeds, label=f"housings, {kind}"))


def figures(rows: Sequence[dict[str, Any]]) -> list[Figure]:
    """How many of all are chosen rightly."""
    return [
        Figure(
            name=f"housings: lens and port chosen rightly, {name}", goal=Goal(minimum=len(rows)),
            value=sum(row[f"{name}: right"] for row in rows), unit=f"of {len(rows)}",
        )
        for name in PARTS
    ]  # fmt: skip
