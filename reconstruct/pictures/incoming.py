"""Pictures on their way into a workspace: checked, named, masked and copied."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np

from alice_survey.core.errors import ImageError, warn
from alice_survey.core.executor import Executor
from alice_survey.core.manifest import ImageRecord
from camera_calib.rig import Rig
from missions.logs.dive import DATED_AFTER_S
from reconstruct.pictures.files import (
    PictureFacts,
    bits_used,
    copy_picture,
    inspect,
    safe_name,
    target_suffix,
)
from reconstruct.pictures.undistorted import read_mask

UNDECODABLE = "cannot be decoded"
MIRRORED = "mirror images"
COPIES = "copies of others"


@dataclass(frozen=True, kw_only=True)
class Incoming:
    """One picture to import."""

    source: Path
    camera: str
    station: int
    facts: PictureFacts
    image: str = ""
    mask: Path | None = None
    video_time_s: float | None = None
    """Of a frame, since the start of the first recording; NaN where that is unknown."""
    recording: str = ""
    """Name of the recording that a frame is of."""


def find_entries(
    stations: Sequence[Mapping[str, Path]], executor: Executor
) -> tuple[list[Incoming], dict[str, list[str]]]:
    """Pictures of all stations that can be used; the others are named in warnings.

    Returns:
        Those that can be used, and names of the others by reason.
    """
    listed = [
        (camera, station, path)
        for station, paths in enumerate(stations)
        for camera, path in paths.items()
    ]
    copies = same_bytes([path for _, _, path in listed])
    owners = {path: camera for camera, _, path in listed}
    for copy, first in copies.items():
        if owners[copy] != owners[first]:
            raise ImageError(
                f"{owners[first]} and {owners[copy]} have the same picture, {first} and {copy}: "
                "give each camera the pictures that it took"
            )
    listed = [one for one in listed if one[2] not in copies]
    facts = executor.map(inspect, [path for _, _, path in listed], label="checking pictures")
    entries = []
    left_out: dict[str, list[str]] = {}
    for copy, first in copies.items():
        warn(f"{copy} is left out: it is the same file as {first}")
        left_out.setdefault(COPIES, []).append(copy.name)
    for (camera, station, path), known in zip(listed, facts, strict=True):
        if known.fault:
            warn(f"{path} is left out: {known.fault}")
            reason = MIRRORED if known.width_px else UNDECODABLE
            left_out.setdefault(reason, []).append(path.name)
            continue
        entries.append(Incoming(source=path, camera=camera, station=station, facts=known))
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


def at_time(entry: Incoming, time_s: float) -> Incoming:
    """A picture with the time of its message: a date, or seconds of a clock without dates."""
    if time_s < DATED_AFTER_S:
        return replace(entry, video_time_s=time_s)
    date = datetime.fromtimestamp(time_s, UTC)
    return replace(entry, facts=replace(entry.facts, time_local=date))


def by_camera(entries: Sequence[Incoming], name: str) -> list[Incoming]:
    """Name the cameras that took pictures, as far as EXIF and sizes distinguish them.

    The camera of most pictures has the name that is given; the next ones a number more.
    """
    counts = Counter(camera_key(entry.facts) for entry in entries)
    names = {
        key: name if number == 1 else f"{name}-{number}"
        for number, (key, _) in enumerate(counts.most_common(), 1)
    }
    return [replace(entry, camera=names[camera_key(entry.facts)]) for entry in entries]


def camera_key(facts: PictureFacts) -> tuple[str, int, int]:
    """What tells the pictures of one camera from those of another: device, width, height."""
    return facts.device, facts.width_px, facts.height_px


def check_entries(entries: Sequence[Incoming], rig: Rig | None) -> None:
    """Check that pictures are enough, of one size by camera, and of the size that the rig says."""
    if len({entry.station for entry in entries}) < 2:
        count = len(entries)
        raise ImageError(
            f"{count} usable picture{'s' * (count != 1)}: a model needs pictures from 2 or more "
            "places that overlap"
        )
    for camera in dict.fromkeys(entry.camera for entry in entries):
        own = [e for e in entries if e.camera == camera]
        first = own[0].facts
        for entry in own:
            facts = entry.facts
            if (facts.width_px, facts.height_px) != (first.width_px, first.height_px):
                raise ImageError(
                    f"{entry.source} has {facts.width_px} x {facts.height_px} pixels, but "
                    f"{own[0].source.name} of the same camera has {first.width_px} x "
                    f"{first.height_px}: import pictures of one size only"
                )
        if rig is None:
            continue
        if camera not in rig.cameras:
            raise ImageError(f"the rig has no camera {camera!r}, only {', '.join(rig.cameras)}")
        model = rig.cameras[camera]
        if (model.width_px, model.height_px) != (first.width_px, first.height_px):
            others = ", ".join(name for name in rig.cameras if name != camera)
            raise ImageError(
                f"{own[0].source} has {first.width_px} x {first.height_px} pixels, but the rig's "
                f"camera {camera} has {model.width_px} x {model.height_px}"
                + (f": --camera NAME=FOLDER says if {others} took them" if others else "")
            )


def named_apart(entries: Sequence[Incoming]) -> list[Incoming]:
    """Names below `images/`: the camera's folder and a safe, unique form of the file's own name."""
    taken: set[str] = set()
    named = []
    for entry in entries:
        if entry.image:
            named.append(entry)
            continue
        stem = safe_name(entry.source.stem)
        suffix = target_suffix(entry.source, _bits(entries, entry.camera))
        image, copy = f"{safe_name(entry.camera)}/{stem}{suffix}", 1
        while image.lower() in taken:
            copy += 1
            image = f"{safe_name(entry.camera)}/{stem}_{copy}{suffix}"
        taken.add(image.lower())
        named.append(replace(entry, image=image))
    return named


def _bits(entries: Sequence[Incoming], camera: str) -> int:
    return bits_used(max(e.facts.highest for e in entries if e.camera == camera))


def mask_of(entry: Incoming, masks: Path | None, stereo: bool) -> Path | None:
    """The mask of a picture, in the folder of masks or next to it; None where it has none."""
    stem = entry.source.stem
    names = [f"{stem}.png", f"{stem}_mask.png", f"{stem}.jpg", f"{stem}.tif"]
    if masks is None:
        places = [entry.source.with_name(f"{stem}_mask.png")]
    else:
        places = [masks / entry.camera / name for name in names]
        if not stereo:
            places += [masks / name for name in names]
    found = next((path for path in places if path.is_file()), None)
    if found is not None:
        read_mask(found, (entry.facts.width_px, entry.facts.height_px))
    return found


def copy_all(entries: Sequence[Incoming], partial: Path, executor: Executor) -> list[str]:
    """Copy pictures to where their names say; what was lost in it, as notes."""
    bits = {camera: _bits(entries, camera) for camera in {e.camera for e in entries}}
    tasks = [(entry.source, partial / entry.image, bits[entry.camera]) for entry in entries]
    for _ in executor.map(_copy, tasks, label="copying pictures"):
        pass
    return [
        f"pictures of camera {camera} held {count} bits; the upper 8 were kept"
        for camera, count in sorted(bits.items())
        if count > 8
    ]


def _copy(task: tuple[Path, Path, int]) -> None:
    copy_picture(*task)


def record_of(entry: Incoming, partial: Path) -> ImageRecord:
    """Row of the manifest; writes the mask of the picture."""
    mask = ""
    if entry.mask is not None:
        mask = f"masks/{Path(entry.image).with_suffix('.png').as_posix()}"
        usable = read_mask(entry.mask, (entry.facts.width_px, entry.facts.height_px))
        (partial / mask).parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(partial / mask), usable.astype(np.uint8) * 255):
            raise ImageError(f"{partial / mask}: cannot be written")
    return ImageRecord(image=entry.image, camera=entry.camera, station=entry.station, mask=mask)
