import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera, pose_jacobian
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.ports.flat import FlatPort
from tests import oracles_camera
from tests.cameras import MANTA, changed

PARAMETERS = (*OpenCVLens.parameters, *FlatPort.parameters)


def tilted(angle_deg: float, azimuth_deg: float) -> tuple[float, float, float]:
    turn = Rotation.from_euler("yz", [angle_deg, azimuth_deg], degrees=True)
    x, y, z = turn.as_matrix()[:, 2].tolist()
    return x, y, z


RANGES = {
    "fx_px": (2500.0, 8000.0), "fy_px": (2500.0, 8000.0), "cx_px": (1600.0, 1800.0),
    "cy_px": (1300.0, 1400.0), "k1": (-0.15, 0.15), "k2": (-0.05, 0.1), "p1": (-2e-3, 2e-3),
    "p2": (-2e-3, 2e-3), "k3": (-0.02, 0.02), "k4": (-0.05, 0.05), "k5": (-0.02, 0.02),
    "k6": (-0.01, 0.01), **dict.fromkeys(("s1", "s2", "s3", "s4"), (-1e-3, 1e-3)),
    "port_distance_m": (0.0, 0.2), "glass_thickness_m": (0.0, 0.2), "n_glass": (1.45, 1.8),
    "n_water": (1.0, 1.36),
}  # fmt: skip


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Cameras over the ranges in which the model is to be exact."""
    values = {name: draw(st.floats(low, high)) for name, (low, high) in RANGES.items()}
    normal = tilted(draw(st.floats(0.0, 10.0)), draw(st.floats(0.0, 360.0)))
    return changed(MANTA, **values, normal=normal)


@settings(deadline=None, max_examples=150)
@given(camera=cameras(), distance_m=st.floats(0.3, 20.0))
def test_a_pixel_comes_back_within_a_billionth(camera: Camera, distance_m: float) -> None:
    pixels = camera.pixel_centres(step=241).reshape(-1, 2)
    glass, directions = camera.unproject(pixels)

    back = camera.project(glass + distance_m * directions)

    seen = np.isfinite(glass).all(axis=1)  # some lenses fold back before the corners of the frame
    assert seen.mean() > 0.8
    np.testing.assert_array_equal(np.isfinite(back).all(axis=1), seen)
    assert np.abs(back - pixels)[seen].max() < 1e-9


@settings(deadline=None, max_examples=60)
@given(
    camera=cameras(), x=st.floats(-0.4, 0.4), y=st.floats(-0.4, 0.4), water_m=st.floats(0.3, 20.0)
)
def test_project_agrees_with_the_shortest_optical_path(
    camera: Camera, x: float, y: float, water_m: float
) -> None:
    glass_m = camera.parameter("port_distance_m") + camera.parameter("glass_thickness_m")
    point = (glass_m + water_m) * np.array(camera.port.axis_cam) + water_m * np.array([x, y, 0.0])
    if camera.parameter("port_distance_m") < 1e-6:
        camera = changed(camera, port_distance_m=1e-6)
    if camera.parameter("glass_thickness_m") < 1e-6:
        camera = changed(camera, glass_thickness_m=1e-6)

    np.testing.assert_allclose(
        camera.project(point), oracles_camera.project_by_shortest_path(camera, point), atol=1e-8
    )


@settings(deadline=None, max_examples=150)
@given(
    camera=cameras(),
    slope=st.floats(0.0, 0.6),
    azimuth=st.floats(0.0, 6.28),
    water_m=st.floats(0.3, 20.0),
)
def test_project_agrees_with_bisection(
    camera: Camera, slope: float, azimuth: float, water_m: float
) -> None:
    camera = changed(camera, normal=(0.0, 0.0, 1.0))
    z = camera.parameter("port_distance_m") + camera.parameter("glass_thickness_m") + water_m
    point = np.array([slope * z * math.cos(azimuth), slope * z * math.sin(azimuth), z])
    if not np.all(np.isfinite(camera.project(point))):
        assert slope > 0.4  # only far outside of the frame may a lens have no image
        return

    np.testing.assert_allclose(
        camera.project(point), oracles_camera.project_by_bisection(camera, point), atol=1e-8
    )


@st.composite
def points_in_water(draw: st.DrawFn) -> Array:
    """Points within and a little beyond the frame, from near to far, one on the port's normal."""
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    directions = np.stack([*rng.uniform(-0.4, 0.4, (2, 20)), np.ones(20)], axis=1)
    return directions * rng.uniform(0.75, 10.0, (20, 1))


STEPS = {
    "fx_px": 0.1, "fy_px": 0.1, "cx_px": 0.1, "cy_px": 0.1, "n_glass": 1e-3, "n_water": 1e-3,
}  # fmt: skip


