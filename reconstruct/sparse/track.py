"""The camera track of a model: where every registered picture was taken from."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.artefacts import atomic_path, write_csv
from alice_survey.errors import WorkspaceError
from alice_survey.frames import Array
from alice_survey.manifest import ImageRecord
from reconstruct.lenses.lens import Lens
from reconstruct.mapping.mapper import as_transform
from reconstruct.model import WorldFrame

_NED = ("north_m", "east_m", "depth_m")
_MODEL = ("x", "y", "z")
_MODEL_SCALED = ("x_m", "y_m", "z_m")
_QUATERNION = ("qx", "qy", "qz", "qw")


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackRow:
    """One registered picture."""

    image: str
    station: int
    camera: str
    time_s: float
    """NaN when unknown."""
    world_from_cam: RigidTransform
    """Of the entrance pupil."""
    points: int
    """Observations of points of the model."""
    reprojection_px: float
    """Mean over those."""


def track_rows(
    model: Any,
    records: Mapping[str, ImageRecord],
    lenses: Mapping[str, Lens],
    frame: WorldFrame,
) -> list[TrackRow]:
    """Rows of all registered pictures of a COLMAP model of ideal pinholes, by station and name.

    The pinhole's centre lies before or behind the entrance pupil, which is where the camera is; in
    a model without scale the few millimetres between them are not known and left out.
    """
    points = {i: p.xyz for i, p in model.points3D.items()}
    pupils = {
        name: lens.pinhole_from_cam if frame.scaled else RigidTransform.identity()
        for name, lens in lenses.items()
    }
    rows = []
    for image in model.images.values():
        if not image.has_pose:
            continue
        record = records[image.name]
        cam_from_world = as_transform(image.cam_from_world())
        seen = [p for p in image.points2D if p.has_point3D()]
        misses = np.array([np.nan])
        if seen:
            world = np.array([points[p.point3D_id] for p in seen])
            found = np.array(image.camera.img_from_cam(cam_from_world.apply(world)))
            misses = np.linalg.norm(found - np.array([p.xy for p in seen]), axis=1)
        rows.append(
            TrackRow(
                image=image.name,
                station=record.station,
                camera=record.camera,
                time_s=record.time_s,
                world_from_cam=cam_from_world.inv() * pupils[record.camera],
                points=len(seen),
                reprojection_px=float(misses.mean()),
            )
        )
    return sorted(rows, key=lambda row: (row.station, row.image))


def write_track_csv(path: Path, rows: Sequence[TrackRow], frame: WorldFrame) -> None:
    """Write the track; columns of position are named after the frame."""
    axes = _NED if frame.name == "ned" else _MODEL_SCALED if frame.scaled else _MODEL
    header = [
        "image", "station", "camera", "time_s", *axes, *_QUATERNION,
        "latitude_deg", "longitude_deg", "points", "reprojection_px",
    ]  # fmt: skip
    positions = np.array([row.world_from_cam.translation for row in rows]).reshape(-1, 3)
    places: Array = np.full((len(rows), 3), np.nan)
    if frame.datum is not None:
        places = frame.datum.geodetic_from_ned(positions)
    lines = []
    for row, position, place in zip(rows, positions, places, strict=True):
        quaternion = row.world_from_cam.rotation.as_quat(canonical=True)
        where = ["", ""] if np.isnan(place[0]) else [f"{v:.10f}" for v in place[:2]]
        lines.append(
            [
                row.image,
                row.station,
                row.camera,
                row.time_s,
                *(f"{v:.9f}" for v in position),
                *(f"{q:.12f}" for q in quaternion),
                *where,
                row.points,
                "" if np.isnan(row.reprojection_px) else f"{row.reprojection_px:.6f}",
            ]
        )
    write_csv(path, header, lines)


def write_track_tum(path: Path, rows: Sequence[TrackRow]) -> None:
    """Write the track in TUM's format; without times the station number stands for the time.

    Of every station one row is kept: that of its first camera.
    """
    lines, stations = [], set()
    timed = all(row.time_s == row.time_s for row in rows)
    for row in rows:
        if row.station in stations:
            continue
        stations.add(row.station)
        pose = row.world_from_cam
        values = [*pose.translation, *pose.rotation.as_quat(canonical=True)]
        time = f"{row.time_s if timed else row.station:.6f}"
        lines.append(" ".join([time, *(f"{v:.9f}" for v in values)]))
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_track_poses(path: Path) -> dict[str, RigidTransform]:
    """Read `world_from_cam` (entrance pupils) by picture from `track.csv`.

    Raises:
        WorkspaceError: the file is missing or no track.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read: {error.strerror}") from None
    poses = {}
    for line, row in enumerate(rows, 2):
        axes = next((a for a in (_NED, _MODEL_SCALED, _MODEL) if a[0] in row), _NED)
        try:
            position = np.array([float(row[name]) for name in axes])
            rotation = Rotation.from_quat([float(row[name]) for name in _QUATERNION])
            poses[row["image"]] = RigidTransform.from_components(position, rotation)
        except (KeyError, TypeError, ValueError) as error:
            raise WorkspaceError(f"{path} line {line}: no pose: {error}") from None
    return poses
