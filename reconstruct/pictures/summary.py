"""What an import brought into a workspace, and what it left out."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from alice_survey.core.artefacts import JsonRecord
from alice_survey.core.manifest import ImageRecord
from reconstruct.pictures.files import ADVICE, PictureFolder, kind_of, named
from reconstruct.pictures.incoming import COPIES, MIRRORED, UNDECODABLE, Incoming
from reconstruct.pictures.recordings import Recording
from reconstruct.pictures.when_where import readings_of

_WHY = {
    UNDECODABLE: "copy them from the camera again",
    MIRRORED: "save them as they are seen, without an EXIF orientation",
    COPIES: "each file counts once",
    **ADVICE,
}
_NAMED = 3
FRAMES = "frames of videos"


class CameraRow(JsonRecord):
    """A camera that took pictures."""

    pictures: int
    width_px: int
    height_px: int
    device: str = ""

    def __str__(self) -> str:
        """Such as `34 of 5184 x 3888 pixels, GoPro HERO9 Black`."""
        text = f"{self.pictures} of {self.width_px} x {self.height_px} pixels"
        return f"{text}, {self.device}" if self.device else text


class RecordingRow(JsonRecord):
    """A recording whose frames were taken."""

    files: tuple[str, ...]
    frames: int
    duration_s: float
    start: str | None
    """ISO 8601; without a zone where it is the camera's local time."""
    clock: str

    def __str__(self) -> str:
        """Such as `12 frames of 60 s in 2 files, from 2024-07-01T12:00:00 (UTC in the video)`."""
        of = f" in {len(self.files)} files" if len(self.files) > 1 else ""
        began = "start unknown" if self.start is None else f"from {self.start} ({self.clock})"
        return f"{self.frames} frames of {self.duration_s:.0f} s{of}, {began}"


class ImportRecord(JsonRecord):
    """`images/imported.json`: cameras, kinds of files and recordings, and what was left out."""

    path: ClassVar = "images/imported.json"
    cameras: dict[str, CameraRow]
    kinds: dict[str, int]
    recordings: dict[str, RecordingRow]
    left_out: dict[str, tuple[str, ...]]
    """Names by reason, of files that were looked into."""

    def lines(self) -> list[str]:
        """A line for each camera that was recognised, each recording, and each reason."""
        rows = self.cameras.values()
        sizes = {(row.width_px, row.height_px) for row in rows}
        known = len(sizes) > 1 or any(row.device for row in rows)
        return [
            *(f"{name}: {row}" for name, row in self.cameras.items() if known),
            *(f"{name}: {row}" for name, row in self.recordings.items()),
            *(
                f"left out: {len(names)} {reason} ({named(names, _NAMED)}); {_WHY[reason]}"
                for reason, names in self.left_out.items()
            ),
        ]


@dataclass(frozen=True, kw_only=True)
class ImportedPictures:
    """What a workspace got, and what was left out."""

    changed: bool
    """False when all was there already."""
    cameras: Mapping[str, int]
    """Pictures by camera."""
    kinds: Mapping[str, int]
    """Pictures by kind of file."""
    positions: int
    """Number of pictures with a known position."""
    readings: Mapping[str, int]
    """Pictures by what navigation measured of them."""
    left_out: Mapping[str, int]
    """Files that were not imported, by reason."""
    lines: Sequence[str] = ()
    """A line for each camera, recording and reason."""

    def __str__(self) -> str:
        """A line such as `68 pictures (68 PNG) of left and right, 0 with a position`; the lines."""
        total = sum(self.cameras.values())
        *others, last = self.cameras
        of = f" of {', '.join(others)} and {last}" if others else ""
        kinds = ", ".join(f"{count} {what}" for what, count in self.kinds.items())
        text = f"{total} pictures ({kinds}){of}, {self.positions} with a position"
        for name, count in self.readings.items():
            text += f", {count} with {name}" if count > self.positions else ""
        return "\n".join([text, *self.lines])


def import_record(
    entries: Sequence[Incoming],
    order: Sequence[str],
    recordings: Sequence[Recording],
    left_out: Mapping[str, Sequence[str]],
) -> ImportRecord:
    """Count what came in.

    Args:
        entries: pictures that were imported.
        order: names of cameras, first ones first.
        recordings: whose frames they are, if they are.
        left_out: names of pictures that were not imported, by reason.
    """
    counts = Counter(entry.camera for entry in entries)
    some = {entry.camera: entry.facts for entry in entries}
    frames = Counter(entry.recording for entry in entries)
    kinds = Counter(FRAMES if e.recording else kind_of(e.source) for e in entries)
    rows: dict[str, RecordingRow] = {}
    for recording in recordings:
        last = recording.files[-1]
        rows[recording.name] = RecordingRow(
            files=tuple(file.path.name for file in recording.files),
            frames=frames[recording.name],
            duration_s=last.start_s + last.duration_s,
            start=None if recording.start is None else recording.start.isoformat(" ", "seconds"),
            clock=recording.clock,
        )
    return ImportRecord(
        cameras={
            name: CameraRow(
                pictures=counts[name], width_px=some[name].width_px,
                height_px=some[name].height_px, device=some[name].device,
            )
            for name in dict.fromkeys([*order, *sorted(counts)])
            if counts[name]
        },
        kinds=dict(kinds),
        recordings=rows,
        left_out={reason: tuple(names) for reason, names in left_out.items()},
    )  # fmt: skip


def with_folders(record: ImportRecord, folders: Sequence[PictureFolder]) -> ImportRecord:
    """The record with what the folders hold now that is not imported."""
    found: dict[str, list[str]] = {reason: list(names) for reason, names in record.left_out.items()}
    for folder in folders:
        for reason, paths in folder.left_out.items():
            names = [str(path.relative_to(folder.folder)) for path in paths]
            found.setdefault(reason, []).extend(names)
    left_out = {reason: tuple(names) for reason, names in found.items()}
    return record.model_copy(update={"left_out": left_out})


def summary(
    workspace: Path, records: Sequence[ImageRecord], folders: Sequence[PictureFolder], *,
    changed: bool,
) -> ImportedPictures:  # fmt: skip
    """Counts of a finished import."""
    record = with_folders(ImportRecord.read(workspace / ImportRecord.path), folders)
    return ImportedPictures(
        changed=changed,
        cameras={name: row.pictures for name, row in record.cameras.items()},
        kinds=record.kinds,
        positions=sum(one.has_position for one in records),
        readings=readings_of(records),
        left_out={reason: len(names) for reason, names in record.left_out.items()},
        lines=record.lines(),
    )