@settings(deadline=None, max_examples=60)
@given(camera=cameras(), points=points_in_water())
def test_slopes_are_those_of_project(camera: Camera, points: Array) -> None:
    """By the point also for a port at the pupil and in air; parameters need room for a step."""
    points = np.vstack([points, 1.5 * np.array(camera.port.axis_cam)])
    oracles_camera.assert_slopes_by_point(camera, points)
    camera = changed(
        camera,
        port_distance_m=camera.parameter("port_distance_m") + 1e-3,
        glass_thickness_m=camera.parameter("glass_thickness_m") + 1e-3,
        n_water=camera.n_water + 4e-3,
    )
    oracles_camera.assert_slopes(camera, points, STEPS)


def test_slopes_by_a_pose_are_those_of_moved_points() -> None:
    rng = np.random.default_rng(5)
    camera = changed(MANTA, normal=tilted(4.0, 70.0), k1=-0.1)
    points = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 2.5], (30, 3))
    _, by_point, _ = camera.project_jacobian(points)
    slopes = pose_jacobian(by_point, points)

    assert slopes.shape == (30, 2, 6)
    for axis in range(3):
        unit = np.eye(3)[axis]
        turned = oracles_camera.numeric_slope(
            lambda h, u=unit: camera.project(Rotation.from_rotvec(h * u).apply(points)), 1e-3
        )
        shifted = oracles_camera.numeric_slope(
            lambda h, u=unit: camera.project(points + h * u), 1e-3
        )
        np.testing.assert_allclose(slopes[..., axis], turned, rtol=1e-6, atol=1e-4)
        np.testing.assert_allclose(slopes[..., 3 + axis], shifted, rtol=1e-6, atol=1e-4)


def test_slopes_are_missing_where_pixels_are() -> None:
    points = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.03], [0.1, 0.1, 1.0], [np.nan, 0.0, 1.0]])
    pixels, by_point, by_parameter = MANTA.project_jacobian(points)

    seen = [False, False, True, False]
    assert np.isfinite(pixels).all(axis=1).tolist() == seen
    assert np.isfinite(by_point).all(axis=(1, 2)).tolist() == seen
    assert np.isfinite(by_parameter).all(axis=(1, 2)).tolist() == seen


def test_parameters_go_by_name() -> None:
    values = {name: 0.01 * (i + 1) for i, name in enumerate(PARAMETERS)} | {
        "n_glass": 1.49, "n_water": 1.342, "fx_px": 3000.0, "fy_px": 3001.0,
    }  # fmt: skip
    camera = MANTA.with_parameters(values)

    assert {name: camera.parameter(name) for name in PARAMETERS} == pytest.approx(values)
    assert math.hypot(*camera.port.axis_cam) == pytest.approx(1.0, abs=1e-15)
    with pytest.raises(CalibrationError, match="k9"):
        MANTA.with_parameters({"k9": 0.1})
    with pytest.raises(CalibrationError, match="normal_x"):
        MANTA.with_parameters({"normal_x": 0.9, "normal_y": 0.9})


@pytest.mark.parametrize("angle_deg", [0.0, 5.0, 15.0, 25.0, 32.0])
def test_a_ray_obeys_snells_law_in_closed_form(angle_deg: float) -> None:
    angle = math.radians(angle_deg)
    pixel = np.array([MANTA.cx_px + MANTA.fx_px * math.tan(angle), MANTA.cy_px])

    glass, direction = MANTA.unproject(pixel)

    in_glass = math.asin(math.sin(angle) / 1.52)
    in_water = math.asin(math.sin(angle) / 1.34)
    at_glass = 0.02 * math.tan(angle) + 0.01 * math.tan(in_glass)
    np.testing.assert_allclose(glass, [at_glass, 0.0, 0.03], atol=1e-15)
    np.testing.assert_allclose(direction, [math.sin(in_water), 0, math.cos(in_water)], atol=1e-15)


def test_without_port_and_water_it_is_opencvs_camera() -> None:
    rng = np.random.default_rng(1)
    camera = changed(MANTA, k1=-0.1, k2=0.05, p1=1e-3, p2=-2e-3, k3=0.01, n_glass=1.0, n_water=1.0)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (200, 3))

    expected = [oracles_camera.lens_pixel(camera, point) for point in points]

    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


def test_light_beyond_the_critical_angle_never_reaches_a_pupil_on_the_glass() -> None:
    camera = changed(MANTA, port_distance_m=0.0, glass_thickness_m=0.0)
    critical = math.tan(math.asin(1 / 1.34))
    points = np.array([[critical * f, 0.0, 1.0] for f in (0.9, 0.9999, 1.0001, 1.5)])

    seen = np.isfinite(camera.project(points)).all(axis=1)

    assert seen.tolist() == [True, True, False, False]


