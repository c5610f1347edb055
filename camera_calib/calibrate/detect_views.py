"""Find the target in all pictures of a calibration."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2

from alice_survey.core.errors import CalibrationError
from alice_survey.core.executor import Executor
from camera_calib.calibrate.picture_sets import PictureSet
from camera_calib.calibration import TargetView
from camera_calib.picture_files import is_cut_short, read_pixels
from camera_calib.targets.detect import Detection, as_grey, chessboard_size, detect
from camera_calib.targets.target import Rejection, Target

_CHECKED = 3
_READ = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION

Size = tuple[int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class Detections:
    """Observations of the target in all pictures."""

    views: tuple[TargetView, ...]
    """Views in which a camera saw it."""
    sizes: Mapping[str, Size]
    """Width and height of each camera's pictures."""
    rejections: tuple[Rejection, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    path: Path
    size: Size | None = None
    """None where the picture cannot be decoded."""
    detection: Detection
    board: Size | None = None
    """Corners along the longer and the shorter side of the chessboard, where counted."""


def detect_views(sets: Sequence[PictureSet], target: Target, executor: Executor) -> Detections:
    """Find the target in sets of pictures; what cannot be used is named and left out.

    Args:
        sets: pictures of one moment each.
        target: what to look for.
        executor: where tasks run.

    Raises:
        CalibrationError: a camera has pictures of different sizes, or none that shows the target.
    """
    jobs = [
        (path, target, i in _measured_numbers(len(sets)))
        for i, one in enumerate(sets)
        for path in one.paths.values()
    ]
    found = iter(list(executor.map(_look, jobs, label="target points")))
    seen = [(one.name, {camera: next(found) for camera in one.paths}) for one in sets]
    by_camera: dict[str, list[_Seen]] = {}
    rejections: list[Rejection] = []
    views = []
    for view, pictures in seen:
        for camera, what in pictures.items():
            by_camera.setdefault(camera, []).append(what)
            rejections += what.detection.rejections(view, camera)
        points = {camera: what.detection.pixels for camera, what in pictures.items()}
        pixels = {camera: known for camera, known in points.items() if known is not None}
        if pixels:
            views.append(TargetView(name=view, pixels=pixels))
    _check_board(target, [what for mine in by_camera.values() for what in mine])
    sizes = {camera: _one_size(camera, mine) for camera, mine in by_camera.items()}
    for camera, mine in by_camera.items():
        _check_found(camera, target, mine)
    return Detections(views=tuple(views), sizes=sizes, rejections=tuple(rejections))


def _measured_numbers(count: int) -> set[int]:
    """Numbers of the views in which the size of the board is measured."""
    return {(2 * i + 1) * count // (2 * _CHECKED) for i in range(_CHECKED)}


def _look(job: tuple[Path, Target, bool]) -> _Seen:
    path, target, check = job
    picture = None if is_cut_short(path) else read_pixels(path, _READ)
    if picture is None:
        why = "is cut short" if is_cut_short(path) else "cannot be decoded as a picture"
        return _Seen(path=path, detection=Detection(pixels=None, refused=f"{path.name} {why}"))
    height, width = map(int, picture.shape[:2])
    try:
        detection = detect(target, picture)
    except CalibrationError as error:
        detection = Detection(pixels=None, refused=str(error))
    board = None
    if check and target.kind == "chessboard" and detection.pixels is not None:
        board = chessboard_size(as_grey(picture))
    return _Seen(path=path, size=(width, height), detection=detection, board=board)


def _one_size(camera: str, seen: Sequence[_Seen]) -> Size:
    counts = Counter(what.size for what in seen if what.size is not None).most_common()
    if not counts:
        raise CalibrationError(
            f"none of the pictures of {camera} can be read: {seen[0].detection.refused}"
        )
    if len(counts) > 1:
        (common, many), (other, few) = counts[:2]
        odd = next(what.path.name for what in seen if what.size == other)
        raise CalibrationError(
            f"pictures of {camera} differ in size: {many} of {common[0]} x {common[1]} px, {few} "
            f"of {other[0]} x {other[1]} px (such as {odd}): give those of one size"
        )
    return counts[0][0]


def _check_board(target: Target, seen: Sequence[_Seen]) -> None:
    """A part of a larger chessboard looks like a smaller one, but not always the same part."""
    expected = max(target.columns, target.rows), min(target.columns, target.rows)
    boards = [what.board for what in seen if what.board is not None]
    larger = [b for b in boards if b[0] >= expected[0] and b[1] >= expected[1] and b != expected]
    if len(larger) > len(boards) / 2:
        (columns, rows), count = Counter(larger).most_common(1)[0]
        raise CalibrationError(
            f"the chessboard has {columns}x{rows} inner corners in {count} of {len(boards)} "
            f"pictures looked at, more than the {target.columns}x{target.rows} of --target: count "
            "them again"
        )


def _check_found(camera: str, target: Target, seen: Sequence[_Seen]) -> None:
    looked = [what.detection for what in seen if what.size is not None]
    if any(detection.pixels is not None for detection in looked):
        return
    reasons = Counter(str(detection.refused) for detection in looked).most_common(1)
    raise CalibrationError(
        f"the target '{target.description}' was found in none of the {len(looked)} pictures of "
        f"{camera}; of {reasons[0][1]} of them: {reasons[0][0]}"
    )
