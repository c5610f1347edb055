"""The stages `pool` and `images`: take the pictures of a calibration and of a survey.

A picture that is there already, from a run that was interrupted, is kept: each is written whole or
not at all, and none depends on another.
"""

from dataclasses import asdict, dataclass, replace
from datetime import UTC
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import atomic_path, write_csv, write_json
from alice_survey.core.config import (
    AreaConfig,
    CameraConfig,
    ImagingConfig,
    SeafloorConfig,
    WaterConfig,
)
from alice_survey.core.errors import ImageError, NavigationError
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array, interpolate_poses, pose_to_json
from alice_survey.core.manifest import ImageRecord, write_manifest
from alice_survey.core.records import BoardRecord, PicturesRecord
from alice_survey.core.trajectory import Trajectory, read_columns, read_track
from alice_survey.sim.seafloor.as_built import true_rig
from alice_survey.sim.seafloor.board import PoolBoard, board_records, pool_poses, render_board
from alice_survey.sim.seafloor.light import (
    CameraLight,
    Sensor,
    camera_light,
    develop,
    expose,
    make_sensor,
    nominal_gain,
)
from alice_survey.sim.seafloor.renderer import Scene, flat_floor_radiance, render
from alice_survey.sim.seafloor.terrain import read_terrain
from alice_survey.sim.seafloor.texture import SAND_ALBEDO, survey_texture
from camera_calib.camera import Camera
from camera_calib.rig import Rig, read_rig, write_rig
from camera_calib.water import water_optics
from missions.fly.simulation import true_terrain
from missions.logs.navigation_csv import read_navigation
from missions.values.plan_file import read_plan

CAMERAS = ("left", "right")
VERTICAL_DATUM = "sea surface at the datum (simulated)"
MOMENTS = 16
"""Poses over one exposure."""

_POOL_STREAM, _POOL_NOISE_STREAM, _NOISE_STREAM = 3500, 3501, 3300
_POOL_WHITE = 0.6
"""Share of the full well that a white of full reflectance fills in the pool."""


@dataclass(frozen=True, kw_only=True)
class _Shoot:
    """What all pictures of a stage share."""

    folder: Path
    camera: CameraConfig
    water: WaterConfig
    imaging: ImagingConfig
    seed: int
    exposure_s: float = 0.0
    """Of a survey's pictures, as the altitude; a pool's board stands still."""
    altitude_m: float = 0.0
    stamp: tuple[int, ...] = ()
    """Size and time of the files that workers read, so that none keeps what has changed."""


def run_pool(
    workspace: Path,
    folder: Path,
    executor: Executor,
    *,
    camera: CameraConfig,
    water: WaterConfig,
    imaging: ImagingConfig,
    seed: int,
) -> None:
    """Take the stereo pictures of a chessboard in a pool, and in air where its ports need them."""
    board = PoolBoard()
    rig = true_rig(camera, water, scale=imaging.scale, seed=seed)
    rng = np.random.default_rng([seed, _POOL_STREAM])
    shoot = _Shoot(folder=folder, camera=camera, water=water, imaging=imaging, seed=seed)
    _take_boards(shoot, board, rig, rng, executor)
    BoardRecord(**asdict(board)).write(folder / "board.json")
    if any(one.port.needs_air for one in rig.cameras.values()):
        cameras = {name: one.in_air() for name, one in rig.cameras.items()}
        dry = replace(shoot, folder=folder / "air", seed=seed + 1)
        _take_boards(dry, board, replace(rig, cameras=cameras), rng, executor)


def _take_boards(
    shoot: _Shoot, board: PoolBoard, rig: Rig, rng: np.random.Generator, executor: Executor
) -> None:
    """Take the pictures of one calibration, with their truth."""
    folder = shoot.folder
    poses = pool_poses(board, rig, shoot.imaging.pool_views, rng)
    shown = board_records(rig, poses)
    jobs = [
        (shoot, board, view, name, rig.cameras[name], pose.as_matrix())
        for view, by_camera in enumerate(shown)
        for name, pose in by_camera.items()
    ]
    records = list(executor.map(_take_board, jobs, label="pool pictures"))
    write_manifest(folder / "manifest.csv", records)
    write_rig(folder / "truth" / "rig.json", rig)
    write_json(
        folder / "truth" / "boards.json",
        {
            "cam_from_board": [
                {"station": view, **{name: pose_to_json(p) for name, p in by_camera.items()}}
                for view, by_camera in enumerate(shown)
            ]
        },
    )


