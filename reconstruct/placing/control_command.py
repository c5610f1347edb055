"""The commands `control` and `import-control`: markers, picking, one known length, other programs.

One known length scales a model that no calibrated rig has scaled: `scale.json` in the workspace
keeps it, and `sparse/` and all that follows are then redone.

Control of other programs becomes `control.csv` and `picks.csv`:

- Metashape and PhotoScan export markers as XML (File > Export > Export Markers). A chunk lists
  `cameras` (labels by number), `markers` with `reference` coordinates (x, y, z, their accuracies;
  unticked ones are check points), `scalebars` between two of them with a `reference` distance, and
  by frame the `location` of each marker in pictures, in pixels from the outer corner of the first
  one. Locations that no person pinned are predictions of the program, and are not used. A
  scale bar that does not name its markers by their numbers has their labels in its own, `A_B`.
- OpenDroneMap's `gcp_list.txt` names the coordinate system in its first line (`EPSG:32615`, a PROJ
  string or `WGS84 UTM 16N`); each other line is a pick: `x y z im_x im_y picture [name]`, separated
  by blanks. Picks of one name, or where there are no names of one place, are one point.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Literal
from xml.etree import ElementTree as ET

import cv2
import numpy as np

from alice_survey.core.artefacts import need_stage, write_csv
from alice_survey.core.contents import as_line, one_line, ordinary_file, xml_root
from alice_survey.core.errors import ReconstructionError, WorkspaceError, file_faults, warn
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import SYSTEM, Array, distances_m
from alice_survey.core.manifest import ImageRecord, read_manifest
from alice_survey.core.records import MappingRecord, RegistrationRecord, ScaleRecord
from alice_survey.kit.words import count
from reconstruct.pictures.files import list_names, read_header, safe_name
from reconstruct.pictures.undistorted import read_colour
from reconstruct.placing.control_points import (
    CONTROL_FILE,
    MARKERS_FILE,
    PICK_SIGMA_PX,
    PICKS_FILE,
    KnownLength,
    KnownPoint,
    Pick,
    PlaceOf,
    Use,
    coordinates,
    read_number,
    read_positive,
    write_control,
    write_picks,
)
from reconstruct.stages import SCALE_FILE
from reconstruct.views.model import read_frame

MARKER_SIGMA_PX = 0.2
"""Sigma of a corner that the detector refined."""
DICTIONARIES = (
    "DICT_4X4_50", "DICT_4X4_250", "DICT_5X5_100", "DICT_6X6_250", "DICT_7X7_100",
    "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h11",
)  # fmt: skip
"""Dictionaries tried one after the other where none is named."""
_HEADER = ("image", "point", "x", "y", "sigma_px")
_MIN_VIEWS = 2


def find_markers(picture: Any, dictionary: str) -> dict[int, Array]:
    """Find the markers of a dictionary of OpenCV's in a picture, (H, W) or (H, W, 3) bytes.

    Returns:
        Their corners by number: (4, 2), clockwise from their own upper left; pixels from 0 at the
        first one's middle.
    """
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners, numbers, _ = cv2.aruco.ArucoDetector(known, options).detectMarkers(picture)
    if numbers is None:
        return {}
    found = dict(zip(np.ravel(numbers).tolist(), corners, strict=True))
    # A number seen twice in one picture is a misreading or a copy: neither is a known place.
    counts = Counter(np.ravel(numbers).tolist())
    once = sorted(number for number, count in counts.items() if count == 1)
    return {number: np.asarray(found[number], np.float64).reshape(4, 2) for number in once}


def survey_control(
    workspace: Path, *, dictionary: str | None = None, executor: Executor = SERIAL
) -> tuple[str, dict[str, Any]]:
    """Find coded markers in all pictures, and write `markers.csv`.

    Args:
        workspace: folder with finished `images/`.
        dictionary: name of a dictionary of `cv2.aruco`; the one with most markers if None.
        executor: where tasks run.

    Returns:
        What was found, as text and as JSON values: `dictionary`, `markers` (pictures by number)
        and `detections`.

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
    look = partial(_look, dictionaries=tried)
    found = list(executor.map(look, [images / name for name in names], label="markers"))
    best, views = _best_dictionary(tried, found)
    rows = [
        (name, f"{number}.{k}", f"{x:.4f}", f"{y:.4f}", MARKER_SIGMA_PX)
        for name, seen in zip(names, found, strict=True)
        for number, corners in seen[best].items()
        if views[number] >= _MIN_VIEWS
        for k, (x, y) in enumerate(corners)
    ]
    write_csv(workspace / MARKERS_FILE, _HEADER, rows)
    seen_often = {n: count for n, count in sorted(views.items()) if count >= _MIN_VIEWS}
    lines = [
        f"{len(seen_often)} markers of {best} in {len({row[0] for row in rows})} of {len(names)} "
        f"pictures: {MARKERS_FILE}"
        if seen_often
        else f"no marker is in two of the {len(names)} pictures"
    ]
    if (workspace / CONTROL_FILE).is_file():
        lines.append("run 'alice-survey reconstruct' to place the model again")
    else:
        lines.append(f"write what is known of the points to {CONTROL_FILE}")
    return "\n".join(lines), {
        "dictionary": best if seen_often else None,
        "markers": {str(n): count for n, count in seen_often.items()},
        "detections": len(rows) // 4,
    }


