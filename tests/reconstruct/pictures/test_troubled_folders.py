"""Folders of ordinary trouble by the command line: each ends well, or in one line that helps.

A way to end is the exit code and what a user reads; `END` says which is expected of which folder.
"""

import csv
import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from alice_survey.app.cli.main import main
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import PicturesRecord, RegistrationRecord
from camera_calib.rig import design_rig, write_rig

START = datetime(2024, 7, 1, 12, tzinfo=UTC)
SIZE = (64, 48)
Build = Callable[[Path], list[str]]
"""Writes into a folder, and says what to import."""


def picture(
    path: Path,
    seed: int,
    *,
    size: tuple[int, int] = SIZE,
    time_s: float | None = None,
    orientation: int = 1,
    device: str = "",
    mode: str = "RGB",
) -> Path:
    """A picture of blotches with EXIF."""
    rng = np.random.default_rng([seed, *path.parent.name.encode()])
    coarse = rng.integers(20, 230, (8, 10, 3), dtype=np.uint8)
    image = Image.fromarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)).convert(mode)
    exif = Image.Exif()
    exif[0x112] = orientation
    if device:
        exif[0x10F], exif[0x110] = "Maker", device
    if time_s is not None:
        time = START + timedelta(seconds=time_s)
        exif.get_ifd(0x8769)[0x9003] = time.strftime("%Y:%m:%d %H:%M:%S")
        exif.get_ifd(0x8769)[0x9291] = f"{time.microsecond:06d}"
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, exif=exif)
    return path


def several(folder: Path, count: int = 4, first: int = 0, suffix: str = ".jpg") -> Path:
    for k in range(first, first + count):
        picture(folder / f"IMG_{k:04d}{suffix}", k, time_s=2.0 * k)
    return folder


def navigation(path: Path, start: datetime = START, step_s: float = 1.0, count: int = 20) -> Path:
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time_utc", "latitude_deg", "longitude_deg", "depth_m"])
        for k in range(count):
            time = (start + timedelta(seconds=step_s * k)).isoformat()
            rows.writerow([time, 32.82 + 1e-6 * k, 34.95, 5.0])
    return path


def empty(folder: Path) -> list[str]:
    (folder / "in").mkdir()
    return [str(folder / "in")]


def missing(folder: Path) -> list[str]:
    return [str(folder / "in")]


def a_file_instead(folder: Path) -> list[str]:
    (folder / "in").write_text("pictures are elsewhere")
    return [str(folder / "in")]


def one_picture(folder: Path) -> list[str]:
    return [str(several(folder / "in", 1))]


def rotated(folder: Path) -> list[str]:
    for k, orientation in enumerate((1, 6, 3, 8)):
        picture(folder / "in" / f"{k}.jpg", k, orientation=orientation)
    return [str(folder / "in")]


def mirrored(folder: Path) -> list[str]:
    several(folder / "in", 3)
    picture(folder / "in" / "selfie.jpg", 9, orientation=2)
    return [str(folder / "in")]


def mixed_cameras(folder: Path) -> list[str]:
    for k in range(3):
        picture(folder / "in" / f"G{k}.jpg", k, device="Action 1")
        picture(folder / "in" / f"P{k}.jpg", k + 10, device="Phone 2", size=(48, 64))
    return [str(folder / "in")]


def duplicated(folder: Path) -> list[str]:
    source = several(folder / "in")
    for k in range(4):
        (source / f"IMG_{k:04d} (1).jpg").write_bytes((source / f"IMG_{k:04d}.jpg").read_bytes())
    return [str(source)]


def nothing_but_copies(folder: Path) -> list[str]:
    data = picture(folder / "in" / "a.jpg", 0).read_bytes()
    for k in range(3):
        (folder / "in" / f"copy{k}.jpg").write_bytes(data)
    return [str(folder / "in")]


