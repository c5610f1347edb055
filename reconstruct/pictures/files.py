"""Picture files as cameras write them: found, checked by decoding them whole, and copied."""

import math
import os
import re
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.contents import as_line, is_nowhere, is_unknown, ordinary_file
from alice_survey.core.errors import ImageError, file_faults
from camera_calib import picture_files

HEIC = (".heic", ".heif", ".hif", ".avif")
COPIED = (".jpg", ".jpeg", ".png")
"""Pictures of 8 bits that are copied as they are."""
RAW = (
    ".3fr", ".arw", ".cr2", ".cr3", ".dng", ".erf", ".gpr", ".iiq", ".kdc", ".mef", ".mos", ".mrw",
    ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f",
)  # fmt: skip
VIDEO = (
    ".360", ".avi", ".insv", ".lrv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg",
    ".mts", ".webm", ".wmv",
)  # fmt: skip
ENDS = [end for ends in picture_files.KINDS.values() for end in ends]
IN_FOLDERS = "in folders inside"
ADVICE = {
    "HEIC": "save them as JPEG",
    "video": "take its frames with --video, into a workspace of their own",
    IN_FOLDERS: "take them with 'import-images --recursive', or give these folders too",
    "other files": "their names are not those of pictures",
}
_GPS, _EXIF, _FOCAL, _FOCAL_35 = 0x8825, 0x8769, 0x920A, 0xA405
_MAX_FOCAL_MM = 2000.0
_MAKE, _MODEL, _SERIAL, _ORIENTATION = 0x010F, 0x0110, 0xA431, 0x0112
_MIRRORED = (2, 4, 5, 7)
"""EXIF orientations of mirror images, which no lens projects."""
_MAX_DEVICE = 80


@dataclass(frozen=True, kw_only=True)
class PictureFacts:
    """What a picture file holds; `fault` says why it cannot be used."""

    path: Path
    width_px: int = 0
    height_px: int = 0
    highest: int = 255
    """Largest value of any pixel; above 255 in a picture of 16 bits."""
    cut_out: bool = False
    """Whether its alpha leaves a part out, see `opaque_part`."""
    device: str = ""
    """Make, model, serial number and focal length of the camera, as far as EXIF states them."""
    orientation: int = 1
    """As EXIF states it; pixels are used as they are stored."""
    time_local: datetime | None = None
    """Local time at which it was taken; with a zone if the camera wrote one."""
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    fault: str = ""

    @property
    def key(self) -> tuple[str, int, int]:
        """What tells the pictures of one camera from those of another: device, width, height."""
        return self.device, self.width_px, self.height_px


@dataclass(frozen=True, kw_only=True)
class PictureFolder:
    """What a folder holds, without hidden files and folders."""

    folder: Path
    pictures: tuple[Path, ...]
    """Pictures in the order of the numbers in their names."""
    masks: tuple[Path, ...]
    """Those of `mask_names`, next to their pictures."""
    left_out: Mapping[str, tuple[Path, ...]]
    """What is not a picture that can be read, by reason."""


def look_into(
    folder: Path, apart: Collection[Path] = (), *, recursive: bool = False
) -> PictureFolder:
    """List the pictures of a folder, and what else is there.

    Args:
        folder: to look into.
        apart: files and folders that the caller knows; they are not reported as left out.
        recursive: list those of folders inside too, but not of folders in `apart`.

    Raises:
        ImageError: it is not a folder that can be read, or it holds no picture.
    """
    known = {path.resolve() for path in apart}
    inside: list[Path] = []
    with file_faults(folder, ImageError):
        for top, folders, names in os.walk(folder, onerror=_raise):
            for some in (folders, names):
                some[:] = [
                    name for name in some
                    if not name.startswith(".") and Path(top, name).resolve() not in known
                ]  # fmt: skip
            inside += [Path(top, name) for name in names]
    inside.sort(key=lambda p: [(natural_key(part), part) for part in p.relative_to(folder).parts])
    of_masks = {
        (path.parent, name) for path in inside if kind_of(path) for name in mask_names(path.name)
    }
    pictures: list[Path] = []
    masks: list[Path] = []
    left_out: dict[str, list[Path]] = {reason: [] for reason in ADVICE}
    for path in inside:
        suffix, is_picture = path.suffix.lower(), bool(kind_of(path))
        if not recursive and path.parent != folder:
            left_out[IN_FOLDERS] += [path] if is_picture else []
        elif not is_picture:
            reason = "HEIC" if suffix in HEIC else "video" if suffix in VIDEO else "other files"
            left_out[reason].append(path)
        else:
            (masks if (path.parent, path.name.lower()) in of_masks else pictures).append(path)
    if not pictures:
        held = [f"{len(paths)} {reason}; {ADVICE[reason]}" for reason, paths in left_out.items()
                if paths]  # fmt: skip
        raise ImageError(
            f"{folder}: holds no pictures ({', '.join(picture_files.KINDS)} or camera RAW)"
            + (f", but {', '.join(held)}" if held else "")
        )
    return PictureFolder(
        folder=folder,
        pictures=tuple(pictures),
        masks=tuple(masks),
        left_out={reason: tuple(paths) for reason, paths in left_out.items() if paths},
    )


