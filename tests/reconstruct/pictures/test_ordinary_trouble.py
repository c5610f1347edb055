"""Folders as divers bring them: turned, mixed, doubled, nested, of phones."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.core.artefacts import read_json
from alice_survey.core.errors import ImageError, keep_warnings
from alice_survey.core.manifest import read_manifest
from reconstruct.pictures.files import decode, exif_focal_px, inspect
from reconstruct.pictures.importing import import_images, preview_import
from reconstruct.pictures.undistorted import read_colour
from tests.reconstruct.pictures.dated import counts, reasons, rows_of, save, table, take

DISPLAYED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda a: a, 2: np.fliplr, 3: lambda a: np.rot90(a, 2), 4: np.flipud,
    5: lambda a: a.swapaxes(0, 1), 6: lambda a: np.rot90(a, -1),
    7: lambda a: np.rot90(a.swapaxes(0, 1), 2), 8: np.rot90,
}  # fmt: skip
"""What a viewer makes of stored pixels, by orientation (EXIF 2.32, 4.6.5.1.2)."""


def smooth(seed: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    """(H, W, 3) RGB that JPEG hardly changes, without symmetry."""
    rng = np.random.default_rng(seed)
    small = rng.uniform(30, 220, (4, 5, 3))
    large = cv2.resize(small, size, interpolation=cv2.INTER_CUBIC)
    return np.clip(large, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_used_as_stored(tmp_path: Path, suffix: str, orientation: int) -> None:
    """The same in features, calibration and mosaic, and in every viewer of the copies."""
    stored = [smooth(seed) for seed in range(2)]
    for number, pixels in enumerate(stored):
        save(tmp_path / "in" / f"{number}{suffix}", pixels, orientation=orientation, focal=28)
    first = tmp_path / "in" / f"0{suffix}"
    seen = cv2.imread(str(first), cv2.IMREAD_COLOR)
    if suffix != ".tif":  # of which OpenCV cannot read all
        assert np.abs(seen[..., ::-1].astype(int) - DISPLAYED[orientation](stored[0])).max() < 12
    assert np.abs(decode(first)[..., ::-1].astype(int) - stored[0]).max() < 12
    if orientation in (2, 4, 5, 7):
        fault = inspect(first).fault
        assert "mirror image" in fault and f"orientation {orientation}" in fault
        with pytest.raises(ImageError, match="0 usable pictures"):
            import_images(tmp_path / "w", [tmp_path / "in"])
        return
    import_images(tmp_path / "w", [tmp_path / "in"])
    images = tmp_path / "w" / "images"
    for record, pixels in zip(read_manifest(images / "manifest.csv"), stored, strict=True):
        copy = images / record.image
        for read in (read_colour(copy), cv2.imread(str(copy), cv2.IMREAD_COLOR)):
            assert read.shape == pixels.shape
            assert np.abs(read[..., ::-1].astype(int) - pixels).max() < 12
        if suffix == ".jpg":
            assert exif_focal_px(copy, 64, 48) == pytest.approx(28 / 36 * 64)


def test_cameras_of_a_mixed_folder_are_told_apart_by_exif_and_size(tmp_path: Path) -> None:
    hero = {"make": "GoPro", "model": "GoPro HERO9"}
    phone = {"make": "Apple", "model": "iPhone 15"}
    for name, count, size, tags in (
        ("a", 6, (64, 48), hero | {"serial": "C3"}), ("b", 3, (64, 48), hero | {"serial": "C4"}),
        ("c", 2, (80, 60), phone), ("d", 1, (64, 48), {}),
    ):  # fmt: skip
        for number in range(count):
            turned = {"orientation": (1, 3)[number % 2]} if name == "a" else {}
            pixels = smooth(10 * ord(name) + number, size)
            save(tmp_path / "in" / f"{name}{number}.jpg", pixels, **tags, **turned)
    found = import_images(tmp_path / "w", [tmp_path / "in"])
    assert counts(found) == {"camera": 6, "camera-2": 3, "camera-3": 2, "camera-4": 1}
    assert found.lines == [
        "camera: 6 of 64 x 48 pixels, GoPro HERO9 #C3",
        "camera-2: 3 of 64 x 48 pixels, GoPro HERO9 #C4",
        "camera-3: 2 of 80 x 60 pixels, Apple iPhone 15",
        "camera-4: 1 of 64 x 48 pixels",
    ]
    images = tmp_path / "w" / "images"
    assert all(r.camera == r.image.split("/")[0] for r in rows_of(tmp_path / "w"))
    assert read_json(images / "survey.json")["notes"][-4:] == found.lines


def test_zooms_of_one_camera_are_several_lenses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also a crop by which the focal length on film alone changes; 0 and 1 are unknown."""
    for number, (lens, film) in enumerate([(4.5, 25), (6.3, 35), (4.5, 0), (4.5, 50), (0, 1)] * 2):
        tags = {"model": "TG-6", "lens": lens, "focal": film}
        save(tmp_path / "in" / f"{number}.jpg", smooth(number), **tags)
    found = import_images(tmp_path / "w", [tmp_path / "in"])
    names = ["camera", *(f"camera-{n}" for n in range(2, 6))]
    assert counts(found) == counts(preview_import([tmp_path / "in"])) == dict.fromkeys(names, 2)
    assert "one lens" not in capsys.readouterr().err
    import_images(tmp_path / "v", [], cameras={"down": tmp_path / "in"})
    assert "5 cameras or zooms" in capsys.readouterr().err


