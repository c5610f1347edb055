"""Synthetic tracks over a rough plane, and a workspace of them whose mapping is done."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array, Datum, attitude_from_rotation
from alice_survey.core.manifest import ImageRecord, write_manifest
from alice_survey.core.records import (
    CamerasRecord,
    MappingRecord,
    PicturesRecord,
    PlaceRecord,
    RangeRecord,
)
from benchmarks.bend_survey import NOISE_PX
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.rig import Rig, write_rig
from reconstruct.adjustment.exact_observations import Pixels, RigState
from reconstruct.mapping.arrays import Indices
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.refraction import Keypoints
from reconstruct.matching.matches import as_seen
from reconstruct.views.model_files import colmap_pinhole, rigid3d

ALTITUDE_M, _STEP_M, _LINES_M, _DEPTH_M, _SPEED_MPS = 2.0, 0.4, 0.8, 10.0, 0.2
_MATCHED = 0.5
"""Share of the pictures that show a point in which it is matched."""
_PLACE_M, _TURN_RAD = 0.002, 0.0005
"""How far off the start is."""
DATUM = Datum(32.8236, 34.9553)


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """A survey of synthetic tracks."""

    truth: RigState
    pixels: Pixels


def block(rig: Rig, stations: int, points: int) -> Block:
    """Fly a rig, whose reference camera comes first, over a rough plane.

    Args:
        rig: cameras.
        stations: how many.
        points: on the sea floor, of each station.
    """
    rng = np.random.default_rng(stations)
    names = list(rig.cameras)
    reference = rig.cam_from_rig[names[0]]
    rig = replace(
        rig, cam_from_rig={n: pose * reference.inv() for n, pose in rig.cam_from_rig.items()}
    )
    long = int(np.sqrt(2.0 * stations))
    line, along = np.divmod(np.arange(stations), long)
    odd = line % 2 == 1
    north = _STEP_M * np.where(odd, long - 1 - along, along)
    centres = np.column_stack([north, _LINES_M * line, np.full(stations, _DEPTH_M)])
    leaning = Rotation.from_euler("ZYX", rng.normal(0, 0.03, (stations, 3)))
    ahead = Rotation.from_rotvec(np.pi * odd[:, None] * [0.0, 0.0, 1.0])
    turns = (ahead * leaning * rig.body_from_cam(names[0]).rotation).as_matrix()
    low, high = centres.min(axis=0)[:2] - 1.0, centres.max(axis=0)[:2] + 1.0
    ground = rng.uniform(low, high, (points * stations, 2))
    down = _DEPTH_M + ALTITUDE_M + 0.1 * np.sin(3.0 * ground).sum(axis=1)
    floor = np.column_stack([ground, down])
    near = cKDTree(ground).query_ball_point(centres[:, :2], 0.8 * ALTITUDE_M)
    station = np.repeat(np.arange(stations), [len(row) for row in near])
    point = np.concatenate([np.array(row, dtype=np.int64) for row in near])
    arm = np.einsum("nij,ni->nj", turns[station], floor[point] - centres[station])
    rows = []
    for c, name in enumerate(names):
        camera = rig.cameras[name]
        at = camera.project(rig.cam_from_rig[name].apply(arm))
        inside = np.all((at > 1) & (at < [camera.width_px - 1, camera.height_px - 1]), axis=1)
        seen = np.flatnonzero(inside & (rng.uniform(size=len(at)) < _MATCHED))
        rows.append((point[seen], station[seen], np.full(len(seen), c), at[seen]))
    point, station, camera_of, taken = (
        np.concatenate(column) for column in zip(*rows, strict=True)
    )
    enough = np.bincount(point, minlength=len(floor)) > 2
    order = np.flatnonzero(enough[point])
    order = order[np.argsort(point[order], kind="stable")]
    kept, inverse, counts = np.unique(point[order], return_inverse=True, return_counts=True)
    return Block(
        truth=RigState(rig=rig, turns=turns, centres=centres, points=floor[kept]),
        pixels=Pixels(
            starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            station=station[order],
            camera=camera_of[order],
            taken=taken[order] + rng.normal(0, NOISE_PX, (len(order), 2)),
            point=inverse.astype(np.int64),
        ),
    )


def near_start(truth: RigState) -> RigState:
    """A state a little off the truth."""
    rng, count = np.random.default_rng(1), len(truth.centres)
    off = Rotation.from_rotvec(rng.normal(0, _TURN_RAD, (count, 3))).as_matrix()
    return replace(
        truth,
        turns=off @ truth.turns,
        centres=truth.centres + rng.normal(0, _PLACE_M, (count, 3)),
        points=truth.points + rng.normal(0, _PLACE_M, truth.points.shape),
    )


def records_of(rig: Rig, truth: RigState) -> list[ImageRecord]:
    """A log with a constant and a white error of depth and white errors of the rest."""
    name, rng = next(iter(rig.cameras)), np.random.default_rng(2)
    poses = RigidTransform.from_components(truth.centres, Rotation.from_matrix(truth.turns))
    bodies = poses * rig.body_from_cam(name).inv()
    ned = bodies.translation + rng.normal(0, [0.03, 0.03, 0.002], (len(poses), 3)) + [0, 0, 0.05]
    places = DATUM.geodetic_from_ned(ned)
    angles = np.rad2deg(attitude_from_rotation(bodies.rotation))
    angles = angles + rng.normal(0, 0.02, angles.shape)
    return [
        ImageRecord(
            image=f"{name}/{i:06d}.png", camera=name, station=i,
            time_s=i * _STEP_M / _SPEED_MPS, latitude_deg=float(place[0]),
            longitude_deg=float(place[1]), depth_m=float(place[2]), roll_deg=float(angle[0]),
            pitch_deg=float(angle[1]), heading_deg=float(angle[2] % 360.0),
            altitude_m=ALTITUDE_M, sigma_horizontal_m=0.03, sigma_depth_m=0.05,
            sigma_attitude_deg=0.02, sigma_heading_deg=0.02,
        )
        for i, (place, angle) in enumerate(zip(places, angles, strict=True))
    ]  # fmt: skip


NEAR_M, FAR_M = 0.9 * ALTITUDE_M, 1.1 * ALTITUDE_M


def pinhole_warps(rig: Rig) -> dict[str, PinholeWarp]:
    """The pinholes that replace a rig's cameras."""
    return {name: best_warp(camera, NEAR_M, FAR_M) for name, camera in rig.cameras.items()}