def heic(folder: Path) -> list[str]:
    for k in range(3):
        (folder / "in").mkdir(exist_ok=True)
        (folder / "in" / f"IMG_{k}.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(200))
    return [str(folder / "in")]


def subfolders(folder: Path) -> list[str]:
    for k in range(2):
        several(folder / "in" / f"{100 + k}GOPRO")
    return [str(folder / "in")]


def truncated(folder: Path) -> list[str]:
    source = several(folder / "in")
    whole = (source / "IMG_0002.jpg").read_bytes()
    (source / "IMG_0002.jpg").write_bytes(whole[: len(whole) // 2])
    (source / "IMG_0003.jpg").write_bytes(b"")
    return [str(source)]


def other_files(folder: Path) -> list[str]:
    source = several(folder / "in")
    for name in (".DS_Store", "Thumbs.db", "notes.txt", "._IMG_0001.jpg"):
        (source / name).write_bytes(b"\0\5\x16\7")
    (source / "GX010001.MP4").write_bytes(b"\0\0\0\x18ftypmp42")
    return [str(source)]


def not_pictures_inside(folder: Path) -> list[str]:
    (folder / "in").mkdir()
    for k in range(3):
        (folder / "in" / f"IMG_{k}.jpg").write_text("<html>404</html>")
    return [str(folder / "in")]


def strange_modes(folder: Path) -> list[str]:
    source = folder / "in"
    picture(source / "grey.png", 0, mode="L")
    picture(source / "alpha.png", 1, mode="RGBA")
    picture(source / "palette.png", 2, mode="P")
    picture(source / "print.jpg", 3, mode="CMYK")
    picture(source / "plain.jpg", 4)
    return [str(source)]


def strange_names(folder: Path) -> list[str]:
    for k, name in enumerate(("Ré cif #1 (2).jpg", "été.JPG", "a b.jpeg", "-w.jpg", "x.y.z.jpg")):
        picture(folder / "in" / name, k)
    return [str(folder / "in")]


def one_frame_dropped(folder: Path) -> list[str]:
    for side, dropped in (("left", 2), ("right", 4)):
        own = 0
        for k in range(7):
            if k != dropped:
                picture(folder / side / f"{own:04d}.jpg", k, time_s=0.25 + 0.5 * k)
                own += 1
    return ["--left", str(folder / "left"), "--right", str(folder / "right")]


def unequal_without_numbers(folder: Path) -> list[str]:
    for side, names in (("left", "abc"), ("right", "pq")):
        for k, name in enumerate(names):
            picture(folder / side / f"{name}.jpg", k)
    return ["--left", str(folder / "left"), "--right", str(folder / "right")]


def same_folder_twice(folder: Path) -> list[str]:
    return ["--left", str(several(folder / "left")), "--right", str(folder / "left")]


def one_side_copied(folder: Path) -> list[str]:
    several(folder / "left")
    (folder / "right").mkdir()
    for path in (folder / "left").iterdir():
        (folder / "right" / path.name).write_bytes(path.read_bytes())
    return ["--left", str(folder / "left"), "--right", str(folder / "right")]


def only_left(folder: Path) -> list[str]:
    return ["--left", str(several(folder / "left"))]


def clock_off(folder: Path) -> list[str]:
    log = navigation(folder / "dive.csv", START - timedelta(hours=3))
    return [str(several(folder / "in")), "--navigation", str(log)]


def clock_off_in_part(folder: Path) -> list[str]:
    log = navigation(folder / "dive.csv", START - timedelta(seconds=16))
    return [str(several(folder / "in")), "--navigation", str(log)]


def no_times(folder: Path) -> list[str]:
    for k in range(3):
        picture(folder / "in" / f"{k}.jpg", k)
    return [str(folder / "in"), "--navigation", str(navigation(folder / "dive.csv"))]


def navigation_of_commas(folder: Path) -> list[str]:
    log = navigation(folder / "dive.csv")
    log.write_text(log.read_text().replace(",", ";").replace(".", ","))
    return [str(several(folder / "in")), "--navigation", str(log)]


def wrong_rig(folder: Path) -> list[str]:
    write_rig(folder / "rig.json", design_rig(CameraConfig(), WaterConfig()))
    return [str(several(folder / "in")), "--rig", str(folder / "rig.json")]


def not_a_rig(folder: Path) -> list[str]:
    (folder / "rig.json").write_text('{"cameras": 3}')
    return [str(several(folder / "in")), "--rig", str(folder / "rig.json")]


def masks_of_another_size(folder: Path) -> list[str]:
    several(folder / "in")
    for k in range(4):
        picture(folder / "masks" / f"IMG_{k:04d}.png", k, size=(10, 10), mode="L")
    return [str(folder / "in"), "--masks", str(folder / "masks")]


def a_video_that_is_none(folder: Path) -> list[str]:
    (folder / "GX010001.MP4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(500))
    return ["--video", str(folder / "GX010001.MP4")]


@dataclass(frozen=True, kw_only=True)
class End:
    """What a user sees in the end."""

    error: str = ""
    """Words of the one line; empty where it ends well."""
    pictures: int = 0
    cameras: int = 1
    stations: int | None = None
    said: str = ""
    """Words of a warning or of the summary."""


END: dict[Build, End] = {
    empty: End(error="holds no pictures"),
    missing: End(error="no such file or folder"),
    a_file_instead: End(error="in: cannot be read: Not a directory"),
    one_picture: End(error="1 usable picture: a model needs"),
    rotated: End(pictures=4),
    mirrored: End(pictures=3, said="mirror image"),
    mixed_cameras: End(pictures=6, cameras=2),
    duplicated: End(pictures=4, said="is the same file as"),
    nothing_but_copies: End(error="1 usable picture"),
    heic: End(error="pip install pillow-heif"),
    subfolders: End(error="--recursive"),
    truncated: End(pictures=2, said="IMG_0003.jpg is left out"),
    other_files: End(pictures=4, said="--video"),
    not_pictures_inside: End(error="0 usable pictures"),
    strange_modes: End(pictures=5, cameras=1),
    strange_names: End(pictures=5),
    one_frame_dropped: End(pictures=12, cameras=2, stations=7, said="1 of left, 1 of right"),
    unequal_without_numbers: End(error="pictures do not pair: 3 of left"),
    same_folder_twice: End(error="is given twice"),
    one_side_copied: End(error="left and right have the same picture"),
    only_left: End(error="--left and --right go together"),
    clock_off: End(error="--clock-offset"),
    clock_off_in_part: End(pictures=4, said="--clock-offset|outside|without"),
    no_times: End(error="--triggers"),
    navigation_of_commas: End(error="commas between cells"),
    wrong_rig: End(error="has 64 x 48 pixels, but the rig's"),
    not_a_rig: End(error="rig.json"),
    masks_of_another_size: End(error="IMG_0000.png"),
    a_video_that_is_none: End(error="GX010001.MP4"),
}


def command(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[int, str, str]:
    """Exit code, output and errors of a command in this process."""
    monkeypatch.setattr(sys, "argv", ["alice-survey", *words])
    capsys.readouterr()
    try:
        main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    shown = capsys.readouterr()
    return code, shown.out, shown.err


@pytest.mark.parametrize("build", END, ids=lambda build: build.__name__)
def test_a_folder_ends_well_or_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    build: Build,
) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    end, work = END[build], tmp_path / "work"
    code, out, err = command(
        ["import-images", *build(tmp_path), "-w", str(work), "--threads", "1"], capsys, monkeypatch
    )
    if end.error:
        assert code == 1, out
        *_, last = err.splitlines()
        assert last.startswith("error: ") and end.error in last, err
        assert sum(line.startswith("error: ") for line in err.splitlines()) == 1
        assert not (work / "images").exists()
        return
    assert code == 0, err
    records = read_manifest(work / "images" / "manifest.csv")
    assert len(records) == end.pictures
    assert len({record.camera for record in records}) == end.cameras
    if end.stations is not None:
        assert len({record.station for record in records}) == end.stations
    assert any(words in err + out for words in end.said.split("|")), err + out
    assert PicturesRecord.read(work / "images" / "survey.json").source == "imported"


def test_a_troubled_folder_becomes_a_model(
    shared_data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Turned, doubled, cut and black pictures among those of a beach, and one of elsewhere."""
    folder, work = tmp_path / "in", tmp_path / "work"
    folder.mkdir()
    work.mkdir()
    (work / "survey.toml").write_text("[reconstruct]\nmax_features = 1500\n")
    sources = sorted((shared_data / "brighton_beach" / "images").glob("*.jpg"))[9:14]
    for k, source in enumerate(sources):
        with Image.open(source) as image:
            small = image.resize((image.width // 3, image.height // 3), Image.Resampling.BOX)
            exif = image.getexif()
            exif[0x112] = (1, 6, 3, 8, 1)[k]
            small.save(folder / source.name, exif=exif, quality=92)
    size = small.size
    (folder / f"{sources[0].stem} (1).jpg").write_bytes((folder / sources[0].name).read_bytes())
    (folder / "cut.jpg").write_bytes((folder / sources[1].name).read_bytes()[:4000])
    Image.new("RGB", size).save(folder / "black.jpg", exif=exif)
    rng = np.random.default_rng(1)
    elsewhere = cv2.resize(rng.integers(0, 256, (60, 80, 3), dtype=np.uint8), size)
    Image.fromarray(elsewhere).save(folder / "elsewhere.jpg", exif=exif)
    code, _, err = command(
        ["import-images", str(folder), "-w", str(work), "--threads", "1"], capsys, monkeypatch
    )
    assert code == 0, err
    assert "(1).jpg is left out" in err and "cut.jpg is left out" in err
    code, _, err = command(["reconstruct", "-w", str(work), "--threads", "1"], capsys, monkeypatch)
    assert code == 0, err
    found = RegistrationRecord.read(work / "sparse" / "registration.json")
    assert (found.registered, found.total) == (5, 7)
    assert (work / "mosaic" / "mosaic.tif").is_file()