def _known_dictionaries() -> tuple[str, ...]:
    return tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))


def _look(path: Path, dictionaries: Sequence[str]) -> dict[str, dict[int, Array]]:
    picture = cv2.cvtColor(read_colour(path), cv2.COLOR_BGR2GRAY)
    return {name: find_markers(picture, name) for name in dictionaries}


def _best_dictionary(
    tried: Sequence[str], found: Sequence[dict[str, dict[int, Array]]]
) -> tuple[str, Counter[int]]:
    """The dictionary with most detections of markers that two pictures or more show."""
    views = {name: Counter(n for seen in found for n in seen[name]) for name in tried}
    detections = {
        name: sum(n for n in counts.values() if n >= _MIN_VIEWS) for name, counts in views.items()
    }
    best = max(tried, key=detections.__getitem__)  # of equals the first
    return best, views[best]


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


@dataclass(frozen=True, kw_only=True)
class ForeignControl:
    """All that a file of another program holds.

    Heights are positive up and depths unknown; NaN stands for sigmas that it does not state, and
    for places of points that have none. Pictures of picks are files, with or without folder and
    suffix.
    """

    points: list[KnownPoint] = field(default_factory=list)
    lengths: list[KnownLength] = field(default_factory=list)
    picks: list[Pick] = field(default_factory=list)


_ACCURACIES = ("accuracy_markers", "accuracy_projections", "accuracy_scalebars")
"""Settings of a chunk: sigma of markers' coordinates (m), of their places in pictures (px) and of
scale bars (m)."""


