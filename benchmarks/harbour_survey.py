"""A stereo rig's survey of the harbour: where it stands, its pictures, and their import.

The rig is the project's own, as built, on a mount that looks 45 degrees ahead and down: a pitch of
the body of 45 degrees looks level, -45 straight down, and no view is near the pole of the angles.
"""

import csv
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, ImagingConfig, WaterConfig
from alice_survey.core.executor import Executor
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array, Datum, rotation_from_attitude
from alice_survey.sim.seafloor.as_built import true_rig
from alice_survey.sim.seafloor.light import (
    MIDDLE_GREY,
    CameraLight,
    Sensor,
    camera_light,
    develop,
    expose,
)
from alice_survey.sim.seafloor.renderer import Scene, flat_floor_radiance, render
from alice_survey.sim.seafloor.texture import SAND_ALBEDO, survey_texture
from benchmarks.harbour_meshes import moving_at, still_harbour
from benchmarks.harbour_scene import PILE
from camera_calib.mount import mount_rotation
from camera_calib.rig import Rig, write_rig
from camera_calib.water import water_optics

DATUM = Datum(32.8236, 34.9553)
DISTANCE_M = 2.0
EVERY_S = 2.0
"""Between stations."""
_TILT_DEG = 45.0
_BODY_FROM_RIG = RigidTransform.from_components(
    [0.3, -0.05, 0.1], mount_rotation(f"forward+{_TILT_DEG:g}")
)
_REACH_M = 6.0
SEED = 19
_START = datetime(2024, 7, 1, 12, tzinfo=UTC)
_WANDER_M, _SWAY_DEG = 0.03, 1.5
_MIDDLE_E = 8000.0
"""Electrons of a middling pixel at the nominal distance: a hundredth of noise."""
STROBES = ImagingConfig(strobes_body_m=((0.05, 0.5, 0.05), (0.05, -0.5, 0.05)))
"""To the right and the left of the cameras, in the frame of a body that looks down."""
SIGMA_HORIZONTAL_M, SIGMA_DEPTH_M, SIGMA_ATTITUDE_DEG, SIGMA_HEADING_DEG = 0.1, 0.02, 0.3, 1.0


@dataclass(frozen=True, kw_only=True)
class Station:
    """Where the left camera is meant to be, and whither it looks."""

    row: str
    place: tuple[float, float, float]
    heading_deg: float
    down_deg: float
    """Of the axis below the horizon; negative where it looks up."""


def stations(step_m: float) -> list[Station]:
    """All stations, in the order of their times; rows have one about every `step_m`."""
    found: list[Station] = []

    def row(
        name: str, start: Sequence[float], end: Sequence[float],
        headings: tuple[float, float], downs: tuple[float, float], count: int | None = None,
    ) -> None:  # fmt: skip
        length = float(np.linalg.norm(np.subtract(end, start)))
        steps = count or round(length / step_m) + 1
        for t in np.linspace(0.0, 1.0, steps).tolist():
            north, east, depth = (float(a + t * (b - a)) for a, b in zip(start, end, strict=True))
            found.append(
                Station(
                    row=name,
                    place=(north, east, depth),
                    heading_deg=headings[0] + t * (headings[1] - headings[0]),
                    down_deg=downs[0] + t * (downs[1] - downs[0]),
                )
            )

    ahead, level, oblique, nadir = (0.0, 0.0), (0.0, 0.0), (45.0, 45.0), (90.0, 90.0)
    for depth in (3.5, 4.4, 5.3):
        row("wall", (-2.0, -0.3, depth), (-2.0, 2.2, depth), ahead, level)
    for depth in (3.3, 4.2):
        row("hull", (-2.8, 5.6, depth), (-2.8, 3.2, depth), ahead, level)
    row("under hull", (-2.6, 3.2, 5.3), (-2.6, 5.6, 5.3), ahead, (-30.0, -30.0))
    row("oblique", (-2.1, 2.2, 4.5), (-2.1, -0.3, 4.5), ahead, oblique)
    row("oblique", (-1.3, -1.0, 4.5), (-1.3, 1.3, 4.5), (90.0, 90.0), oblique)
    for north, east in ((-1.0, (2.2, -0.2)), (-1.9, (-0.2, 5.3)), (-2.8, (5.3, -0.2))):
        row("floor", (north, east[0], 4.0), (north, east[1], 4.0), (90.0, 90.0), nadir)
    tie = round(90.0 / 13.0 / max(step_m / 0.5, 0.5)) + 1
    row("tie", (-2.0, 0.8, 4.4), (-1.6, 0.8, 4.0), ahead, (0.0, 90.0), tie)
    row("tie", (-2.8, 4.4, 4.2), (-2.0, 4.4, 4.0), ahead, (0.0, 90.0), tie)
    row("tie", (-2.0, 2.3, 4.4), (-2.8, 3.2, 4.3), ahead, level)
    row("tie", (-2.8, 4.4, 4.2), (-2.6, 4.4, 5.3), ahead, (0.0, -30.0), 4)
    # Around the pile the floor links to the other rows, and one ring to the other.
    row("floor", (-2.8, -0.7, 4.0), (-2.8, -1.9, 4.0), (90.0, 90.0), nadir)
    pile_north, pile_east = PILE.place_ne
    before, over = (pile_north - 1.75, pile_east, 4.4), (pile_north - 1.3, pile_east, 4.1)
    row("tie", before, over, ahead, (0.0, 90.0), tie)
    for depth, down in ((4.4, 0.0), (4.6, 18.0)):
        arc = 1.75 * np.deg2rad(200.0)
        for azimuth in np.linspace(-100.0, 100.0, round(arc / step_m) + 1).tolist():
            angle = np.deg2rad(azimuth)
            aside_north, aside_east = -1.75 * np.cos(angle), 1.75 * np.sin(angle)
            place = (float(pile_north + aside_north), float(pile_east + aside_east), depth)
            found.append(Station(row="pile", place=place, heading_deg=-azimuth, down_deg=down))
    return found


