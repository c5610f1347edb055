"""Coded markers in pictures, and the files in which points are picked by hand."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alice_survey.core.artefacts import need_stage, read_stage, write_csv
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array, Datum
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import ControlRecord
from reconstruct.pictures.undistorted import Pictures, read_colour
from reconstruct.placing.control import describe
from reconstruct.placing.control_file import (
    CONTROL_FILE,
    MARKERS_FILE,
    PICKS_FILE,
    KnownPoint,
    read_control,
    read_picks,
)
from reconstruct.views.model import SparseModel, read_model

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
