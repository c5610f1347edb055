"""Pictures of a board before the four cameras of `rig_survey`, in air and in water, and what the
command line finds from them.
"""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.executor import Executor
from camera_calib.rig import Rig
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import in_air, views_of_some
from tests.oracles_targets import light_through, to_srgb
from tests.reconstruct.rig_survey import command, four_cameras, places

BOARD = parse_target("chessboard 9x6 40mm")
VIEWS = 18
_NOISE = 0.006
"""Of light, where white is 0.7."""
HOUSINGS = (
    "--port", "flat,bow=dome,side=dome", "--glass", "6,wide=10,bow=5",
    "--n-glass", "1.52,tele=1.49", "--dome-radius", "80,bow=60",
)  # fmt: skip
"""What the owner of the cameras knows of their ports."""


@lru_cache(maxsize=2)
def _housed(wet: bool) -> Rig:
    return four_cameras() if wet else in_air(four_cameras())


def _take(task: tuple[Path, bool, str, int, RigidTransform]) -> None:
    """Write the board as rays of pixels meet it: through a port that is not a homography."""
    folder, wet, name, view, rig_from_board = task
    path = folder / name / f"{view:03d}.png"
    if path.exists():
        return
    rig = _housed(wet)
    board_from_cam = (rig.cam_from_rig[name] * rig_from_board).inv()
    light = light_through(BOARD, rig.cameras[name], board_from_cam)
    rng = np.random.default_rng([view, wet, list(rig.cameras).index(name)])
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), to_srgb(light + rng.normal(0.0, _NOISE, light.shape)))


def calibrated_rig(folder: Path, executor: Executor) -> Path:
    """The rig.json of the four cameras, from pictures in air and then in water."""
    found = folder / "air" / "rig.json"
    for medium in ("air", "water"):
        wet = medium == "water"
        shown = views_of_some(_housed(wet), BOARD.points, VIEWS, np.random.default_rng(31 + wet))
        tasks = [
            (folder / "board" / medium, wet, name, view, pose)
            for view, (pose, seen) in enumerate(shown)
            for name in seen
        ]
        list(executor.map(_take, tasks, label="board"))
        pictures = places(folder / "board" / medium, list(four_cameras().cameras))
        known: list[str | Path] = ["--water", "--start", found, *HOUSINGS] if wet else []
        known += ["--lens", "opencv5,side=fisheye", "--target", BOARD.description]
        command("calibrate", *pictures, *known, "-o", folder / medium)
        found = folder / medium / "rig.json"
    return found
