"""A stereo survey along a simulated flight, whose truth is known: tracks of points, no pictures.

The vehicle simulator flies an example and its sensors log what they log. Points on that example's
sea floor are seen by the cameras of a true rig, which differs from the calibrated one by an error
drawn from the calibration's covariance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform
from scipy.stats.qmc import Halton

from alice_survey.app.api.survey import Survey
from alice_survey.app.pipeline import run
from alice_survey.core.config import SurveyConfig
from alice_survey.core.executor import local_executor
from alice_survey.core.frames import Array, Datum, attitude_from_rotation, interpolate_poses
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import RangeRecord
from alice_survey.core.trajectory import Trajectory, read_columns, read_track
from alice_survey.sim.seafloor.terrain import Terrain, survey_terrain
from camera_calib.freedom import move_rig
from camera_calib.rig import Covariance, Rig, read_rig
from missions.logs.navigation_csv import NavigationLog, read_navigation
from missions.values.plan_file import read_plan
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped
from tests.reconstruct.scenes import Scene
from tests.reconstruct.true_models import near_truth, warped_scene

NOISE_PX = 0.02
"""Of one coordinate: 13,000 observations with it are worth 330,000 with 0.1 px."""
OBSERVATIONS = 13_000
_FAR_PORT = """[camera]
port_distance_m = 0.1
glass_thickness_m = 0.02
port_tilt_deg = [2, 0]
"""
MATCHED = 0.5
"""Share of the pictures that show a point in which it is matched: the demo's tracks have 4.9 views
where 8.2 pictures show a point."""
_BETWEEN_DIVES_S = 1800.0
_MARGIN_M = 1.5
"""Around the track, where points lie."""
_FAR = 1.6
"""Altitudes from a camera beyond which nothing is in its picture."""
_RIG, _POINTS, _NOISE, _LOG = range(4)
"""Streams of random numbers of one seed."""
DEPTH_CONSTANT_M, DEPTH_SLOW_M, DEPTH_SLOW_S, DEPTH_WHITE_M = 0.05, 0.006, 600.0, 0.0016
FIX_M, STRETCH, WALK_M, LEVEL_WHITE_M = 0.03, 0.003, 0.001, 0.002
"""Of a drawn log: the fix it starts from, stretch, metres in a second's root, and white noise."""
TILT_DEG, HEADING_DEG, ATTITUDE_WHITE_DEG = 0.01, 0.3, 0.014


@dataclass(frozen=True, kw_only=True, eq=False)
class FlownTrack:
    """A flight: where pictures were taken, and what the log has."""

    config: SurveyConfig
    datum: Datum
    corners_ne: Array
    """(N, 2) of the area that the vehicle may be in."""
    taken_s: Array
    """(S,) times of the stations."""
    truth: Trajectory
    log: NavigationLog | None
    """None of a flight that no sensor logged."""

    def at(self, time_s: Array) -> RigidTransform:
        """(N,) true poses of the body."""
        return interpolate_poses(self.truth.time_s, self.truth.ned_from_body, time_s)

    @property
    def ned_from_body(self) -> RigidTransform:
        """(S,) true poses of the stations."""
        return self.at(self.taken_s)

    @property
    def floor(self) -> Terrain:
        """The sea floor below."""
        return _floor(self.config, self.corners_ne.tobytes())


@lru_cache(maxsize=1)
def _floor(config: SurveyConfig, corners: bytes) -> Terrain:
    return survey_terrain(
        config.seafloor,
        np.frombuffer(corners).reshape(-1, 2),
        margin_m=config.plan.altitude_m,
        depth_m=config.area.seafloor_depth_m,
        seed=config.seed,
    )


def fly(folder: Path, example: str, seed: int) -> FlownTrack:
    """Plan and fly an example with another seed, unless the folder holds that flight."""
    workspace = _workspace(folder, str(seed), example, seed, "")
    run(["plan", "fly"], workspace, None, executor=local_executor(1))
    plan, flight = read_plan(workspace / "plan" / "plan.json"), workspace / "flight"
    return FlownTrack(
        config=Survey(workspace).config,
        datum=plan.datum,
        corners_ne=np.array(plan.area.allowed_corners_ne, dtype=np.float64).reshape(-1, 2),
        taken_s=read_columns(flight / "triggers.csv", ("time_s",))["time_s"],
        truth=read_track(flight / "truth" / "track.csv"),
        log=read_navigation(flight / "navigation.csv", UTC),
    )