def mask_names(picture: str) -> list[str]:
    """Names, in lower case, that the mask next to a picture may have.

    Of `P1.JPG` they are `P1.JPG.png`, as COLMAP has it, and `P1_mask` of any kind, as OpenDroneMap
    has it.
    """
    name, stem = picture.lower(), Path(picture).stem.lower()
    return [f"{name}.png", f"{name}_mask.png", *(f"{stem}_mask{end}" for end in ENDS)]


def kind_of(path: Path) -> str:
    """A kind of `KINDS`, or `RAW`, by the name of a file; empty for all others."""
    suffix, kinds = path.suffix.lower(), {**picture_files.KINDS, "RAW": RAW}
    return next((kind for kind, names in kinds.items() if suffix in names), "")


def list_names(names: Sequence[str], maximum: int = 8) -> str:
    """The first few of some names, and how many more there are."""
    rest = len(names) - maximum
    return ", ".join(names[:maximum]) + (f" and {rest} more" if rest > 0 else "")


def _raise(error: OSError) -> None:
    raise error


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """A sorting key that puts picture2 before picture10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts]


def safe_name(stem: str) -> str:
    """A stem of letters, digits, dots, dashes and underscores that cannot leave its folder."""
    return re.sub(r"[^\w.-]", "_", stem).strip(".") or "picture"


def inspect(path: Path) -> PictureFacts:
    """Decode a picture whole and read when and where it was taken; never raises for a bad file."""
    try:
        if not path.is_file():
            return PictureFacts(path=path, fault="not a regular file")
        stored = decode(path, alpha=True)
    except (ImageError, OSError) as error:
        return PictureFacts(path=path, fault=str(error))
    height, width = stored.shape[:2]
    highest = int(stored[..., :3].max(initial=0) if stored.ndim == 3 else stored.max(initial=0))
    cut_out = not opaque_part(stored).all()
    facts = PictureFacts(path=path, width_px=width, height_px=height, highest=highest)
    facts = _with_exif(replace(facts, cut_out=cut_out))
    if facts.orientation in _MIRRORED:
        fault = f"a mirror image by its EXIF orientation {facts.orientation}: save it as it is seen"
        return replace(facts, fault=f"{fault}, without that tag")
    return facts


def inspect_shot(paths: Sequence[Path]) -> list[PictureFacts]:
    """What the files of one shot hold, up to the first that can be used."""
    tried = [inspect(paths[0])]
    while tried[-1].fault and len(tried) < len(paths):
        tried.append(inspect(paths[len(tried)]))
    return tried


def same_shots(pictures: Sequence[Path]) -> list[list[Path]]:
    """Files of one shot that are of several kinds, the one to take first.

    They have one name and one time by EXIF; where one states no time they are of one folder. A file
    that states its time is taken, and of these the RAW, else that of most pixels, else no JPEG.
    """
    named: dict[str, list[Path]] = {}
    for path in pictures:
        named.setdefault(path.stem.lower(), []).append(path)
    shots: list[list[PictureFacts]] = []
    for some in named.values():
        own = len(shots)
        headers = map(read_header, some) if len({*map(kind_of, some)}) > 1 else ()
        for one in sorted(headers, key=_preference, reverse=True):
            fits = (shot for shot in shots[own:] if all(_is_one_shot(one, two) for two in shot))
            if (shot := next(fits, [])) == []:
                shots.append(shot)
            shot.append(one)
    return [[facts.path for facts in shot] for shot in shots if len(shot) > 1]


def _preference(facts: PictureFacts) -> tuple[float, ...]:
    kind, pixels = kind_of(facts.path), facts.width_px * facts.height_px
    dated = facts.time_local is not None
    return not facts.fault, dated, kind == "RAW", pixels, kind != "JPEG"


def _is_one_shot(one: PictureFacts, other: PictureFacts) -> bool:
    times = [str(facts.time_local or "")[:19] for facts in (one, other)]
    same = times[0] == times[1] if all(times) else one.path.parent == other.path.parent
    return same and kind_of(one.path) != kind_of(other.path)


def read_header(path: Path) -> PictureFacts:
    """What a picture states, without decoding it; size 0 where only decoding can tell."""
    size, raw = (0, 0), path.suffix.lower() in RAW
    try:
        with picture_files.opened_picture(path) as image:
            size = image.size
    except ImageError as error:
        return PictureFacts(path=path, fault="" if raw else str(error))
    width, height = (0, 0) if raw else size  # of RAW Pillow sees the small picture inside
    return _with_exif(PictureFacts(path=path, width_px=width, height_px=height))


def opaque_part(stored: NDArray[Any]) -> NDArray[np.bool_]:
    """(H, W) where a picture is more opaque than not; everywhere where that would be nowhere."""
    if stored.ndim < 3 or stored.shape[2] < 4:
        return np.ones(stored.shape[:2], np.bool_)
    opaque: NDArray[np.bool_] = stored[..., 3] > np.iinfo(stored.dtype).max // 2
    return opaque if opaque.any() else ~opaque


def decode(path: Path, *, alpha: bool = False) -> NDArray[Any]:
    """All pixels of a picture, (H, W) or (H, W, 3) BGR, or BGRA where asked for; 8 or 16 bits.

    Raises:
        ImageError: it cannot be decoded to its end.
    """
    suffix = path.suffix.lower()
    if maximum := picture_files.pixels_too_many(path):
        raise ImageError(f"states over {maximum / 1e6:.0f} million pixels: make it smaller")
    if suffix in RAW:
        return _develop(path)
    if suffix not in picture_files.KINDS["TIFF"]:
        with picture_files.opened_picture(path) as image:
            image.load()  # it refuses truncated files; OpenCV fills them with grey
    pixels = picture_files.read_pixels(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise ImageError("cannot be decoded")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"holds {pixels.dtype} pixels; 8 or 16 bits can be read")
    if pixels.ndim == 3 and pixels.shape[2] not in (3, 4):
        raise ImageError(f"has {pixels.shape[2]} channels; 1, 3 or 4 can be read")
    return np.ascontiguousarray(pixels[..., :3] if pixels.ndim == 3 and not alpha else pixels)


def _develop(path: Path) -> NDArray[Any]:
    """A RAW picture in 16 bits: the camera's daylight colours, the same for every picture."""
    import rawpy

    try:
        with rawpy.imread(str(ordinary_file(path, None))) as raw:
            rgb = raw.postprocess(
                output_bps=16, no_auto_bright=True, use_camera_wb=False, use_auto_wb=False,
                user_flip=0,
            )  # fmt: skip
    except (rawpy.LibRawError, OSError, ValueError, MemoryError, RuntimeError) as error:
        text = error.args[0] if error.args else error
        text = text.decode(errors="replace") if isinstance(text, bytes) else str(text)
        raise ImageError(f"RAW cannot be developed: {as_line(text)}") from None
    return np.ascontiguousarray(rgb[..., ::-1])


