"""Pictures of several cameras, in folders or in bags: which are of one moment.

Times are those of a trigger log, else moments in the names of files, else EXIF's. Without them
numbers in the names say which pictures belong together (`pair_pictures`). Bags of ROS 1 and ROS 2
hold `Image` and `CompressedImage`, with their times.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import read_csv
from alice_survey.core.contents import as_line
from alice_survey.core.errors import CalibrationError, ImageError, warn
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array
from camera_calib.calibrate.picture_sets import pair_pictures
from camera_calib.picture_files import time_taken
from missions.logs.dive import finite_number
from missions.logs.navigation_csv import utc_date
from missions.logs.ros_bag import opened_bag
from reconstruct.pictures.files import list_names, safe_name, to_utc

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_WITHIN_SHARE = 0.25
"""Pictures this share of the shortest usual interval apart are of one moment: a dropped picture
leaves a gap of a whole interval, and no trigger jitters by so much."""
_WORST_SHARE = 0.1
"""Pairs that are further apart than this share of the interval are worth a warning."""


def moments_of(times_s: Mapping[str, Array]) -> list[dict[str, int]]:
    """Group pictures by their times.

    The earliest picture that is left opens a moment; of every other camera its next picture joins
    it if it is within a quarter of the shortest of the cameras' median intervals.

    Args:
        times_s: by camera (N,) increasing times on one clock.

    Returns:
        For each moment, in order, the index of the picture of each camera that has one.

    Raises:
        ImageError: times do not increase, or no moment has two cameras.
    """
    for camera, times in times_s.items():
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise ImageError(f"times of the pictures of {camera} do not increase")
    intervals = [float(np.median(np.diff(t))) for t in times_s.values() if len(t) > 1]
    within_s = _WITHIN_SHARE * min(intervals, default=0.0)
    found = _groups(list(times_s), [np.asarray(t) for t in times_s.values()], within_s)
    if len(times_s) < 2:
        return found
    shared = [moment for moment in found if len(moment) > 1]
    if not shared:
        raise ImageError(
            f"no pictures of {' and '.join(times_s)} are within {1e3 * within_s:.3g} ms of each "
            "other: are their times of one clock?"
        )
    _say(times_s, found, shared, min(intervals, default=np.inf))
    return found


def _groups(names: Sequence[str], times: Sequence[Array], within_s: float) -> list[dict[str, int]]:
    at = [0] * len(names)
    found = []
    while any(i < len(t) for i, t in zip(at, times, strict=True)):
        first = min(float(t[i]) for i, t in zip(at, times, strict=True) if i < len(t))
        moment = {}
        for k, (name, own) in enumerate(zip(names, times, strict=True)):
            if at[k] < len(own) and own[at[k]] - first <= within_s:
                moment[name] = at[k]
                at[k] += 1
        found.append(moment)
    return found


def _say(
    times_s: Mapping[str, Array],
    found: Sequence[Mapping[str, int]],
    shared: Sequence[Mapping[str, int]],
    interval_s: float,
) -> None:
    """Warn of pictures without partners, and of pairs that are far apart."""
    alone = {name: sum(len(m) == 1 and name in m for m in found) for name in times_s}
    if any(alone.values()):
        counts = ", ".join(f"{count} of {name}" for name, count in alone.items() if count)
        warn(f"pictures without one of another camera at the same moment: {counts}")
    apart = [np.ptp([times_s[name][i] for name, i in m.items()]) for m in shared]
    worst = float(np.median(apart))
    if worst > _WORST_SHARE * interval_s:
        warn(
            f"pictures of one moment are {1e3 * worst:.3g} ms apart in the median, and pictures of "
            f"one camera {1e3 * interval_s:.3g} ms: a rig counts them as taken at once"
        )


_EPOCH = re.compile(r"(?<!\d)(1\d{9})(?:\.(\d{1,9})|_(\d{9})|(\d{3}|\d{6}|\d{9}))?(?!\d)")
"""Seconds since 1970 after September 2001, with or without a fraction, as robots write them."""
_DATE = re.compile(
    r"(?<!\d)(20\d\d)-?(\d\d)-?(\d\d)[T_ -]?(\d\d)[-:_]?(\d\d)[-:_]?(\d\d)"
    r"(?:\.(\d{1,9})|_?(\d{6})|(\d{3}))?(?!\d)"
)
"""A date and a time of day. Fewer digits behind a dash are a counter, not a fraction."""
_MIN_PAIRED = 0.5
"""Share of the pictures of the camera with fewest that times must pair."""
_WHOLE_SECONDS_S = 4.0
"""Times in whole seconds tell pictures apart that are this far from each other."""


@dataclass(frozen=True, kw_only=True)
class PairedPictures:
    """Pictures by moment."""

    stations: tuple[Mapping[str, Path], ...]
    """Picture of each camera, by moment."""
    time_s: Mapping[Path, float] = field(default_factory=dict)
    """When pictures were taken by the trigger log or the bag, on its clock."""


def pair_by_time(
    sides: Mapping[str, Sequence[Path]], triggers: Path | None, zone: tzinfo
) -> PairedPictures:
    """Group the pictures of cameras by moment.

    Args:
        sides: pictures of each camera, in the order of their names.
        triggers: CSV with `time_s` or `time_utc` and `image` or `number`, and `camera` where
            cameras are triggered apart.
        zone: of its dates that name none.

    Raises:
        ImageError: the trigger log is wrong or holds none of the pictures, or pictures do not pair.
    """
    if triggers is not None:
        logged = _trigger_times(triggers, sides, zone)
        known = {
            side: sorted((p for p in paths if p in logged), key=logged.__getitem__)
            for side, paths in sides.items()
        }
        moments = moments_of(
            {side: np.array([logged[p] for p in paths]) for side, paths in known.items() if paths}
        )
        found = [{side: known[side][i] for side, i in moment.items()} for moment in moments]
        return PairedPictures(stations=tuple(found), time_s=logged)
    if len(sides) <= 1:
        return PairedPictures(stations=tuple({s: p} for s, paths in sides.items() for p in paths))
    return PairedPictures(stations=tuple(_pair_by_times(sides) or _pair_by_numbers(sides)))


def _pair_by_times(sides: Mapping[str, Sequence[Path]]) -> list[dict[str, Path]] | None:
    """Moments by names or EXIF; None where these give no times, or not of one clock."""
    for source, read in (("their names", _time_in_name), ("EXIF", _time_in_exif)):
        known = {side: [read(p) for p in paths] for side, paths in sides.items()}
        if any(t is None for times in known.values() for t in times):
            continue
        times = {side: np.array(own, dtype=np.float64) for side, own in known.items()}
        orders = {side: np.argsort(own, kind="stable") for side, own in times.items()}
        times = {side: own[orders[side]] for side, own in times.items()}
        if not _distinct(times):
            continue
        try:
            moments = moments_of(times)
        except ImageError:
            moments = []
        minimum = min(len(own) for own in times.values())
        if sum(len(moment) > 1 for moment in moments) < _MIN_PAIRED * minimum:
            warn(
                f"times in {source} are not of one clock: pictures are paired by numbers or order, "
                "by which a picture that a camera dropped can shift the pairs after it; a trigger "
                "log (--triggers) pairs them by time"
            )
            continue
        return [
            {side: sides[side][orders[side][i]] for side, i in moment.items()} for moment in moments
        ]
    return None


def _distinct(times: Mapping[str, Array]) -> bool:
    """Whether times are fine enough to tell one picture of a camera from the next."""
    steps = [np.diff(own) for own in times.values() if len(own) > 1]
    if not steps or any((own <= 0).any() for own in steps):
        return False
    if any((own % 1.0).any() for own in times.values()):
        return True
    return min(float(np.median(own)) for own in steps) >= _WHOLE_SECONDS_S


def _pair_by_numbers(sides: Mapping[str, Sequence[Path]]) -> list[Mapping[str, Path]]:
    """Moments by numbers in names, else by order."""
    try:
        sets = pair_pictures(sides)
    except CalibrationError as error:
        raise ImageError(f"{error}; or give a trigger log with --triggers") from None
    whole = [len(one.paths) == len(sides) for one in sets]
    paired = [k for k, all_there in enumerate(whole) if all_there]
    if paired and not all(whole) and all(whole[: paired[-1] + 1]):
        rest = [path.name for one in sets[paired[-1] + 1 :] for path in one.paths.values()]
        warn(
            f"only the last pictures have no partner ({list_names(rest)}): a camera that counts "
            "its own pictures and dropped one shifts the pairs after it; a trigger log "
            "(--triggers) pairs by time"
        )
    return [one.paths for one in sets]


def _time_in_name(path: Path) -> float | None:
    """Seconds since 1970 by the name of a file; None where it holds no moment."""
    stamp = _EPOCH.search(path.stem)
    if stamp is not None:
        return float(f"{stamp[1]}.{stamp[2] or stamp[3] or stamp[4] or 0}")
    date = _DATE.search(path.stem)
    if date is None:
        return None
    try:
        whole = datetime(*(int(part) for part in date.groups()[:6]), tzinfo=UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return None
    return whole.timestamp() + float(f"0.{date[7] or date[8] or date[9] or 0}")


def _time_in_exif(path: Path) -> float | None:
    taken = time_taken(path)
    return None if taken is None else to_utc(taken, UTC).timestamp()


def _trigger_times(
    triggers: Path, sides: Mapping[str, Sequence[Path]], zone: tzinfo
) -> dict[Path, float]:
    """Times of the pictures that a trigger log holds; the others are named in a warning."""
    columns, rows = read_csv(triggers, exact=True, fault=ImageError)
    when = next((name for name in ("time_s", "time_utc") if name in columns), None)
    which = next((name for name in ("image", "number") if name in columns), None)
    if when is None or which is None:
        raise ImageError(
            f"{triggers}: has {as_line(', '.join(columns))}: a trigger log needs the columns image "
            "(or number) and time_s (or time_utc), and camera where cameras are triggered apart"
        )
    logged: dict[tuple[str, str], float] = {}
    for line, row in rows:
        key = row.get("camera", "").strip(), _key(row[which], which)
        time_s = _moment(row[when].strip(), when, zone)
        if not np.isfinite(time_s) or not key[1]:
            raise ImageError(
                f"{triggers} line {line}: {as_line(str(row))} states no picture or time"
            )
        if logged.setdefault(key, time_s) != time_s:
            raise ImageError(
                f"{triggers} line {line}: {which} {as_line(row[which])} has two times; a column "
                "camera tells those of several cameras apart"
            )
    found, lost = {}, []
    for side, paths in sides.items():
        taken: dict[float, Path] = {}
        for path in paths:
            digits = re.findall(r"\d+", path.stem)
            own = _key(path.name, which) if which == "image" else digits and _key(digits[-1], which)
            time = logged.get((side, own or ""), logged.get(("", own or "")))
            if time is None:
                lost.append(path.name)
                continue
            other = taken.setdefault(time, path)
            if other != path:
                raise ImageError(
                    f"{triggers}: {other.name} and {path.name} of {side} have the same time: give "
                    "pictures by name, in a column image"
                )
            found[path] = time
    if not found:
        raise ImageError(
            f"{triggers}: holds none of the pictures, such as {list_names(lost, 2)}; its first is "
            f"{as_line(rows[0][1][which]) if rows else 'missing'}"
        )
    if lost:
        warn(f"{len(lost)} pictures are not in {triggers} and are left out: {list_names(lost)}")
    return found


def _key(text: str, which: str) -> str:
    """How a picture is found: by its name without folder and suffix, or by its number."""
    if which == "image":
        return Path(text.strip().replace("\\", "/")).stem.lower()
    return text.strip().lstrip("0") or "0" if text.strip().isdecimal() else ""


def _moment(text: str, column: str, zone: tzinfo) -> float:
    if column == "time_s":
        return finite_number(text)
    try:
        return utc_date(text, zone).timestamp()
    except ValueError:
        return float("nan")


_IMAGE, _COMPRESSED = "Image", "CompressedImage"
_MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png"}
"""How files begin that a CompressedImage may hold, and their suffixes."""
_BAYER = {
    "bayer_rggb": cv2.COLOR_BayerRGGB2BGR, "bayer_bggr": cv2.COLOR_BayerBGGR2BGR,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2BGR, "bayer_grbg": cv2.COLOR_BayerGRBG2BGR,
}  # fmt: skip
_PLAIN: Mapping[str, tuple[int, int | None]] = {
    "mono": (1, None), "bgr": (3, None), "rgb": (3, cv2.COLOR_RGB2BGR),
    "bgra": (4, cv2.COLOR_BGRA2BGR), "rgba": (4, cv2.COLOR_RGBA2BGR),
    **{name: (1, code) for name, code in _BAYER.items()},
}  # fmt: skip
"""Channels of encodings without their number of bits, and how they become BGR."""
_OPENCV = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC1": "mono16", "16UC3": "bgr16"}
_YUV = {"yuv422": cv2.COLOR_YUV2BGR_UYVY, "uyvy": cv2.COLOR_YUV2BGR_UYVY,
        "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2, "yuyv": cv2.COLOR_YUV2BGR_YUY2}  # fmt: skip


def take_bag(
    bag: Path, topics: Mapping[str, str], mono: str, folder: Path, every_s: float | None
) -> PairedPictures:
    """Write the pictures of a bag to files, as they are or as PNG.

    Args:
        bag: a ROS 1 file, a ROS 2 folder, or the .mcap or .db3 of one.
        topics: by camera; empty for the one topic of pictures, or for those of a left and a right.
        mono: name of the camera of a single topic.
        folder: for the files.
        every_s: seconds between moments at least; None for all.

    Raises:
        ImageError: the bag has no such topic or no pictures, or those of cameras do not pair.
        NavigationError: it is no bag, or damaged.
    """
    lost: Counter[str] = Counter()
    with opened_bag(bag) as reader:
        cameras = _cameras(bag, reader, topics, mono)
        times = _times(reader, cameras, lost)
        if not any(times.values()):
            raise ImageError(f"{bag}: no pictures in {', '.join(cameras)}")
        moments = moments_of({c: 1e-9 * np.array(own) for c, own in times.items() if own})
        starts = 1e-9 * np.array([min(times[c][i] for c, i in m.items()) for m in moments])
        kept = [moments[k] for k in _thin(starts, every_s)]
        requested = {(c, times[c][i]) for moment in kept for c, i in moment.items()}
        files: dict[tuple[str, int], Path] = {}
        for camera, time_ns, topic, message in _messages(reader, cameras, "pictures of the bag"):
            if (camera, time_ns) in requested and (camera, time_ns) not in files:
                stem = folder / safe_name(camera) / f"{time_ns // 10**9}_{time_ns % 10**9:09d}"
                path = _write(stem, message, lost, topic)
                if path is not None:
                    files[camera, time_ns] = path
    for reason, count in sorted(lost.items()):
        warn(f"{bag}: {count} {reason}")
    if not files:
        raise ImageError(f"{bag}: no picture could be taken")
    stations = [
        {c: files[c, times[c][i]] for c, i in moment.items() if (c, times[c][i]) in files}
        for moment in kept
    ]
    return PairedPictures(
        stations=tuple(station for station in stations if station),
        time_s={path: 1e-9 * time_ns for (_, time_ns), path in files.items()},
    )


def _cameras(
    bag: Path, reader: "AnyReader", topics: Mapping[str, str], mono: str
) -> dict[str, str]:
    """Camera of each topic."""
    kinds = {c.topic: c.msgtype.split("/")[-1] for c in reader.connections}
    present = sorted(t for t, kind in kinds.items() if kind in (_IMAGE, _COMPRESSED))
    chosen = dict(topics) or _choose(bag, present, mono)
    for camera, topic in chosen.items():
        if topic not in present:
            raise ImageError(
                f"{bag}: {camera}: no pictures in {as_line(topic)}; it has "
                f"{', '.join(present) or 'none at all'}"
            )
    if len(set(chosen.values())) < len(chosen):
        raise ImageError(f"{bag}: one topic is given to two cameras")
    return {topic: camera for camera, topic in chosen.items()}


def _messages(
    reader: "AnyReader", cameras: Mapping[str, str], label: str
) -> Iterator[tuple[str, int, str, Any]]:
    """Camera, time (ns; of the recording where the header has none), topic and message of each."""
    connections = [c for c in reader.connections if c.topic in cameras]
    total = sum(c.msgcount for c in connections)
    for connection, recorded_ns, raw in progress(reader.messages(connections), label, total):
        message: Any = reader.deserialize(raw, connection.msgtype)
        stamp = message.header.stamp
        time_ns = stamp.sec * 10**9 + stamp.nanosec or recorded_ns
        yield cameras[connection.topic], time_ns, connection.topic, message


def _times(
    reader: "AnyReader", cameras: Mapping[str, str], lost: Counter[str]
) -> dict[str, list[int]]:
    """Increasing times, ns, of the pictures of each camera."""
    times: dict[str, list[int]] = {camera: [] for camera in cameras.values()}
    for camera, time_ns, topic, message in _messages(reader, cameras, "times of pictures"):
        stamp = message.header.stamp
        if not (stamp.sec or stamp.nanosec):
            lost[f"{topic}: pictures with the time of their recording"] += 1
        if times[camera] and time_ns <= times[camera][-1]:
            lost[f"{topic}: pictures left out whose time repeats or goes back"] += 1
            continue
        times[camera].append(time_ns)
    return times


def _choose(bag: Path, present: Sequence[str], mono: str) -> dict[str, str]:
    """Topics by camera where none are named."""
    if len(present) == 1:
        return {mono: present[0]}
    sides = {side: [t for t in present if side in t.lower()] for side in ("left", "right")}
    if len(present) == 2 and all(len(found) == 1 for found in sides.values()):
        return {side: found[0] for side, found in sides.items()}
    if not present:
        raise ImageError(f"{bag}: holds no topic of Image or CompressedImage")
    raise ImageError(f"{bag}: choose its topics with --camera NAME=TOPIC: {', '.join(present)}")


def _thin(start_s: Array, every_s: float | None) -> list[int]:
    """Moments that are at least an interval apart."""
    if every_s is None:
        return list(range(len(start_s)))
    kept: list[int] = []
    for k, time in enumerate(start_s.tolist()):
        if not kept or time - start_s[kept[-1]] >= every_s - 1e-6:
            kept.append(k)
    return kept


def _write(stem: Path, message: Any, lost: Counter[str], topic: str) -> Path | None:
    """A picture as a file; None, counted, where it cannot be one."""
    data = bytes(message.data)
    suffix = ".png"
    if not hasattr(message, "encoding"):  # a CompressedImage
        suffix = next((s for magic, s in _MAGIC.items() if data.startswith(magic)), "")
        if not suffix:
            lost[f"{topic}: pictures left out whose format is {as_line(message.format)!r}"] += 1
            return None
    else:
        try:
            pixels = pixels_of(message)
        except ValueError as error:
            lost[f"{topic}: pictures left out: {error}"] += 1
            return None
        data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    path = stem.with_name(stem.name + suffix)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        path.write_bytes(data)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def pixels_of(message: Any) -> NDArray[Any]:
    """Pixels of a sensor_msgs/Image: (H, W) or (H, W, 3) BGR of 8 or 16 bits.

    Raises:
        ValueError: its encoding is not known, or it has fewer bytes than it states.
    """
    encoding = _OPENCV.get(message.encoding, message.encoding.lower())
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    if encoding in _YUV:
        packed = _table(message, rows, columns * 2, step, np.dtype(np.uint8))
        return np.asarray(cv2.cvtColor(packed.reshape(rows, columns, 2), _YUV[encoding]))
    name = encoding.rstrip("0123456789")
    bits = encoding.removeprefix(name)
    if name not in _PLAIN or bits not in ("8", "16"):
        raise ValueError(f"encoding {as_line(message.encoding)!r} is not known")
    channels, code = _PLAIN[name]
    order = ">" if message.is_bigendian else "<"
    kind = np.dtype(f"{order}u{int(bits) // 8}")
    table = _table(message, rows, columns * channels, step, kind).astype(kind.newbyteorder("="))
    pixels = table if channels == 1 else table.reshape(rows, columns, channels)
    return np.asarray(pixels if code is None else cv2.cvtColor(pixels, code))


def _table(message: Any, rows: int, values: int, step: int, kind: np.dtype[Any]) -> NDArray[Any]:
    """Values (rows, values) of lines that may be padded to `step` bytes."""
    width = values * kind.itemsize
    data = np.frombuffer(bytes(message.data), np.uint8)
    if rows <= 0 or values <= 0 or step < width or len(data) < rows * step - (step - width):
        raise ValueError("they have fewer bytes than they state")
    padded = np.zeros(rows * step, np.uint8)
    padded[: len(data)] = data[: rows * step]
    lines = np.ascontiguousarray(padded.reshape(rows, step)[:, :width])
    return lines.view(kind)