def test_a_lens_that_folds_gives_no_pixel_beyond_its_fold() -> None:
    # Barrel distortion r (1 - 0.3 r^2) turns back at r = 1.054 in air: what lies beyond would be
    # drawn over the frame a second time.
    camera = changed(MANTA, k1=-0.3, port_distance_m=0.0, glass_thickness_m=0.0)
    for tangent, seen in ((1.0, True), (1.05, True), (1.06, False), (1.7, False)):
        angle = math.asin(math.sin(math.atan(tangent)) / 1.34)
        point = np.array([2.0 * math.tan(angle), 0.0, 2.0])
        assert np.isfinite(camera.project(point)).all() == seen, tangent


def test_a_pixel_that_no_ray_reaches_has_none() -> None:
    camera = changed(MANTA, k1=-0.3)  # its slope vanishes where 1 = 0.9 r^2
    reach = camera.fx_px * math.sqrt(1 / 0.9) * (1 - 0.3 / 0.9) * np.array([0.999, 1.001])
    pixels = np.stack([camera.cx_px + reach, np.full(2, camera.cy_px)], axis=1)

    glass, direction = camera.unproject(pixels)

    assert np.isfinite(glass).all(axis=1).tolist() == [True, False]
    assert np.isfinite(direction).all(axis=1).tolist() == [True, False]


def test_shapes_follow_the_argument() -> None:
    pixels = MANTA.pixel_centres(step=1000)
    assert pixels.shape == (3, 4, 2)
    np.testing.assert_allclose(pixels[1, 2], [2000.5, 1000.5])

    points = MANTA.at_depth(pixels, 2.0)
    assert points.shape == (3, 4, 3)
    np.testing.assert_allclose(points[..., 2], 2.0)
    np.testing.assert_allclose(MANTA.project(points), pixels, atol=1e-9)
    assert MANTA.project(points[0, 0]).shape == (2,)


def test_a_reduced_camera_sees_the_same_points_at_smaller_pixels() -> None:
    small = MANTA.downscale(4)
    points = MANTA.at_depth(MANTA.pixel_centres(500), 2.0)

    assert (small.width_px, small.height_px) == (846, 677)
    np.testing.assert_allclose(small.project(points) * 4, MANTA.project(points), atol=1e-9)


def test_the_border_goes_round_the_frame_once() -> None:
    border = MANTA.border(8)

    assert border.shape == (32, 2)
    np.testing.assert_allclose(border[::8], [[0, 0], [3384, 0], [3384, 2710], [0, 2710]], atol=1e-9)
    closed = np.vstack([border, border[:1]])
    lengths = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    assert lengths.sum() == pytest.approx(2 * (3384 + 2710))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("fx_px", math.nan), ("cx_px", math.inf), ("width_px", 0), ("fy_px", -1.0),
        ("port_distance_m", -0.01), ("n_water", 0.9), ("normal", (0.0, 0.1, 1.0)),
        ("normal", (0.0, 0.0, -1.0)),
    ],
)  # fmt: skip
def test_a_camera_that_cannot_be_is_refused(name: str, value: object) -> None:
    with pytest.raises(CalibrationError, match=name):
        changed(MANTA, **{name: value})


def test_near_the_axis_water_magnifies_by_its_index() -> None:
    camera = changed(MANTA, port_distance_m=0.0, glass_thickness_m=0.0)
    point = np.array([1e-5, -2e-5, 2.0])

    offset = camera.project(point) - [camera.cx_px, camera.cy_px]

    np.testing.assert_allclose(offset, 1.34 * 3388.0 * point[:2] / 2.0, rtol=1e-8)


@given(factor=st.floats(0.1, 10.0), x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5))
def test_pixels_do_not_know_the_unit_of_length(factor: float, x: float, y: float) -> None:
    point = np.array([x, y, 1.5])
    camera = changed(MANTA, normal=tilted(4.0, 70.0))
    larger = changed(camera, port_distance_m=0.02 * factor, glass_thickness_m=0.01 * factor)

    np.testing.assert_allclose(larger.project(factor * point), camera.project(point), atol=1e-8)


def test_a_normal_that_is_rounded_is_a_unit_vector_to_rays() -> None:
    rounded = FlatPort(port_distance_m=0.02, normal=(0.01, 0.0, 0.9999505))
    assert np.linalg.norm(rounded.values[-3:]) == pytest.approx(1.0, abs=1e-15)
