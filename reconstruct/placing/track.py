"""The camera track of a model: where every registered picture was taken from, and how surely.

A covariance of a pose here is (6, 6) of its position (north, east, down of the world frame, in the
frame's unit) and of its rotation about the same three axes, radians: the true pose is
`exp(rotation) * attitude` at `position + shift`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import read_csv, write_csv, write_json
from alice_survey.core.contents import one_line
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array, attitude_from_rotation
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.rig import Rig
from reconstruct.adjustment.uncertainty import Uncertainty
from reconstruct.mapping.arrays import cross_matrices, observations
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.fit import PlacementFit
from reconstruct.placing.navigation import PLACE, attitude_axes, slopes_by_place
from reconstruct.views.model import WorldFrame
from reconstruct.views.model_files import as_transform

_NED = ("north_m", "east_m", "depth_m")
_MODEL = ("x", "y", "z")
_MODEL_SCALED = ("x_m", "y_m", "z_m")
_QUATERNION = ("qx", "qy", "qz", "qw")
SIGMAS = (
    "sigma_north_m", "sigma_east_m", "sigma_depth_m",
    "sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg",
)  # fmt: skip

POSE_ORDER = (
    "north_m", "east_m", "down_m", "rotation_north_rad", "rotation_east_rad", "rotation_down_rad",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackRow:
    """One registered picture."""

    image: str
    station: int
    camera: str
    time_s: float
    """Time; NaN when unknown."""
    world_from_cam: RigidTransform
    """Pose of the entrance pupil."""
    points: int
    """Observations of points of the model."""
    reprojection_px: float
    """Mean over those."""
    world_from_body: Rotation
    """Attitude of the vehicle; of what carries a nadir camera where no rig is known."""


def track_rows(
    model: Any,
    records: Mapping[str, ImageRecord],
    warps: Mapping[str, PinholeWarp],
    frame: WorldFrame,
    rig: Rig | None = None,
) -> list[TrackRow]:
    """Rows of all registered pictures of a COLMAP model of ideal pinholes, by station and name.

    The pinhole's centre lies before or behind the entrance pupil, which is where the camera is; in
    a model without scale the few millimetres between them are not known and left out.

    Args:
        model: in world coordinates.
        records: by picture.
        warps: by camera.
        frame: the world.
        rig: on a vehicle; None where the mount is unknown.
    """
    seen = observations(model)
    missed = np.linalg.norm(seen.residuals(model), axis=1)
    pupils = {
        name: warp.pinhole_from_cam if frame.scaled else RigidTransform.identity()
        for name, warp in warps.items()
    }
    rows = []
    for n, number in enumerate(seen.pictures.tolist()):
        image, residuals = model.images[number], missed[seen.of(n)]
        record = records[image.name]
        cam_from_world = as_transform(image.cam_from_world())
        pose = cam_from_world.inv() * pupils[record.camera]
        mount = rig.body_from_cam(record.camera).rotation if rig else BODY_FROM_NADIR_CAM
        rows.append(
            TrackRow(
                image=image.name,
                station=record.station,
                camera=record.camera,
                time_s=record.time_s,
                world_from_cam=pose,
                points=len(residuals),
                reprojection_px=float(residuals.mean()) if len(residuals) else float("nan"),
                world_from_body=pose.rotation * mount.inv(),
            )
        )
    return sorted(rows, key=lambda row: (row.station, row.image))


def picture_modes(
    shape: Uncertainty, records: Sequence[ImageRecord], pinholes: Sequence[RigidTransform]
) -> Array:
    """(N, 6, K) of pictures by a model's soft modes: motions of the pinholes, turns about its axes.

    Args:
        shape: of the model.
        records: (N,) pictures.
        pinholes: `model_from_pinhole` of these.
    """
    arms = _arms_of(shape, records, pinholes)
    modes = np.zeros((len(records), 6, shape.modes.stations.shape[2]))
    for i, (row, arm) in enumerate(arms):
        if row is not None:
            turn, shift = shape.modes.stations[row, :3], shape.modes.stations[row, 3:]
            modes[i, :3], modes[i, 3:] = shift - cross_matrices(arm[None])[0] @ turn, turn
    return modes


def _arms_of(
    shape: Uncertainty, records: Sequence[ImageRecord | TrackRow], poses: Sequence[RigidTransform]
) -> list[tuple[int | None, Array]]:
    """For each picture the row of its station, None if unknown, and its place from there."""
    row_of = {int(station): row for row, station in enumerate(shape.stations)}
    references = set(shape.images)
    first = {
        record.station: pose.translation
        for record, pose in zip(records, poses, strict=True)
        if record.image in references
    }
    return [
        (row_of.get(r.station), pose.translation - first.get(r.station, pose.translation))
        for r, pose in zip(records, poses, strict=True)
    ]


@progress.step("covariance of the track")
def pose_covariances(
    rows: Sequence[TrackRow],
    fit: PlacementFit | None,
    shape: Uncertainty | None,
    world_from_model: Similarity,
) -> Array:
    """Covariance of poses in the world, (N, 6, 6); NaN where that of the shape is unknown.

    The place and the soft modes were estimated together; what else there is of the shape is
    independent of them.

    Args:
        rows: the pictures.
        fit: of the place and the modes; None without.
        shape: of the model before its modes were found; None where unknown.
        world_from_model: the model's place.
    """
    poses = RigidTransform.concatenate([row.world_from_cam for row in rows])
    total = np.zeros((len(rows), 6, 6))
    count = 0 if fit is None else len(fit.modes)
    jacobian = np.zeros((len(rows), 6, PLACE + count))
    if fit is not None:
        away = poses.translation - fit.middle_ned
        jacobian[:, :3, :PLACE] = slopes_by_place(away)
        jacobian[:, 3:, :3] = np.eye(3)
    if shape is not None:
        turn = world_from_model.rotation.as_matrix()
        # There: turn, then position; here: position, then turn.
        move = np.zeros((6, 6))
        move[:3, 3:] = world_from_model.scale * turn
        move[3:, :3] = turn
        for i, (row, arm) in enumerate(_arms_of(shape, rows, list(poses))):
            if row is None:
                total[i] = np.nan
                continue
            lever = np.eye(6)
            lever[:3, 3:] = -cross_matrices(arm[None])[0]
            lever = lever @ move
            total[i] = lever @ shape.frame_cov[row] @ lever.T
            if count:
                modes = lever @ shape.modes.stations[row]
                total[i] -= shape.modes.known * modes @ modes.T
                jacobian[i, :, PLACE:] = modes
    if fit is not None:
        total = total + jacobian @ fit.joint @ np.swapaxes(jacobian, 1, 2)
    return total


def attitude_sigmas_deg(ned_from_body: Rotation, covariances: Array) -> Array:
    """Sigmas of roll, pitch and heading, (N, 3) degrees, of poses with such covariances."""
    angles = np.linalg.inv(attitude_axes(ned_from_body))
    moved = angles @ covariances[:, 3:, 3:] @ np.swapaxes(angles, 1, 2)
    return np.asarray(np.rad2deg(np.sqrt(np.diagonal(moved, axis1=1, axis2=2))))


def track_sigmas(rows: Sequence[TrackRow], covariances: Array | None) -> Array:
    """(N, 6) sigmas in the order of `SIGMAS`; NaN where no covariance is known.

    Args:
        rows: the track.
        covariances: (N, 6, 6) of the poses; None where the world has no NED.
    """
    if covariances is None or not rows:
        return np.full((len(rows), 6), np.nan)
    attitudes = Rotation.concatenate([row.world_from_body for row in rows])
    places = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, :3])
    return np.asarray(np.hstack([places, attitude_sigmas_deg(attitudes, covariances)]))


def write_track_csv(path: Path, rows: Sequence[TrackRow], frame: WorldFrame, sigmas: Array) -> None:
    """Write the track; columns of position are named after the frame; `sigmas` as `SIGMAS`."""
    axes = _NED if frame.name == "ned" else _MODEL_SCALED if frame.scaled else _MODEL
    header = [
        "image", "station", "camera", "time_s", *axes, *_QUATERNION,
        "latitude_deg", "longitude_deg", "points", "reprojection_px", *SIGMAS,
    ]  # fmt: skip
    positions = np.array([row.world_from_cam.translation for row in rows]).reshape(-1, 3)
    places: Array = np.full((len(rows), 3), np.nan)
    if frame.datum is not None:
        places = frame.datum.geodetic_from_ned(positions)
    lines = []
    for row, position, place, sigma in zip(rows, positions, places, sigmas, strict=True):
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
                *("" if np.isnan(value) else f"{value:.6g}" for value in sigma),
            ]
        )
    write_csv(path, header, lines)


def write_track_geojson(
    path: Path, rows: Sequence[TrackRow], frame: WorldFrame, sigmas: Array
) -> None:
    """Write a point for every picture and a line through the stations, in RFC 7946.

    Heights are those above the WGS 84 ellipsoid, as that format requires. Needs a datum.
    """
    if frame.datum is None:
        raise ValueError("a track without datum has no longitude and latitude")
    positions = np.array([row.world_from_cam.translation for row in rows]).reshape(-1, 3)
    places = frame.datum.geodetic_from_ned(positions)
    points: list[dict[str, Any]] = []
    line: dict[int, list[float]] = {}
    for row, (latitude, longitude, depth), sigma in zip(rows, places, sigmas, strict=True):
        at = [
            round(float(longitude), 10), round(float(latitude), 10),
            round(frame.datum.height_m - float(depth), 5),
        ]  # fmt: skip
        line.setdefault(row.station, at)
        roll, pitch, heading = np.rad2deg(attitude_from_rotation(row.world_from_body))
        names = ("time_s", "depth_m", "roll_deg", "pitch_deg", "heading_deg", *SIGMAS)
        values = (row.time_s, depth, roll, pitch, heading % 360.0, *sigma)
        numbers = {
            name: None if np.isnan(value) else round(float(value), 6)
            for name, value in zip(names, values, strict=True)
        }
        what = {"image": row.image, "station": row.station, "camera": row.camera, **numbers}
        points.append(_feature("Point", at, what))
    features = points
    if len(line) > 1:
        what = {"stations": len(line), "vertical_datum": frame.vertical_datum}
        features = [_feature("LineString", list(line.values()), what), *points]
    write_json(path, {"type": "FeatureCollection", "features": features})


def _feature(kind: str, coordinates: Sequence[Any], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def read_track_poses(path: Path) -> dict[str, RigidTransform]:
    """Read `world_from_cam` (entrance pupils) by picture from `track.csv`.

    Raises:
        WorkspaceError: the file is missing or no track.
    """
    poses = {}
    for line, row in read_csv(path, exact=True, fault=WorkspaceError)[1]:
        axes = next((a for a in (_NED, _MODEL_SCALED, _MODEL) if a[0] in row), _NED)
        try:
            position = np.array([float(row[name]) for name in axes])
            rotation = Rotation.from_quat([float(row[name]) for name in _QUATERNION])
            poses[row["image"]] = RigidTransform.from_components(position, rotation)
        except (KeyError, ValueError) as error:
            raise WorkspaceError(f"{path} line {line}: no pose: {one_line(error)}") from None
    return poses
