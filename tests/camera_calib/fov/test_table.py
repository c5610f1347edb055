import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import CalibrationError, ConfigError
from camera_calib.camera import Camera
from camera_calib.formats.rigs import led_by, only
from camera_calib.fov.focus import apparent_distance_m
from camera_calib.fov.table import MATCH_SIGMA_PX, blur_table, fov_table, rig_fov_table
from camera_calib.rig import Rig, design_rig
from tests.cameras import changed
from tests.oracles_camera import project_by_shortest_path, reach_m
from tests.oracles_fov import triangulated_depth_sigma_m
from tests.reconstruct.rig_survey import four_cameras

NO_PORT = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)
PORT = CameraConfig()


def left(config: CameraConfig, n_water: float) -> Camera:
    return design_rig(config, WaterConfig(n_water=n_water)).cameras["left"]


def crooked_rig() -> Rig:
    """Distorted lenses, tilted ports, and cameras that look past each other a little."""
    normal = np.array([0.03, -0.02, 1.0])
    normal /= np.linalg.norm(normal)
    rig = design_rig(PORT, WaterConfig())
    cameras = {
        name: changed(camera, k1=-0.12, k2=0.08, p1=1e-3, normal=tuple(normal.tolist()))
        for name, camera in rig.cameras.items()
    }
    poses = {
        "left": RigidTransform.identity(),
        "right": RigidTransform.from_components(
            [-0.1, 0.001, 0.002], Rotation.from_euler("xyz", [0.5, 1.0, -0.4], degrees=True)
        ),
    }
    return replace(rig, cameras=cameras, cam_from_rig=poses)


@given(n_water=st.floats(1.0, 1.4), lens_mm=st.floats(5.0, 100.0), altitude_m=st.floats(0.3, 20.0))
def test_without_a_port_water_magnifies_a_pinhole_n_times(
    n_water: float, lens_mm: float, altitude_m: float
) -> None:
    row = fov_table([lens_mm], [altitude_m], n_water, NO_PORT)[0]
    assert row.pixel_centre_mm == pytest.approx(3.69e-3 * altitude_m * 1e3 / (n_water * lens_mm))
    assert row.focus_air_m == pytest.approx(altitude_m / n_water)
    half_air = math.radians(row.diagonal_air_deg / 2)
    assert math.sin(half_air) == pytest.approx(
        n_water * math.sin(math.radians(row.diagonal_water_deg / 2))
    )
    for size, pixels in ((row.horizontal_m, 3384), (row.vertical_m, 2710)):
        in_air = math.atan(pixels * 3.69e-3 / 2 / lens_mm)
        in_water = math.asin(math.sin(in_air) / n_water)
        assert size == pytest.approx(2 * altitude_m * math.tan(in_water), rel=1e-12)


@given(
    lens_mm=st.floats(3.0, 50.0),
    altitude_m=st.floats(0.3, 10.0),
    distance_m=st.floats(0.0, 0.1),
    glass_m=st.floats(0.0, 0.03),
    n_glass=st.floats(1.4, 1.6),
)
def test_footprints_behind_a_port_are_those_of_three_tangents(
    lens_mm: float, altitude_m: float, distance_m: float, glass_m: float, n_glass: float
) -> None:
    """The corners of the sure rectangle are where the picture's corners see the floor."""
    port = {"port_distance_m": distance_m, "glass_thickness_m": glass_m, "n_glass": n_glass}
    row = fov_table([lens_mm], [altitude_m], 1.34, PORT.model_copy(update=port))[0]
    layers = ((distance_m, 1.0), (glass_m, n_glass), (altitude_m, 1.34))
    halves = np.array([3384, 2710]) * 3.69e-3 / 2
    corner = np.hypot(*halves)
    along, down, far = (reach_m(math.atan(half / lens_mm), layers) for half in (*halves, corner))
    assert (row.horizontal_m, row.vertical_m) == pytest.approx((2 * along, 2 * down), rel=1e-9)
    sure = (row.sure_horizontal_m, row.sure_vertical_m)
    assert sure == pytest.approx(2 * far * halves / corner, rel=1e-9)
    assert sure[0] < row.horizontal_m and sure[1] < row.vertical_m


def test_in_air_it_is_a_pinhole() -> None:
    row = fov_table([12.5], [2.0], 1.0, NO_PORT)[0]

    assert row.horizontal_m == pytest.approx(2 * 3384 * 3.69e-3 / 12.5)
    assert row.sure_horizontal_m == pytest.approx(row.horizontal_m)
    assert row.pixel_centre_mm == pytest.approx(row.pixel_mean_mm)
    assert row.pixel_corner_mm == pytest.approx(row.pixel_centre_mm)
    assert row.diagonal_water_deg == pytest.approx(row.diagonal_air_deg)
    assert row.diagonal_air_deg == pytest.approx(65.2, abs=0.05)
    assert row.focus_air_m == pytest.approx(2.0)
    assert row.corner_blur_px == pytest.approx(0.0, abs=1e-9)
    # A rectangle minus the strip of one baseline.
    assert row.stereo_overlap == pytest.approx(1 - 0.1 / row.horizontal_m)


