"""Lenses and ports in all their combinations, against oracles of other construction."""

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera, camera_from_json
from camera_calib.fov.focus import altitude_of_apparent_m, apparent_distance_m, axial_pixel_m
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.none import NO_PORT
from camera_calib.ports.values import PortValues
from tests.cameras import changed
from tests.oracles_camera import assert_slopes
from tests.oracles_dome import optical_path_slopes, ray_to, traced

PINHOLE = OpenCVLens(
    fx_px=1500.0, fy_px=1510.0, cx_px=805.0, cy_px=590.0, k1=-0.1, k2=0.02, p1=1e-3
)
FISHEYE = FisheyeLens(
    fx_px=600.0, fy_px=604.0, cx_px=805.0, cy_px=590.0, k1=-0.02, k2=0.004, k3=1e-3, k4=-3e-4
)
DOME = DomePort(
    dome_x_m=0.003, dome_y_m=-0.004, dome_z_m=0.012, outer_radius_m=0.08, glass_thickness_m=0.006
)
HALF_PIXELS = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
PORTS = (NO_PORT, FlatPort(port_distance_m=0.02, glass_thickness_m=0.01), DOME)


def camera_of(lens: LensValues, port: PortValues) -> Camera:
    return Camera(width_px=1600, height_px=1200, lens=lens, port=port)


@st.composite
def domes(draw: st.DrawFn) -> DomePort:
    """Domes over the range in which they are to be exact."""
    outer = draw(st.floats(0.03, 0.15))
    thickness = draw(st.floats(0.0, 1 / 3)) * outer
    way = np.array([draw(st.floats(-1.0, 1.0)) for _ in range(3)])
    way = way / max(float(np.linalg.norm(way)), 1e-3)
    x, y, z = (draw(st.floats(0.0, 0.5)) * (outer - thickness) * way).tolist()
    return DomePort(
        dome_x_m=x, dome_y_m=y, dome_z_m=z, outer_radius_m=outer, glass_thickness_m=thickness,
        n_glass=draw(st.floats(1.45, 1.8)), n_water=draw(st.floats(1.32, 1.36)),
    )  # fmt: skip


@settings(deadline=None, max_examples=150)
@given(port=domes(), lens=st.sampled_from([PINHOLE, FISHEYE]), distance_m=st.floats(0.1, 20.0))
def test_a_pixel_comes_back_through_a_dome(
    port: DomePort, lens: LensValues, distance_m: float
) -> None:
    camera = camera_of(lens, port)
    pixels = camera.pixel_centres(step=101).reshape(-1, 2)
    glass, directions = camera.unproject(pixels)
    back = camera.project(glass + distance_m * directions)
    assert np.abs(back - pixels).max() < 1e-9


@settings(deadline=None, max_examples=100)
@given(
    port=domes(), x=st.floats(-1.2, 1.2), y=st.floats(-1.2, 1.2), distance_m=st.floats(0.25, 10.0)
)
def test_a_dome_sends_light_where_traced_rays_go(
    port: DomePort, x: float, y: float, distance_m: float
) -> None:
    way = np.array([x, y, 1.0])
    point = distance_m * way / np.linalg.norm(way)
    bare = Camera(
        width_px=4,
        height_px=4,
        lens=OpenCVLens(fx_px=1000, fy_px=1000, cx_px=0, cy_px=0),
        port=port,
    )
    ray = ray_to(port, point)
    np.testing.assert_allclose(bare.project(point), 1000.0 * ray[:2] / ray[2], atol=1e-8)

    inner, outer, direction = traced(port, ray)
    found, along = bare.unproject(bare.project(point))
    np.testing.assert_allclose(found, outer, atol=1e-12)
    np.testing.assert_allclose(along, direction, atol=1e-11)
    if port.glass_thickness_m > 1e-5:  # else the way through the glass has no direction
        assert np.abs(optical_path_slopes(port, inner, outer, point)).max() < 1e-8


@settings(deadline=None, max_examples=40)
@given(
    outer_m=st.floats(0.03, 0.15), share=st.floats(0.0, 1 / 3),
    lens=st.sampled_from([PINHOLE, FISHEYE]),
)  # fmt: skip
def test_a_centred_dome_of_any_thickness_does_nothing(
    outer_m: float, share: float, lens: LensValues
) -> None:
    port = DomePort(outer_radius_m=outer_m, glass_thickness_m=share * outer_m)
    dome, bare = camera_of(lens, port), camera_of(lens, NO_PORT)
    points = np.random.default_rng(1).uniform([-1, -1, 0.5], [1, 1, 4], (200, 3))
    np.testing.assert_allclose(dome.project(points), bare.project(points), atol=1e-10, rtol=0)
    assert not dome.refracts
    assert dome.focal_in_water_px == bare.focal_in_water_px