def quick_stations() -> list[Station]:
    """A few, in front of wall, ladder and floor."""
    kept = [s for s in stations(0.4) if s.row in ("wall", "oblique") and 0.0 < s.place[1] < 1.6]
    return [s for s in kept if s.row == "oblique" or s.place[2] > 4.0]


@lru_cache(maxsize=4)
def harbour_rig(scale: int) -> Rig:
    """The rig as built, on its mount; a picture's pixel is `scale` of the sensor's each way."""
    built = true_rig(CameraConfig(), WaterConfig(), scale=scale, seed=SEED)
    return replace(built, body_from_rig=_BODY_FROM_RIG)


def body_poses(planned: Sequence[Station]) -> RigidTransform:
    """`ned_from_body` of the stations: as meant, but for the vehicle's wander and sway."""
    rng = np.random.default_rng([SEED, 1])
    rig_from_body = _BODY_FROM_RIG.inv()
    poses = []
    for one in planned:
        sway = rng.normal(0.0, _SWAY_DEG, 3)
        attitude = np.array([0.0, _TILT_DEG - one.down_deg, one.heading_deg]) + sway
        turn = rotation_from_attitude(*np.deg2rad(attitude))
        turn_rig = turn * rig_from_body.rotation.inv()
        place = np.asarray(one.place) + rng.normal(0.0, _WANDER_M, 3)
        poses.append(RigidTransform.from_components(place, turn_rig) * rig_from_body)
    return RigidTransform.concatenate(poses)


def time_of(station: int) -> float:
    """Seconds since the start."""
    return EVERY_S * station


@dataclass(frozen=True, kw_only=True)
class Shoot:
    """What a process needs to take a picture."""

    folder: Path
    planned: tuple[Station, ...]
    scale: int


@lru_cache(maxsize=2)
def _light(scale: int, name: str) -> CameraLight:
    rig = harbour_rig(scale)
    # Strobes are described on a body that looks down, with the left camera at its origin.
    level = RigidTransform.from_rotation(BODY_FROM_NADIR_CAM)
    pose = level * rig.cam_from_rig[name].inv()
    return camera_light(rig.cameras[name], pose, STROBES, water_optics("II"), _REACH_M)


@lru_cache(maxsize=1)
def _electrons(scale: int) -> float:
    """For a unit of radiance, so that sand at the nominal distance is middling."""
    camera, light = harbour_rig(scale).cameras["left"], _light(scale, "left")
    nominal = flat_floor_radiance(camera, light, DISTANCE_M, SAND_ALBEDO, 16)
    return _MIDDLE_E / float(np.median(nominal.mean(axis=-1)))