@given(altitude_m=st.floats(0.3, 10.0), n_water=st.floats(1.0, 1.36), lens_mm=st.floats(8.0, 50.0))
def test_pixel_sizes_are_those_near_the_axis_and_shrink_outwards(
    altitude_m: float, n_water: float, lens_mm: float
) -> None:
    camera = left(PORT.model_copy(update={"focal_mm": lens_mm}), n_water)
    row = fov_table([lens_mm], [altitude_m], n_water, PORT)[0]

    paraxial_mm = (0.02 + 0.01 / 1.52 + altitude_m / n_water) / camera.fx_px * 1e3
    assert row.pixel_centre_mm == pytest.approx(paraxial_mm, rel=1e-6)
    assert row.horizontal_m == pytest.approx(row.pixel_mean_mm * 1e-3 * 3384)
    # Refraction narrows what a pixel sees towards the corner.
    assert row.pixel_corner_mm <= row.pixel_mean_mm * (1 + 1e-9)
    assert row.pixel_mean_mm <= row.pixel_centre_mm * (1 + 1e-9)


@given(altitude_m=st.floats(1.0, 10.0), n_water=st.floats(1.3, 1.36))
def test_depth_precision_near_the_axis_is_n_d_squared_over_f_b(
    altitude_m: float, n_water: float
) -> None:
    row = fov_table([12.5], [altitude_m], n_water, PORT)[0]
    apparent_m = 0.02 + 0.01 / 1.52 + altitude_m / n_water
    closed_mm = MATCH_SIGMA_PX * n_water * apparent_m**2 / (12.5e3 / 3.69 * 0.1) * 1e3
    assert row.depth_sigma_mm == pytest.approx(closed_mm, rel=4e-3)


@pytest.mark.parametrize("altitude_m", [0.5, 2.0])
@pytest.mark.parametrize("rig", [design_rig(PORT, WaterConfig()), crooked_rig()])
def test_depth_precision_is_the_scatter_of_triangulated_points(rig: Rig, altitude_m: float) -> None:
    row = rig_fov_table(rig, [altitude_m], PORT)[0]
    floor_z = 0.03 * rig.cameras["left"].port.axis_cam[2] + altitude_m
    scatter_m = triangulated_depth_sigma_m(
        rig, floor_z, MATCH_SIGMA_PX, 20_000, np.random.default_rng(4)
    )
    assert row.depth_sigma_mm == pytest.approx(scatter_m * 1e3, rel=0.02)


def test_a_focused_point_is_sharp_where_its_rays_seem_to_come_from() -> None:
    """Rays that leave one point cross the axis, traced back in air, at the focus distance."""
    camera = left(PORT, 1.34)
    point = np.array([0.0, 1e-4, 2.03])
    pixel = camera.project(point)
    apparent = point[1] / ((pixel[1] - camera.cy_px) / camera.fy_px)

    assert apparent_distance_m(camera, 2.0) == pytest.approx(apparent, rel=1e-6)
    assert fov_table([12.5], [2.0], 1.34, PORT)[0].focus_air_m == pytest.approx(apparent, rel=1e-6)


@pytest.mark.parametrize("rig", [design_rig(PORT, WaterConfig()), crooked_rig()])
def test_overlap_is_the_share_of_random_points_that_both_cameras_see(rig: Rig) -> None:
    first, second = rig.cameras["left"], rig.cameras["right"]
    floor_z = 0.03 * first.port.axis_cam[2] + 1.0
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (60_000, 2)), np.full(60_000, floor_z)])

    def sees(camera: Camera, points: Any) -> Any:
        pixels = camera.project(points)
        return np.all((pixels >= 0) & (pixels <= [camera.width_px, camera.height_px]), axis=1)

    ours = sees(first, points)
    both = ours & sees(second, rig.cam_from_rig["right"].apply(points))
    row = rig_fov_table(rig, [1.0], PORT)[0]
    assert row.stereo_overlap == pytest.approx(both.sum() / ours.sum(), abs=0.006)
    assert 0.7 < row.stereo_overlap < 0.95


def test_cameras_that_see_nothing_together_have_no_depth() -> None:
    row = fov_table([50.0], [0.2], 1.34, PORT)[0]
    assert row.horizontal_m < row.baseline_m
    assert row.stereo_overlap == 0.0
    assert math.isnan(row.depth_sigma_mm)


def test_a_designed_rig_gives_the_row_of_its_lens() -> None:
    ours = rig_fov_table(design_rig(PORT, WaterConfig(n_water=1.34)), [2.0], PORT)[0]
    expected = fov_table([12.5], [2.0], 1.34, PORT)[0]
    # A calibrated focal length is the image distance at its focus: 0.8 % more than the lens's.
    rough = {"near_altitude_m", "far_altitude_m", "depth_of_field_m", "hyperfocal_air_m",
             "hyperfocal_altitude_m", "frame_near_altitude_m", "frame_far_altitude_m",
             "corner_blur_px"}  # fmt: skip
    for key, value in asdict(expected).items():
        rel = 0.03 if key in rough else 1e-9
        assert getattr(ours, key) == pytest.approx(value, rel=rel, nan_ok=True), key


