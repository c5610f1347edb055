"""Colours through a flat port: the design figures, and a rendered pattern made to fit again."""

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import shift as shift_picture

from alice_survey.core.errors import CalibrationError, ConfigError, ImageError
from alice_survey.core.seawater import n_water
from camera_calib.approximation.dispersion import (
    channel_cameras,
    channel_maps,
    frame_shifts,
    n_glass,
    shift_px,
    shifts_report,
    undisperse,
)
from camera_calib.camera import Camera
from camera_calib.water import CHANNELS
from tests.cameras import changed, flat_port_camera

ALICE = flat_port_camera(
    width_px=3384, height_px=2710, fx_px=3388.0, fy_px=3388.0, cx_px=1692.0, cy_px=1355.0,
    port_distance_m=0.02, glass_thickness_m=0.01, n_water=1.3419,
)  # fmt: skip
LEVANT: dict[str, Any] = {"temperature_c": 24.0, "salinity_psu": 39.0, "depth_m": 15.0}
SEA: dict[str, Any] = {"temperature_c": 20.0, "salinity_psu": 35.0, "depth_m": 10.0}
RANGE_M = 2.0


def pattern(points: np.ndarray) -> np.ndarray:
    """A smooth, irregular texture of the sea floor, 0.2 to 0.8: waves of 1.4 to 5 cm."""
    rng = np.random.default_rng(5)
    value = np.zeros(points.shape[:-1])
    for _ in range(40):
        angle, length_m, phase = rng.uniform([0, 0.014, 0], [np.pi, 0.05, 2 * np.pi])
        wave = np.array([np.cos(angle), np.sin(angle)]) * 2 * np.pi / length_m
        value += np.cos(points[..., :2] @ wave + phase)
    return 0.5 + 0.3 * value / np.abs(value).max()


def render(cameras: dict[str, Camera], range_m: float) -> np.ndarray:
    """What each channel sees of the pattern: (rows, columns, 3)."""
    green = cameras["green"]
    pixels = green.pixel_centres()
    return np.stack([pattern(cameras[name].at_depth(pixels, range_m)) for name in CHANNELS], -1)


