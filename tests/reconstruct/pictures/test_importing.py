import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, TiffImagePlugin, TiffTags

from alice_survey.core.artefacts import read_json
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import AliceError, ImageError, WorkspaceError, keep_warnings
from alice_survey.core.executor import local_executor
from alice_survey.core.manifest import read_manifest
from camera_calib.rig import design_rig, read_rig, write_rig
from reconstruct.pictures.files import inspect
from reconstruct.pictures.importing import import_images, join_dives, preview_import
from tests.reconstruct.pictures.dated import counts, date, noise, reasons, rows_of, save, table


def draw(path: Path, number: int = 0, size: Any = (64, 48), **tags: Any) -> Path:
    """Write a picture of noise by its number and folder."""
    return save(path, noise(number, *path.parent.name.encode(), size=size), **tags)


def several(folder: Path, count: int, *, dated: bool = False, suffix: str = ".jpg") -> Path:
    """Write pictures `in/0.jpg` and on; with dates, they are of 12:00:00 and the seconds after."""
    for number in range(count):
        tags = {"taken": date(number)} if dated else {}
        draw(folder / "in" / f"{number}{suffix}", number, **tags)
    return folder / "in"


def pair_in(folder: Path) -> dict[str, Path]:
    return {name: folder / name for name in ("left", "right")}


def test_pictures_of_one_camera_keep_their_bytes_and_order(tmp_path: Path) -> None:
    source = tmp_path / "in"
    for number, name in enumerate(["b10.jpg", "b9.jpg", "a.PNG"]):
        draw(source / name, number)
    (source / "notes.txt").write_text("no picture")
    (source / ".hidden.jpg").write_bytes(b"x")
    assert import_images(tmp_path / "w", [source]).changed
    images = tmp_path / "w" / "images"
    records = read_manifest(images / "manifest.csv")
    assert [r.image for r in records] == ["camera/a.png", "camera/b9.jpg", "camera/b10.jpg"]
    assert [r.station for r in records] == [0, 1, 2]
    for record, name in zip(records, ["a.PNG", "b9.jpg", "b10.jpg"], strict=True):
        assert (images / record.image).read_bytes() == (source / name).read_bytes()
    survey = read_json(images / "survey.json")
    assert (survey["source"], survey["datum"]) == ("imported", None) and survey["notes"]
    assert not import_images(tmp_path / "w", [source]).changed
    draw(source / "c.jpg", 9)
    assert import_images(tmp_path / "w", [source]).changed


def test_a_divers_folder_is_counted_by_kind_and_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "in"
    for number in range(4):
        place = (60.0 + number * 1e-5, 5.0, 0.0)
        draw(source / f"IMG_{number}.JPG", number, taken=date(number), gps=place)
    draw(source / "scan.png", 9)
    (source / "IMG_7.jpg").write_bytes(b"cut")
    for name in ("IMG_5.HEIC", "IMG_6.heic", "GX010001.MOV", "notes.txt", ".DS_Store"):
        (source / name).write_bytes(b"x")
    draw(source / "second" / "IMG_8.jpg", 8)
    (source / "empty").mkdir()

    found = import_images(tmp_path / "w", [source])

    assert found.changed and counts(found) == {"camera": 5} and found.positions == 4
    assert found.kinds == {"JPEG": 4, "PNG": 1}
    assert reasons(found) == {
        "cannot be decoded": 1, "HEIC": 2, "video": 1, "in folders inside": 1, "other files": 1,
    }  # fmt: skip
    assert "IMG_7.jpg is left out" in capsys.readouterr().err
    for name in ("IMG_7.jpg", "IMG_5.HEIC", "GX010001.MOV", "IMG_8.jpg", "notes.txt"):
        assert sum(name in line for line in found.omissions) == 1
    again = import_images(tmp_path / "w", [source])
    assert not again.changed and again.model_copy(update={"changed": True}) == found