def calibrated_rig(
    folder: Path, example: str, pool_scale: int, scale: int, *, far_port: bool = False
) -> Rig:
    """The rig of an example, calibrated from pictures of a board in a pool.

    Args:
        folder: keeps the pictures and the calibration.
        example: whose cameras and board.
        pool_scale: how many pixels of the sensor make one of the pool's pictures.
        scale: the same for the rig returned.
        far_port: the ports are 100 mm away and tilted by 2 degrees.
    """
    port, settings = ("-far-port", _FAR_PORT) if far_port else ("", "")
    workspace = _workspace(folder, f"pool-{pool_scale}{port}", example, None, settings)
    run(
        ["pool", "calibrate"],
        workspace,
        None,
        local_executor(1),
        {"imaging": {"scale": pool_scale}},
    )
    rig = read_rig(workspace / "calibration" / "rig.json")
    assert rig.covariance is not None
    by = scale // pool_scale
    names = rig.covariance.parameters
    unit = np.array([1.0 / by if name.endswith("_px") else 1.0 for name in names])
    matrix = rig.covariance.matrix * np.outer(unit, unit)
    return replace(
        rig,
        cameras={name: camera.downscale(by) for name, camera in rig.cameras.items()},
        covariance=Covariance(parameters=names, matrix=matrix),
    )


def example_config(folder: Path, example: str) -> SurveyConfig:
    """Settings of an example, kept in a folder."""
    return Survey(_workspace(folder, "settings", example, None, "")).config


def _workspace(folder: Path, name: str, example: str, seed: int | None, extra: str) -> Path:
    """A workspace with an example's settings, another seed and more settings."""
    workspace = folder / f"{example}-{name}"
    settings = workspace / "survey.toml"
    if not settings.is_file():
        survey = Survey.new(workspace, example=example)
        text, own = settings.read_text(), f"seed = {survey.config.seed}\n"
        if seed is not None:
            text = text.replace(own, f"seed = {seed}\n", 1)
        settings.write_text(f"{text}\n{extra}")
    return workspace


def wrong_rig(rig: Rig, times: float, seed: int, *, bias_px: float = 0.0) -> Rig:
    """A rig off another by a draw from its covariance.

    Args:
        rig: as calibrated.
        times: as large.
        seed: of the draw.
        bias_px: radial shift, root mean square over a picture, of keypoints in all pictures of a
            camera, as of another lens.
    """
    assert rig.covariance is not None
    rng = np.random.default_rng([seed, _RIG])
    names, scale = rig.covariance.parameters, np.sqrt(np.diag(rig.covariance.matrix))
    factor = np.linalg.cholesky(rig.covariance.correlation)
    step = times * scale * (factor @ rng.normal(size=len(scale)))
    for name, camera in rig.cameras.items():
        radius_px = np.hypot(camera.width_px, camera.height_px) / np.sqrt(12.0)
        own = [names.index(f"{name}.{field}") for field in ("fx_px", "fy_px")]
        step[own] += bias_px * rng.normal() / radius_px * camera.parameter("fx_px")
    return move_rig(rig, names, step)


