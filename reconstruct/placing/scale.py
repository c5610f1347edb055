"""One known length scales a model that no calibrated rig has scaled.

`scale.json` in the workspace keeps it; `sparse/` and all that follows are then redone.
"""

import math
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.artefacts import need_stage
from alice_survey.base.errors import ReconstructionError
from alice_survey.base.frames import Array
from alice_survey.base.records import MappingRecord, RegistrationRecord, ScaleRecord
from alice_survey.stages import SCALE_FILE
from camera_calib.triangulate import nearest_to_rays
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import SparseModel, View, read_frame, read_model

_NEIGHBOURS = 15
"""Model points from which the surface at a pixel is taken."""
_LARGEST_MISS_PX = 5.0
"""Picks of one spot in several pictures must agree this well."""


def scale_model(workspace: Path, points: str, length_m: float) -> str:
    """Note the true distance between two points of a model in `scale.json`.

    Args:
        workspace: folder with a finished `sparse/`.
        points: two points, separated by a space. Each is `x,y,z` in the coordinates of the model
            (as in `sparse/track.csv` and the clouds), or a spot in pictures: `IMAGE:x,y` with
            pixels of the imported picture counted from 0, as viewers show them. A spot marked in
            several pictures, joined by `+` (`left/001.png:52,80+left/002.png:31,82`), is
            triangulated; one marked in one picture is taken on the surface through the model's
            points nearest to it.
        length_m: their true distance.

    Returns:
        What was found, in one line.

    Raises:
        ReconstructionError: the points cannot be understood or found, or the scale is known from
            the rig already.
    """
    tokens = points.split()
    if len(tokens) != 2:
        raise ReconstructionError(
            f"--points needs two points separated by a space, got {len(tokens)}: {points!r}"
        )
    sparse = need_stage(workspace, "sparse", "reconstruct")
    model = read_model(sparse)
    pictures = Pictures.open(workspace)
    first, second = (find_point(token, model, pictures) for token in tokens)
    return note_scale(workspace, (tokens[0], tokens[1]), first, second, length_m)


def note_scale(
    workspace: Path, names: tuple[str, str], first: Array, second: Array, length_m: float
) -> str:
    """Note the true distance between two places of a model in `scale.json`.

    Args:
        workspace: folder with a finished `sparse/`.
        names: of the places, for the file.
        first: (3,) in the coordinates of the model.
        second: (3,).
        length_m: their true distance.

    Returns:
        What was found, in one line.

    Raises:
        ReconstructionError: the scale is known from the rig already, or there is no such length.
    """
    if not (math.isfinite(length_m) and length_m > 0):
        raise ReconstructionError(f"--length {length_m}: the true distance must be more than 0 m")
    sparse = need_stage(workspace, "sparse", "reconstruct")
    mapping = MappingRecord.read(workspace / "mapping" / "mapping.json")
    if mapping.scaled:
        raise ReconstructionError("the calibrated rig has scaled this model already")
    world_from_mapping = RegistrationRecord.read(sparse / "registration.json").world_from_mapping
    distance = float(np.linalg.norm(second - first))
    if not distance > 0:
        raise ReconstructionError(f"the two points are one and the same: {' '.join(names)!r}")
    ScaleRecord.save(
        workspace / SCALE_FILE,
        {
            "format": "alice-survey scale",
            "version": 1,
            "points": list(names),
            "length_m": length_m,
            "metres_per_unit": length_m * world_from_mapping.scale / distance,
            "gauge": mapping.gauge,
        },
    )
    unit = read_frame(sparse / "frame.json").unit
    return (
        f"{distance:.6g} {unit} between the points are {length_m:g} m: multiply by "
        f"{length_m / distance:.6g}; run 'alice-survey reconstruct' to do so"
    )