def test_stereo_pictures_pair_in_order(tmp_path: Path) -> None:
    for number in range(3):
        draw(tmp_path / "left" / f"p{number}.png", number)
        draw(tmp_path / "right" / f"s{number + 5}.png", number + 10)
    import_images(tmp_path / "w", [], cameras=pair_in(tmp_path))
    records = rows_of(tmp_path / "w")
    assert [(r.image, r.station) for r in records] == [
        (f"{side}/{letter}{n + first}.png", n)
        for n in range(3)
        for side, letter, first in (("left", "p", 0), ("right", "s", 5))
    ]


def test_a_camera_that_missed_a_moment_is_paired_by_number(tmp_path: Path) -> None:
    cameras = {name: tmp_path / name for name in ("down", "bow", "port")}
    for side in cameras:
        for number in range(7, 12):
            if (side, number) != ("bow", 8):
                draw(tmp_path / side / f"{side}_{number}.png", number)
    with keep_warnings() as warnings:
        found = import_images(tmp_path / "w", [], cameras=cameras)
    assert str(found) == "14 pictures (14 PNG) of down, bow and port, 0 with a position"
    assert not warnings
    assert {(r.image, r.station) for r in rows_of(tmp_path / "w")} == {
        (f"{side}/{path.name}", int(path.stem.removeprefix(f"{side}_")) - 7)
        for side, folder in cameras.items()
        for path in folder.iterdir()
    }


def test_one_camera_of_a_rig_goes_by_its_name(tmp_path: Path) -> None:
    rig = design_rig(CameraConfig(), WaterConfig())
    widths = {"left": 80, "right": 64}
    cameras = {n: replace(rig.cameras[n], width_px=w, height_px=48) for n, w in widths.items()}
    write_rig(tmp_path / "rig.json", replace(rig, cameras=cameras))
    for number in range(2):
        draw(tmp_path / "in" / f"{number}.png", number)
    with pytest.raises(ImageError, match="--camera NAME=FOLDER says if right took them"):
        import_images(tmp_path / "w", [tmp_path / "in"], rig=tmp_path / "rig.json")
    given = {"right": tmp_path / "in"}
    found = import_images(tmp_path / "w", [], cameras=given, rig=tmp_path / "rig.json")
    assert counts(found) == {"right": 2}


def test_a_corrupt_picture_is_left_out_and_its_partner_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for side in ("left", "right"):
        for number in range(4):
            draw(tmp_path / side / f"{number}.jpg", number, size=(200, 150))
    whole = (tmp_path / "left" / "1.jpg").read_bytes()
    (tmp_path / "left" / "1.jpg").write_bytes(whole[: len(whole) * 2 // 3])  # truncated
    (tmp_path / "right" / "2.jpg").write_bytes(b"no picture at all")
    (tmp_path / "right" / "3.jpg").write_bytes(b"")
    import_images(tmp_path / "w", [], cameras=pair_in(tmp_path))
    shown = capsys.readouterr().err
    for name in ("left/1.jpg", "right/2.jpg", "right/3.jpg"):
        assert name in shown
    records = rows_of(tmp_path / "w")
    kept = [(r.camera, r.station) for r in records]
    assert kept == [("left", 0), ("right", 0), ("right", 1), ("left", 2), ("left", 3)]


def test_sixteen_bits_become_eight_by_one_gain_per_camera(tmp_path: Path) -> None:
    """12 bits of sensor in 16 of file: the upper 8 of the 12 are kept, the same in each picture."""
    rng = np.random.default_rng(1)
    dim = rng.integers(0, 300, (40, 50, 3)).astype(np.uint16)
    bright = rng.integers(0, 4096, (40, 50, 3)).astype(np.uint16)
    (tmp_path / "in").mkdir()
    cv2.imwrite(str(tmp_path / "in" / "a.tiff"), dim)
    cv2.imwrite(str(tmp_path / "in" / "b.png"), bright)
    import_images(tmp_path / "w", [tmp_path / "in"])
    images = tmp_path / "w" / "images"
    for name, taken in (("a", dim), ("b", bright)):
        np.testing.assert_array_equal(cv2.imread(str(images / f"camera/{name}.png")), taken >> 4)
    assert any("12 bits" in note for note in read_json(images / "survey.json")["notes"])


@pytest.mark.parametrize("suffix", ["bmp", "ppm", "webp", "jp2", "PNG"])
def test_every_kind_of_picture_keeps_its_pixels(tmp_path: Path, suffix: str) -> None:
    pixels = np.random.default_rng(3).integers(0, 256, (48, 64, 3))
    several(tmp_path, 1)
    exact = cv2.IMWRITE_JPEG2000_COMPRESSION_X1000
    lossless = {"webp": [cv2.IMWRITE_WEBP_QUALITY, 101], "jp2": [exact, 1000]}
    cv2.imwrite(
        str(tmp_path / "in" / f"a.{suffix}"), pixels.astype(np.uint8), lossless.get(suffix, [])
    )
    import_images(tmp_path / "w", [tmp_path / "in"])
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "w/images/camera/a.png")), pixels)