@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE])
@pytest.mark.parametrize("port", PORTS)
def test_slopes_are_those_of_project(lens: LensValues, port: PortValues) -> None:
    camera = camera_of(lens, port)
    axis = 1.3 * np.array(port.axis_cam)
    points = np.random.default_rng(2).uniform([-0.5, -0.5, 0.6], [0.5, 0.5, 3.0], (60, 3))
    points = np.vstack([points, axis, [0.0, 0.0, 2.0]])
    assert_slopes(camera, points, dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px"), 0.1))


@settings(deadline=None, max_examples=60)
@given(port=domes())
def test_slopes_through_a_dome_are_those_of_project(port: DomePort) -> None:
    thicker = {"glass_thickness_m": port.glass_thickness_m + 1e-3}  # room for a step
    camera = camera_of(FISHEYE, port.with_parameters(thicker))
    points = np.random.default_rng(3).uniform([-0.5, -0.5, 0.4], [0.5, 0.5, 3.0], (20, 3))
    assert_slopes(camera, points, dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px"), 0.1))


def test_a_fisheye_is_that_of_opencv_and_colmap() -> None:
    camera = camera_of(FISHEYE, NO_PORT)
    points = np.random.default_rng(4).uniform([-3, -3, 0.3], [3, 3, 2], (500, 3))
    k = np.array([FISHEYE.k1, FISHEYE.k2, FISHEYE.k3, FISHEYE.k4])
    matrix = np.array([[600.0, 0.0, 804.5], [0.0, 604.0, 589.5], [0.0, 0.0, 1.0]])
    opencv = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, k)[0]
    np.testing.assert_allclose(camera.project(points), opencv[:, 0] + 0.5, atol=1e-9)
    colmap = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=1600, height=1200,
        params=[600.0, 604.0, 805.0, 590.0, *k.tolist()],
    )  # fmt: skip
    np.testing.assert_allclose(camera.project(points), colmap.img_from_cam(points), atol=1e-9)


def test_a_fisheye_sees_behind_itself_up_to_where_its_radius_turns_back() -> None:
    lens = FisheyeLens(fx_px=300.0, fy_px=300.0, cx_px=0.0, cy_px=0.0)
    camera = camera_of(lens, NO_PORT)
    ray = np.array([np.sin(1.9), 0.0, np.cos(1.9)])
    np.testing.assert_allclose(camera.project(2.0 * ray), [570.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(camera.unproject(np.array([570.0, 0.0]))[1], ray, atol=1e-12)
    folded = camera_of(changed(camera, k1=-0.2).lens, NO_PORT)  # r' = 1 - 0.6 a^2
    last = np.sqrt(1.0 / 0.6)
    inside, beyond = ([np.sin(a), 0.0, np.cos(a)] for a in (last - 0.01, last + 0.01))
    assert np.isfinite(folded.project(np.array(inside))).all()
    assert np.isnan(folded.project(np.array(beyond))).all()


@pytest.mark.parametrize("altitude_m", [0.5, 2.0, 50.0])
@pytest.mark.parametrize("dome_z_m", [-0.02, 0.0, 0.03])
def test_a_dome_makes_a_near_image(altitude_m: float, dome_z_m: float) -> None:
    """Gauss's equation at both spheres: n'/s' = n/s + (n' - n)/r, distances along the light."""
    port = DomePort(dome_z_m=dome_z_m, outer_radius_m=0.1, glass_thickness_m=0.008)
    in_glass = (port.n_glass - port.n_water) / 0.1 - port.n_water / altitude_m
    image = port.n_glass / in_glass - 0.008
    in_air = port.n_glass / image + (1.0 - port.n_glass) / 0.092
    expected = dome_z_m + 0.092 - 1.0 / in_air

    camera = camera_of(PINHOLE, port)
    assert apparent_distance_m(camera, altitude_m) == pytest.approx(expected, rel=1e-9)
    assert expected < 0.5  # some three radii, however far the sea floor is
    assert altitude_of_apparent_m(camera, expected) == pytest.approx(altitude_m, rel=1e-7)


@pytest.mark.parametrize("port", PORTS)
@pytest.mark.parametrize("altitude_m", [0.4, 3.0])
def test_a_pixel_on_the_sea_floor_is_as_large_as_traced(
    port: PortValues, altitude_m: float
) -> None:
    lens = OpenCVLens(fx_px=1000.0, fy_px=1000.0, cx_px=0.0, cy_px=0.0)
    camera = camera_of(lens, port)
    floor_z = float(camera.front_cam[2]) + altitude_m
    foot = camera.project(np.array([0.0, 0.0, floor_z]))
    square = camera.at_depth(foot + HALF_PIXELS, floor_z)
    traced_m = (square[1, 0] - square[0, 0] + square[3, 1] - square[2, 1]) / 2
    at_glass_m, per_m = axial_pixel_m(camera)
    assert at_glass_m + per_m * altitude_m == pytest.approx(traced_m, rel=2e-4)


@pytest.mark.parametrize("dome_z_m", [-0.02, 0.03])
def test_an_off_centre_dome_magnifies_as_far_points_show(dome_z_m: float) -> None:
    camera = camera_of(OpenCVLens(fx_px=1000.0, fy_px=1000.0, cx_px=0.0, cy_px=0.0), DOME)
    camera = changed(camera, dome_x_m=0.0, dome_y_m=0.0, dome_z_m=dome_z_m)
    far = 1e6
    pixel = camera.project(np.array([1e-4 * far, 0.0, far]))
    assert camera.focal_in_water_px == pytest.approx(float(pixel[0]) / 1e-4, rel=1e-6)


@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE])
@pytest.mark.parametrize("port", PORTS)
def test_json_keeps_lens_and_port(lens: LensValues, port: PortValues) -> None:
    camera = camera_of(lens, port)
    assert camera_from_json(camera.to_json()) == camera


def test_json_that_makes_no_camera_is_refused() -> None:
    """Unknown kinds, unknown and missing keys, and a pupil outside its dome."""
    data = camera_of(PINHOLE, DOME).to_json()
    for changes, named in (
        ({"port": "egg"}, "port = 'egg' is none of none, flat, dome"),
        ({"lens": 7}, "lens"),
        ({"port_distance_m": 0.02}, "port_distance_m"),
        ({"k9": 0.1}, "k9"),
        ({"dome_z_m": 0.08, "glass_thickness_m": 0.005}, "80.* mm from the dome's centre"),
    ):
        with pytest.raises(CalibrationError, match=named):
            camera_from_json({**data, **changes})
    del data["fx_px"]
    with pytest.raises(CalibrationError, match="fx_px"):
        camera_from_json(data)
