"""Files of tanks with fixed cameras: reference points (JSON with comments) and detections (CSV).

Both are those of 3D-ZeF, Aalborg University's zebrafish tracking, and plain enough for others.
Pixels in these files count from the centre of the first pixel, as OpenCV does.
"""

import csv
import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.contents import one_line
from alice_survey.base.errors import CalibrationError, warn
from alice_survey.base.frames import Array
from camera_calib.tank.interface import Reference

_HALF_PX = 0.5
_COLUMNS = ("cam", "frame", "id", "x", "y")
_STRINGS_AND_COMMENTS = re.compile(r'("(?:\\.|[^"\\])*")|/\*.*?\*/|//[^\n]*', re.DOTALL)
METRES: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


def camera_name(path: Path) -> str:
    """The camera that a reference file is of: its name up to the first underscore."""
    return path.stem.partition("_")[0]


def read_reference(path: Path, unit: str = "cm") -> Reference:
    """Read reference points: a list of {"camera": {"x", "y"}, "world": {"x", "y", "z"}}.

    Args:
        path: JSON, in which `/* */` and `//` comments may stand.
        unit: of the world's coordinates, `m`, `cm` or `mm`.

    Raises:
        CalibrationError: the file is missing or holds no such list; the message names the file.
    """
    if unit not in METRES:
        raise CalibrationError(f"unit '{unit}': write one of {', '.join(METRES)}")
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: is no text") from None
    bare = _STRINGS_AND_COMMENTS.sub(lambda match: match[1] or " ", text)
    try:
        entries: Any = json.loads(bare)
        pixels = [[float(entry["camera"][axis]) for axis in "xy"] for entry in entries]
        points = [[float(entry["world"][axis]) for axis in "xyz"] for entry in entries]
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        what = f"lacks {one_line(error)}" if isinstance(error, KeyError) else one_line(error)
        raise CalibrationError(
            f'{path}: {what}; a list of {{"camera": {{"x", "y"}}, "world": {{"x", "y", "z"}}}} '
            "is wanted"
        ) from None
    return Reference(
        camera=camera_name(path),
        pixels=np.array(pixels, dtype=np.float64).reshape(-1, 2) + _HALF_PX,
        points_world=np.array(points, dtype=np.float64).reshape(-1, 3) * METRES[unit],
        source=str(path),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Detections:
    """What several cameras saw of the same things at the same moments."""

    frames: NDArray[np.int64]
    """(N,)."""
    ids: NDArray[np.int64]
    """(N,) which thing."""
    candidates: NDArray[np.int64]
    """(N,) how many rows share frame and id, because a camera gave it several times."""
    pixels: Array
    """(C, N, 2) from the outer corner of the first pixel; NaN where a camera saw nothing."""
    alone: int
    """Detections that no other camera made; they are left out."""
    not_numbers: int
    """Detections whose pixel is not a number; they are left out."""
    doubled: int
    """Further detections of the first camera for a frame and id that it has; left out."""


def read_detections(
    path: Path, cameras: Sequence[str], frame_offsets: Mapping[str, int] | None = None
) -> Detections:
    """Read detections and pair them by frame and id.

    A camera `cam1` owns the rows whose `cam` is `cam1` or `1`. Where it has a frame and id several
    times (reflections, for instance) the rule is 3D-ZeF's: of the first camera the first row
    counts, and each row of the others makes a point of its own.

    Args:
        path: CSV with at least the columns cam, frame, id, x, y.
        cameras: names, in order.
        frame_offsets: by camera, what to add to its frame numbers so that equal numbers are equal
            moments; 0 where not given.

    Raises:
        CalibrationError: the file is missing, a column or a number is, or nothing pairs.
    """
    offsets = dict.fromkeys(cameras, 0) | dict(frame_offsets or {})
    unknown = sorted(set(offsets) - set(cameras))
    if unknown:
        raise CalibrationError(
            f"frame offset of {', '.join(unknown)}: the cameras are {', '.join(cameras)}"
        )
    seen, not_numbers = _rows(path, cameras, offsets)
    keys = sorted({key for rows in seen.values() for key in rows})
    frames, ids, candidates, pixels = [], [], [], []
    alone = doubled = 0
    for frame, thing in keys:
        rows = [seen[name].get((frame, thing), []) for name in cameras]
        if sum(map(bool, rows)) < 2:
            alone += sum(map(len, rows))
            continue
        doubled += max(len(rows[0]) - 1, 0)
        choices = [rows[0][:1], *rows[1:]]
        combined = list(
            itertools.product(*(choice or [(math.nan, math.nan)] for choice in choices))
        )
        frames += [frame] * len(combined)
        ids += [thing] * len(combined)
        candidates += [len(combined)] * len(combined)
        pixels += combined
    if not pixels:
        raise CalibrationError(f"{path}: no frame and id was detected by two of the cameras")
    return Detections(
        frames=np.array(frames, dtype=np.int64),
        ids=np.array(ids, dtype=np.int64),
        candidates=np.array(candidates, dtype=np.int64),
        pixels=np.array(pixels, dtype=np.float64).transpose(1, 0, 2) + _HALF_PX,
        alone=alone,
        not_numbers=not_numbers,
        doubled=doubled,
    )


def warn_of_left_out(path: Path, detections: Detections) -> None:
    """Tell how many detections take no part, and why."""
    reasons = [
        (detections.alone, "have no partner in another camera"),
        (detections.not_numbers, "hold a pixel that is not a number"),
        (detections.doubled, "repeat a frame and id of the first camera"),
    ]
    told = [f"{count} {reason}" for count, reason in reasons if count]
    if told:
        warn(f"{path}: detections left out: {', '.join(told)}")


_Rows = dict[tuple[int, int], list[tuple[float, float]]]


def _rows(
    path: Path, cameras: Sequence[str], offsets: Mapping[str, int]
) -> tuple[dict[str, _Rows], int]:
    """Pixels by camera, frame and id, in the order of the file; and how many are not numbers."""
    owner = {name: name for name in cameras} | {
        name.removeprefix("cam"): name for name in cameras if name.startswith("cam")
    }
    seen: dict[str, _Rows] = {name: {} for name in cameras}
    not_numbers = 0
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise CalibrationError(
                    f"{path}: lacks the column {', '.join(missing)}; wanted are "
                    f"{', '.join(_COLUMNS)}"
                )
            for row in reader:
                name, key, pixel = _row(path, reader.line_num, row, owner)
                if not all(map(math.isfinite, pixel)):
                    not_numbers += 1
                    continue
                moment = (key[0] + offsets[name], key[1])
                seen[name].setdefault(moment, []).append(pixel)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error):
        raise CalibrationError(f"{path}: is no CSV text") from None
    return seen, not_numbers


def _row(
    path: Path, line: int, row: Mapping[str, str | None], owner: Mapping[str, str]
) -> tuple[str, tuple[int, int], tuple[float, float]]:
    try:
        cells = [(row[name] or "").strip() for name in _COLUMNS]
        camera = _whole(cells[0]) if cells[0] not in owner else cells[0]
        key = (int(_whole(cells[1])), int(_whole(cells[2])))
        pixel = (float(cells[3] or "nan"), float(cells[4] or "nan"))
    except ValueError as error:
        raise CalibrationError(f"{path}, line {line}: {error}") from None
    if camera not in owner:
        raise CalibrationError(
            f"{path}, line {line}: camera '{camera}' has no reference file; there are "
            f"{', '.join(sorted(set(owner.values())))}"
        )
    return owner[camera], key, pixel


def _whole(cell: str) -> str:
    """A cell such as `12` or `12.0` as a whole number's digits.

    Raises:
        ValueError: it is none.
    """
    if not math.isfinite(number := float(cell)) or number != round(number):
        raise ValueError(f"'{cell}' is no whole number")
    return str(round(number))
