"""The border to COLMAP: its types from ours and back, and its binary files.

Files are looked at before COLMAP reads them, and read where it is slow.

COLMAP trusts the counts in these files: past the end of a file that was cut short it goes
on reading what is not there. The layout is that of COLMAP 4 (scene/reconstruction_io.cc).
"""

import errno
import mmap
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.compiled import compiled
from alice_survey.core.errors import ReconstructionError, file_faults
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import Pinhole

_PARAMS = {
    0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16, 12: 4, 13: 5,
    14: 3, 15: 4, 16: 6, 17: 2,
}  # fmt: skip
"""Numbers of parameters by COLMAP's number of a camera model."""
Content = bytes | mmap.mmap
"""Bytes of a file."""
KEYPOINT = np.dtype([("xy", "<f8", (2,)), ("point", "<i8")])
"""Place of a keypoint, and the id of its point: -1 where it has none."""
_SENSOR, _POSE = struct.calcsize("<iI"), 7 * 8
_NO_ROOM = "no room for a temporary copy of the model"
_POINT_HEAD, _TRACK_LENGTH = 32, 43
"""Bytes of a point's id and place, and where the length of its track is."""
_POINTS_AT_A_TIME = 100_000


def read_reconstruction(folder: Path) -> pycolmap.Reconstruction:
    """Read the model in a folder.

    Raises:
        ReconstructionError: a file is missing, cut short or damaged.
    """
    for name, length in _LENGTHS.items():
        _check(folder / name, length)
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, IndexError, KeyError, TypeError, MemoryError) as error:
        text = " ".join(str(error).split()).replace(str(folder), folder.name)[:200]
        raise ReconstructionError(
            f"{folder}: COLMAP cannot read the model ({text}): remove the folder's stage and run "
            "'alice-survey reconstruct' again"
        ) from None


def colmap_pinhole(pinhole: Pinhole) -> pycolmap.Camera:
    """A pinhole as COLMAP's camera."""
    return pycolmap.Camera(
        model="PINHOLE",
        width=pinhole.width_px,
        height=pinhole.height_px,
        params=pinhole.numbers,
        has_prior_focal_length=True,
    )


def rigid3d(pose: RigidTransform) -> pycolmap.Rigid3d:
    """A scipy transform as COLMAP's."""
    rotation = pycolmap.Rotation3d(pose.rotation.as_quat())
    return pycolmap.Rigid3d(rotation, np.asarray(pose.translation))


