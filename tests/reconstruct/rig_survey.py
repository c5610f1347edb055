"""A rendered survey with four unlike cameras, two of which look obliquely, and its score."""

import csv
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import RigidTransform
from shapely.geometry import MultiPolygon, box

from alice_survey.core.config import ImagingConfig, SeafloorConfig
from alice_survey.core.executor import Executor
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Datum, rotation_from_attitude
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import RegistrationRecord
from alice_survey.sim.seafloor.light import (
    MIDDLE_GREY,
    CameraLight,
    Sensor,
    camera_light,
    develop,
    expose,
)
from alice_survey.sim.seafloor.renderer import Scene, render
from alice_survey.sim.seafloor.terrain import build_terrain
from alice_survey.sim.seafloor.texture import survey_texture
from camera_calib.camera import Camera
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig, write_rig
from camera_calib.water import water_optics
from reconstruct.elevation import elevation_in
from reconstruct.evaluate.run import CameraScore, score_cameras
from reconstruct.evaluate.scores import MosaicScore, SurfaceScore, score_mosaic, score_surface
from reconstruct.evaluate.truth import ground_pixel_m
from reconstruct.placing.track import read_track_poses
from tests.cameras import rig_of

DATUM = Datum(32.8236, 34.9553)
DEPTH_M, ALTITUDE_M = 6.0, 1.6
LINES, MOMENTS, SPACING_M, STEP_M = 4, 4, 0.7, 0.45
_START = datetime(2024, 7, 1, 12)
_SEED = 21
_MIDDLE_E = 8000.0
"""Electrons of a middling pixel: 90 of noise, a hundredth."""
_POSITION_SIGMA_M, _DEPTH_SIGMA_M = 0.3, 0.02


def four_cameras() -> Rig:
    """Two behind flat ports that look down, one behind a dome ahead, and a fisheye aside."""
    cameras = {
        "wide": Camera(
            width_px=640, height_px=480,
            lens=OpenCVLens(fx_px=500.0, fy_px=501.0, cx_px=324.0, cy_px=236.0, k1=-0.06, k2=0.03),
            port=FlatPort(port_distance_m=0.02, glass_thickness_m=0.01, normal=(1e-2, 0, 0.99995)),
        ),
        "tele": Camera(
            width_px=480, height_px=600,
            lens=OpenCVLens(fx_px=640.0, fy_px=639.0, cx_px=236.0, cy_px=303.0, k1=0.03),
            port=FlatPort(port_distance_m=0.045, glass_thickness_m=0.006, n_glass=1.49),
        ),
        "bow": Camera(
            width_px=600, height_px=500,
            lens=OpenCVLens(fx_px=560.0, fy_px=562.0, cx_px=302.0, cy_px=246.0, k1=-0.1, k2=0.02),
            port=DomePort(dome_z_m=0.004, dome_x_m=0.001, outer_radius_m=0.06,
                          glass_thickness_m=0.005),
        ),
        "side": Camera(
            width_px=560, height_px=560,
            lens=FisheyeLens(fx_px=470.0, fy_px=471.0, cx_px=283.0, cy_px=278.0, k1=-0.02),
            port=DomePort(dome_z_m=-0.003, outer_radius_m=0.08, glass_thickness_m=0.006),
        ),
    }  # fmt: skip
    turns: dict[str, list[float]] = {
        "wide": [0, 0, 0], "tele": [1, -2, 90], "bow": [20, 1, -1], "side": [-1, 18, 2],
    }  # fmt: skip
    places: dict[str, list[float]] = {
        "wide": [0, 0, 0], "tele": [0.14, 0.01, 0], "bow": [0.06, -0.12, 0.02],
        "side": [0.2, 0.1, -0.01],
    }  # fmt: skip
    body_from_rig = RigidTransform.from_components([0.1, -0.1, 0.05], BODY_FROM_NADIR_CAM)
    return rig_of(cameras, turns, places, body_from_rig)


def bodies(lines: int = LINES) -> RigidTransform:
    """`ned_from_body` of all moments: lines to and fro, with a swaying vehicle."""
    rng = np.random.default_rng(_SEED)
    poses = []
    for line in range(lines):
        for step in range(MOMENTS):
            north = STEP_M * (step if line % 2 == 0 else MOMENTS - 1 - step)
            place = np.array([north, SPACING_M * line, DEPTH_M - ALTITUDE_M])
            turn = np.deg2rad(rng.normal(0, 1.5, 3)) + np.array([0, 0, np.pi * (line % 2)])
            poses.append(
                RigidTransform.from_components(
                    place + rng.normal(0, 0.03, 3), rotation_from_attitude(*turn)
                )
            )
    return RigidTransform.concatenate(poses)


def area(lines: int = LINES) -> MultiPolygon:
    """What is scored: where several moments look."""
    return MultiPolygon([box(0.0, -0.2, STEP_M * (MOMENTS - 1), SPACING_M * (lines - 1) + 0.2)])


@lru_cache(maxsize=1)
def scene() -> Scene:
    """The sea floor, wider than any camera looks."""
    seafloor = SeafloorConfig(relief_m=0.2, grid_m=0.02, amphora=False)
    beyond = (-6.0, 8.0, -7.0, 8.5)
    terrain = build_terrain(seafloor, beyond, DEPTH_M, np.random.default_rng(_SEED))
    return Scene(terrain=terrain, texture=survey_texture(_SEED))