def _with_exif(facts: PictureFacts) -> PictureFacts:
    try:
        with picture_files.opened_picture(facts.path) as image:
            exif = image.getexif()
            gps, time_local = exif.get_ifd(_GPS), picture_files.exif_time(exif)
            orientation = exif.get(_ORIENTATION, 1)
            device = _device(exif)
    except ImageError:
        return facts  # a RAW format that Pillow does not know, or broken tags: pixels suffice
    latitude_deg, longitude_deg = _angle(gps, 2, 90.0), _angle(gps, 4, 180.0)
    if is_nowhere(latitude_deg, longitude_deg):
        latitude_deg = longitude_deg = None
    return replace(
        facts,
        time_local=time_local,
        device=device,
        orientation=orientation if orientation in range(1, 9) else 1,
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        altitude_m=_altitude(gps),
    )


def _device(exif: Any) -> str:
    """Make, model and serial number; the make only where the model does not start with it.

    Then the focal length, of the lens and on 35 mm film: a zoom is another lens.
    """
    details = exif.get_ifd(_EXIF)
    make, model, serial = (
        "".join(c for c in str(value or "") if c.isprintable()).strip()[:_MAX_DEVICE]
        for value in (exif.get(_MAKE), exif.get(_MODEL), details.get(_SERIAL))
    )
    words = [model if model.lower().startswith(make.lower()) else f"{make} {model}"]
    body = " ".join([*words, *([f"#{serial}"] if serial else [])]).strip()
    focal, film = _number(details.get(_FOCAL)), _film_mm(details)
    lens = [f"{focal:.3g} mm"] if 0 < focal < _MAX_FOCAL_MM else []
    lens += [f"({film:.3g} mm on film)"] if film > 0 else []
    return " at ".join(filter(None, [body, " ".join(lens)]))