def read_markers(text: str) -> ForeignControl:
    """Read markers that Metashape exported.

    Raises:
        ValueError: it is not valid, or lacks something.
    """
    top = xml_root(text)
    chunks = [top] if top.tag == "chunk" else list(top.iter("chunk"))
    chunks = [chunk for chunk in chunks if chunk.find("markers") is not None]
    if len(chunks) != 1:
        raise ValueError(f"{len(chunks)} chunks have markers: export the markers of one")
    (chunk,) = chunks
    settings = {item.get("name"): item.get("value") for item in chunk.iter("property")}
    sigma_m, sigma_px, sigma_bar_m = (
        read_positive(settings.get(name) or "", name) for name in _ACCURACIES
    )
    cameras = {camera.get("id"): str(camera.get("label")) for camera in chunk.iter("camera")}
    labels = {
        marker.get("id"): (marker.get("label") or f"marker {marker.get('id')}").strip()
        for marker in chunk.findall("markers/marker")
    }
    found = ForeignControl()
    systems = [chunk.findtext(tag) or "" for tag in ("markers_reference", "reference")]
    system = next((text.strip() for text in systems if text.strip()), "")
    placed = chunk.findall("markers/marker/reference[@x]")
    if not system and (placed or chunk.find("scalebars/scalebar") is None):
        raise ValueError(
            "names no coordinate system: set one in Metashape's reference pane and export"
        )
    for marker in chunk.findall("markers/marker") if system else ():
        reference = marker.find("reference")
        if reference is not None:
            name = labels[marker.get("id")]
            found.points.append(_marker_point(name, reference, coordinates(system), sigma_m))
    for marker in chunk.findall("frames/frame/markers/marker"):
        for location in marker.findall("location"):
            if not _is_true(location, "pinned"):
                continue
            picture = cameras.get(location.get("camera_id"))
            point = labels.get(marker.get("marker_id"))
            if picture is None or point is None:
                raise ValueError(
                    f"a location names camera {location.get('camera_id')} and marker "
                    f"{marker.get('marker_id')}, which it does not list"
                )
            x, y = (_finite(location, axis, point) for axis in "xy")
            sigma = PICK_SIGMA_PX if math.isnan(sigma_px) else sigma_px
            found.picks.append(Pick(image=picture, point=point, x_px=x, y_px=y, sigma_px=sigma))
    lost = []
    for number, item in enumerate(chunk.findall("scalebars/scalebar")):
        bar = _bar(item, labels, sigma_bar_m)
        if bar is None:
            lost.append(item.get("label") or f"number {number}")
        else:
            found.lengths.append(bar)
    if lost:
        warn(f"scale bars without a distance or two markers are left out: {', '.join(lost)}")
    return found


def _bar(item: ET.Element, labels: Mapping[str | None, str], sigma_m: float) -> KnownLength | None:
    """A scale bar; None where it has no distance, or does not lie between two known markers."""
    reference = item.find("reference")
    if reference is None or not reference.get("distance", "").strip():
        return None
    name = (item.get("label") or f"bar {item.get('id')}").strip()
    numbers = [
        value
        for part in item.iter()
        for key, value in sorted(part.attrib.items())
        if "marker" in key or (key == "id" and part.tag == "marker")
    ]
    ends = [labels[number] for number in numbers if number in labels]
    if not numbers:
        pairs = [(name[:k], name[k + 1 :]) for k, letter in enumerate(name) if letter == "_"]
        known = set(labels.values())
        ends = next(([*pair] for pair in pairs if known.issuperset(pair)), [])
    if len(ends) != 2 or ends[0] == ends[1]:
        return None
    length_m = read_positive(reference.get("distance", ""), f"distance of {name}")
    own = read_positive(reference.get("accuracy", ""), f"accuracy of {name}")
    return KnownLength(
        name=name,
        ends=(ends[0], ends[1]),
        length_m=length_m,
        use="control" if _is_true(reference, "enabled") else "check",
        sigma_m=sigma_m if math.isnan(own) else own,
    )


def _marker_point(
    name: str, reference: ET.Element, place_of: PlaceOf, sigma_m: float
) -> KnownPoint:
    use: Use = "control" if _is_true(reference, "enabled") else "check"
    if any(reference.get(axis) is None for axis in "xyz"):
        return KnownPoint(name=name, use=use, sigma_m=sigma_m, sigma_vertical_m=sigma_m)
    x, y, z = (_finite(reference, axis, name) for axis in "xyz")
    sx, sy, sz = (
        read_positive(reference.get(axis, ""), f"{axis} of {name}") for axis in ("sx", "sy", "sz")
    )
    level = max((s for s in (sx, sy) if s > 0), default=sigma_m)
    return replace(
        place_of(x, y), name=name, use=use, height_m=z, sigma_m=level,
        sigma_vertical_m=sigma_m if math.isnan(sz) else sz,
    )  # fmt: skip