@lru_cache(maxsize=4)
def _lit(name: str) -> tuple[Camera, RigidTransform, CameraLight]:
    rig = four_cameras()
    pose, camera = rig.body_from_cam(name), rig.cameras[name]
    return camera, pose, camera_light(camera, pose, ImagingConfig(), water_optics("1C"), 6.0)


def _take(task: tuple[Path, str, int]) -> None:
    folder, name, moment = task
    path = folder / name / f"{moment:04d}.png"
    if path.exists():
        return
    camera, body_from_cam, light = _lit(name)
    pose = bodies()[moment] * body_from_cam
    seen = RigidTransform.from_matrix(pose.as_matrix()[None])
    radiance = render(scene(), camera, light, seen, samples=2)
    per_e = _MIDDLE_E / float(np.median(radiance.mean(axis=-1)))
    sensor = Sensor(electrons_per_radiance=(per_e, per_e, per_e), full_well_e=1e5, read_noise_e=5.0)
    rng = np.random.default_rng([_SEED, moment, list(four_cameras().cameras).index(name)])
    picture = develop(expose(radiance, sensor, rng), MIDDLE_GREY / _MIDDLE_E)
    exif = Image.Exif()
    exif[0x0110] = name  # Pillow leaves out EXIF that has details alone
    exif.get_ifd(0x8769)[0x9003] = f"{_START + timedelta(seconds=2 * moment):%Y:%m:%d %H:%M:%S}"
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture[..., ::-1]).save(path, exif=exif)


def render_survey(folder: Path, executor: Executor, lines: int = LINES) -> None:
    """Write `NAME/0000.png` and so on, `navigation.csv` and `rig.json` of the truth."""
    poses, names = bodies(lines), four_cameras().cameras
    tasks = [(folder, name, moment) for name in names for moment in range(len(poses))]
    list(executor.map(_take, tasks, label="pictures"))
    write_rig(folder / "rig.json", four_cameras())
    rng = np.random.default_rng(_SEED + 1)
    bias = rng.normal(0, 0.2, 3) * [1, 1, 0.1]
    with (folder / "navigation.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([
            "time_utc", "latitude_deg", "longitude_deg", "depth_m", "roll_deg", "pitch_deg",
            "heading_deg", "altitude_m", "sigma_horizontal_m", "sigma_depth_m",
            "sigma_attitude_deg", "sigma_heading_deg",
        ])  # fmt: skip
        for moment in range(len(poses)):
            time = _START + timedelta(seconds=2 * moment)
            yaw, pitch, roll = poses[moment].rotation.as_euler("ZYX", degrees=True)
            place = DATUM.geodetic_from_ned((poses[moment].translation + bias)[None])[0]
            writer.writerow([
                f"{time:%Y-%m-%dT%H:%M:%SZ}", f"{place[0]:.9f}", f"{place[1]:.9f}",
                f"{place[2]:.4f}", f"{roll:.3f}", f"{pitch:.3f}", f"{yaw % 360:.3f}", ALTITUDE_M,
                _POSITION_SIGMA_M, _DEPTH_SIGMA_M, 0.3, 1.0,
            ])  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RigScore:
    """Errors of a survey's products against its truth."""

    surface: SurfaceScore
    mosaic: MosaicScore
    pixel_m: float
    """Side of a pixel on the sea floor."""


def placed(workspace: Path, lines: int = LINES) -> tuple[CameraScore, float]:
    """Errors of cameras in a workspace whose pictures are of this survey, and a ground pixel."""
    rig, poses = four_cameras(), bodies(lines)
    records = read_manifest(workspace / "images" / "manifest.csv")
    truth = {r.image: poses[r.station] * rig.body_from_cam(r.camera) for r in records}
    total = RegistrationRecord.read(workspace / "sparse" / "registration.json").total
    cameras = score_cameras(read_track_poses(workspace / "sparse" / "track.csv"), truth, total)
    of = {r.image: r.camera for r in records}
    return cameras, ground_pixel_m(rig, of, truth, scene().terrain)


def score(workspace: Path, lines: int = LINES) -> RigScore:
    """Score a workspace that is reconstructed to its mosaic."""
    cameras, pixel_m = placed(workspace, lines)
    terrain, moved = scene().terrain, cameras.truth_from_world
    dense = workspace / "dense"
    heights = elevation_in(dense)
    surface = score_surface(heights, area(lines), terrain, moved, pixel_m)
    mosaic = score_mosaic(
        workspace / "mosaic" / "mosaic.tif", heights, area(lines), terrain,
        scene().texture, moved,
    )  # fmt: skip
    return RigScore(surface=surface, mosaic=mosaic, pixel_m=pixel_m)


def command(*arguments: str | Path) -> str:
    """What `alice-survey` with these arguments prints, warnings too."""
    line = [sys.executable, "-m", "alice_survey", *map(str, arguments)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{arguments}: {done.stderr}")
    return done.stdout + done.stderr


def places(folder: Path, names: Sequence[str]) -> list[str]:
    """Options that name the folders of pictures of some cameras."""
    return [part for name in names for part in ("--camera", f"{name}={folder / name}")]


def import_survey(pictures: Path, rig: Path, workspace: Path, names: Sequence[str]) -> str:
    """Import the pictures of some cameras; what the command printed."""
    files = ("--rig", rig, "--navigation", pictures / "navigation.csv")
    return command("import-images", *places(pictures, names), *files, "-w", workspace)