def _take_board(job: tuple[_Shoot, PoolBoard, int, str, Camera, Array]) -> ImageRecord:
    shoot, board, view, camera, one, matrix = job
    imaging = shoot.imaging
    image = f"{camera}/{view:02d}.png"
    record = ImageRecord(image=image, camera=camera, station=view)
    if (shoot.folder / image).exists():
        return record
    # Large pixels need more rays for the same precision of an edge on the board.
    samples = imaging.samples + (1 if imaging.scale > 1 else 0)
    light = render_board(board, one, RigidTransform.from_matrix(matrix), samples)
    sensor = make_sensor(shoot.camera, one.n_water, 1.0, imaging.scale)
    white = _POOL_WHITE * sensor.full_well_e
    lit = Sensor(
        electrons_per_radiance=(white, white, white),
        full_well_e=sensor.full_well_e,
        read_noise_e=sensor.read_noise_e,
    )
    seed = [shoot.seed, _POOL_NOISE_STREAM, view, CAMERAS.index(camera)]
    rng = np.random.default_rng(seed)
    _write_picture(shoot.folder / image, develop(expose(light, lit, rng), 1.0 / white))
    return record


def run_images(
    workspace: Path,
    folder: Path,
    executor: Executor,
    *,
    camera: CameraConfig,
    water: WaterConfig,
    imaging: ImagingConfig,
    seafloor: SeafloorConfig,
    altitude_m: float,
    area: AreaConfig,
    seed: int,
) -> None:
    """Take the pictures of a flown survey.

    Raises:
        WorkspaceError: the plan or the flight lacks a value.
        NavigationError: a trigger lies outside of the flight, or none is there.
    """
    flight = workspace / "flight"
    triggers, navigation = flight / "triggers.csv", flight / "navigation.csv"
    track = flight / "truth" / "track.csv"
    planned = read_plan(workspace / "plan" / "plan.json")
    rows = read_columns(triggers, ("station", "time_s"))
    stations = [(int(s), float(t)) for s, t in zip(*rows.values(), strict=True)]
    if not stations:
        raise NavigationError(
            f"{triggers} holds no trigger: {flight / 'flight.json'} says how it ended"
        )
    truth = read_track(track)
    believed = _believed_records(navigation, np.array([t for _, t in stations]))
    rig = true_rig(camera, water, scale=imaging.scale, seed=seed)
    terrain = folder / "truth" / "terrain.ply"
    if not terrain.with_suffix(".json").exists():
        true_terrain(planned, area, seafloor, altitude_m, seed).write(terrain)
    write_rig(folder / "truth" / "rig.json", rig)
    shoot = _Shoot(
        folder=folder,
        camera=camera,
        water=water,
        imaging=imaging,
        seed=seed,
        exposure_s=planned.exposure_s,
        altitude_m=planned.altitude_m,
        stamp=(terrain.stat().st_size, terrain.stat().st_mtime_ns),
    )
    jobs = (
        (shoot, station, camera, body.as_matrix())
        for station, time_s in stations
        for body in [_poses_over_exposure(truth, time_s, planned.exposure_s)]
        for camera in CAMERAS
    )
    images = list(executor.map(_take, jobs, label="pictures", total=2 * len(stations)))
    both = [(known, station) for known, (station, _) in zip(believed, stations, strict=True)]
    taken = zip(images, product(both, CAMERAS), strict=True)
    records = [
        replace(known, image=image, camera=camera, station=station)
        for image, ((known, station), camera) in taken
    ]
    write_manifest(folder / "manifest.csv", records)
    _write_poses(folder / "truth" / "poses.csv", records, stations, truth, rig)
    PicturesRecord.save(
        folder / "survey.json",
        {
            "source": "simulated",
            "datum": {
                "latitude_deg": planned.datum.latitude_deg,
                "longitude_deg": planned.datum.longitude_deg,
            },
            "vertical_datum": VERTICAL_DATUM,
            "notes": ["pictures are rendered: a simulated sea floor, lit by strobes alone"],
        },
    )


