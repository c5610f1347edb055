"""One known length scales a model that no calibrated rig has scaled.

`scale.json` in the workspace keeps it; `sparse/` and all that follows are then redone.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import need_stage
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from alice_survey.core.records import MappingRecord, RegistrationRecord, ScaleRecord
from alice_survey.core.stages import SCALE_FILE
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.placing.control_file import Pick
from reconstruct.placing.picked_points import RegisteredPicture, find_spots
from reconstruct.views.model import SparseModel, View, read_frame, read_model, read_warps

_NEIGHBOURS = 15
"""Model points from which the surface at a pixel is taken."""
_MARK_SIGMA_PX = 1.0
"""Marks of one spot in several pictures must agree to five of these."""


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
    model, warps = read_model(sparse), read_warps(sparse / "cameras.json")
    first, second = (find_point(token, model, warps) for token in tokens)
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


def find_point(token: str, model: SparseModel, warps: Mapping[str, PinholeWarp]) -> Array:
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
    views = {view.image: view for view in model.views}
    picks = [_read_pick(text, views, warps) for text in token.split("+")]
    if len(picks) == 1:
        view = views[picks[0].image]
        pixel = np.array([[picks[0].x_px, picks[0].y_px]])
        return _on_surface(token, view, warps[view.camera].to_pinhole(pixel)[0], model)
    cameras = {
        image: RegisteredPicture(warp=warps[view.camera], model_from_pinhole=view.world_from_cam)
        for image, view in views.items()
        if image in {pick.image for pick in picks}
    }
    found, lost = find_spots(picks, cameras)
    if not found:
        raise ReconstructionError(f"{token!r}: {lost['spot']}; mark it again")
    return found["spot"].model


def _read_pick(text: str, views: Mapping[str, View], warps: Mapping[str, PinholeWarp]) -> Pick:
    """The pick that `IMAGE:x,y` says."""
    match = re.fullmatch(r"(.+):([-+.\deE]+),([-+.\deE]+)", text)
    try:
        name, pixel = (
            (match[1], np.array([float(match[2]), float(match[3])])) if match else ("", None)
        )
    except ValueError:
        pixel = None
    if pixel is None:
        raise ReconstructionError(f"{text!r} is not a spot IMAGE:x,y")
    if name not in views:
        raise ReconstructionError(f"{text!r}: no picture {name} is in the model")
    warp = warps[views[name].camera]
    width, height = warp.size_px
    if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
        raise ReconstructionError(f"{text!r} is outside of the picture, {width} x {height} pixels")
    if not np.isfinite(warp.to_pinhole(pixel[None] + 0.5)).all():
        raise ReconstructionError(f"{text!r} is beyond the reach of the lens model")
    x, y = (pixel + 0.5).tolist()
    return Pick(image=name, point="spot", x_px=x, y_px=y, sigma_px=_MARK_SIGMA_PX)


def _on_surface(token: str, view: View, pixel: Array, model: SparseModel) -> Array:
    """Where the ray meets the plane through the nearest points that the picture saw."""
    index = model.views.index(view)
    seen = np.unique(model.observations[model.observations[:, 1] == index, 0])
    cam_from_world: RigidTransform = view.world_from_cam.inv()
    points = cam_from_world.apply(model.points_world[seen]).reshape(-1, 3)
    points = points[points[:, 2] > 0]
    slopes = points / points[:, 2:]
    ray = np.append(view.pinhole.slopes(pixel), 1.0)
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