def test_one_file_of_each_shot_is_taken(tmp_path: Path) -> None:
    """The one without losses, else the larger; the JPEG where that cannot be decoded."""
    folder = tmp_path / "in"
    for number in range(5):
        tags = {"model": "TG", "taken": f"2024:07:01 12:00:0{number}"} if number else {}
        save(folder / f"P{number}.JPG", smooth(number), **tags)
        size = (32, 24) if number == 1 else (64, 48)
        save(folder / f"p{number}.png", smooth(number + 9, size), **tags)
    cut = folder / "p2.png"
    cut.write_bytes(cut.read_bytes()[:-2000])
    save(folder / "p3.bmp", smooth(6))
    save(folder / "b" / "P4.webp", smooth(4, (32, 24)), **tags)
    save(folder / "b" / "P3.jpg", smooth(7), model="TG", taken="2024:07:01 13:00:00")
    save(folder / "b" / "P0.bmp", smooth(8))
    expected = ["p0.png", "p0_2.png", "p1.jpg", "p2.jpg", "p3.jpg", "p3.png", "p4.png"]
    seen = preview_import([folder], recursive=True)
    found = import_images(tmp_path / "w", [folder], recursive=True)
    assert sorted(Path(r.image).name.lower() for r in rows_of(tmp_path / "w")) == expected
    assert {Path(name).stem.lower() for name in found.left_out["other files of a shot"]} == {
        "p0", "p1", "p3", "p4",
    }  # fmt: skip
    assert reasons(found) == {"other files of a shot": 6, "cannot be decoded": 1}
    assert reasons(seen) == {"other files of a shot": 7} and seen.pictures == len(expected)
    triggers = table(tmp_path / "t.csv", "image,time_s", [(f"p{n}", n) for n in (2, 3, 4)])
    import_images(tmp_path / "v", [folder], triggers=triggers)
    assert [r.time_s for r in rows_of(tmp_path / "v")] == [2, 3, 4]


def test_copies_are_left_out_and_named(tmp_path: Path) -> None:
    for number in range(3):
        path = save(tmp_path / "in" / f"{number}.png", smooth(number))
    (tmp_path / "in" / "2 (1).png").write_bytes(path.read_bytes())
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "IMG_2.png").write_bytes(path.read_bytes())
    found = import_images(tmp_path / "w", [tmp_path / "in", tmp_path / "more"])
    assert counts(found) == {"camera": 3} and reasons(found) == {"copies of others": 2}
    assert set(found.left_out["copies of others"]) == {"2 (1).png", "IMG_2.png"}
    (tmp_path / "other").mkdir()
    for number, name in enumerate("abc"):
        source = tmp_path / "in" / f"{number}.png"
        (tmp_path / "other" / f"{name}.png").write_bytes(source.read_bytes())
    cameras = {"left": tmp_path / "in", "right": tmp_path / "other"}
    (tmp_path / "in" / "2 (1).png").unlink()
    with pytest.raises(ImageError, match="left and right have the same picture"):
        import_images(tmp_path / "v", [], cameras=cameras)


def test_folders_inside_are_taken_on_request(tmp_path: Path) -> None:
    source = tmp_path / "card"
    names = ["100GOPRO/G2.jpg", "100GOPRO/G10.jpg", "101GOPRO/G2.jpg", "a.jpg"]
    for number, name in enumerate(names):
        save(source / name, smooth(number))
    save(source / ".trash" / "x.jpg", smooth(8))
    save(source / "masks" / "G10.png", np.full((48, 64), 255, np.uint8))
    for name in ("100GOPRO/G2_mask.png", "101GOPRO/notes.txt"):
        (source / name).write_bytes((source / "masks" / "G10.png").read_bytes())
    found = import_images(tmp_path / "w", [source, source / "101GOPRO"])
    assert any("--recursive" in line for line in found.omissions)
    work = source / "work"
    for _ in range(2):  # what it wrote itself is not taken
        found = import_images(work, [source], recursive=True, masks=source / "masks")
        records = rows_of(work)
        copies = ["G2.jpg", "G10.jpg", "G2_2.jpg", "a.jpg"]
        assert [r.image for r in records] == [f"camera/{name}" for name in copies]
        assert reasons(found) == {"other files": 1}
    assert [bool(r.mask) for r in records] == [False, True, False, False]
    import_images(tmp_path / "v", [source], recursive=True)
    records = rows_of(tmp_path / "v")
    assert [r.image for r in records if r.mask] == ["camera/G2.jpg"]


@pytest.mark.parametrize(
    ("place", "said"),
    [("43,5", ""), ("5,43", "exchanged"), ("43.01,5", "1.11 km"), ("0,0", "no fix")],
)
def test_navigation_is_compared_with_exif(tmp_path: Path, place: str, said: str) -> None:
    rows = [f"{name}.jpg,{place},3" for name in "ab"]
    for i, name in enumerate("ab"):
        take(tmp_path / "in" / f"{name}.jpg", i, place=0.0)
    log = table(tmp_path / "n.csv", "image,lat,lon,depth", [row.split(",") for row in rows])
    with keep_warnings() as warned:
        import_images(tmp_path / "w", [tmp_path / "in"], navigation=log)
    assert [said in text for text in warned] == [True] * bool(said)
    assert rows_of(tmp_path / "w")[0].depth_m == 3.0