@dataclass(frozen=True, kw_only=True)
class Fault:
    """What is wrong with a log that it does not state."""

    clock_s: float = 0.0
    """The log's clock minus that of the cameras."""
    heading_deg: float = 0.0
    """Added to the headings; positions stay."""
    depth_m: float = 0.0
    """By which depth has drifted at the end."""
    stretch: float = 0.0
    """Of horizontal positions about the first one."""
    sigmas: float = 1.0
    """Factor on what the log states."""
    jump_m: float = 0.0
    """By which positions jump between two dives that the survey is flown in, if not zero."""
    white: float = 1.0
    """Factor on the white errors of a drawn log."""
    tau: float = 1.0
    """Factor on the correlation time of a drawn log's depths."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Readings:
    """What a log has at the stations."""

    time_s: Array
    """(S,) times that the pictures state."""
    ned: Array
    """(S, 3) positions of the body, metres."""
    angles_deg: Array
    """(S, 3) roll, pitch, heading."""
    sigmas: Array
    """(S, 4) of horizontal position and depth, metres, and of tilt and heading, degrees."""

    def with_fault(self, fault: Fault) -> "Readings":
        """The same with all of a fault but the clock's and the statistics'."""
        share = np.linspace(0.0, 1.0, len(self.ned))
        ned, angles = self.ned.copy(), self.angles_deg.copy()
        ned[:, :2] += fault.stretch * (ned[:, :2] - ned[0, :2])
        ned[:, 2] += fault.depth_m * share
        angles[:, 2] += fault.heading_deg
        second = (share > 0.5) & (fault.jump_m != 0.0)
        ned[second, 0] += fault.jump_m
        time_s = self.time_s + _BETWEEN_DIVES_S * second
        return Readings(
            time_s=time_s, ned=ned, angles_deg=angles, sigmas=fault.sigmas * self.sigmas
        )


def logged(track: FlownTrack, fault: Fault, _: int) -> Readings:
    """The log of the simulated flight."""
    assert track.log is not None
    columns = track.log.at(track.taken_s + fault.clock_s)

    def rows(*names: str) -> Array:
        return np.column_stack([columns[name] for name in names])

    return Readings(
        time_s=track.taken_s,
        ned=track.datum.ned_from_geodetic(rows("latitude_deg", "longitude_deg", "depth_m")),
        angles_deg=rows("roll_deg", "pitch_deg", "heading_deg"),
        sigmas=rows("sigma_horizontal_m", "sigma_depth_m", "sigma_attitude_deg",
                    "sigma_heading_deg"),
    )  # fmt: skip


def drawn(track: FlownTrack, fault: Fault, seed: int) -> Readings:
    """A log with errors of the same instruments as the simulated one, drawn for each seed.

    Depth has a constant, a slow and a white error, as a pressure sensor's; north and east are
    reckoned from a fix by a Doppler log with a wrong scale, a wrong heading and noise that adds up;
    attitude has a constant and a white error.
    """
    rng = np.random.default_rng([seed, _LOG])
    time_s = track.taken_s + fault.clock_s
    bodies, count = track.at(time_s), len(time_s)
    place = bodies.translation
    depth_off = rng.normal(0, DEPTH_CONSTANT_M) + fault.white * rng.normal(0, DEPTH_WHITE_M, count)
    depth_off += DEPTH_SLOW_M * _gauss_markov(rng, time_s, fault.tau * DEPTH_SLOW_S)
    away = place[:, :2] - place[0, :2]
    turn_rad = np.deg2rad(rng.normal(0, HEADING_DEG))
    walk = rng.normal(size=(count, 2)) * np.sqrt(np.diff(time_s, prepend=time_s[0]))[:, None]
    level_off = (
        rng.normal(0, FIX_M, 2)
        + rng.normal(0, STRETCH) * away
        + turn_rad * np.column_stack([-away[:, 1], away[:, 0]])
        + WALK_M * np.cumsum(walk, axis=0)
        + fault.white * rng.normal(0, LEVEL_WHITE_M, (count, 2))
    )
    constant = np.array([*rng.normal(0, TILT_DEG, 2), np.rad2deg(turn_rad)])
    return Readings(
        time_s=track.taken_s,
        ned=place + np.column_stack([level_off, depth_off]),
        angles_deg=np.rad2deg(attitude_from_rotation(bodies.rotation))
        + constant
        + fault.white * rng.normal(0, ATTITUDE_WHITE_DEG, (count, 3)),
        sigmas=np.tile(
            [np.hypot(FIX_M, STRETCH * np.ptp(away)), DEPTH_CONSTANT_M,
             np.hypot(TILT_DEG, ATTITUDE_WHITE_DEG), HEADING_DEG],
            (count, 1),
        ),
    )  # fmt: skip


Logbook = Callable[[FlownTrack, Fault, int], Readings]
"""From a flight, what is wrong and a seed; of a fault the clock's and the statistics'."""
LOGS: dict[str, Logbook] = {"flown": logged, "drawn": drawn}


def _gauss_markov(rng: np.random.Generator, time_s: Array, tau_s: float) -> Array:
    """(N,) of unit variance."""
    values = rng.normal(size=len(time_s))
    kept = np.exp(-np.diff(time_s) / tau_s)
    for i, keep in enumerate(kept, 1):
        values[i] = keep * values[i - 1] + np.sqrt(1.0 - keep**2) * values[i]
    return values


@dataclass(frozen=True, kw_only=True, eq=False)
class Started:
    """A survey whose model lies near the truth, as its last adjustment finds it."""

    scene: Scene
    """On the calibrated rig; pixels are those of the true one."""
    seen: Observations
    mapped: Mapped
    distances: RangeRecord
    datum: Datum


def start(track: FlownTrack, rig: Rig, true: Rig, read: Readings, seed: int) -> Started:
    """Fly a true rig along a track; start the model on the rig that is believed.

    Args:
        track: the flight.
        rig: as calibrated.
        true: that takes the pictures.
        read: navigation.
        seed: of points, noise and start.
    """
    poses = track.ned_from_body
    bodies = list(poses)
    points = _points(track, seed)
    rng = np.random.default_rng([seed, _NOISE])
    tree, far_m = cKDTree(points), _FAR * track.config.plan.altitude_m
    where: list[RigidTransform] = []
    seen: list[tuple[NDArray[np.int64], Array]] = []
    depths = []
    for body in bodies:
        for name, camera in true.cameras.items():
            pose = body * true.body_from_cam(name)
            near = np.sort(np.array(tree.query_ball_point(pose.translation, far_m), dtype=int))
            local = pose.inv().apply(points[near])
            at = camera.project(local)
            inside = np.all((at > 1) & (at < [camera.width_px - 1, camera.height_px - 1]), axis=1)
            inside &= rng.uniform(size=len(near)) < MATCHED
            where.append(pose)
            seen.append((near[inside], at[inside]))
            depths.append(local[inside, 2])
    views = np.bincount(np.concatenate([ids for ids, _ in seen]), minlength=len(points))
    enough = int(np.searchsorted(np.cumsum(np.where(views > 1, views, 0)), OBSERVATIONS)) + 1
    ids = [of[of < enough] for of, _ in seen]
    pixels = [
        at[of < enough] + rng.normal(0, NOISE_PX, (int((of < enough).sum()), 2)) for of, at in seen
    ]
    scene = Scene(
        rig=rig,
        records=records_of(track, list(rig.cameras), read),
        ned_from_cam=where,
        points_ned=points[:enough],
        pixels=pixels,
        ids=ids,
        pairs=[],
    )
    near_m, far_m = np.percentile(np.concatenate(depths), [1, 99]).tolist()
    observations, warps = warped_scene(scene, near_m, far_m)
    return Started(
        scene=scene,
        seen=observations,
        mapped=near_truth(scene, observations, warps, rng),
        distances=RangeRecord(near_m=near_m, far_m=far_m, source="truth"),
        datum=track.datum,
    )


def _points(track: FlownTrack, seed: int) -> Array:
    """Points on the sea floor below a track; the first ones, however many, are spread evenly."""
    place = track.ned_from_body.translation[:, :2]
    low, high = place.min(axis=0) - _MARGIN_M, place.max(axis=0) + _MARGIN_M
    spread = Halton(2, rng=np.random.default_rng([seed, _POINTS])).random(OBSERVATIONS)
    level = low + spread * (high - low)
    near, _ = cKDTree(place).query(level)
    level = level[near < 2 * _MARGIN_M]
    return np.column_stack([level, track.floor.depth_at(level)])


def records_of(track: FlownTrack, cameras: Sequence[str], read: Readings) -> list[ImageRecord]:
    """Pictures of all stations with what the log says of them."""
    places = track.datum.geodetic_from_ned(read.ned)
    return [
        ImageRecord(
            image=f"{camera}/{station:06d}.png", camera=camera, station=station,
            time_s=float(time_s), latitude_deg=float(place[0]), longitude_deg=float(place[1]),
            depth_m=float(place[2]), roll_deg=float(angles[0]), pitch_deg=float(angles[1]),
            heading_deg=float(angles[2] % 360.0), altitude_m=track.config.plan.altitude_m,
            sigma_horizontal_m=float(sigma[0]), sigma_depth_m=float(sigma[1]),
            sigma_attitude_deg=float(sigma[2]), sigma_heading_deg=float(sigma[3]),
        )
        for station, (time_s, place, angles, sigma) in enumerate(
            zip(read.time_s, places, read.angles_deg, read.sigmas, strict=True)
        )
        for camera in cameras
    ]  # fmt: skip
