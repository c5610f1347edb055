"""The command `control`: find coded markers, prepare picking, and note one known length.

One known length scales a model that no calibrated rig has scaled: `scale.json` in the workspace
keeps it, and `sparse/` and all that follows are then redone.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import need_stage, read_stage, write_csv
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array, Datum
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import ControlRecord, MappingRecord, RegistrationRecord, ScaleRecord
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.pictures.undistorted import Pictures, read_colour
from reconstruct.placing.control import describe
from reconstruct.placing.control_points import (
    CONTROL_FILE,
    MARKERS_FILE,
    PICKS_FILE,
    KnownPoint,
    Pick,
    RegisteredPicture,
    read_control,
    read_picks,
    triangulate_picks,
)
from reconstruct.stages import SCALE_FILE
from reconstruct.views.model import SparseModel, View, read_frame, read_model, read_warps

MARKER_SIGMA_PX = 0.2
"""Sigma of a corner that the detector refined."""
DICTIONARIES = (
    "DICT_4X4_50", "DICT_4X4_250", "DICT_5X5_100", "DICT_6X6_250", "DICT_7X7_100",
    "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h11",
)  # fmt: skip
"""Dictionaries tried one after the other where none is named."""
_HEADER = ("image", "point", "x", "y", "sigma_px")
_TEMPLATE = ("image", "point", "x", "y", "sigma_px", "near_x", "near_y")
_MIN_VIEWS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Marker:
    """One marker in one picture."""

    number: int
    corners: Array
    """(4, 2) clockwise from its own upper left; pixels from 0 at the first one's middle."""


@dataclass(frozen=True)
class _MarkerTask:
    path: Path
    dictionaries: tuple[str, ...]


def find_markers(picture: Any, dictionary: str) -> list[Marker]:
    """Find the markers of a dictionary of OpenCV's in a picture, (H, W) or (H, W, 3) bytes."""
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners, numbers, _ = cv2.aruco.ArucoDetector(known, options).detectMarkers(picture)
    if numbers is None:
        return []
    found = [
        Marker(number=int(n), corners=np.asarray(c, dtype=np.float64).reshape(4, 2))
        for n, c in zip(np.ravel(numbers), corners, strict=True)
    ]
    # A number seen twice in one picture is a misreading or a copy: neither is a known place.
    counts = Counter(marker.number for marker in found)
    return sorted((m for m in found if counts[m.number] == 1), key=lambda m: m.number)


def survey_control(
    workspace: Path, *, dictionary: str | None = None, executor: Executor = SERIAL
) -> tuple[str, dict[str, Any]]:
    """Find coded markers in all pictures and prepare the picking of control points by hand.

    Writes `markers.csv` (replaced), and `picks.csv` where there is none yet: a row for every point
    of `control.csv` and every picture of a placed model that should show it, x and y left empty.

    Args:
        workspace: folder with finished `images/`.
        dictionary: name of a dictionary of `cv2.aruco`; the one with most markers if None.
        executor: where tasks run.

    Returns:
        What was found, in words and as JSON values: `dictionary`, `markers` (pictures by number),
        `detections`, `template_rows`, and `score` of the present model if there is one.

    Raises:
        ReconstructionError: there is no such dictionary.
    """
    images = need_stage(workspace, "images", "import-images")
    names = [record.image for record in read_manifest(images / "manifest.csv")]
    if dictionary is not None and dictionary not in _known_dictionaries():
        raise ReconstructionError(
            f"no dictionary {dictionary!r}; there are {', '.join(_known_dictionaries())}"
        )
    tried = DICTIONARIES if dictionary is None else (dictionary,)
    tasks = [_MarkerTask(images / name, tried) for name in names]
    found = list(executor.map(_look, tasks, label="markers"))
    best, views = _best_dictionary(tried, found)
    rows = [
        (name, f"{marker.number}.{k}", f"{x:.4f}", f"{y:.4f}", MARKER_SIGMA_PX)
        for name, markers in zip(names, (seen[best] for seen in found), strict=True)
        for marker in markers
        if views[marker.number] >= _MIN_VIEWS
        for k, (x, y) in enumerate(marker.corners)
    ]
    write_csv(workspace / MARKERS_FILE, _HEADER, rows)
    seen_often = {n: count for n, count in sorted(views.items()) if count >= _MIN_VIEWS}
    lines = [
        f"{len(seen_often)} markers of {best} in {len({row[0] for row in rows})} of {len(names)} "
        f"pictures: {MARKERS_FILE}"
        if seen_often
        else f"no marker is in two of the {len(names)} pictures"
    ]
    template = _write_template(workspace)
    if template:
        lines.append(
            f"{template} rows to fill in: {PICKS_FILE}; pixels count from 0 at the middle of the "
            "first, near_x and near_y say where to look; delete what is not to be seen"
        )
    score = _score(workspace)
    if score is not None:
        lines.append(describe(score))
    if (workspace / CONTROL_FILE).is_file():
        lines.append("run 'alice-survey reconstruct' to place the model again")
    else:
        lines.append(f"write what is known of the points to {CONTROL_FILE}")
    return "\n".join(lines), {
        "dictionary": best if seen_often else None,
        "markers": {str(n): count for n, count in seen_often.items()},
        "detections": len(rows) // 4,
        "template_rows": template,
        "score": score,
    }