def misregistration_px(picture: np.ndarray, channel: int, size: int = 96) -> np.ndarray:
    """Shift of a channel's patches against green: (patches, 2), by least squares."""
    green = picture[..., 1].astype(np.float64)
    other = picture[..., channel].astype(np.float64)
    rows, columns = green.shape
    found = []
    for top in [0, (rows - size) // 2, rows - size]:
        for left in [0, (columns - size) // 2, columns - size]:
            window = np.s_[top : top + size, left : left + size]
            inner = np.s_[8:-8, 8:-8]
            patch, moved = green[window], np.zeros(2)
            slope = np.stack([*np.gradient(patch)][::-1], axis=-1)[inner].reshape(-1, 2)
            for _ in range(12):
                back = shift_picture(other[window], -moved[::-1], order=5, mode="nearest")
                step = np.linalg.lstsq(-slope, (back - patch)[inner].ravel(), rcond=None)[0]
                moved = moved + step
            found.append(moved)
    return np.array(found)


def test_shifts_are_those_of_the_design_study() -> None:
    """+2.9 / -2.3 px at 1000 px and +8.1 / -6.3 px in the corner (610, 530, 460 nm at 2 m)."""
    cameras = channel_cameras(ALICE, **LEVANT, wavelengths_nm=[610.0, 530.0, 460.0])
    red, blue = frame_shifts(cameras, RANGE_M)

    assert (red.channel, blue.channel) == ("red", "blue")
    assert blue.shift_1000_px == pytest.approx(2.9, abs=0.05)
    assert red.shift_1000_px == pytest.approx(-2.3, abs=0.05)
    assert blue.corner_px == pytest.approx(8.1, abs=0.06)
    assert red.corner_px == pytest.approx(-6.3, abs=0.06)
    assert blue.max_px == pytest.approx(blue.corner_px, rel=1e-6)
    assert 0.4 * blue.max_px < blue.rms_px < 0.7 * blue.max_px
    assert 0.02 < blue.rest_px < 0.06


def test_from_fresh_water_to_the_sea_the_corner_moves() -> None:
    """15 px, at 20 C and at 24 C with 39 psu: why a calibration is carried by its index."""
    pool = changed(ALICE, n_water=float(n_water(20.0, 0.0, 0.0)))
    sea = changed(ALICE, n_water=float(n_water(24.0, 39.0, 0.0)))
    corner = np.array([[0.0, 0.0]])
    moved = np.linalg.norm(shift_px(sea, pool, corner, RANGE_M))
    assert moved == pytest.approx(15.0, abs=0.2)


def test_green_keeps_what_was_calibrated() -> None:
    camera = changed(ALICE, n_water=1.337, n_glass=1.49)
    cameras = channel_cameras(camera, **SEA, glass="pmma", wavelengths_nm=[620, 540, 450])

    assert cameras["green"] == camera
    water, port = n_water(20, 35, 10, [620, 540, 450]), n_glass("pmma", [620, 540, 450])
    assert cameras["blue"].n_water - 1.337 == pytest.approx(water[2] - water[1], abs=1e-15)
    assert cameras["red"].n_water - 1.337 == pytest.approx(water[0] - water[1], abs=1e-15)
    assert cameras["blue"].parameter("n_glass") - 1.49 == pytest.approx(
        port[2] - port[1], abs=1e-15
    )
    assert changed(cameras["blue"], n_water=1.337, n_glass=1.49) == camera


@given(x=st.floats(0, 3384), y=st.floats(0, 2710), range_m=st.floats(0.5, 10))
def test_one_spot_of_the_scene_is_seen_by_all_channels(x: float, y: float, range_m: float) -> None:
    cameras = channel_cameras(ALICE, **SEA)
    pixel = np.array([x, y])
    for name in ("red", "blue"):
        seen = pixel + shift_px(cameras["green"], cameras[name], pixel, range_m)
        np.testing.assert_allclose(
            cameras[name].at_depth(seen, range_m),
            cameras["green"].at_depth(pixel, range_m),
            atol=1e-10,
        )


def test_maps_are_exact_between_their_nodes() -> None:
    camera = changed(
        ALICE, k1=-0.12, k2=0.08, p1=3e-4, p2=-2e-4, normal=(0.05, -0.03, (1 - 0.0034) ** 0.5)
    )
    cameras = channel_cameras(camera, **SEA)
    maps = channel_maps(cameras, RANGE_M)
    rng = np.random.default_rng(1)
    at = rng.integers([0, 0], [camera.width_px, camera.height_px], (2000, 2))

    for name, (x, y) in maps.items():
        exact = (
            cameras[name].project(cameras["green"].at_depth(at.astype(float) + 0.5, RANGE_M)) - 0.5
        )
        got = np.stack([x[at[:, 1], at[:, 0]], y[at[:, 1], at[:, 0]]], axis=-1)
        # Single precision holds 1.2e-4 at 3000 px.
        np.testing.assert_allclose(got, exact, atol=4e-4)
    assert set(maps) == {"red", "blue"}


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_rendered_pattern_fits_again(dtype: type[np.uint8] | type[np.uint16]) -> None:
    """A quarter of the resolution, with a port far before the pupil and a tilt."""
    tilted = (0.03, 0.0, float(np.sqrt(1 - 0.03**2)))
    camera = changed(ALICE, port_distance_m=0.05, glass_thickness_m=0.015, normal=tilted).reduced(4)
    cameras = channel_cameras(camera, **LEVANT)
    full = np.iinfo(dtype).max
    picture: NDArray[Any] = np.round(render(cameras, RANGE_M) * full).astype(dtype)

    corrected = undisperse(picture, channel_maps(cameras, RANGE_M))

    assert corrected.dtype == dtype
    np.testing.assert_array_equal(corrected[..., 1], picture[..., 1])
    for channel, corner_px in ((0, 1.42), (2, 2.03)):
        before = np.linalg.norm(misregistration_px(picture, channel), axis=1)
        after = np.linalg.norm(misregistration_px(corrected, channel), axis=1)
        # A patch in the corner has its middle 60 px inside: seven eighths of the shift.
        assert before.max() == pytest.approx(0.88 * corner_px, rel=0.08)
        # OpenCV places samples to 1/32 px.
        assert after.max() < 0.015
        assert np.sqrt(np.mean(after**2)) < 0.01
        assert np.sqrt(np.mean(before**2)) > 80 * np.sqrt(np.mean(after**2))


def test_a_scene_nearer_or_farther_is_corrected_nearly_as_well() -> None:
    """The rest that is stated for a quarter of the range is what remains."""
    camera = ALICE.reduced(4)
    cameras = channel_cameras(camera, **LEVANT)
    stated = frame_shifts(cameras, RANGE_M)[1].rest_px
    picture = render(cameras, 0.75 * RANGE_M).astype(np.float32)

    corrected = undisperse(picture, channel_maps(cameras, RANGE_M))

    left = np.linalg.norm(misregistration_px(corrected, 2), axis=1)
    assert 0.3 * stated < left.max() < stated + 0.01


def test_nothing_changes_where_all_channels_are_equal() -> None:
    camera = ALICE.reduced(8)
    same = dict.fromkeys(CHANNELS, camera)
    picture = np.random.default_rng(0).integers(0, 255, (338, 423, 3), dtype=np.uint8)
    np.testing.assert_array_equal(undisperse(picture, channel_maps(same, RANGE_M)), picture)
    assert all(row.max_px < 1e-9 for row in frame_shifts(same, RANGE_M))


def test_the_report_has_no_number_where_the_picture_is_narrow() -> None:
    text, data = shifts_report(
        frame_shifts(channel_cameras(ALICE.reduced(4), **SEA), RANGE_M), RANGE_M
    )
    assert data["channels"][0]["shift_1000_px"] is None
    assert f"{data['channels'][1]['corner_px']:+.2f} px" in text


def test_what_cannot_be_corrected_is_refused() -> None:
    cameras = channel_cameras(ALICE.reduced(8), **SEA)
    maps = channel_maps(cameras, RANGE_M)
    for shape in ((338, 423), (338, 424, 3), (338, 423, 4)):
        with pytest.raises(ImageError, match=r"338.*423"):
            undisperse(np.zeros(shape, dtype=np.uint8), maps)
    with pytest.raises(CalibrationError, match=r"0\.02 m"):
        channel_maps(cameras, 0.02)
    with pytest.raises(ConfigError):
        channel_cameras(ALICE, **SEA, wavelengths_nm=[460.0, 530.0, 600.0])
    folded = {name: changed(camera, k1=-2.0) for name, camera in cameras.items()}
    with pytest.raises(CalibrationError, match="2 m"):
        channel_maps(folded, RANGE_M)


def test_cv2_and_the_camera_agree_where_a_pixel_is() -> None:
    """Half a pixel too much or too little would show as a shift of the whole picture."""
    cameras = channel_cameras(ALICE.reduced(8), **SEA)
    x, y = channel_maps(cameras, RANGE_M)["blue"]
    where = cameras["blue"].pixel_centres().astype(np.float32)
    seen = cv2.remap(where, x, y, cv2.INTER_LINEAR)
    exact = cameras["blue"].project(
        cameras["green"].at_depth(cameras["green"].pixel_centres(), RANGE_M)
    )
    assert np.abs(seen - exact)[2:-2, 2:-2].max() < 0.025