def as_transform(pose: Any) -> RigidTransform:
    """A COLMAP pose as scipy's."""
    return RigidTransform.from_components(
        np.asarray(pose.translation), Rotation.from_quat(np.asarray(pose.rotation.quat))
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredModel:
    """What COLMAP keeps of a model, as arrays."""

    keypoints: Mapping[int, NDArray[np.void]]
    """Of every registered picture by its id, (N,) of `KEYPOINT`."""
    point_ids: NDArray[np.int64]
    """(P,) ids of the points, ascending."""
    points: Array
    """(P, 3) where they are."""


def stored_of(model: pycolmap.Reconstruction) -> StoredModel:
    """Keypoints and points of a model.

    They travel through COLMAP's own files: one by one it takes eight times as long.

    Raises:
        OSError: there is no room for the files.
    """
    with tempfile.TemporaryDirectory() as folder:
        model.write_binary(folder)
        point_ids, points = all_points(Path(folder))
        try:
            file = ImagesFile(Path(folder))
        except ReconstructionError:
            raise OSError(errno.ENOSPC, _NO_ROOM, folder) from None
        keypoints = {picture.number: file.keypoints(picture) for picture in file.pictures}
        return StoredModel(keypoints=keypoints, point_ids=point_ids, points=points)


@dataclass(frozen=True, kw_only=True)
class PosedPicture:
    """A registered picture in a model's `images.bin`."""

    number: int
    name: str
    cam_from_world: Array
    """(7,) quaternion wxyz, then translation."""
    first: int
    count: int
    """Where its keypoints start in the file, bytes, and how many there are."""


class ImagesFile:
    """A model's `images.bin`, of which only what is asked for is read."""

    def __init__(self, folder: Path) -> None:
        """Look through the pictures of the model in a folder.

        Raises:
            ReconstructionError: the file is missing, cut short or damaged.
        """
        path = folder / "images.bin"
        _check(path, _image)
        self._content = _map_file(path)
        self.pictures = tuple(self._walk())

    def _walk(self) -> Iterator[PosedPicture]:
        content, at = self._content, 8
        (pictures,) = struct.unpack_from("<Q", content)
        for _ in range(pictures):
            (number,) = struct.unpack_from("<I", content, at)
            first, count = _keypoints(content, at)
            yield PosedPicture(
                number=number,
                name=content[at + 4 + _POSE + 4 : first - 9].decode(),
                cam_from_world=np.frombuffer(content[at + 4 : at + 4 + _POSE], "<f8"),
                first=first,
                count=count,
            )
            at = first + KEYPOINT.itemsize * count

    def keypoints(self, picture: PosedPicture) -> NDArray[np.void]:
        """(N,) of `KEYPOINT`."""
        end = picture.first + KEYPOINT.itemsize * picture.count
        return np.frombuffer(self._content[picture.first : end], KEYPOINT)


def points_of(folder: Path, ids: NDArray[np.int64]) -> Array:
    """Places (N, 3) of points of the model in a folder by their ids; NaN of those not in it.

    Raises:
        ReconstructionError: the file is missing, cut short or damaged.
    """
    path = folder / "points3D.bin"
    _check(path, _point)
    content = np.asarray(np.memmap(path, np.uint8, "r"))
    starts, _ = _point_starts(content)
    requested, at = np.unique(ids, return_inverse=True)
    found = np.full((len(requested) + 1, 3), np.nan)
    for first in range(0, len(starts), _POINTS_AT_A_TIME):
        head = content[starts[first : first + _POINTS_AT_A_TIME, None] + np.arange(_POINT_HEAD)]
        numbers = head[:, :8].copy().view("<i8")[:, 0]
        rows = np.searchsorted(requested, numbers)
        known = np.flatnonzero(np.append(requested, -1)[rows] == numbers)
        found[rows[known]] = head[known, 8:].copy().view("<f8")
    return found[at]


def all_points(folder: Path) -> tuple[NDArray[np.int64], Array]:
    """Ids (P,), ascending, and places (P, 3) of the points of the model in a folder.

    Raises:
        OSError: the file is missing or cut short.
    """
    path = folder / "points3D.bin"
    content = np.fromfile(path, np.uint8)
    starts, end = _point_starts(content)
    if end != len(content):
        raise OSError(errno.ENOSPC, _NO_ROOM, path)
    head = content[starts[:, None] + np.arange(_POINT_HEAD)]
    numbers = head[:, :8].copy().view("<i8")[:, 0]
    order = np.argsort(numbers)
    return numbers[order], head[order, 8:].copy().view("<f8")


@compiled
def _point_starts(content: NDArray[np.uint8]) -> tuple[NDArray[np.int64], int]:
    """(P,) where the entries of `points3D.bin` start, and where they end; -1 if it is too short."""
    size, minimum = content.shape[0], _TRACK_LENGTH + 8
    if size < 8:
        return np.empty(0, np.int64), -1
    count = np.int64(0)
    for k in range(8):
        count |= np.int64(content[k]) << (8 * k)
    if count < 0 or count > size // minimum:
        return np.empty(0, np.int64), -1
    starts, at = np.empty(count, np.int64), np.int64(8)
    for i in range(count):
        if at + minimum > size:
            return starts[:i], -1
        starts[i] = at
        track = np.int64(0)
        for k in range(4):  # a longer one has no room in a file either
            track |= np.int64(content[at + _TRACK_LENGTH + k]) << (8 * k)
        at += minimum + 8 * track
    return starts, int(at)


def _map_file(path: Path) -> Content:
    """The bytes of a file, read where they are looked at."""
    with path.open("rb") as file:
        try:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError:  # it is empty
            return b""


def _check(path: Path, length: Callable[[Content, int], int]) -> None:
    """Follow a file's counts to its end."""
    with file_faults(path, ReconstructionError):
        content = _map_file(path)
    at = 8
    try:
        (count,) = struct.unpack_from("<Q", content)
        for _ in range(min(count, len(content))):
            at += length(content, at)
    except (struct.error, KeyError, ValueError, OverflowError):
        at = -1
    if at != len(content):
        raise ReconstructionError(
            f"{path}: is cut short or damaged: remove the folder's stage and run "
            "'alice-survey reconstruct' again"
        )


def _camera(content: Content, at: int) -> int:
    _, model = struct.unpack_from("<Ii", content, at)
    return 24 + 8 * _PARAMS[model]


def _image(content: Content, at: int) -> int:
    first, count = _keypoints(content, at)
    return first + KEYPOINT.itemsize * count - at


def _keypoints(content: Content, at: int) -> tuple[int, int]:
    """Where the keypoints of the picture whose entry begins at a place do, and their number."""
    end = content.find(b"\0", at + 4 + _POSE + 4) + 1
    if not end:
        raise ValueError("a name without an end")
    (count,) = struct.unpack_from("<Q", content, end)
    return end + 8, int(count)


def _point(content: Content, at: int) -> int:
    (track,) = struct.unpack_from("<Q", content, at + _TRACK_LENGTH)
    return int(_TRACK_LENGTH + 8 + 8 * track)


def _rig(content: Content, at: int) -> int:
    _, sensors = struct.unpack_from("<II", content, at)
    end = at + 8 + (_SENSOR if sensors else 0)
    for _ in range(max(0, min(sensors, len(content)) - 1)):
        (posed,) = struct.unpack_from("<B", content, end + _SENSOR)
        end += _SENSOR + 1 + (_POSE if posed else 0)
    return end - at


def _frame(content: Content, at: int) -> int:
    (data,) = struct.unpack_from("<I", content, at + 8 + _POSE)
    return int(8 + _POSE + 4 + (_SENSOR + 8) * data)


_LENGTHS: dict[str, Callable[[Content, int], int]] = {
    "cameras.bin": _camera,
    "images.bin": _image,
    "points3D.bin": _point,
    "rigs.bin": _rig,
    "frames.bin": _frame,
}
"""For each file: bytes that the entry at a place takes."""