def _film_mm(details: Any) -> float:
    """Focal length on film of 35 mm; NaN where EXIF states none that is one."""
    stated = _number(details.get(_FOCAL_35))
    return stated if 5 <= stated <= 1000 else math.nan


def _number(value: Any) -> float:
    """A number of EXIF; NaN where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return math.nan


def _angle(gps: Any, key: int, maximum: float) -> float | None:
    """Degrees from degrees, minutes and seconds; the key before names the hemisphere."""
    stored = gps.get(key)
    parts = [_number(p) for p in stored] if isinstance(stored, tuple) else []
    angle = parts[0] + parts[1] / 60.0 + parts[2] / 3600.0 if len(parts) == 3 else math.nan
    if not 0 <= angle <= maximum:
        return None
    return -angle if str(gps.get(key - 1, "")).upper()[:1] in ("S", "W") else angle


def _altitude(gps: Any) -> float | None:
    altitude = _number(gps.get(6)) * (-1.0 if gps.get(5) in (1, b"\x01") else 1.0)
    return None if is_unknown(altitude) else altitude


def exif_focal_px(path: Path, width_px: int, height_px: int) -> float:
    """Focal length in air, pixels, from the one that EXIF gives for 35 mm film; NaN without.

    Film is 36 mm wide; makers relate the longer sides (or the diagonals, which differs by a few
    per cent).
    """
    try:
        with picture_files.opened_picture(path) as image:
            film = _film_mm(image.getexif().get_ifd(_EXIF))
    except ImageError:
        return float("nan")
    return film / 36.0 * max(width_px, height_px)


def to_utc(time: datetime, zone: tzinfo) -> datetime:
    """A camera's time in UTC; `zone` where the camera wrote none."""
    return (time.replace(tzinfo=zone) if time.tzinfo is None else time).astimezone(UTC)


def bits_used(highest: int) -> int:
    """Bits of the sensor whose largest value was `highest`: 8, 10, 12, 14 or 16."""
    return next(bits for bits in (8, 10, 12, 14, 16) if highest < 2**bits)


def half_of(pixels: NDArray[Any], side: str) -> NDArray[Any]:
    """The left or the right of two pictures side by side; of no side both."""
    middle = pixels.shape[1] // 2
    return {"left": pixels[:, :middle], "right": pixels[:, middle:]}.get(side, pixels)


def copy_picture(task: tuple[Path, Path, int, str]) -> None:
    """Import a picture: JPEG and PNG of 8 bits as they are, all else as PNG of 8 bits.

    An EXIF orientation is taken off the copy, so that every program shows pixels as stored.

    Args:
        task: a file that `inspect` found whole; where it goes, with the suffix `target_suffix`
            gives; `bits_used` by all pictures of the camera: lower bits are cut off; and the side
            of `half_of`.
    """
    source, target, bits, side = task
    target.parent.mkdir(parents=True, exist_ok=True)
    as_it_is = source.suffix.lower() in COPIED and target.suffix == source.suffix.lower()
    if as_it_is and bits == 8 and not side:
        if _with_exif(PictureFacts(path=source)).orientation == 1:
            shutil.copyfile(source, target)
            return
        if target.suffix != ".png":
            target.write_bytes(picture_files.without_orientation(source.read_bytes()))
            return
    pixels = half_of(decode(source), side)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> (bits - 8)).astype(np.uint8)
    if not cv2.imwrite(str(target), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3]):
        raise ImageError(f"{target}: cannot be written")


def target_suffix(source: Path, bits: int) -> str:
    """`.jpg`, `.jpeg` or `.png` for files copied as they are, `.png` for all else."""
    suffix = source.suffix.lower()
    return suffix if suffix in (".jpg", ".jpeg") and bits == 8 else ".png"