def test_gps_of_exif_gives_positions_and_a_datum(tmp_path: Path) -> None:
    places = [(-33.5, 151.25, 12.5), (-33.5001, 151.2501, 13.0), (-33.5002, 151.25, -2.0)]
    for number, place in enumerate(places):
        draw(tmp_path / "in" / f"{number}.jpg", number, taken=date(number), gps=place)
    import_images(tmp_path / "w", [tmp_path / "in"])
    images = tmp_path / "w" / "images"
    for record, place in zip(rows_of(tmp_path / "w"), places, strict=True):
        found = (record.latitude_deg, record.longitude_deg, -record.depth_m)
        assert found == pytest.approx(place, abs=1e-6)
        assert record.time_s == pytest.approx(record.station)
    survey = read_json(images / "survey.json")
    assert survey["vertical_datum"] == "EXIF GPS altitude"
    assert survey["datum"]["latitude_deg"] == pytest.approx(-33.5, abs=1e-6)


def test_navigation_is_tied_by_time_zone_and_clock_offset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, second in enumerate([0, 4, 8, 50]):
        draw(tmp_path / "in" / f"{number}.jpg", number, taken=date(second))
    rows = [[f"2024-07-01T10:00:{s:02d}Z", 60 + s * 1e-5, 5.0, 10 + s, 90.0] for s in range(15)]
    header = "time_utc,latitude_deg,longitude_deg,depth_m,heading_deg"
    nav = table(tmp_path / "nav.csv", header, rows)
    given: dict[str, Any] = {"clock_offset_s": 2.5, "time_zone": "Europe/Oslo", "navigation": nav}
    # the name of the level alone differs: depths stay as logged
    for name, level in (("sea surface, as in the navigation log", None), ("NN2000", " NN2000 ")):
        import_images(tmp_path / "w", [tmp_path / "in"], vertical_datum=level, **given)
        records = rows_of(tmp_path / "w")
        assert [r.time_s for r in records] == [2.5, 6.5, 10.5, 52.5]
        assert [r.depth_m for r in records[:3]] == pytest.approx([12.5, 16.5, 20.5])
        assert records[1].heading_deg == pytest.approx(90)
        assert not records[3].has_position
        assert read_json(tmp_path / "w" / "images" / "survey.json")["vertical_datum"] == name
    assert "camera/3.jpg" in capsys.readouterr().err