def _is_true(element: ET.Element, key: str) -> bool:
    return element.get(key, "true").lower() in ("true", "1")


def _finite(element: ET.Element, key: str, name: str) -> float:
    value = read_number(element.get(key, ""), f"{key} of {name}")
    if math.isnan(value):
        raise ValueError(f"{key} of {as_line(name)} is missing")
    return value


_MIN_FIELDS = 6
_CHECK = "CHK-"
"""How the names of ODM's check points begin."""


def read_gcp_list(text: str) -> ForeignControl:
    """Read a list of ODM.

    Raises:
        ValueError: a line is wrong.
    """
    lines = [
        (number, line.strip())
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    (_, system), *rows = lines
    place_of = coordinates(system)
    points: dict[str, KnownPoint] = {}
    names: dict[tuple[float, ...], str] = {}
    found = ForeignControl()
    for number, line in rows:
        fields = line.split()
        if len(fields) < _MIN_FIELDS:
            raise ValueError(
                f"line {number}: {len(fields)} fields, not x y z im_x im_y picture [name]"
            )
        try:
            x, y, z, column, row = map(float, fields[:5])
        except ValueError:
            raise ValueError(f"line {number}: {as_line(line)!r} has no five numbers") from None
        if not all(map(math.isfinite, (x, y, column, row))):
            raise ValueError(f"line {number}: {as_line(line)!r} has a number that is not finite")
        if len(fields) > _MIN_FIELDS:
            name = fields[_MIN_FIELDS]
        else:
            name = names.setdefault((x, y, z), f"P{len(names) + 1}")
        use: Use = "check" if name.upper().startswith(_CHECK) else "control"
        point = replace(place_of(x, y), name=name, height_m=z, use=use)
        first = points.setdefault(name, point)
        if first.place != point.place and not math.isnan(z):
            raise ValueError(f"line {number}: point {as_line(name)} has another place than before")
        found.picks.append(
            Pick(image=fields[5], point=name, x_px=column, y_px=row, sigma_px=PICK_SIGMA_PX)
        )
    found.points.extend(points.values())
    return found


Heights = Literal["level", "ellipsoid"]
_MAX_BYTES = 200_000_000
_SHOWN_NAMES = 4


def import_control(
    workspace: Path,
    path: Path,
    *,
    sigma_m: float | None = None,
    sigma_vertical_m: float | None = None,
    heights: Heights = "level",
    overwrite: bool = False,
) -> str:
    """Write `control.csv` and `picks.csv` from a file of another program (see the module).

    Args:
        workspace: folder with finished `images/`.
        path: the file.
        sigma_m: standard deviation of north and of east where the file states none.
        sigma_vertical_m: of heights; as `sigma_m` when None.
        heights: what the file's heights count from: `level`, up from the level that depths of the
            survey count from, or `ellipsoid`, that of WGS 84.
        overwrite: replace files that are there.

    Returns:
        What the workspace got, in one line.

    Raises:
        WorkspaceError: the file cannot be read or is of no known format, a point's sigma is not
            known, no picture of it is in the workspace, or a file would be replaced.
    """
    images = need_stage(workspace, "images", "import-images")
    targets = [workspace / CONTROL_FILE, workspace / PICKS_FILE]
    there = [target for target in targets if target.exists()]
    if there and not overwrite:
        raise WorkspaceError(f"{there[0]} is there: move it away, or give --overwrite")
    found = read_foreign(path)
    placed = [point for point in found.points if not point.unknown]
    if heights == "ellipsoid" and not all(point.geodetic for point in placed):
        raise WorkspaceError(f"{path}: is of a local grid, which has no ellipsoid: --heights level")
    ends = {end for bar in found.lengths for end in bar.ends or ()}
    left = [p.name for p in found.points if p not in placed and p.name not in ends]
    if left:
        warn(
            f"{path}: left out {len(left)} of {len(found.points)} points, whose place is missing "
            f"or stands for unknown: {_name_some(left)}"
        )
    if not placed and not found.lengths:
        raise WorkspaceError(f"{path}: no point has a place")
    points = []
    for point in placed:
        level = _first_above_0(point.sigma_m, sigma_m)
        vertical = _first_above_0(point.sigma_vertical_m, sigma_vertical_m, level)
        point = replace(point, sigma_m=level, sigma_vertical_m=vertical)
        if heights == "level":
            point = replace(point, depth_m=-point.height_m, height_m=math.nan)
        points.append(point)
    lengths = [replace(bar, sigma_m=_first_above_0(bar.sigma_m, sigma_m)) for bar in found.lengths]
    every: list[KnownPoint | KnownLength] = [*points, *lengths]
    unsure = next((one.name for one in every if math.isnan(one.sigma_m)), None)
    if unsure is not None:
        raise WorkspaceError(
            f"{path}: states no accuracy of {as_line(unsure)}: give --sigma, in metres"
        )
    records = read_manifest(images / "manifest.csv")
    names = [record.image for record in records]
    picks, lost = _match_pictures(found.picks, {p.name for p in points} | ends, names)
    lost_names = f"{_name_some(lost)}: not in {images}, or there more than once"
    if not picks:
        raise WorkspaceError(
            f"{path}: no point of known place is picked in a picture"
            + (f"; {lost_names}" if lost else "")
        )
    if lost:
        warn(f"{path}: {lost_names}; picks in them are left out")
    _compare_places(path, points, records)
    _compare_sizes(path, picks, images)
    write_control(targets[0], points, lengths)
    write_picks(targets[1], picks)
    checks = [one.use for one in every].count("check")
    held = f" ({checks} of them to check by)" if checks else ""
    bars = f", {count(len(lengths), 'scale bar')}" if lengths else ""
    pictures = count(len({pick.image for pick in picks}), "picture")
    marks = count(len(picks), "pick")
    return f"{count(len(points), 'point')}{bars}{held}, {marks} in {pictures}"


_FAR_M, _FAR_SHARE = 100.0, 3.0
"""Control is that far from pictures, and so many times their extent, or in another place."""
_DEEP_M, _SIGMAS, _ABOVE_M = 20.0, 5.0, 0.5


def _compare_places(
    path: Path, points: Sequence[KnownPoint], records: Sequence[ImageRecord]
) -> None:
    """Warn where points are not where the navigation of the pictures is, and of the usual cause."""
    geodetic = [p for p in points if p.geodetic]
    seen = np.array([[r.latitude_deg, r.longitude_deg] for r in records if r.has_horizontal])
    if geodetic and len(seen):
        middle = np.median(seen, axis=0)
        at = np.array([[p.latitude_deg, p.longitude_deg] for p in geodetic])
        far = distances_m(at, middle)
        near_m = _FAR_M + _FAR_SHARE * float(distances_m(seen, middle).max())
        far_off = far > near_m
        if far_off.any():
            swapped = far_off & (distances_m(at[:, ::-1], middle) < near_m)
            cause = "coordinates exchanged?" if swapped.any() else "check their system and its zone"
            warn(
                f"{path}: {far_off.sum()} points lie {np.median(far[far_off]) / 1e3:,.1f} km from "
                f"the pictures ({middle[0]:.5f}, {middle[1]:.5f}): {cause}"
            )
    depths = np.array([p.depth_m for p in points if not math.isnan(p.depth_m)])
    taken = np.array([r.depth_m for r in records])
    if not len(depths):
        return
    depth, above = float(np.median(depths)), -_ABOVE_M
    if not np.isfinite(taken).any():
        if depth < above:
            warn(
                f"{path}: points lie {-depth:.1f} m above the level of depths, the sea: give "
                "depths as negative heights; what do heights count from (--heights)?"
            )
        return
    picture = float(np.nanmedian(taken))
    sigmas = np.array([r.sigma_depth_m for r in records])
    sigma = float(np.nanmax(sigmas)) if np.isfinite(sigmas).any() else 0.0
    off = abs(depth - picture) > _DEEP_M + _SIGMAS * sigma
    flipped = abs(depth + picture) < abs(depth - picture) / 2
    if off or (flipped and depth < above < _ABOVE_M < picture):
        cause = "give depths as negative heights" if flipped else "what do heights count from?"
        warn(
            f"{path}: points are {depth:.1f} m deep, pictures {picture:.1f} m (sigma {sigma:.1f} "
            f"m): {cause} (--heights)"
        )


def _compare_sizes(path: Path, picks: Sequence[Pick], images: Path) -> None:
    """Warn of picks that lie outside of their pictures."""
    sizes = {name: read_header(images / name) for name in {pick.image for pick in picks}}
    at = np.array([[p.x_px + 0.5, p.y_px + 0.5] for p in picks])
    size = np.array([[sizes[p.image].width_px, sizes[p.image].height_px] for p in picks])
    outside = (size > 0).all(axis=1) & ((at < 0) | (at > size)).any(axis=1)
    if outside.any():
        factor = float((at / np.maximum(size, 1)).max())
        copies = f": are they of larger copies, at least {factor:.1f} times?" if factor > 1 else ""
        warn(
            f"{path}: {outside.sum()} of {len(picks)} picks lie outside of their pictures of "
            f"{size[outside][0, 0]} x {size[outside][0, 1]} pixels{copies}"
        )


def _first_above_0(*values: float | None) -> float:
    return next((value for value in values if value is not None and value > 0), math.nan)


def read_foreign(path: Path) -> ForeignControl:
    """Read a file of any known format.

    Raises:
        WorkspaceError: it cannot be read or is of none.
    """
    with file_faults(path, WorkspaceError):
        text = ordinary_file(path, _MAX_BYTES).read_text(encoding="utf-8-sig")
    if text.lstrip().startswith("<") and "<markers" in text:
        read = read_markers
    elif SYSTEM.match(text):
        read = read_gcp_list
    else:
        raise WorkspaceError(
            f"{path}: neither a gcp_list.txt of ODM (first its coordinate system) nor markers that "
            "Metashape exported; a plain table is WORKSPACE/control.csv (see docs/formats.md)"
        )
    try:
        found = read(text)
    except (ValueError, OverflowError) as error:
        raise WorkspaceError(f"{path}: {one_line(error)}") from None
    twice = [n for n, k in Counter(p.name for p in found.points).items() if k > 1]
    if twice:
        raise WorkspaceError(f"{path}: point {as_line(twice[0])} is there twice")
    return found


def _match_pictures(
    picks: Sequence[Pick], requested: set[str], names: Sequence[str]
) -> tuple[list[Pick], list[str]]:
    """Picks in the workspace's pictures, and pictures of the file that it lacks or has twice."""
    by_stem: dict[str, list[str]] = {}
    for name in names:
        by_stem.setdefault(PurePosixPath(name).stem.lower(), []).append(name)
    found, lost = [], []
    for pick in picks:
        image = _picture_of(pick.image, by_stem)
        if image is None:
            lost.append(pick.image)
        elif pick.point in requested:
            found.append(replace(pick, image=image))
    return found, list(dict.fromkeys(lost))


def _picture_of(picture: str, by_stem: dict[str, list[str]]) -> str | None:
    """The one picture of the workspace that has a file's name, which may have a folder."""
    parts = PurePosixPath(picture.replace("\\", "/"))
    # A label may lack the suffix and have dots of its own.
    for stem in dict.fromkeys((parts.stem, parts.name)):
        some = by_stem.get(safe_name(stem).lower(), [])
        if len(some) > 1:
            some = [n for n in some if PurePosixPath(n).parent.name == parts.parent.name]
        if len(some) == 1:
            return some[0]
    return None


def _name_some(names: Sequence[str]) -> str:
    return list_names([as_line(name) for name in names], _SHOWN_NAMES)
