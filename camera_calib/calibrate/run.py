"""The stage `calibration`: the rig from the pictures of a board in a pool."""

from dataclasses import replace
from pathlib import Path

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import CalibrationError
from alice_survey.core.executor import Executor
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import BoardRecord
from camera_calib.calibrate.detect_views import Size, detect_views
from camera_calib.calibrate.picture_sets import PictureSet
from camera_calib.calibrate.results import warn_of_unseen, write_results
from camera_calib.calibrate.solve import Intrinsics, calibrate_in_air, calibrate_through_ports
from camera_calib.freedom import USUAL_LENS
from camera_calib.rig import design_rig
from camera_calib.targets.target import Target


def run_calibrate(
    workspace: Path, folder: Path, executor: Executor, *, camera: CameraConfig, water: WaterConfig
) -> None:
    """Calibrate the rig from `pool/`.

    Intrinsics, ports (with their normals) and the pose of the right camera are found together,
    from the design, or from the pictures in air where there are some.

    Raises:
        CalibrationError: too few usable views.
    """
    pool = workspace / "pool"
    board = BoardRecord.read(pool / "board.json")
    target = Target(
        kind="chessboard", columns=board.columns, rows=board.rows, size_m=board.square_m
    )
    found = detect_views(_pool_pictures(pool), target, executor)
    warn_of_unseen(found)
    start = design_rig(camera, water, _scale(found.sizes["left"], camera))
    lens = USUAL_LENS[camera.lens]
    known: Intrinsics = "free"
    if (pool / "air").is_dir():
        seen = detect_views(_pool_pictures(pool / "air"), target, executor)
        dry = calibrate_in_air(seen.views, target.points, seen.sizes, lens).rig
        cameras = {
            name: replace(one, port=start.cameras[name].port) for name, one in dry.cameras.items()
        }
        start, known = replace(dry, cameras=cameras, body_from_rig=start.body_from_rig), "prior"
    calibration = calibrate_through_ports(found.views, target.points, start, known, lens)
    write_results(folder, calibration, found)


def _pool_pictures(pool: Path) -> list[PictureSet]:
    stations: dict[int, dict[str, Path]] = {}
    for record in read_manifest(pool / "manifest.csv"):
        stations.setdefault(record.station, {})[record.camera] = pool / record.image
    return [PictureSet(name=str(n), paths=stations[n]) for n in sorted(stations)]


def _scale(size: Size, camera: CameraConfig) -> int:
    """How many times larger than designed the pixels of a pool's pictures are."""
    width, height = size
    scale = max(round(camera.width_px / width), 1)
    if (camera.width_px // scale, camera.height_px // scale) != (width, height):
        raise CalibrationError(
            f"the pool's pictures have {width} x {height} px, which is not a whole fraction of the "
            f"camera's {camera.width_px} x {camera.height_px}: set [camera] width_px and height_px"
        )
    return scale