@pytest.mark.parametrize("columns", ["depth_m", "depth_m,heading_deg", "altitude_m", "heading_deg"])
def test_a_log_of_any_one_reading_is_taken(
    tmp_path: Path, columns: str, capsys: pytest.CaptureFixture[str]
) -> None:
    readings = [name.rsplit("_", 1)[0] for name in columns.split(",")]
    source = several(tmp_path, 3, dated=True)
    rows = [[f"2024-07-01T12:00:{s:02d}Z", *[10 + s] * len(readings)] for s in range(9)]
    nav = table(tmp_path / "nav.csv", f"time_utc,{columns}", rows)
    done = import_images(tmp_path / "w", [source], navigation=nav)
    assert dict(done.readings) == dict.fromkeys(readings, 3)
    assert all(f"3 with {name}" in str(done) for name in readings)
    records = rows_of(tmp_path / "w")
    for name in columns.split(","):
        assert [getattr(r, name) for r in records] == pytest.approx([10.0, 11.0, 12.0])
    assert read_json(tmp_path / "w" / "images" / "survey.json")["datum"] is None
    assert "warning" not in capsys.readouterr().err


def test_masks_come_along(tmp_path: Path) -> None:
    several(tmp_path, 3, suffix=".png")
    near, apart = np.full((48, 64), 255, np.uint8), np.zeros((48, 64), np.uint8)
    near[:10] = 0
    apart[:, 32:] = 7
    cv2.imwrite(str(tmp_path / "in" / "1_mask.png"), near)
    import_images(tmp_path / "w", [tmp_path / "in"])
    images = tmp_path / "w" / "images"
    records = read_manifest(images / "manifest.csv")
    assert [bool(r.mask) for r in records] == [False, True, False]
    np.testing.assert_array_equal(cv2.imread(str(images / records[1].mask), 0), near)
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "2.png"), apart)
    import_images(tmp_path / "w", [tmp_path / "in"], masks=tmp_path / "masks")
    records = read_manifest(images / "manifest.csv")
    assert [bool(r.mask) for r in records] == [False, False, True]
    np.testing.assert_array_equal(cv2.imread(str(images / records[2].mask), 0), (apart > 0) * 255)


BESIDE = ("1.jpg.png", "1_mask.JPG", "1.JPG_mask.png")


@pytest.mark.parametrize(
    ("name", "apart"),
    [*((name, False) for name in BESIDE), *((name, True) for name in (*BESIDE, "1.PNG", "1.TIF"))],
)
def test_masks_are_found_by_the_names_that_other_programs_give(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, apart: bool
) -> None:
    several(tmp_path, 2)
    mask = np.full((48, 64), 255, np.uint8)
    mask[:16] = 0
    folder = tmp_path / ("masks" if apart else "in")
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / name), mask)
    import_images(tmp_path / "w", [tmp_path / "in"], masks=folder if apart else None)
    records = rows_of(tmp_path / "w")
    assert [bool(r.mask) for r in records] == [False, True]
    assert (cv2.imread(str(tmp_path / "w/images" / records[1].mask), 0) == mask).all()
    assert "mask" not in capsys.readouterr().err
    if apart:
        (folder / name).rename(folder / f"other{name}")
        import_images(tmp_path / "w", [tmp_path / "in"], masks=folder)
        assert "0 of 1 masks" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".png", ".webp", ".tif"])
