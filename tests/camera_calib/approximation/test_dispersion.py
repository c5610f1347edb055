"""Colours through a flat port: the design figures."""

from typing import Any

import numpy as np
import pytest

from alice_survey.core.seawater import n_water
from camera_calib.camera import Camera
from camera_calib.water import (
    channel_cameras,
    n_glass,
)
from tests.cameras import changed, flat_port_camera

ALICE = flat_port_camera(
    width_px=3384, height_px=2710, fx_px=3388.0, fy_px=3388.0, cx_px=1692.0, cy_px=1355.0,
    port_distance_m=0.02, glass_thickness_m=0.01, n_water=1.3419,
)  # fmt: skip
LEVANT: dict[str, Any] = {"temperature_c": 24.0, "salinity_psu": 39.0, "depth_m": 15.0}
SEA: dict[str, Any] = {"temperature_c": 20.0, "salinity_psu": 35.0, "depth_m": 10.0}
RANGE_M = 2.0


def shift_px(green: Camera, channel: Camera, pixel: tuple[float, float]) -> np.ndarray:
    """Where a channel sees what green sees at a pixel, minus that pixel."""
    return channel.project(green.at_depth(np.array(pixel), RANGE_M)) - np.array(pixel)


def test_shifts_are_those_of_the_design_study() -> None:
    """+2.9 / -2.3 px at 1000 px and +8.1 / -6.3 px in the corner (610, 530, 460 nm at 2 m)."""
    cameras = channel_cameras(ALICE, **LEVANT, wavelengths_nm=[610.0, 530.0, 460.0])
    green = cameras["green"]
    for name, at_1000_px, corner_px in (("blue", 2.9, 8.1), ("red", -2.3, -6.3)):
        right = shift_px(green, cameras[name], (1692.0 + 1000.0, 1355.0))
        assert right[0] == pytest.approx(at_1000_px, abs=0.05)
        corner = -shift_px(green, cameras[name], (0.0, 0.0))
        outward = corner @ np.array([1692.0, 1355.0]) / np.hypot(1692.0, 1355.0)
        assert outward == pytest.approx(corner_px, abs=0.06)


def test_from_fresh_water_to_the_sea_the_corner_moves() -> None:
    """15 px, at 20 C and at 24 C with 39 psu: why a calibration is carried by its index."""
    pool = changed(ALICE, n_water=float(n_water(20.0, 0.0, 0.0)))
    sea = changed(ALICE, n_water=float(n_water(24.0, 39.0, 0.0)))
    moved = np.linalg.norm(shift_px(sea, pool, (0.0, 0.0)))
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
