"""Correcting picture files: formats, metadata, and one line for each fault."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import AliceError
from alice_survey.core.executor import local_executor
from camera_calib.approximation.dispersion import channel_cameras, channel_maps, undisperse
from camera_calib.approximation.undisperse import undisperse_files
from camera_calib.rig import design_rig, write_rig

SEA: dict[str, Any] = {"temperature_c": 20.0, "salinity_psu": 35.0, "depth_m": 10.0}
RIG = design_rig(CameraConfig(), WaterConfig(), scale=8)
LEFT = RIG.cameras["left"]


@pytest.fixture
def rig_path(tmp_path: Path) -> Path:
    path = tmp_path / "rig.json"
    write_rig(path, RIG)
    return path


def noise_picture(camera_scale: int = 1, dtype: Any = np.uint8, channels: int = 3) -> np.ndarray:
    shape = (LEFT.height_px // camera_scale, LEFT.width_px // camera_scale, channels)
    small = np.random.default_rng(3).uniform(0.2, 0.8, (40, 50, channels))
    smooth = np.clip(cv2.resize(small, shape[1::-1], interpolation=cv2.INTER_CUBIC), 0, 1)
    return (smooth.reshape(shape) * np.iinfo(dtype).max).astype(dtype)


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", np.uint8), (".tiff", np.uint16)])
def test_files_hold_what_the_function_gives(
    tmp_path: Path, rig_path: Path, suffix: str, dtype: Any
) -> None:
    picture = noise_picture(dtype=dtype)
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), picture[..., ::-1])

    _, data = undisperse_files(
        [path], tmp_path / "out", rig=rig_path, range_m=2.0, **SEA, glass="pmma", camera="right"
    )

    cameras = channel_cameras(RIG.cameras["right"], **SEA, glass="pmma")
    got = cv2.imread(str(tmp_path / "out" / path.name), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(got, undisperse(picture, channel_maps(cameras, 2.0)))
    assert got.dtype == dtype
    assert np.any(got != picture)
    assert data["pictures"] == [path.name]
    assert data["camera"] == "right"


def test_reduced_pictures_and_masks_are_understood(tmp_path: Path, rig_path: Path) -> None:
    picture = noise_picture(camera_scale=2, channels=4)
    path = tmp_path / "half.png"
    cv2.imwrite(str(path), picture)

    undisperse_files([path], tmp_path / "out", rig=rig_path, range_m=2.0, **SEA)

    got = cv2.imread(str(tmp_path / "out" / "half.png"), cv2.IMREAD_UNCHANGED)
    cameras = channel_cameras(LEFT.reduced(2), **SEA)
    expected = undisperse(picture[..., 2::-1], channel_maps(cameras, 2.0))
    np.testing.assert_array_equal(got[..., 2::-1], expected)
    np.testing.assert_array_equal(got[..., 3], picture[..., 3])


def test_a_jpeg_keeps_its_time_and_place(tmp_path: Path, rig_path: Path) -> None:
    path = tmp_path / "dive.JPG"
    exif = Image.Exif()
    exif[306] = "2021:03:04 05:06:07"
    Image.fromarray(noise_picture()).save(path, "JPEG", exif=exif, quality=95)

    undisperse_files([path], tmp_path / "out", rig=rig_path, range_m=2.0, **SEA)

    with Image.open(tmp_path / "out" / "dive.JPG") as written:
        assert written.getexif()[306] == "2021:03:04 05:06:07"
        got = np.asarray(written).astype(float)
    assert np.abs(got - noise_picture()).mean() < 4


def test_threads_change_nothing(tmp_path: Path, rig_path: Path) -> None:
    paths = []
    for i in range(3):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), np.roll(noise_picture(), i * 20, axis=1))
    for threads in (1, 2):
        undisperse_files(
            paths,
            tmp_path / str(threads),
            rig=rig_path,
            range_m=2.0,
            **SEA,
            executor=local_executor(threads),
        )
    for path in paths:
        one, two = ((tmp_path / n / path.name).read_bytes() for n in ("1", "2"))
        assert one == two


def test_each_fault_is_one_line(tmp_path: Path, rig_path: Path) -> None:
    colour, grey = tmp_path / "c.png", tmp_path / "g.png"
    wrong, broken = tmp_path / "w.png", tmp_path / "b.png"
    cv2.imwrite(str(colour), noise_picture())
    cv2.imwrite(str(grey), noise_picture()[..., 0])
    cv2.imwrite(str(wrong), noise_picture()[:-3])
    broken.write_bytes(b"no picture")
    (tmp_path / "sub").mkdir()
    out = tmp_path / "out"
    cut = tmp_path / "cut.jpg"
    cv2.imwrite(str(cut), noise_picture())
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    write_rig(tmp_path / "air.json", RIG.in_water(1.0))
    cases: list[tuple[list[Path], Path, dict[str, Any], str]] = [
        ([tmp_path / "none.png"], out, {}, "none.png"),
        ([grey], out, {}, "g.png"),
        ([wrong], out, {}, "423 x 335 px"),
        ([broken], out, {}, "b.png"),
        ([cut], out, {}, "cut.jpg"),
        ([colour], tmp_path, {}, "c.png"),
        ([colour, tmp_path / "sub" / "c.png"], out, {}, "c.png"),
        ([colour], out, {"camera": "top"}, "left, right"),
        ([colour], out, {"glass": "ice"}, "ice"),
        ([colour], out, {"temperature_c": 70.0}, "temperature_c = 70"),
        ([colour], out, {"range_m": 0.01}, "0.03 m"),
        ([colour], out, {"rig": tmp_path / "air.json"}, "n_water 1"),
    ]
    for pictures, folder, changes, words in cases:
        with pytest.raises(AliceError) as error:
            undisperse_files(
                pictures, folder, **{"rig": rig_path, "range_m": 2.0, **SEA, **changes}
            )
        assert words in str(error.value)
        assert "\n" not in str(error.value)
    assert not [path for path in out.glob("*") if path.is_file()]