def test_what_alpha_leaves_out_is_masked(
    tmp_path: Path, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """An alpha that is opaque, or nowhere so, says nothing; a mask of a file counts as well."""
    alphas = np.full((4, 48, 64), 255, np.uint8)
    alphas[1, :9], alphas[1, 9:20], alphas[2], alphas[3, :, :7] = 100, 200, 0, 0
    for number, alpha in enumerate(alphas):
        path = tmp_path / "in" / f"{number}{suffix}"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(np.dstack([noise(number), alpha])).save(path, lossless=True)
    named = np.full((48, 64), 255, np.uint8)
    named[40:] = 0
    cv2.imwrite(str(tmp_path / "in" / "3_mask.png"), named)
    import_images(tmp_path / "w", [tmp_path / "in"])
    assert "2 pictures are cut out" in capsys.readouterr().err
    masks = [r.mask for r in rows_of(tmp_path / "w")]
    assert [bool(mask) for mask in masks] == [False, True, False, True]
    found = [cv2.imread(str(tmp_path / "w/images" / mask), 0) for mask in masks if mask]
    np.testing.assert_array_equal(found[0], np.where(alphas[1] > 127, 255, 0))
    np.testing.assert_array_equal(found[1], np.minimum(named, alphas[3]))


def test_frames_of_two_cameras_are_cut_into_those_of_a_rig(tmp_path: Path) -> None:
    """Without loss, with the halves of their masks, as pictures of two folders would be."""
    frames = [noise(number, size=(128, 48)) for number in range(3)]
    mask = np.full((48, 128), 255, np.uint8)
    mask[:, :10], mask[:5, 64:] = 0, 0
    for number, pixels in enumerate(frames):
        save(tmp_path / "in" / f"f{number}.jpg", pixels, taken=date(number))
        stored = cv2.imread(str(tmp_path / "in" / f"f{number}.jpg"))
        for side, half in (("left", stored[:, :64]), ("right", stored[:, 64:])):
            (tmp_path / side).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / side / f"f{number}.png"), half)
    cv2.imwrite(str(tmp_path / "in" / "f1_mask.png"), mask)
    rig = design_rig(CameraConfig(), WaterConfig())
    small = {n: replace(model, width_px=64, height_px=48) for n, model in rig.cameras.items()}
    write_rig(tmp_path / "rig.json", replace(rig, cameras=small))
    found = import_images(tmp_path / "w", [tmp_path / "in"], split=True, rig=tmp_path / "rig.json")
    seen = preview_import([tmp_path / "in"], split=True)
    assert counts(found) == counts(seen) == {"left": 3, "right": 3}
    assert seen.cameras["right"].width_px == 64
    import_images(tmp_path / "v", [], cameras=pair_in(tmp_path))
    cut, apart = rows_of(tmp_path / "w"), rows_of(tmp_path / "v")
    key = [(r.image, r.camera, r.station) for r in cut]
    assert key == [(r.image, r.camera, r.station) for r in apart]
    assert [r.time_s for r in cut] == [0, 0, 1, 1, 2, 2]
    for r in cut:
        one, other = (cv2.imread(str(tmp_path / w / "images" / r.image)) for w in "wv")
        np.testing.assert_array_equal(one, other)
    masks = [cv2.imread(str(tmp_path / "w/images" / r.mask), 0) for r in cut if r.mask]
    np.testing.assert_array_equal(np.hstack(masks), mask)
    with pytest.raises(ImageError, match="--split"):
        import_images(tmp_path / "u", [], cameras=pair_in(tmp_path), split=True)
    save(tmp_path / "in" / "odd.png", noise(9, size=(63, 48)))
    (tmp_path / "in" / "f0.jpg").write_bytes(b"never decoded")
    with pytest.raises(ImageError, match="63"):
        import_images(tmp_path / "u", [tmp_path / "in"], split=True)


def test_pictures_of_another_import_are_not_replaced(tmp_path: Path) -> None:
    work, one = tmp_path / "w", several(tmp_path / "a", 3)
    import_images(work, [one])
    (one / "0.jpg").unlink()
    draw(one / "9.jpg", 9)
    assert counts(import_images(work, [one])) == {"camera": 3}
    moved = one.rename(tmp_path / "moved")
    assert counts(import_images(work, [moved])) == {"camera": 3}
    other = several(tmp_path / "b", 4, suffix=".png")
    (moved / "1.jpg").write_bytes(b"never decoded")
    with pytest.raises(WorkspaceError, match="--replace"):
        import_images(work, [other])
    assert len(rows_of(work)) == 3
    assert counts(import_images(work, [other], overwrite=True)) == {"camera": 4}
    dives = [tmp_path / "d1", tmp_path / "d2"]
    for dive in dives:
        import_images(dive, [other])
    with pytest.raises(WorkspaceError, match="another workspace"):
        join_dives(work, dives)
    for _ in range(2):
        join_dives(tmp_path / "both", dives)
    with pytest.raises(WorkspaceError, match="--replace"):
        import_images(tmp_path / "both", [other])


