import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import ConfigError
from camera_calib.camera import Camera
from camera_calib.fov.focus import FocusedLens, apparent_depths, apparent_distance_m
from camera_calib.fov.table import fov_table
from camera_calib.rig import design_rig
from tests.cameras import changed
from tests.oracles_camera import reach_m
from tests.oracles_fov import traced_blur_px

PORT = CameraConfig()
CAMERA = design_rig(PORT, WaterConfig(n_water=1.34)).cameras["left"]
TILTED = changed(CAMERA, normal=(0.08, 0.0, math.sqrt(1.0 - 0.08**2)))
LENS = FocusedLens(focal_m=12.5e-3, f_number=4.0, pixel_m=3.69e-6, focus_m=1.5)


@given(
    focus_m=st.floats(0.3, 8.0),
    coc_px=st.floats(0.2, 5.0),
    f_number=st.floats(1.4, 22.0),
    focal_mm=st.floats(6.0, 60.0),
)
@example(focus_m=0.999 * LENS.hyperfocal_m(1.0), coc_px=1.0, f_number=4.0, focal_mm=12.5)
@example(focus_m=1.001 * LENS.hyperfocal_m(1.0), coc_px=1.0, f_number=4.0, focal_mm=12.5)
def test_limits_are_those_of_the_textbook(
    focus_m: float, coc_px: float, f_number: float, focal_mm: float
) -> None:
    f, c = focal_mm * 1e-3, coc_px * 3.69e-6
    lens = FocusedLens(focal_m=f, f_number=f_number, pixel_m=3.69e-6, focus_m=focus_m)
    hyperfocal = f * f / (f_number * c) + f
    near, far = lens.sharp_depths_m(coc_px)

    assert lens.hyperfocal_m(coc_px) == pytest.approx(hyperfocal)
    assert near == pytest.approx(focus_m * (hyperfocal - f) / (hyperfocal + focus_m - 2 * f))
    if focus_m < 0.9995 * hyperfocal:
        assert far == pytest.approx(focus_m * (hyperfocal - f) / (hyperfocal - focus_m))
        assert lens.blur_px(np.array([near, far])) == pytest.approx(coc_px)
    elif focus_m > hyperfocal:
        assert math.isinf(far)
    assert lens.blur_px(focus_m) == 0.0


def test_a_lens_cannot_focus_within_its_focal_length() -> None:
    with pytest.raises(ConfigError, match=r"12\.5 mm cannot focus at 0\.0125 m"):
        replace(LENS, focus_m=0.0125)


@given(
    half_angle_deg=st.floats(0.5, 60.0),
    altitude_m=st.floats(0.3, 10.0),
    n_water=st.floats(1.0, 1.36),
    port_m=st.floats(0.0, 0.1),
    glass_m=st.floats(0.0, 0.1),
)
def test_line_images_are_where_neighbouring_rays_meet(
    half_angle_deg: float, altitude_m: float, n_water: float, port_m: float, glass_m: float
) -> None:
    """With r(a) the distance from the axis that a ray of angle a reaches on the sea floor.

    Rays across the plane of incidence are turned about the axis and meet on it: at r / sin a along
    the ray. Rays in it meet at the distance dr/da cos a from the pupil.
    """
    camera = changed(CAMERA, n_water=n_water, port_distance_m=port_m, glass_thickness_m=glass_m)
    a = math.radians(half_angle_deg)

    layers = ((port_m, 1.0), (glass_m, camera.parameter("n_glass")), (altitude_m, n_water))
    slope = (reach_m(a + 1e-6, layers) - reach_m(a - 1e-6, layers)) / 2e-6
    pixel = np.array([[camera.cx_px, camera.cy_px - camera.fy_px * math.tan(a)]])
    depths = apparent_depths(camera, pixel).at(altitude_m)[0] / math.cos(a)
    assert depths == pytest.approx(
        [slope * math.cos(a), reach_m(a, layers) / math.sin(a)], rel=1e-6
    )


def test_near_the_axis_both_are_the_apparent_distance() -> None:
    centre = np.array([[CAMERA.cx_px, CAMERA.cy_px]])
    seen = apparent_depths(CAMERA, centre).at(2.0)
    assert seen == pytest.approx(np.full((1, 2), apparent_distance_m(CAMERA, 2.0)), rel=1e-12)


