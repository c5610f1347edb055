"""Pictures out of bags of ROS 1 and ROS 2: `Image` and `CompressedImage`, with their times."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.contents import as_line
from alice_survey.core.errors import ImageError, warn
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array
from missions.logs.bag_reader import opened_bag
from reconstruct.pictures.files import safe_name
from reconstruct.pictures.pairing import PairedPictures, moments_of

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

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