def test_names_stay_inside_and_apart(tmp_path: Path) -> None:
    draw(tmp_path / "one" / "-x..jpg", 0)
    draw(tmp_path / "one" / "a b;c.jpg", 1)
    draw(tmp_path / "two" / "A b;c.JPG", 2)
    draw(tmp_path / "far" / "away.jpg", 3)
    (tmp_path / "two" / "link.jpg").symlink_to(tmp_path / "far" / "away.jpg")
    (tmp_path / "two" / "folder.jpg").mkdir()
    import_images(tmp_path / "w", [tmp_path / "one", tmp_path / "two"])
    images = tmp_path / "w" / "images"
    names = [r.image for r in read_manifest(images / "manifest.csv")]
    assert names == [
        "camera/-x.jpg", "camera/a_b_c.jpg", "camera/A_b_c_2.jpg", "camera/link.jpg",
    ]  # fmt: skip
    assert not any(path.is_symlink() for path in images.rglob("*"))
    linked = (images / "camera" / "link.jpg").read_bytes()
    assert linked == (tmp_path / "far" / "away.jpg").read_bytes()


def test_a_rig_must_be_that_of_the_pictures(tmp_path: Path) -> None:
    for side in ("left", "right"):
        for number in range(2):
            draw(tmp_path / side / f"{number}.png", number, size=(846, 677))
    small = CameraConfig(width_px=846, height_px=677, pixel_um=14.76)
    write_rig(tmp_path / "good.json", design_rig(small, WaterConfig()))
    write_rig(tmp_path / "bad.json", design_rig(CameraConfig(), WaterConfig()))
    pair = pair_in(tmp_path)
    import_images(tmp_path / "w", [], cameras=pair, rig=tmp_path / "good.json")
    assert read_rig(tmp_path / "w" / "images" / "rig.json").cameras["left"].width_px == 846
    with pytest.raises(ImageError, match=r"846 x 677.*3384 x 2710"):
        import_images(tmp_path / "w", [], cameras=pair, rig=tmp_path / "bad.json")
    assert (tmp_path / "w" / "images" / "rig.json").exists()  # what was there stays


