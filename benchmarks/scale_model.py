"""A workspace whose mapping is done, of synthetic tracks: what the placing stage starts from."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord, write_manifest
from alice_survey.core.records import (
    CamerasRecord,
    MappingRecord,
    PicturesRecord,
    PlaceRecord,
    RangeRecord,
)
from benchmarks.block_size import ALTITUDE_M, DATUM, Block, near_start
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.rig import Rig, write_rig
from reconstruct.adjustment.exact_observations import Pixels
from reconstruct.mapping.arrays import Indices
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.refraction import Keypoints
from reconstruct.matching.matches import as_seen
from reconstruct.views.model_files import colmap_pinhole, rigid3d

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