def _known_dictionaries() -> tuple[str, ...]:
    return tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))


def _look(task: _MarkerTask) -> dict[str, list[Marker]]:
    picture = cv2.cvtColor(read_colour(task.path), cv2.COLOR_BGR2GRAY)
    return {name: find_markers(picture, name) for name in task.dictionaries}


def _best_dictionary(
    tried: Sequence[str], found: Sequence[dict[str, list[Marker]]]
) -> tuple[str, Counter[int]]:
    """The dictionary with most detections of markers that two pictures or more show."""
    views = {name: Counter(m.number for seen in found for m in seen[name]) for name in tried}
    detections = {
        name: sum(n for n in counts.values() if n >= _MIN_VIEWS) for name, counts in views.items()
    }
    best = max(tried, key=lambda name: (detections[name], -tried.index(name)))
    return best, views[best]


def _write_template(workspace: Path) -> int:
    """Rows of a new `picks.csv`; 0 where there is one, nothing to pick, or no placed model."""
    picks, control = workspace / PICKS_FILE, workspace / CONTROL_FILE
    sparse = workspace / "sparse"
    if picks.exists() or not control.is_file() or read_stage(sparse) is None:
        return 0
    known = read_control(control).points
    coded = {p.point.rsplit(".", 1)[0] for p in read_picks(workspace / MARKERS_FILE)}
    model, pictures = read_model(sparse), Pictures.open(workspace)
    rows = [
        (view, point.name, None, None, None, round(x - 0.5), round(y - 0.5))
        for point in known
        if point.name not in coded
        for view, x, y in _expected_in(point, model, pictures)
    ]
    if rows:
        write_csv(picks, _TEMPLATE, rows)
    return len(rows)


def _expected_in(
    point: KnownPoint, model: SparseModel, pictures: Pictures
) -> list[tuple[str, float, float]]:
    """Pictures that should show a point, and where; none where the model has no CRS."""
    datum: Datum | None = model.frame.datum
    if datum is None:
        return []
    place = point.ned(datum)[None]
    found = []
    for view in model.views:
        warp = pictures.warp(view.image)
        x, y = warp.from_pinhole(view.project(place))[0]
        if 0 <= x < warp.size_px[0] and 0 <= y < warp.size_px[1]:
            found.append((view.image, float(x), float(y)))
    return found


def _score(workspace: Path) -> dict[str, Any] | None:
    path = workspace / "sparse" / "control.json"
    if read_stage(workspace / "sparse") is None or not path.is_file():
        return None
    return ControlRecord.read(path).to_json()


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
    found, lost = triangulate_picks(picks, cameras)
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