def _believed_records(path: Path, at_s: Array) -> list[ImageRecord]:
    """What the navigation log says at some times: rows of the manifest that lack their picture."""
    log = read_navigation(path, UTC)
    if at_s.min() < log.time_s[0] or at_s.max() > log.time_s[-1]:
        raise NavigationError(
            f"{path} covers {log.time_s[0]:.2f} to {log.time_s[-1]:.2f} s, but triggers go from "
            f"{at_s.min():.2f} to {at_s.max():.2f} s: fly again"
        )
    columns = {"time_s": at_s, **log.at(at_s)}
    nameless = ImageRecord(image="", camera="", station=0)
    return [
        replace(nameless, **{name: float(values[i]) for name, values in columns.items()})  # type: ignore[arg-type]  # all are numbers
        for i in range(len(at_s))
    ]


def _poses_over_exposure(truth: Trajectory, time_s: float, exposure_s: float) -> RigidTransform:
    """`ned_from_body` at moments spread over an exposure whose middle is the trigger's time.

    The last one, beyond `MOMENTS`, is at that time itself.
    """
    spread = np.append((np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5, 0.0)
    moments = time_s + exposure_s * spread
    try:
        return interpolate_poses(truth.time_s, truth.ned_from_body, moments)
    except ValueError:
        raise NavigationError(
            f"the true track covers {truth.time_s[0]:.2f} to {truth.time_s[-1]:.2f} s, but a "
            f"picture is exposed around {time_s:.2f} s: fly again"
        ) from None


def _take(job: tuple[_Shoot, int, str, Array]) -> str:
    """Render one picture, unless it is there; returns its path below the folder."""
    shoot, station, camera, body = job
    imaging = shoot.imaging
    image = f"{camera}/{station:06d}.png"
    if (shoot.folder / image).exists():
        return image
    scene, rig, lights, sensor, gain = _studio(shoot)
    one, poses = rig.cameras[camera], RigidTransform.from_matrix(body) * rig.body_from_cam(camera)
    try:
        radiance = render(scene, one, lights[camera], poses[:MOMENTS], imaging.samples)
        seed = [shoot.seed, _NOISE_STREAM, station, CAMERAS.index(camera)]
        picture = develop(expose(radiance, sensor, np.random.default_rng(seed)), gain)
        _write_picture(shoot.folder / image, picture)
    except ImageError as error:
        raise ImageError(f"station {station}, {camera} camera: {error}") from None
    return image


@lru_cache(maxsize=1)
def _studio(shoot: _Shoot) -> tuple[Scene, Rig, dict[str, CameraLight], Sensor, float]:
    """What a process needs for all of its pictures: sea floor, rig, light, sensor and gain."""
    truth, imaging = shoot.folder / "truth", shoot.imaging
    rig, water = read_rig(truth / "rig.json"), water_optics(shoot.water.jerlov)
    scene = Scene(terrain=read_terrain(truth / "terrain.ply"), texture=survey_texture(shoot.seed))
    reach_m = 2.0 * shoot.altitude_m + 1.0
    lights = {
        name: camera_light(camera, rig.body_from_cam(name), imaging, water, reach_m)
        for name, camera in rig.cameras.items()
    }
    left = rig.cameras["left"]
    sensor = make_sensor(shoot.camera, left.n_water, shoot.exposure_s, imaging.scale)
    pupil_m = shoot.altitude_m + float(left.front_cam[2])
    nominal = flat_floor_radiance(
        left, lights["left"], pupil_m, SAND_ALBEDO, max(left.width_px // 24, 1)
    )
    gain = nominal_gain(nominal * np.asarray(sensor.electrons_per_radiance), sensor)
    return scene, rig, lights, sensor, gain


def _write_poses(
    path: Path,
    records: list[ImageRecord],
    stations: list[tuple[int, float]],
    truth: Trajectory,
    rig: Rig,
) -> None:
    times = np.repeat([t for _, t in stations], len(CAMERAS))
    bodies = interpolate_poses(truth.time_s, truth.ned_from_body, times)
    rows = []
    for record, ned_from_body in zip(records, bodies, strict=True):
        pose = ned_from_body * rig.body_from_cam(record.camera)
        quaternion = pose.rotation.as_quat(canonical=True)
        rows.append([record.image, *(f"{v:.12f}" for v in (*pose.translation, *quaternion))])
    header = ("image", "north_m", "east_m", "depth_m", "qx", "qy", "qz", "qw")
    write_csv(path, header, rows)


def _write_picture(path: Path, picture: NDArray[Any]) -> None:
    rle = cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE
    with atomic_path(path) as temporary:
        if not cv2.imwrite(str(temporary), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1, *rle]):
            raise ImageError(f"{path} cannot be written: is the disk full?")