def find_point(token: str, model: SparseModel, pictures: Pictures) -> Array:
    """A point in world coordinates, (3,), as `scale_model` describes it.

    Raises:
        ReconstructionError: it cannot be understood, or not be found in the model.
    """
    if ":" not in token:
        cells = token.split(",")
        try:
            point = np.array([float(cell) for cell in cells])
        except ValueError:
            point = np.zeros(0)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise ReconstructionError(f"{token!r} is not a point x,y,z")
        return point
    picks = [_read_pick(pick, model, pictures) for pick in token.split("+")]
    if len(picks) == 1:
        return _on_surface(token, *picks[0], model)
    return _triangulate(token, picks)


def _read_pick(text: str, model: SparseModel, pictures: Pictures) -> tuple[View, Array]:
    """The view and the pinhole's pixel, (2,), of `IMAGE:x,y`."""
    match = re.fullmatch(r"(.+):([-+.\deE]+),([-+.\deE]+)", text)
    try:
        name, pixel = (
            (match[1], np.array([float(match[2]), float(match[3])])) if match else ("", None)
        )
    except ValueError:
        pixel = None
    if pixel is None:
        raise ReconstructionError(f"{text!r} is not a spot IMAGE:x,y")
    view = next((v for v in model.views if v.image == name), None)
    if view is None:
        raise ReconstructionError(f"{text!r}: no picture {name} is in the model")
    width, height = pictures.warp(name).size_px
    if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
        raise ReconstructionError(f"{text!r} is outside of the picture, {width} x {height} pixels")
    ideal = pictures.warp(name).to_pinhole(pixel[None] + 0.5)[0]
    if not np.isfinite(ideal).all():
        raise ReconstructionError(f"{text!r} is beyond the reach of the lens model")
    return view, ideal


def _slope(view: View, pixel: Array) -> Array:
    """The ray of a pixel in the camera's frame, (3,), third component one."""
    return np.append(view.pinhole.slopes(pixel), 1.0)


def _on_surface(token: str, view: View, pixel: Array, model: SparseModel) -> Array:
    """Where the ray meets the plane through the nearest points that the picture saw."""
    index = model.views.index(view)
    seen = np.unique(model.observations[model.observations[:, 1] == index, 0])
    cam_from_world: RigidTransform = view.world_from_cam.inv()
    points = cam_from_world.apply(model.points_world[seen]).reshape(-1, 3)
    points = points[points[:, 2] > 0]
    slopes = points / points[:, 2:]
    ray = _slope(view, pixel)
    nearest = np.argsort(np.linalg.norm(slopes - ray, axis=1), kind="stable")[:_NEIGHBOURS]
    if len(nearest) < 3:
        raise ReconstructionError(f"{token!r}: the model has {len(nearest)} points in that picture")
    # On a plane 1/z is linear in the slopes.
    near, inverse = slopes[nearest], 1.0 / points[nearest, 2]
    for _ in range(3):
        plane = np.linalg.lstsq(near, inverse, rcond=None)[0]
        miss = np.abs(near @ plane - inverse)
        good = miss <= 3.0 * np.median(miss) + 1e-12
        if good.sum() < 3:
            break
        near, inverse = near[good], inverse[good]
    depth = 1.0 / float(ray @ plane)
    if not depth > 0:
        raise ReconstructionError(f"{token!r}: no surface of the model is there")
    found: Array = view.world_from_cam.apply(depth * ray)
    return found


def _triangulate(token: str, picks: list[tuple[View, Array]]) -> Array:
    """The point nearest to all rays, (3,)."""
    rotation = [view.world_from_cam.rotation for view, _ in picks]
    starts = np.stack([view.world_from_cam.translation for view, _ in picks])
    rays = np.stack([r.apply(_slope(v, p)) for r, (v, p) in zip(rotation, picks, strict=True)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    point: Array = nearest_to_rays(starts[:, None], rays[:, None])[0]
    if not np.isfinite(point).all():
        raise ReconstructionError(f"{token!r}: the pictures see the spot from one direction only")
    misses = [np.linalg.norm(v.project(point[None])[0] - p) for v, p in picks]
    worst = float(np.max(misses))
    if not worst <= _LARGEST_MISS_PX:
        raise ReconstructionError(
            f"{token!r}: the marks are {worst:.1f} px off one common spot; mark it again"
        )
    return point
