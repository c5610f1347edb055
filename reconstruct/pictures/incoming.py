"""Pictures on their way into a workspace: paired, checked, named, masked, copied, timed, located.

Which pictures of several cameras, in folders or in bags, are of one moment: times are those of a
trigger log, else moments in the names of files, else EXIF's. Without them numbers in the names say
which pictures belong together (`pair_pictures`). Bags of ROS 1 and ROS 2 hold `Image` and
`CompressedImage`, with their times.
"""

import hashlib
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import read_csv
from alice_survey.core.contents import as_line
from alice_survey.core.errors import CalibrationError, ImageError, NavigationError, note, warn
from alice_survey.core.executor import Executor, progress
from alice_survey.core.frames import Array, distances_m
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import PlaceRecord
from alice_survey.kit.words import count
from camera_calib.calibrate.picture_sets import pair_pictures
from camera_calib.picture_files import time_taken
from camera_calib.rig import Rig
from missions.logs.dive import finite_number
from missions.logs.navigation_csv import (
    DATED_AFTER_S,
    READINGS,
    NavigationLog,
    utc_date,
    warn_of_gaps,
)
from missions.logs.ros_bag import opened_bag
from missions.values.navigation import TRIGGER_LOG
from reconstruct.pictures import files
from reconstruct.pictures.undistorted import read_mask

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
    interval_s = min(intervals, default=np.inf)
    within_s = _WITHIN_SHARE * min(intervals, default=0.0)
    found: list[dict[str, int]] = []
    start = -np.inf
    order = sorted((float(t), name, n) for name, own in times_s.items() for n, t in enumerate(own))
    for time, name, n in order:
        if time - start > within_s or name in found[-1]:
            found.append({})
            start = time
        found[-1][name] = n
    if len(times_s) < 2:
        return found
    apart = [np.ptp([times_s[c][i] for c, i in m.items()]) for m in found if len(m) > 1]
    if not apart:
        raise ImageError(
            f"no pictures of {' and '.join(times_s)} are within {1e3 * within_s:.3g} ms of each "
            "other: are their times of one clock?"
        )
    alone = Counter(next(iter(moment)) for moment in found if len(moment) == 1)
    if alone:
        counts = ", ".join(f"{alone[name]} of {name}" for name in times_s if alone[name])
        warn(f"pictures without one of another camera at the same moment: {counts}")
    if np.median(apart) > _WORST_SHARE * interval_s:
        warn(
            f"pictures of one moment are {1e3 * np.median(apart):.3g} ms apart in the median, and "
            f"pictures of one camera {1e3 * interval_s:.3g} ms: a rig counts them as taken at once"
        )
    return found


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


PairedPictures = tuple[Sequence[Mapping[str, Path]], Mapping[Path, float]]
"""Picture of each camera, by moment; and when pictures were taken by the trigger log or the bag, on
its clock."""


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
        return [{side: known[side][i] for side, i in moment.items()} for moment in moments], logged
    if len(sides) <= 1:
        return [{side: path} for side, paths in sides.items() for path in paths], {}
    return _pair_by_times(sides) or _pair_by_numbers(sides), {}


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
            f"only the last pictures have no partner ({files.list_names(rest)}): a camera that "
            "counts its own pictures and dropped one shifts the pairs after it; a trigger log "
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
    return None if taken is None else files.to_utc(taken, UTC).timestamp()