def picture_at(shoot: Shoot, station: int, name: str) -> NDArray[np.uint8]:
    """A picture in eight bits, blue, green, red."""
    rig = harbour_rig(shoot.scale)
    pose = body_poses(shoot.planned)[station] * rig.body_from_cam(name)
    still = still_harbour()
    terrain = replace(still, objects=still.objects + moving_at(time_of(station)))
    scene = Scene(terrain=terrain, texture=survey_texture(SEED))
    seen = RigidTransform.from_matrix(pose.as_matrix()[None])
    radiance = render(scene, rig.cameras[name], _light(shoot.scale, name), seen, samples=2)
    per_e = _electrons(shoot.scale)
    sensor = Sensor(electrons_per_radiance=(per_e, per_e, per_e), full_well_e=1e5, read_noise_e=5.0)
    rng = np.random.default_rng([SEED, station, list(rig.cameras).index(name)])
    return develop(expose(radiance, sensor, rng), MIDDLE_GREY / _MIDDLE_E)


def _take(task: tuple[Shoot, int, str]) -> None:
    shoot, station, name = task
    path = shoot.folder / name / f"{station:04d}.png"
    if path.exists():
        return
    picture = picture_at(shoot, station, name)
    exif = Image.Exif()
    exif[0x0110] = name  # Pillow leaves out EXIF that has details alone
    at = _START + timedelta(seconds=time_of(station))
    exif.get_ifd(0x8769)[0x9003] = f"{at:%Y:%m:%d %H:%M:%S}"
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture[..., ::-1]).save(path, exif=exif)


def render_survey(shoot: Shoot, executor: Executor) -> None:
    """Write `left/0000.png` and so on, `navigation.csv`, and `rig.json` of the truth."""
    tasks = [(shoot, at, name) for at in range(len(shoot.planned)) for name in ("left", "right")]
    list(executor.map(_take, tasks, label="pictures"))
    write_rig(shoot.folder / "rig.json", harbour_rig(shoot.scale))
    _write_navigation(shoot)


def _write_navigation(shoot: Shoot) -> None:
    """Positions with a bias that is most of their sigma, attitudes with noise of theirs."""
    rng = np.random.default_rng([SEED, 2])
    sigma = np.array([SIGMA_HORIZONTAL_M, SIGMA_HORIZONTAL_M, SIGMA_DEPTH_M])
    bias = 0.9 * sigma * rng.standard_normal(3)
    turns = np.array([SIGMA_ATTITUDE_DEG, SIGMA_ATTITUDE_DEG, SIGMA_HEADING_DEG])
    with (shoot.folder / "navigation.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([
            "time_utc", "latitude_deg", "longitude_deg", "depth_m", "roll_deg", "pitch_deg",
            "heading_deg", "sigma_horizontal_m", "sigma_depth_m", "sigma_attitude_deg",
            "sigma_heading_deg",
        ])  # fmt: skip
        for number, pose in enumerate(body_poses(shoot.planned)):
            at = _START + timedelta(seconds=time_of(number))
            roll, pitch, yaw = np.rad2deg(_attitude(pose.rotation)) + turns * rng.normal(0, 1, 3)
            read = pose.translation + bias + 0.44 * sigma * rng.standard_normal(3)
            lat, lon, depth = DATUM.geodetic_from_ned(read[None])[0]
            writer.writerow([
                f"{at:%Y-%m-%dT%H:%M:%SZ}", f"{lat:.9f}", f"{lon:.9f}", f"{depth:.4f}",
                f"{roll:.3f}", f"{pitch:.3f}", f"{yaw % 360:.3f}", SIGMA_HORIZONTAL_M,
                SIGMA_DEPTH_M, SIGMA_ATTITUDE_DEG, SIGMA_HEADING_DEG,
            ])  # fmt: skip


def _attitude(turn: Rotation) -> Array:
    """Roll, pitch, heading, radians."""
    angles: Array = turn.as_euler("ZYX")[::-1]
    return angles


def import_survey(folder: Path, workspace: Path) -> str:
    """Import as a user does; what the command said."""
    cameras = [
        part for name in ("left", "right") for part in ("--camera", f"{name}={folder / name}")
    ]
    files = ["--rig", str(folder / "rig.json"), "--navigation", str(folder / "navigation.csv")]
    return command("import-images", *cameras, *files, "-w", str(workspace))


def command(*arguments: str) -> str:
    """What `alice-survey` with these arguments prints, warnings too.

    Raises:
        RuntimeError: it ended with an error, which is the last line.
    """
    line = [sys.executable, "-m", "alice_survey", *arguments]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{arguments[0]}: {done.stdout}{done.stderr}")
    return done.stdout + done.stderr
