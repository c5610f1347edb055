"""Pictures out of bags: every pixel, every time, whatever the encoding."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from alice_survey.core.errors import AliceError, ImageError, collected_by
from reconstruct.pictures.importing import import_images
from reconstruct.pictures.incoming import pixels_of
from tests.missions.logs.log_files import Bag
from tests.reconstruct.pictures.dated import counts, rows_of, table

START_NS, STEP_NS, COUNT = 1_700_000_000_000_000_000, 200_000_000, 12
SHAPE = (24, 32)


def scene(seed: int, channels: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (*SHAPE, channels), dtype=np.uint8)
    return picture if channels > 1 else picture[..., 0]


def message(encoding: str, pixels: np.ndarray, **changes: Any) -> SimpleNamespace:
    step = pixels[0].nbytes
    fields = {
        "encoding": encoding, "height": pixels.shape[0], "width": pixels.shape[1], "step": step,
        "is_bigendian": 0, "data": np.frombuffer(pixels.tobytes(), np.uint8), **changes,
    }  # fmt: skip
    return SimpleNamespace(**fields)


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "8UC3", "bgra8", "rgba8"])
def test_channels_are_in_opencvs_order(encoding: str) -> None:
    pixels = scene(1, 4 if "a8" in encoding else 3)
    expected = pixels[..., [2, 1, 0]] if encoding.startswith("rgb") else pixels[..., :3]
    np.testing.assert_array_equal(pixels_of(message(encoding, pixels)), expected)


def test_lines_may_be_padded_and_bytes_swapped() -> None:
    grey = scene(2, 1)
    padded = np.hstack([grey, np.full((SHAPE[0], 5), 7, np.uint8)])
    found = pixels_of(message("mono8", padded, width=SHAPE[1]))
    np.testing.assert_array_equal(found, grey)
    deep = (grey.astype(np.uint16) * 16).astype(">u2")
    found = pixels_of(message("mono16", deep, is_bigendian=1))
    np.testing.assert_array_equal(found, grey.astype(np.uint16) * 16)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_mosaic_of_colours_shows_them(pattern: str) -> None:
    """An even colour through each filter: its own value wherever the filter lets it through."""
    value = {"r": 200, "g": 120, "b": 40}
    tile = np.array([value[filtered] for filtered in pattern]).reshape(2, 2)
    mosaic = np.tile(tile, (SHAPE[0] // 2, SHAPE[1] // 2)).astype(np.uint8)
    found = pixels_of(message(f"bayer_{pattern}8", mosaic))
    np.testing.assert_array_equal(found[4:-4, 4:-4].reshape(-1, 3).max(axis=0), [40, 120, 200])
    np.testing.assert_array_equal(found[4:-4, 4:-4].reshape(-1, 3).min(axis=0), [40, 120, 200])


@pytest.mark.parametrize(
    "changes",
    [{"encoding": "32FC1"}, {"encoding": ""}, {"height": 1000}, {"step": 3}, {"width": 0}],
)
def test_what_cannot_be_a_picture_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"encoding|bytes"):
        pixels_of(message(**{"encoding": "bgr8", "pixels": scene(3), **changes}))


def stereo(folder: Path, version: int = 2, *, dropped: int = -1, late_ns: int = 1_000_000) -> Path:
    """Raw pictures of a left camera and JPEG of a right one, the right a little late."""
    bag = Bag(version)
    for i in range(COUNT):
        stamp = START_NS + i * STEP_NS
        left = scene(i)
        bag.add(
            "/stereo/left/image_raw", "sensor_msgs/msg/Image", stamp, "camera",
            height=left.shape[0], width=left.shape[1], encoding="bgr8", step=left.shape[1] * 3,
            data=left.ravel(),
        )  # fmt: skip
        if i != dropped:
            bag.add(
                "/stereo/right/image_raw/compressed", "sensor_msgs/msg/CompressedImage",
                stamp + late_ns, "camera", stamp + 90_000_000, format="jpeg",
                data=cv2.imencode(".jpg", scene(100 + i))[1].ravel(),
            )  # fmt: skip
    return bag.write(folder / ("d.bag" if version == 1 else "d"))


@pytest.mark.parametrize("version", [1, 2])
def test_a_stereo_bag_becomes_stations_by_time(tmp_path: Path, version: int) -> None:
    bag = stereo(tmp_path, version, dropped=4)
    workspace = tmp_path / "w"
    said: list[str] = []
    with collected_by(lambda _, text: said.append(text)):
        found = import_images(workspace, [], bag=bag)
    assert counts(found) == {"left": COUNT, "right": COUNT - 1}
    records = rows_of(workspace)
    times = {(r.camera, r.station): r.time_s for r in records}
    expected = {(side, k): 0.2 * k + late for k in range(COUNT)
                for side, late in (("left", 0.0), ("right", 0.001))}  # fmt: skip
    del expected["right", 4]
    assert times == pytest.approx(expected, abs=2e-6)
    assert any("1 of left" in line for line in said)
    images = workspace / "images"
    lefts = [cv2.imread(str(images / r.image)) for r in records if r.camera == "left"]
    np.testing.assert_array_equal(lefts, [scene(i) for i in range(COUNT)])
    right = next(r for r in records if r.camera == "right")
    data = cv2.imencode(".jpg", scene(100))[1].tobytes()
    assert (images / right.image).read_bytes() == data
    assert not (images / "bag").exists()


def test_moments_are_thinned_whole(tmp_path: Path) -> None:
    import_images(tmp_path / "w", [], bag=stereo(tmp_path), every_s=0.5)
    records = rows_of(tmp_path / "w")
    lefts = [r.time_s for r in records if r.camera == "left"]
    np.testing.assert_allclose(lefts, [0.0, 0.6, 1.2, 1.8], atol=1e-5)
    assert len(records) == 8


def test_navigation_on_the_same_clock_places_them(tmp_path: Path) -> None:
    rows = [
        (f"{np.datetime64(START_NS + (i - 2) * 10**9, 'ns')}Z", 43 + 1e-6 * i, 5.0, 3 + 0.1 * i)
        for i in range(9)
    ]
    path = table(tmp_path / "n.csv", "time_utc,latitude_deg,longitude_deg,depth_m", rows)
    import_images(tmp_path / "w", [], bag=stereo(tmp_path), navigation=path)
    records = rows_of(tmp_path / "w")
    lefts = [r for r in records if r.camera == "left"]
    expected = 3 + 0.1 * (2 + 0.2 * np.arange(COUNT))
    np.testing.assert_allclose([r.depth_m for r in lefts], expected, atol=1e-6)


def test_cameras_of_different_clocks_are_refused_and_one_of_them_taken(tmp_path: Path) -> None:
    bag = stereo(tmp_path, late_ns=100_000_000)
    with pytest.raises(ImageError, match="one clock"):
        import_images(tmp_path / "w", [], bag=bag)
    topics = {"camera": "/stereo/left/image_raw"}
    assert counts(import_images(tmp_path / "w", [], bag=bag, topics=topics)) == {"camera": COUNT}


def test_a_bag_without_pictures_or_of_no_bag_is_named(tmp_path: Path) -> None:
    bag = Bag(2)
    bag.add_range(START_NS, "/sonar", 2.0)
    with pytest.raises(AliceError, match="holds no topic of Image"):
        import_images(tmp_path / "w", [], bag=bag.write(tmp_path / "d"))
    (tmp_path / "x.bag").write_bytes(b"no bag at all")
    with pytest.raises(AliceError, match="cannot be read as a bag"):
        import_images(tmp_path / "w", [], bag=tmp_path / "x.bag")