def _trigger_times(
    triggers: Path, sides: Mapping[str, Sequence[Path]], zone: tzinfo
) -> dict[Path, float]:
    """Times of the pictures that a trigger log holds; the others are named in a warning."""
    columns, rows = read_csv(triggers, exact=True, known=TRIGGER_LOG, fault=ImageError)
    when = next((name for name in ("time_s", "time_utc") if name in columns), None)
    which = next((name for name in ("image", "number", "station") if name in columns), None)
    if when is None or which is None:
        raise ImageError(
            f"{triggers}: has {as_line(', '.join(columns))}: a trigger log needs the columns image "
            "(or number) and time_s (or time_utc), and camera where cameras are triggered apart"
        )
    logged: dict[tuple[str, str], float] = {}
    for line, row in rows:
        key = row.get("camera", "").strip(), _key(row[which], which)
        try:
            text = row[when].strip()
            time_s = finite_number(text) if when == "time_s" else utc_date(text, zone).timestamp()
        except ValueError:
            time_s = np.nan
        if not np.isfinite(time_s) or not key[1] or logged.setdefault(key, time_s) != time_s:
            raise ImageError(
                f"{triggers} line {line}: {as_line(str(row))} states no picture or time, or a "
                "second time; a column camera distinguishes pictures of several cameras"
            )
    found: dict[Path, float] = {}
    for side, paths in sides.items():
        for path in paths:
            digits = re.findall(r"\d+", path.stem)
            text = path.name if which == "image" else next(iter(digits[-1:]), "")
            own = _key(text, which)
            time = logged.get((side, own), logged.get(("", own)))
            if time is not None:
                found[path] = time
        times = [found[path] for path in paths if path in found]
        if len(set(times)) < len(times):
            raise ImageError(
                f"{triggers}: two pictures of {side} have the same time: give pictures by name, in "
                "a column image"
            )
    lost = [path.name for paths in sides.values() for path in paths if path not in found]
    if not found:
        raise ImageError(f"{triggers}: holds none of the pictures, such as {lost[0]}")
    if lost:
        names = f"{count(len(lost), 'picture')}: {files.list_names(lost)}"
        warn(f"not in {triggers}, and left out: {names}")
    return found


def _key(text: str, which: str) -> str:
    """How a picture is found: by its name without folder and suffix, or by its number."""
    if which == "image":
        return Path(text.strip().replace("\\", "/")).stem.lower()
    return text.strip().lstrip("0") or "0" if text.strip().isdecimal() else ""


_MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png"}
"""How files begin that a CompressedImage may hold, and their suffixes."""
_CHANNELS: Mapping[str, tuple[int, int | None]] = {
    "mono": (1, None), "bgr": (3, None), "rgb": (3, cv2.COLOR_RGB2BGR),
    "bgra": (4, cv2.COLOR_BGRA2BGR), "rgba": (4, cv2.COLOR_RGBA2BGR),
    "bayer_rggb": (1, cv2.COLOR_BayerRGGB2BGR), "bayer_bggr": (1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg": (1, cv2.COLOR_BayerGBRG2BGR), "bayer_grbg": (1, cv2.COLOR_BayerGRBG2BGR),
}  # fmt: skip
"""Channels of encodings without their number of bits, and how they become BGR."""
_OPENCV = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC1": "mono16", "16UC3": "bgr16"}


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
    written: dict[tuple[str, int], Path] = {}
    with opened_bag(bag) as reader:
        cameras = _cameras(bag, reader, topics, mono)
        times: dict[str, list[int]] = {camera: [] for camera in cameras.values()}
        for camera, time_ns, _ in _messages(reader, cameras, "times of pictures"):
            if times[camera] and time_ns <= times[camera][-1]:
                lost[f"pictures of {camera} are left out: their times repeat or go back"] += 1
            else:
                times[camera].append(time_ns)
        if not any(times.values()):
            raise ImageError(f"{bag}: no pictures in {', '.join(cameras)}")
        moments, last_s = [], -np.inf
        for moment in moments_of({c: 1e-9 * np.array(own) for c, own in times.items() if own}):
            start_s = 1e-9 * min(times[c][i] for c, i in moment.items())
            if every_s is None or start_s - last_s >= every_s - 1e-6:
                moments.append({c: (c, times[c][i]) for c, i in moment.items()})
                last_s = start_s
        requested = {key for moment in moments for key in moment.values()}
        for camera, time_ns, message in _messages(reader, cameras, "pictures of the bag"):
            key = camera, time_ns
            if key in requested and key not in written:
                try:
                    suffix, data = _content(message)
                except ValueError as error:
                    lost[f"pictures of {camera} are left out: {error}"] += 1
                    continue
                stem = f"{time_ns // 10**9}_{time_ns % 10**9:09d}"
                written[key] = folder / files.safe_name(camera) / f"{stem}{suffix}"
                written[key].parent.mkdir(parents=True, exist_ok=True)
                written[key].write_bytes(data)
    for reason, number in sorted(lost.items()):
        warn(f"{bag}: {number} {reason}")
    if not written:
        raise ImageError(f"{bag}: no picture could be taken")
    stations = [{c: written[key] for c, key in m.items() if key in written} for m in moments]
    times_s = {path: 1e-9 * time_ns for (_, time_ns), path in written.items()}
    return [station for station in stations if station], times_s


def _cameras(
    bag: Path, reader: "AnyReader", topics: Mapping[str, str], mono: str
) -> dict[str, str]:
    """Camera of each topic; where none are named, that of the only one, or of left and right."""
    kinds = {c.topic: c.msgtype.split("/")[-1] for c in reader.connections}
    present = sorted(t for t, kind in kinds.items() if kind in ("Image", "CompressedImage"))
    sides = {side: [t for t in present if side in t.lower()] for side in ("left", "right")}
    chosen = dict(topics)
    if not topics and len(present) == 1:
        chosen = {mono: present[0]}
    elif not topics and len(present) == 2 and all(len(one) == 1 for one in sides.values()):
        chosen = {side: one[0] for side, one in sides.items()}
    if not present:
        raise ImageError(f"{bag}: holds no topic of Image or CompressedImage")
    if not chosen or not set(chosen.values()) <= set(present) or (
        len(set(chosen.values())) < len(chosen)
    ):  # fmt: skip
        raise ImageError(
            f"{bag}: choose its topics with --camera NAME=TOPIC, one for each camera: "
            f"{', '.join(present)}"
        )
    return {topic: camera for camera, topic in chosen.items()}


def _messages(
    reader: "AnyReader", cameras: Mapping[str, str], label: str
) -> Iterator[tuple[str, int, Any]]:
    """Camera, time (ns; of the recording where the header has none) and message of each."""
    connections = [c for c in reader.connections if c.topic in cameras]
    total = sum(c.msgcount for c in connections)
    for connection, recorded_ns, raw in progress(reader.messages(connections), label, total):
        message: Any = reader.deserialize(raw, connection.msgtype)
        stamp = message.header.stamp
        time_ns = stamp.sec * 10**9 + stamp.nanosec or recorded_ns
        yield cameras[connection.topic], time_ns, message


def _content(message: Any) -> tuple[str, bytes]:
    """Suffix and bytes of a picture's file.

    Raises:
        ValueError: the message holds none that can be read.
    """
    if hasattr(message, "encoding"):
        png = cv2.imencode(".png", pixels_of(message), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        return ".png", png.tobytes()
    data = bytes(message.data)
    for magic, suffix in _MAGIC.items():
        if data.startswith(magic):
            return suffix, data
    raise ValueError(f"format {as_line(message.format)!r} is not known")


def pixels_of(message: Any) -> NDArray[Any]:
    """Pixels of a sensor_msgs/Image: (H, W) or (H, W, 3) BGR of 8 or 16 bits.

    Raises:
        ValueError: its encoding is not known, or it has fewer bytes than it states.
    """
    encoding = _OPENCV.get(message.encoding, message.encoding.lower())
    name = encoding.rstrip("0123456789")
    bits = encoding.removeprefix(name)
    if name not in _CHANNELS or bits not in ("8", "16"):
        raise ValueError(f"encoding {as_line(message.encoding)!r} is not known")
    channels, code = _CHANNELS[name]
    kind = np.dtype(f"{'>' if message.is_bigendian else '<'}u{int(bits) // 8}")
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    width = columns * channels * kind.itemsize
    data = np.frombuffer(bytes(message.data), np.uint8)
    if rows <= 0 or columns <= 0 or step < width or len(data) < rows * step - (step - width):
        raise ValueError("they have fewer bytes than they state")
    padded = np.zeros(rows * step, np.uint8)  # the last line may end at its last pixel
    padded[: len(data)] = data[: rows * step]
    lines = np.ascontiguousarray(padded.reshape(rows, step)[:, :width]).view(kind)
    shape = (rows, columns) if channels == 1 else (rows, columns, channels)
    pixels = lines.astype(kind.newbyteorder("=")).reshape(shape)
    return np.asarray(pixels if code is None else cv2.cvtColor(pixels, code))


UNDECODABLE = "cannot be decoded"
MIRRORED = "mirror images"
SIDES = ("left", "right")
COPIES = "copies of others"
SHOTS = "other files of a shot"


@dataclass(frozen=True, kw_only=True)
class Incoming:
    """One picture to import."""

    source: Path
    camera: str
    station: int
    facts: files.PictureFacts
    image: str = ""
    mask: Path | None = None
    video_time_s: float | None = None
    """Of a frame, since the start of the first recording; NaN where that is unknown."""
    recording: str = ""
    """Name of the recording that a frame is of."""
    side: str = ""
    """Where the file is cut for it, see `half_of`."""

    @property
    def file_px(self) -> tuple[int, int]:
        """Width and height of the file."""
        return self.facts.width_px * (2 if self.side else 1), self.facts.height_px


def halves(entry: Incoming) -> list[Incoming]:
    """The left and the right picture of a file that holds both side by side."""
    facts = replace(entry.facts, width_px=entry.facts.width_px // 2)
    return [replace(entry, camera=side, side=side, facts=facts) for side in SIDES]


def find_entries(
    paired: PairedPictures, shots: Mapping[Path, Sequence[Path]], executor: Executor
) -> tuple[list[Incoming], dict[str, list[str]]]:
    """Pictures of all stations that can be used; the others are named in warnings.

    Args:
        paired: pictures by moment, and times of them.
        shots: other files of the same shot, in the order in which they stand in for a picture.
        executor: where tasks run.

    Returns:
        Those that can be used, and names of the others by reason.
    """
    stations, taken = paired
    listed = [
        (camera, station, [path, *shots.get(path, ())])
        for station, paths in enumerate(stations)
        for camera, path in paths.items()
    ]
    owners = {path: camera for camera, _, shot in listed for path in shot}
    copies = same_bytes([*owners])
    for copy, first in copies.items():
        if owners[copy] != owners[first]:
            raise ImageError(
                f"{owners[first]} and {owners[copy]} have the same picture, {first} and {copy}: "
                "give each camera the pictures that it took"
            )
    listed = [one for one in listed if one[2][0] not in copies]
    every = [shot for _, _, shot in listed]
    facts = executor.map(files.inspect_shot, every, label="checking pictures")
    entries = []
    left_out = {COPIES: [copy.name for copy in copies], MIRRORED: [], UNDECODABLE: [], SHOTS: []}
    for (camera, station, shot), tried in zip(listed, facts, strict=True):
        left_out[SHOTS] += [path.name for path in shot[len(tried) :] if path not in copies]
        for known in tried:
            if known.fault:
                warn(f"{known.path} is left out: {known.fault}")
                reason = MIRRORED if known.width_px else UNDECODABLE
                left_out[reason].append(known.path.name)
                continue
            entry = Incoming(source=known.path, camera=camera, station=station, facts=known)
            entries.append(with_time(entry, taken[shot[0]]) if taken else entry)
    return entries, left_out


def same_bytes(paths: Sequence[Path]) -> dict[Path, Path]:
    """Files that are copies, each with the one of the shortest name of those of the same bytes."""
    sizes = {path: path.stat().st_size if path.is_file() else 0 for path in paths}
    often = Counter(sizes.values())
    first: dict[bytes, Path] = {}
    copies = {}
    for path in sorted(paths, key=lambda p: len(p.name)):
        if sizes[path] == 0 or often[sizes[path]] == 1:
            continue
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").digest()
        other = first.setdefault(digest, path)
        if other != path:
            copies[path] = other
    return copies


def with_time(entry: Incoming, time_s: float) -> Incoming:
    """A picture with the time of its message: a date, or seconds of a clock without dates."""
    if time_s < DATED_AFTER_S:
        return replace(entry, video_time_s=time_s)
    date = datetime.fromtimestamp(time_s, UTC)
    return replace(entry, facts=replace(entry.facts, time_local=date))


def camera_names(
    facts: Sequence[files.PictureFacts], name: str
) -> list[tuple[str, tuple[str, int, int], int]]:
    """Name, key and pictures of the cameras, as far as EXIF and sizes distinguish them.

    The camera of most pictures has the name that is given; the next ones a number more.
    """
    counts = Counter(one.key for one in facts).most_common()
    return [
        (name if number == 1 else f"{name}-{number}", key, count)
        for number, (key, count) in enumerate(counts, 1)
    ]


def check_entries(entries: Sequence[Incoming], rig: Rig | None) -> None:
    """Check that pictures are enough, of one size by camera, and of the size that the rig says."""
    first = {entry.camera: entry for entry in reversed(entries)}
    if len({entry.station for entry in entries}) < 2 and (rig is None or len(first) < 2):
        count = len(entries)
        raise ImageError(
            f"{count} usable picture{'s' * (count != 1)}: a model needs pictures from 2 or more "
            "places that overlap, or a stereo pair with its rig"
        )
    for entry in entries:
        facts, one = entry.facts, first[entry.camera].facts
        if (facts.width_px, facts.height_px) != (one.width_px, one.height_px):
            raise ImageError(
                f"{entry.source} has {facts.width_px} x {facts.height_px} pixels, but "
                f"{one.path.name} of the same camera has {one.width_px} x {one.height_px}: import "
                "pictures of one size only"
            )
    for name in first:
        lenses = {e.facts.device or "one without EXIF" for e in entries if e.camera == name}
        if len(lenses) > 1:
            warn(f"pictures of {name}, which has one lens, are of {len(lenses)} cameras or zooms: "
                 f"{files.list_names(sorted(lenses), 3)}")  # fmt: skip
    if rig is not None:
        check_rig({n: (e.facts.width_px, e.facts.height_px) for n, e in first.items()}, rig)


def check_rig(sizes: Mapping[str, tuple[int, int]], rig: Rig) -> None:
    """Check that a rig is of these cameras, by their widths and heights (0 where unknown)."""
    for name, (width, height) in sizes.items():
        if name not in rig.cameras:
            raise ImageError(
                f"the rig has no camera {name!r}, only {', '.join(rig.cameras)}: call the folders "
                "as the rig does"
            )
        model = rig.cameras[name]
        if width and (width, height) != (model.width_px, model.height_px):
            others = ", ".join(other for other in rig.cameras if other != name)
            raise ImageError(
                f"pictures of {name} have {width} x {height} pixels, but the rig's camera {name} "
                f"has {model.width_px} x {model.height_px}"
                + (f": --camera NAME=FOLDER says if {others} took them" if others else "")
            )


def unique_names(entries: Sequence[Incoming]) -> list[Incoming]:
    """Names below `images/`: the camera's folder and a safe, unique form of the file's own name."""
    taken: set[str] = set()
    named, bits = [], _bits(entries)
    for entry in entries:
        if entry.image:
            named.append(entry)
            continue
        stem = files.safe_name(entry.source.stem)
        suffix = ".png" if entry.side else files.target_suffix(entry.source, bits[entry.camera])
        image, copy = f"{files.safe_name(entry.camera)}/{stem}{suffix}", 1
        while image.lower() in taken:
            copy += 1
            image = f"{files.safe_name(entry.camera)}/{stem}_{copy}{suffix}"
        taken.add(image.lower())
        named.append(replace(entry, image=image))
    return named


def _bits(entries: Sequence[Incoming]) -> dict[str, int]:
    """Bits that the pictures of each camera use."""
    highest: dict[str, int] = {}
    for entry in entries:
        highest[entry.camera] = max(entry.facts.highest, highest.get(entry.camera, 0))
    return {camera: files.bits_used(value) for camera, value in sorted(highest.items())}


def with_masks(entries: Sequence[Incoming], masks: Path | None, *, stereo: bool) -> list[Incoming]:
    """Pictures with the masks in a folder of masks, or next to them; others are named.

    In a folder of masks that of `P1.JPG` may also be `P1` of any kind.
    """
    listed: dict[Path, dict[str, Path]] = {}
    found: list[Incoming] = []
    for entry in entries:
        names, folders = files.mask_names(entry.source.name), [entry.source.parent]
        if masks is not None:
            names += [f"{entry.source.stem.lower()}{end}" for end in files.ENDS]
            folders = [masks / entry.camera, *([] if stereo else [masks])]
        for folder in set(folders) - set(listed):
            inside = sorted(folder.iterdir()) if folder.is_dir() else []
            listed[folder] = {path.name.lower(): path for path in inside}
        named = (listed[folder].get(one) for folder in folders for one in names)
        mask = next((one for one in named if one is not None), None)
        if mask is not None:
            read_mask(mask, entry.file_px)
        found.append(replace(entry, mask=mask))
    if masks is not None:
        used = {entry.mask for entry in found} - {None}
        there = [path for own in listed.values() for path in own.values() if files.kind_of(path)]
        lost = [path.name for path in there if path not in used]
        if lost or not used:
            such = f" (not {files.list_names(lost, 3)})" if lost else ""
            warn(f"{masks}: {len(used)} of {len(there)} masks belong to a picture{such}: give them "
                 "the names of their pictures")  # fmt: skip
    cut_out = sum(entry.facts.cut_out and entry.side != SIDES[1] for entry in found)
    if cut_out:
        note(f"{cut_out} pictures are cut out: what their alpha leaves out is masked")
    return found


def copy_all(entries: Sequence[Incoming], partial: Path, executor: Executor) -> list[str]:
    """Copy pictures to where their names say; what was lost in it, as notes."""
    bits = _bits(entries)
    tasks = [(e.source, partial / e.image, bits[e.camera], e.side) for e in entries]
    for _ in executor.map(files.copy_picture, tasks, label="copying pictures"):
        pass
    return [
        f"pictures of camera {camera} held {count} bits; the upper 8 were kept"
        for camera, count in bits.items()
        if count > 8
    ]


def record_of(entry: Incoming, partial: Path) -> ImageRecord:
    """Row of the manifest; writes the mask of the picture."""
    mask, usable = "", None
    if entry.mask is not None:
        usable = read_mask(entry.mask, entry.file_px)
    if entry.facts.cut_out:
        opaque = files.opaque_part(files.decode(entry.source, alpha=True))
        usable = opaque if usable is None else usable & opaque
    if usable is not None:
        usable = files.half_of(usable, entry.side)
        mask = f"masks/{Path(entry.image).with_suffix('.png').as_posix()}"
        (partial / mask).parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(partial / mask), usable.astype(np.uint8) * 255):
            raise ImageError(f"{partial / mask}: cannot be written")
    return ImageRecord(image=entry.image, camera=entry.camera, station=entry.station, mask=mask)


_EXIF_SIGMA_M = (3.0, 6.0)
"""Horizontal and vertical sigma of the GPS in a picture's EXIF, which states none."""
_LOGGED_LEVEL = "sea surface, as in the navigation log"
_ABOVE_M = 0.5
"""Depths are on the wrong side of the surface beyond waves and the zero of a sensor."""


def level_of_log(name: str | None, navigation: Path | None) -> str:
    """What to call the level of logged depths; files that state it give it one line."""
    if name is None:
        return _LOGGED_LEVEL
    if navigation is None or not name.strip() or not name.isprintable():
        raise NavigationError(
            f"--vertical-datum {name!r}: give --navigation, and one line with the name of the "
            "level that its depths count from, such as 'NN2000'"
        )
    return name.strip()


def readings_of(records: Sequence[ImageRecord]) -> Counter[str]:
    """How many pictures navigation measured what of."""
    return Counter(name for r in records for name, known in r.readings.items() if known)


def place_records(
    entries: Sequence[Incoming],
    records: Sequence[ImageRecord],
    log: NavigationLog | None,
    logged_level: str,
    clock_offset_s: float,
    zone: tzinfo,
    notes: list[str],
) -> tuple[list[ImageRecord], PlaceRecord | None, str]:
    """Give records their times and positions; also the datum and the level of depths."""
    times, origin = _times(entries, log, clock_offset_s, zone)
    named = None
    if log is not None and log.row_of:
        logged_s, named = log.of_pictures([str(entry.source) for entry in entries])
        if np.isfinite(logged_s).any():
            times, origin = logged_s, ""
            if clock_offset_s:
                warn("--clock-offset is not used: the navigation log has the times of pictures")
    records = [replace(r, time_s=float(t)) for r, t in zip(records, times, strict=True)]
    if log is None:
        records, level = _with_gps(records, entries), "EXIF GPS altitude"
    else:
        if named is None and not np.isfinite(times).any():
            raise ImageError(
                "no time of a picture is known (EXIF DateTimeOriginal, a recording's start), so "
                "navigation cannot be tied: give times of pictures with --triggers; import each "
                "video into a workspace of its own with --clock-offset, then 'join' them"
            )
        if origin:
            notes.append(f"picture times count from {origin}, plus the clock offset")
        records, level = _with_navigation(records, times, log, named), logged_level
        _compare_with_exif(records, entries)
        depths = np.array([r.depth_m for r in records if r.readings["depth"]])
        if level == _LOGGED_LEVEL and len(depths) and np.median(depths) < -_ABOVE_M:
            warn(
                f"most pictures are above the sea surface, by {-np.median(depths):.1f} m: depth_m "
                "is positive down; --vertical-datum names another level that depths count from"
            )
    counted = readings_of(records)
    if not counted:
        if named is not None:
            raise ImageError(
                f"none of the pictures, such as {records[0].image}, is named in the navigation log"
            )
        if log is not None:
            raise ImageError(
                f"no picture was taken while navigation was logged: pictures from "
                f"{log.span(times)}, log from {log.span(log.time_s)}; check --clock-offset and "
                "--time-zone"
            )
        notes.append("no positions: no CRS, and unscaled unless a rig or a known length scales it")
        return records, None, "none"
    if log is None:
        notes.append("positions from EXIF GPS, of unknown accuracy")
    if any(counted[name] < len(records) for name in records[0].readings):
        counts = ", ".join(f"{name} of {counted[name]}" for name in records[0].readings)
        notes.append(f"navigation of {len(records)} pictures: {counts}")
    first = next((r for r in records if r.has_horizontal), None)
    if first is None:
        return records, None, level
    place = PlaceRecord(latitude_deg=first.latitude_deg, longitude_deg=first.longitude_deg)
    return records, place, level


_FAR_M, _FAR_SIGMAS = 100.0, 5.0


def _compare_with_exif(records: Sequence[ImageRecord], entries: Sequence[Incoming]) -> None:
    """Warn where navigation has pictures elsewhere than their own GPS, and of the usual cause."""
    facts = [entry.facts for entry in entries]
    stated = np.array([[f.latitude_deg, f.longitude_deg] for f in facts], np.float64)
    logged = np.array([[r.latitude_deg, r.longitude_deg] for r in records])
    apart_m = distances_m(logged, stated)
    if not (count := int(np.isfinite(apart_m).sum())):
        return
    apart, turned = np.nanmedian([apart_m, distances_m(logged[:, ::-1], stated)], axis=1)
    sigma_m = max([_EXIF_SIGMA_M[0], *(r.sigma_horizontal_m for r in records)])
    if apart > _FAR_M + _FAR_SIGMAS * sigma_m:
        cause = "check the log, --time-zone and --clock-offset; is EXIF's GPS of an older fix?"
        cause = "latitude and longitude exchanged?" if turned < apart / 2 else cause
        own, gps = np.nanmedian([logged, stated], axis=1).round(5).tolist()
        warn(
            f"navigation and EXIF have {count} pictures {apart / 1e3:,.2f} km apart, around {own} "
            f"and {gps}: {cause}"
        )


def _times(
    entries: Sequence[Incoming], log: NavigationLog | None, clock_offset_s: float, zone: tzinfo
) -> tuple[Array, str]:
    """Seconds of every picture on the clock of navigation (else since the first), NaN if unknown.

    Also where they count from if the clocks of pictures and log have no dates in common.
    """
    local = [entry.facts.time_local for entry in entries]
    dates = [None if time is None else files.to_utc(time, zone) for time in local]
    known = [date for date in dates if date is not None]
    log_start = None if log is None else log.start_utc
    if all(e.video_time_s is not None for e in entries) and not (log_start and known):
        times = np.array([e.video_time_s for e in entries], dtype=np.float64)
        return times + clock_offset_s, "" if log is None else "the start of the first recording"
    if not known:
        return np.full(len(entries), np.nan), ""
    start: datetime = min(known) if log_start is None else log_start
    seconds = [np.nan if d is None else (d - start).total_seconds() for d in dates]
    from_first = "the first picture" if log is not None and log_start is None else ""
    return np.array(seconds) + clock_offset_s, from_first


def _with_navigation(
    records: Sequence[ImageRecord], times: Array, log: NavigationLog, named: dict[str, Array] | None
) -> list[ImageRecord]:
    found = log.at(times) if named is None else named
    has_reading = np.any([np.isfinite(found[name]) for name in READINGS if name in found], axis=0)
    if named is None:
        warn_of_gaps([r.image for r in records], times, np.where(has_reading, 1.0, np.nan), log)
    elif not has_reading.all():
        lost = [r.image for r, known in zip(records, has_reading, strict=True) if not known]
        warn(f"navigation names {len(records) - len(lost)} of {len(records)} pictures, not "
             f"{files.list_names(lost)}")  # fmt: skip
    rows = zip(*(column.tolist() for column in found.values()), strict=True)
    return [
        replace(record, **dict(zip(found, row, strict=True))) if known else record
        for record, row, known in zip(records, rows, has_reading, strict=True)
    ]


def _with_gps(records: Sequence[ImageRecord], entries: Sequence[Incoming]) -> list[ImageRecord]:
    placed, lost = [], []
    for record, entry in zip(records, entries, strict=True):
        facts = entry.facts
        place = np.array([facts.latitude_deg, facts.longitude_deg, facts.altitude_m], np.float64)
        if np.isnan(place).any():
            lost.append(record.image)
        if not np.isnan(place).all():
            record = replace(
                record, latitude_deg=float(place[0]), longitude_deg=float(place[1]),
                depth_m=-float(place[2]), sigma_horizontal_m=_EXIF_SIGMA_M[0],
                sigma_depth_m=_EXIF_SIGMA_M[1],
            )  # fmt: skip
        placed.append(record)
    if 0 < len(lost) < len(records):
        warn(f"no complete GPS in EXIF: {count(len(lost), 'picture')}: {files.list_names(lost)}")
    return placed