def write_mapped(
    workspace: Path, rig: Rig, survey: Block, records: list[ImageRecord], unmatched: int = 0
) -> None:
    """Write `images/`, `calibration/` and `mapping/` of a survey, its model a little off the truth.

    Args:
        workspace: to make.
        rig: as calibrated.
        survey: synthetic tracks.
        records: of all pictures, station by station, those of one by the cameras of the rig.
        unmatched: keypoints of every picture that have no point.
    """
    warps, images, mapping = pinhole_warps(rig), workspace / "images", workspace / "mapping"
    mapped = _model(rig, survey, records, warps, unmatched)
    (mapping / "model").mkdir(parents=True)
    (workspace / "calibration").mkdir()
    mapped.model.write_binary(mapping / "model")
    write_rig(workspace / "calibration" / "rig.json", rig)
    for number, (name, camera) in enumerate(rig.cameras.items()):
        first = images / records[number].image  # of a camera, its first alone is looked at
        (images / name).mkdir(parents=True)
        cv2.imwrite(str(first), np.zeros((camera.height_px, camera.width_px), np.uint8))
    write_manifest(images / "manifest.csv", records)
    place = PlaceRecord(latitude_deg=DATUM.latitude_deg, longitude_deg=DATUM.longitude_deg)
    PicturesRecord(source="simulated", datum=place).write(images / "survey.json")
    known = {r.image: {"camera": r.camera, "station": r.station, "mask": r.mask} for r in records}
    CamerasRecord.save(
        mapping / "cameras.json",
        {"cameras": {name: warp.to_json() for name, warp in warps.items()}, "images": known},
    )
    MappingRecord(
        registered=len(records), total=len(records), models=mapped.models, scaled=True,
        baseline=mapped.baseline, rig_factor=1.0,
        distances=RangeRecord(near_m=NEAR_M, far_m=FAR_M, source="synthetic"),
    ).write(mapping / "mapping.json")  # fmt: skip


