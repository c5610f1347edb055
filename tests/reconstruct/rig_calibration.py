"""Pictures of a board before the four cameras of `rig_survey`, in air and in water, and what the
command line finds from them.

`python -m tests.reconstruct.rig_calibration WORK` renders board and survey, calibrates, and maps
the survey with the true and the found rig, by all cameras and without the reference.
"""

import sys
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.executor import Executor, local_executor
from camera_calib.camera import Camera
from camera_calib.rig import Rig, read_rig
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import differences, in_air
from tests.oracles_targets import picture_light, to_srgb
from tests.reconstruct.rig_survey import (
    command,
    four_cameras,
    import_survey,
    places,
    render_survey,
    score,
)

BOARD = parse_target("chessboard 9x6 40mm")
VIEWS = 40
_NEAREST_M, _FARTHEST_M, _TILT_DEG = 0.45, 1.4, 40.0
_MARGIN_PX = 12
_NOISE = 0.006
"""Of light, where white is 0.7."""
HOUSINGS = (
    "--port", "flat,bow=dome,side=dome", "--glass", "6,wide=10,bow=5",
    "--n-glass", "1.52,tele=1.49", "--dome-radius", "80,bow=60",
)  # fmt: skip
"""What the owner of the cameras knows of their ports."""


def _is_whole(camera: Camera, cam_from_board: RigidTransform) -> bool:
    pixels = camera.project(cam_from_board.apply(BOARD.points))
    size = np.array([camera.width_px, camera.height_px])
    return bool(np.all((pixels > _MARGIN_PX) & (pixels < size - _MARGIN_PX)))


def poses(rig: Rig, seed: int) -> list[tuple[RigidTransform, list[str]]]:
    """`rig_from_board` of all views, and the cameras that see it whole: two or more.

    The place aimed at is anywhere in the frame of each camera in turn.
    """
    rng, found = np.random.default_rng(seed), []
    middle = BOARD.points.mean(axis=0)
    while len(found) < VIEWS:
        name = list(rig.cameras)[len(found) % len(rig.cameras)]
        camera = rig.cameras[name]
        pixel = rng.uniform(0.0, 1.0, 2) * [camera.width_px, camera.height_px]
        turn = Rotation.from_euler("xyz", rng.uniform(-_TILT_DEG, _TILT_DEG, 3), degrees=True)
        place = camera.at_depth(pixel, rng.uniform(_NEAREST_M, _FARTHEST_M))
        cam_from_board = RigidTransform.from_components(place - turn.apply(middle), turn)
        pose = rig.cam_from_rig[name].inv() * cam_from_board
        seen = [n for n, c in rig.cameras.items() if _is_whole(c, rig.cam_from_rig[n] * pose)]
        if name in seen and len(seen) >= 2:
            found.append((pose, seen))
    return found


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
    camera, board_from_cam = rig.cameras[name], (rig.cam_from_rig[name] * rig_from_board).inv()

    def hits(pixels: np.ndarray) -> np.ndarray:
        """(M, 2) x and y where the rays of pixels meet the board's plane."""
        points, directions = camera.unproject(pixels)
        start, ways = board_from_cam.apply(points), board_from_cam.rotation.apply(directions)
        return start[:, :2] - start[:, 2:] / ways[:, 2:] * ways[:, :2]

    size = camera.width_px, camera.height_px
    light = picture_light(BOARD, np.eye(3), size, fine=4, warp=hits)
    rng = np.random.default_rng([view, wet, list(rig.cameras).index(name)])
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), to_srgb(light + rng.normal(0.0, _NOISE, light.shape)))


def calibrated_rig(folder: Path, executor: Executor) -> Path:
    """The rig.json of the four cameras, from pictures in air and then in water."""
    found = folder / "air" / "rig.json"
    for medium in ("air", "water"):
        wet = medium == "water"
        tasks = [
            (folder / "board" / medium, wet, name, view, pose)
            for view, (pose, seen) in enumerate(poses(_housed(wet), 31 + wet))
            for name in seen
        ]
        list(executor.map(_take, tasks, label="board"))
        pictures = places(folder / "board" / medium, list(four_cameras().cameras))
        known = ["--water", "--start", found, *HOUSINGS] if wet else []
        known += ["--lens", "opencv5,side=fisheye", "--target", BOARD.description]
        said = command("calibrate", *pictures, *known, "-o", folder / medium)
        (folder / f"{medium}.txt").write_text(said)
        found = folder / medium / "rig.json"
    return found


def errors_over_sigmas(rig: Rig) -> dict[str, float]:
    """Error over sigma of every parameter that was found."""
    errors = differences(rig, four_cameras())
    return {key: errors[key] / sigma for key, sigma in rig.sigmas.items()}


if __name__ == "__main__":
    work = Path(sys.argv[1])
    path = calibrated_rig(work, local_executor())
    over = errors_over_sigmas(read_rig(path))
    sys.stdout.write("".join(f"{key} {value:+.2f}\n" for key, value in over.items()))
    values = np.abs(list(over.values()))
    sys.stdout.write(f"error over sigma {np.sqrt(np.mean(values**2)):.2f}, {values.max():.2f}\n")
    survey = work / "pictures"
    render_survey(survey, local_executor())
    for chosen in (list(four_cameras().cameras), list(four_cameras().cameras)[1:]):
        for kind, rig_path in (("true", survey / "rig.json"), ("found", path)):
            made = work / "-".join([*chosen, kind])
            import_survey(survey, rig_path, made, chosen)
            command("reconstruct", "-w", made)
            sys.stdout.write(f"{kind} rig, {', '.join(chosen)}: {score(made)}\n")
