"""Blocks of the kernels: a row's result is its own, whatever the other rows hold."""

import math

import numpy as np
import pytest

from camera_calib.ports.flat import air_tangent
from tests.cameras import changed, flat_port_camera

CAMERA = flat_port_camera(
    width_px=1600, height_px=1200, fx_px=1200.0, fy_px=1190.0, cx_px=790.0, cy_px=610.0,
    k1=-0.2, k2=0.1, p1=0.001, k3=-0.02, port_distance_m=0.02, glass_thickness_m=0.01,
    normal=(0.1, 0.0, math.sqrt(0.99)),
)  # fmt: skip
PORTS = [(0.0, 0.0), (0.0, 0.01), (1e-6, 0.005), (0.02, 0.01), (0.2, 0.2)]


@pytest.mark.parametrize(("air_m", "glass_m"), PORTS)
def test_projection_does_not_depend_on_the_neighbours(air_m: float, glass_m: float) -> None:
    camera = changed(CAMERA, port_distance_m=air_m, glass_thickness_m=glass_m)
    rng = np.random.default_rng(1)
    points = rng.normal(size=(300, 3)) * 10.0 ** rng.uniform(-2, 2, (300, 1))
    points[[0, 140, 299]] = [[0.0, 0.0, 1.0], [np.nan, 0.0, 1.0], [0.0, 0.0, -1.0]]

    together = camera.project(points)

    one_by_one = np.stack([camera.project(point) for point in points])
    np.testing.assert_array_equal(together, one_by_one)
    assert 15 < np.isfinite(together[:, 0]).sum() < 270


def test_unprojection_does_not_depend_on_the_neighbours() -> None:
    rng = np.random.default_rng(2)
    pixels = rng.uniform([-1500, -1500], [3100, 2700], (300, 2))  # many beyond the lens's fold

    together = np.hstack(CAMERA.unproject(pixels))

    one_by_one = np.stack([np.concatenate(CAMERA.unproject(pixel)) for pixel in pixels])
    np.testing.assert_array_equal(together, one_by_one)
    assert 30 < np.isfinite(together[:, 0]).sum() < 270


@pytest.mark.parametrize(("air_m", "glass_m"), PORTS)
def test_tangents_are_right_at_any_angle(air_m: float, glass_m: float) -> None:
    rng = np.random.default_rng(3)
    port = np.array([air_m, glass_m, 1.52, 1.34, 0.0, 0.0, 1.0])
    tangents = 10.0 ** rng.uniform(-6, 2, 300)
    waters = 10.0 ** rng.uniform(-3, 1.5, 300)
    for tangent, water in zip(tangents, waters, strict=True):
        sine = tangent / math.sqrt(1.0 + tangent**2)
        in_glass, in_water = (math.tan(math.asin(sine / n)) for n in (1.52, 1.34))
        radius = air_m * tangent + glass_m * in_glass + water * in_water
        found = air_tangent(radius, water, port)
        # What rounding of the radius costs: its error over its slope by the tangent.
        by_glass = 1.52**2 / (1.52**2 + (1.52**2 - 1) * tangent**2) ** 1.5
        by_water = 1.34**2 / (1.34**2 + (1.34**2 - 1) * tangent**2) ** 1.5
        steep = air_m + glass_m * by_glass + water * by_water
        assert abs(found - tangent) < 4e-15 * (radius / steep + tangent)