def test_every_fault_names_its_cause(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    draw(tmp_path / "one" / "0.jpg")
    for number in range(3):
        draw(tmp_path / "three" / f"{number}.jpg", number)
        draw(tmp_path / "sizes" / f"{number}.jpg", number, size=(64, 48 + (number == 2)))
    (tmp_path / "no.mp4").write_bytes(b"no video")
    several(tmp_path, 2, dated=True)
    header = "time_s,latitude_deg,longitude_deg,depth_m"
    nav = table(tmp_path / "nav.csv", header, [[0, 60, 5, 3], [1, 60, 5, 3]])
    rows = [["2024-07-02T12:00:01Z", 10], ["2024-07-02T12:00:09Z", 10]]
    later = table(tmp_path / "later.csv", "time_utc,depth_m", rows)
    w, three, film = tmp_path / "w", tmp_path / "three", [tmp_path / "no.mp4"]
    faults: list[tuple[list[Path], dict[str, object], str]] = [
        ([tmp_path / "empty"], {}, "empty"),
        ([tmp_path / "one"], {}, "1"),
        ([], {"cameras": {"down": tmp_path / "sizes"}}, "64 x 49 .* 64 x 48"),
        ([three], {"cameras": {"left": three, "right": three}}, "--left and --right"),
        ([], {"cameras": {"left": three, "right": tmp_path / "one"}}, "3 of left .* 1 of right"),
        ([], {"videos": film}, "no.mp4"),
        ([], {"videos": film, "every_s": 1.0, "overlap": 0.7}, "exclude"),
        ([three], {"overlap": 0.7}, "--video too"),
        ([], {"videos": film * 2}, "given twice"),
        ([three], {"navigation": nav}, "DateTimeOriginal"),
        ([tmp_path / "in"], {"navigation": later}, "--clock-offset"),
        ([three], {"clock_offset_s": float("nan")}, "--clock-offset"),
        ([three], {"vertical_datum": "LAT"}, "--navigation"),
        ([three], {"navigation": nav, "vertical_datum": "a\nb"}, "--vertical-datum"),
    ]
    for folders, given, named in faults:
        with pytest.raises(AliceError, match=named):
            import_images(w, folders, **given)  # type: ignore[arg-type]
    assert not (w / "images").exists()
    for stage in ("images", "pool"):
        truth = tmp_path / stage / stage / "truth"
        truth.mkdir(parents=True)
        with pytest.raises(WorkspaceError):
            import_images(tmp_path / stage, [three])
        assert truth.is_dir()


def test_one_or_two_processes_write_the_same(tmp_path: Path) -> None:
    source = several(tmp_path, 4)
    for threads in (1, 2):
        import_images(tmp_path / f"w{threads}", [source], executor=local_executor(threads))
    one, two = tmp_path / "w1" / "images", tmp_path / "w2" / "images"
    for file in sorted(p for p in one.rglob("*") if p.is_file() and p.name != "stage.json"):
        assert file.read_bytes() == (two / file.relative_to(one)).read_bytes()


def write_dng(path: Path, mosaic: np.ndarray) -> None:
    """A minimal RAW file: a 16-bit RGGB mosaic with the tags that LibRaw needs."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    typed: dict[int, dict[int, Any]] = {
        TiffTags.ASCII: {271: "Alice", 272: "Test", 50708: "Alice Test"},
        TiffTags.BYTE: {33422: bytes([0, 1, 1, 2]), 50706: bytes([1, 4, 0, 0])},
        TiffTags.SHORT: {33421: (2, 2), 50714: 0, 50717: 65535, 50778: 21},
        TiffTags.LONG: {254: 0},
        TiffTags.RATIONAL: {50728: (1, 1, 1)},
        TiffTags.SIGNED_RATIONAL: {50721: (1, 0, 0, 0, 1, 0, 0, 0, 1)},
    }
    for kind, known in typed.items():
        for tag, value in known.items():
            tags.tagtype[tag], tags[tag] = kind, value
    Image.fromarray(mosaic.astype(np.uint16)).save(path, format="TIFF", tiffinfo=tags)
    grey, filters = (struct.pack("<HHII", 262, 3, 1, kind) for kind in (1, 32803))
    path.write_bytes(path.read_bytes().replace(grey, filters))


def test_raw_pictures_are_developed_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One gain for all: a picture half as bright stays darker, by the same curve."""
    (tmp_path / "in").mkdir()
    x = np.arange(128) + np.zeros((96, 1))
    for name, level in (("a", 1.0), ("b", 0.5)):
        write_dng(tmp_path / "in" / f"{name}.dng", level * (8000 + 250 * x))
    (tmp_path / "in" / "c.dng").write_bytes(b"II*\0 broken")
    import_images(tmp_path / "w", [tmp_path / "in"])
    assert "c.dng" in capsys.readouterr().err
    images = tmp_path / "w" / "images"
    bright, dim = (cv2.imread(str(images / "camera" / f"{n}.png"), 0) for n in "ab")
    assert bright.shape == (96, 128)
    inner = (slice(10, -10), slice(10, -10))
    assert np.all(np.diff(bright[inner].mean(axis=0)) > -0.5)
    light = ((bright[inner] / 255.0 + 0.099) / 1.099) ** (1 / 0.45)  # BT.709 undone
    expected = 255.0 * (1.099 * (light / 2) ** 0.45 - 0.099)
    assert np.abs(dim[inner] - expected).max() < 2.0


def test_a_picture_that_states_more_than_can_be_read(tmp_path: Path) -> None:
    Image.new("1", (13_000, 13_000)).save(tmp_path / "a.png")
    assert "104 million pixels" in inspect(tmp_path / "a.png").fault