def test_a_calibrated_rig_is_seen_with_its_distortion_and_tilt() -> None:
    """The ends of the middle row, found on the sea floor, come back through the shortest path."""
    rig = crooked_rig()
    camera = rig.cameras["left"]
    row = rig_fov_table(rig, [2.0], PORT)[0]
    straight = fov_table([12.5], [2.0], 1.34, PORT)[0]
    assert abs(row.horizontal_m / straight.horizontal_m - 1) > 0.01

    ends = np.array([[0.0, 1355.0], [3384.0, 1355.0]])
    points = camera.at_depth(ends, 0.03 * camera.port.axis_cam[2] + 2.0)
    assert row.horizontal_m == pytest.approx(float(np.linalg.norm(points[1] - points[0])))
    for end, point in zip(ends, points, strict=True):
        np.testing.assert_allclose(project_by_shortest_path(camera, point), end, atol=1e-5)


def test_one_camera_has_a_field_of_view_but_no_stereo() -> None:
    rig = design_rig(PORT, WaterConfig())
    row = rig_fov_table(only(rig, "left"), [2.0], PORT)[0]
    assert row.horizontal_m == pytest.approx(1.441, abs=1e-3)
    for value in (row.baseline_m, row.stereo_overlap, row.depth_sigma_mm):
        assert math.isnan(value)


def test_wide_lenses_are_marked() -> None:
    narrow, wide = fov_table([12.5, 8.0], [2.0], 1.34, PORT)
    assert narrow.within_trusted_fov
    assert not wide.within_trusted_fov
    (domed,) = fov_table([8.0], [2.0], 1.34, PORT.model_copy(update={"port": "dome"}))
    assert domed.within_trusted_fov


def test_blur_is_the_way_made_in_pixels_and_the_longest_exposure_its_inverse() -> None:
    rows = fov_table([12.5, 25.0], [2.0], 1.33, NO_PORT)
    blur = blur_table(rows, [0.2, 0.5], [1e-3, 3e-3], 1.5)
    assert len(blur) == 8
    paper = next(b for b in blur if (b.lens_mm, b.speed_mps, b.exposure_s) == (12.5, 0.5, 3e-3))
    assert paper.blur_px == pytest.approx(3.38, abs=0.005)
    for b in blur:
        again = blur_table([r for r in rows if r.lens_mm == b.lens_mm], [b.speed_mps],
                           [b.longest_exposure_s], 1.0)[0]  # fmt: skip
        assert again.blur_px == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("lens_mm", "altitude_m", "n_water", "named"),
    [
        (0.0, 2.0, 1.34, "lens 0"), (math.nan, 2.0, 1.34, "lens nan"),
        (12.5, -1.0, 1.34, "altitude -1"), (12.5, math.inf, 1.34, "altitude inf"),
        (12.5, 2.0, 2.0, "n_water 2"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(
    lens_mm: float, altitude_m: float, n_water: float, named: str
) -> None:
    with pytest.raises(ConfigError, match=named):
        fov_table([lens_mm], [altitude_m], n_water, PORT)


def test_blurs_out_of_range_are_refused() -> None:
    rows = fov_table([12.5], [2.0], 1.34, PORT)
    for speeds, exposures, allowed in (([0.0], [1e-3], 1), ([0.2], [-1], 1), ([0.2], [1e-3], 0)):
        with pytest.raises(ConfigError):
            blur_table(rows, speeds, exposures, allowed)


@pytest.mark.parametrize("name", list(four_cameras().cameras))
def test_any_camera_of_a_rig_has_its_row(name: str) -> None:
    """Where cameras are does not depend on which of them leads; sizes are those of its own lens."""
    rig = four_cameras()
    led = led_by(rig, name)
    assert led.reference == name and set(led.cameras) == set(rig.cameras)
    for camera in rig.cameras:
        off = led.body_from_cam(camera).inv() * rig.body_from_cam(camera)
        np.testing.assert_allclose(off.as_matrix(), np.eye(4), atol=1e-12)
    one = rig.cameras[name]
    row = rig_fov_table(led, [2.0], PORT)[0]
    middle = np.array([one.cx_px, one.cy_px])
    points = one.at_depth(np.stack([middle, middle + np.array([1.0, 0.0])]), 2.0 + one.front_cam[2])
    assert 1e-3 * row.pixel_centre_mm == pytest.approx(
        np.linalg.norm(np.diff(points, axis=0)), rel=5e-3
    )
    with pytest.raises(CalibrationError, match="no camera 'mast'"):
        led_by(rig, "mast")