def _model(
    rig: Rig,
    survey: Block,
    records: list[ImageRecord],
    warps: dict[str, PinholeWarp],
    unmatched: int,
) -> Mapped:
    """The model, its keypoints where its pinholes see them."""
    rng = np.random.default_rng(0)
    names, pixels, start = list(rig.cameras), survey.pixels, near_start(survey.truth)
    in_rig = {name: warps[name].pinhole_from_cam * rig.cam_from_rig[name] for name in names}
    from_reference = in_rig[names[0]].inv()
    model, colmap_rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    sensors = []
    for number, name in enumerate(names, 1):
        camera = colmap_pinhole(warps[name].pinhole)
        camera.camera_id = number
        model.add_camera(camera)
        sensors.append(camera.sensor_id)
        if number == 1:
            colmap_rig.add_ref_sensor(camera.sensor_id)
        else:
            colmap_rig.add_sensor(camera.sensor_id, rigid3d(in_rig[name] * from_reference))
    model.add_rig(colmap_rig)
    keypoints: list[Array] = []
    of_picture, row = _by_picture(pixels, len(names), len(records))
    poses = RigidTransform.from_components(start.centres, Rotation.from_matrix(start.turns))
    for station, pose in enumerate(poses):
        frame = pycolmap.Frame(frame_id=station + 1, rig_id=1)
        numbers = [len(names) * station + c + 1 for c in range(len(names))]
        for sensor, number in zip(sensors, numbers, strict=True):
            frame.add_data_id(pycolmap.data_t(sensor, number))
        frame.rig_from_world = rigid3d(warps[names[0]].pinhole_from_cam * pose.inv())
        model.add_frame(frame)
        for c, number in enumerate(numbers):
            taken = pixels.taken[of_picture[number - 1]]
            aside = rng.uniform([1, 1], warps[names[c]].size_px, (unmatched, 2)) - 1
            keypoints.append(np.concatenate([taken, aside]))
            seen = as_seen(keypoints[-1], warps[names[c]])
            rows = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in seen])
            model.add_image(
                pycolmap.Image(
                    name=records[number - 1].image, image_id=number, camera_id=c + 1,
                    frame_id=station + 1, points2D=rows,
                )
            )  # fmt: skip
        model.register_frame(station + 1)
    picture = (len(names) * pixels.station + pixels.camera + 1).tolist()
    rows, starts = row.tolist(), pixels.starts.tolist()
    for point, xyz in enumerate(start.points):
        own = range(starts[point], starts[point + 1])
        track = [pycolmap.TrackElement(picture[o], rows[o]) for o in own]
        model.add_point3D(xyz, pycolmap.Track(track))
    mapped = Mapped(
        model=model, warps=warps, models=(len(records),), scaled=True,
        baseline=model_baseline(model), rig_factor=1.0,
    )  # fmt: skip
    cameras = {name: colmap_pinhole(warp.pinhole) for name, warp in warps.items()}
    observed = Observations(images=records, cameras=cameras, taken=keypoints, pairs=(), warps=warps)
    Keypoints(mapped, observed).correct(model, 1.0)
    model.update_point_3d_errors()
    return mapped


def _by_picture(pixels: Pixels, cameras: int, pictures: int) -> tuple[list[Indices], Indices]:
    """The observations of every picture, and the row (O,) of each in its own."""
    picture = cameras * pixels.station + pixels.camera
    order = np.argsort(picture, kind="stable")
    ends = np.cumsum(np.bincount(picture, minlength=pictures))
    of_picture = np.split(order, ends[:-1])
    row = np.empty(len(order), np.int64)
    for mine in of_picture:
        row[mine] = np.arange(len(mine))
    return of_picture, row