PLACES = [(0.5, 0.5), (1.0, 0.5), (0.5, 0.0), (0.0, 0.0), (0.85, 0.9)]


@pytest.mark.parametrize(
    ("camera", "place", "f_number"),
    [*itertools.product([CAMERA], PLACES, [2.8, 8.0]), (TILTED, (1.0, 0.5), 4.0)],
)
def test_blur_is_that_of_the_apertures_edge_rays(
    camera: Camera, place: tuple[float, float], f_number: float
) -> None:
    """Rays from the rim of the aperture, traced through the port by Fermat's principle."""
    lens = replace(LENS, f_number=f_number)
    pixel = np.array([place]) * [camera.width_px, camera.height_px]
    away = pixel[0] - [camera.cx_px, camera.cy_px]
    length = float(np.linalg.norm(away))
    radial = away / length if length > 0 else np.array([1.0, 0.0])
    across = np.array([-radial[1], radial[0]])
    for altitude_m in (1.2, 2.0, 3.5):
        point = camera.at_depth(pixel, camera.front_cam[2] + altitude_m)[0]
        ours = lens.blur_px(apparent_depths(camera, pixel).at(altitude_m))[0]
        traced = [traced_blur_px(camera, lens, point, along) for along in (radial, across)]
        assert ours == pytest.approx(traced, rel=0.002, abs=0.002)


@given(
    altitude_m=st.floats(0.5, 5.0),
    n_water=st.floats(1.0, 1.36),
    coc_px=st.floats(0.3, 4.0),
    lens_mm=st.floats(8.0, 50.0),
)
def test_limits_in_water_are_where_the_blur_is_the_circle_of_confusion(
    altitude_m: float, n_water: float, coc_px: float, lens_mm: float
) -> None:
    row = fov_table([lens_mm], [altitude_m], n_water, PORT, coc_px)[0]
    lens = FocusedLens(
        focal_m=lens_mm * 1e-3, f_number=4.0, pixel_m=3.69e-6, focus_m=row.focus_air_m
    )

    def blur(altitude: float) -> float:
        return float(lens.blur_px(0.02 + 0.01 / 1.52 + altitude / n_water))

    assert row.near_altitude_m < altitude_m < row.far_altitude_m
    assert row.depth_of_field_m == pytest.approx(row.far_altitude_m - row.near_altitude_m)
    if row.near_altitude_m > 0:
        assert blur(row.near_altitude_m) == pytest.approx(coc_px, rel=1e-6)
    if math.isfinite(row.far_altitude_m):
        assert blur(row.far_altitude_m) == pytest.approx(coc_px, rel=1e-6)
    assert blur(altitude_m) == pytest.approx(0.0, abs=1e-6)
    # The whole frame is never sharper than its centre.
    if math.isfinite(row.frame_near_altitude_m):
        assert row.frame_near_altitude_m >= row.near_altitude_m
        assert row.frame_far_altitude_m <= row.far_altitude_m


def test_the_port_bends_the_field_so_that_no_altitude_is_sharp_everywhere() -> None:
    """At 1 m and F/4 the corners need another focus than the centre by more than 1 px allows."""
    row = fov_table([12.5], [1.0], 1.34, PORT)[0]
    assert math.isnan(row.frame_near_altitude_m)
    assert math.isnan(row.frame_far_altitude_m)
    assert row.corner_blur_px == pytest.approx(3.83, abs=0.01)
    softer = fov_table([12.5], [1.0], 1.34, PORT, 5.0)[0]
    assert softer.frame_near_altitude_m < 1.0 < softer.frame_far_altitude_m


def test_traced_rays_at_the_limits_blur_by_the_circle_of_confusion() -> None:
    row = fov_table([12.5], [2.0], 1.34, PORT, 2.0)[0]
    lens = replace(LENS, focus_m=row.focus_air_m)
    for altitude_m in (row.near_altitude_m, row.far_altitude_m):
        point = np.array([0.0, 0.0, 0.03 + altitude_m])
        traced = traced_blur_px(CAMERA, lens, point, np.array([1.0, 0.0]))
        assert traced == pytest.approx(2.0, rel=1e-3)
