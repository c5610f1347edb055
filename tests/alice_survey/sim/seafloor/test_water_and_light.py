import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import ImagingConfig
from alice_survey.core.frames import BODY_FROM_NADIR_CAM
from alice_survey.sim.seafloor.light import (
    LUMENS_PER_WATT,
    add_direct,
    backscatter_along,
    backscatter_at,
    backscatter_of_row,
    beam_profile,
    beam_solid_angle_sr,
    camera_light,
)
from camera_calib.camera import Camera
from camera_calib.water import ASYMMETRY, WaterOptics, phase_per_sr, water_optics
from tests.cameras import flat_port_camera
from tests.oracles_seafloor import direct_light

DOWN = np.array([0.0, 0.0, 1.0])
UP = -DOWN
NO_LOSS = np.zeros(3)


def irradiance(
    distance_m: float, attenuation: np.ndarray = NO_LOSS, path_m: float = 0.0,
    normal: np.ndarray = UP, lit: float = 1.0,
) -> np.ndarray:  # fmt: skip
    out, strobe = np.zeros((3, 1)), np.array([[0.0, 0.0, -distance_m]])
    path, lit_by = np.full(1, path_m), np.full((1, 1), lit)
    add_direct(
        np.zeros((3, 1)), normal[:, None].copy(), path, lit_by, strobe, DOWN, 1.0, 5.0,
        attenuation, out,
    )  # fmt: skip
    return out[:, 0]


@settings(deadline=None)
@given(c=st.tuples(*[st.floats(0.01, 3.0)] * 3), out=st.floats(0.2, 3.0), back=st.floats(0.0, 3.0))
def test_water_takes_its_share_of_the_way_out_and_back(
    c: tuple[float, float, float], out: float, back: float
) -> None:
    """Beer and Lambert: exp(-c (way out + way back))."""
    lost = irradiance(out, np.array(c), back) / irradiance(out)
    np.testing.assert_allclose(lost, np.exp(-np.array(c) * (out + back)), rtol=1e-12)


@settings(max_examples=50, deadline=None)
@given(
    point=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(1, 3)),
    tilt=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    path=st.floats(0, 3),
)
def test_direct_light_is_that_of_its_slow_twin(
    point: tuple[float, float, float], tilt: tuple[float, float], path: float
) -> None:
    strobes = np.array([[0.7, 0.0, 0.1], [-0.6, 0.1, -0.1]])
    normal = np.array([*tilt, -1.0]) / np.linalg.norm([*tilt, -1.0])
    beam, attenuation = np.deg2rad(60.0), np.array([0.4, 0.2, 0.3])
    away = np.array(point) - strobes
    profile = np.array([beam_profile(c, beam) for c in away[:, 2] / np.linalg.norm(away, axis=1)])
    out = np.zeros((3, 1))
    add_direct(
        np.array(point)[:, None], normal[:, None], np.full(1, path), np.ones((2, 1)), strobes, DOWN,
        beam, 3.0, attenuation, out,
    )  # fmt: skip
    twin = direct_light(np.array(point), normal, path, strobes, DOWN, profile, 3.0, attenuation)
    np.testing.assert_allclose(out[:, 0], twin, rtol=1e-12)


@pytest.mark.parametrize("half_angle_deg", [15.0, 45.0, 60.0, 80.0])
def test_a_strobe_sends_all_of_its_power(half_angle_deg: float) -> None:
    """Its light on a plane below sums to its power."""
    beam = np.deg2rad(half_angle_deg)
    power = 40.0
    peak = power / beam_solid_angle_sr(beam)
    angle = np.linspace(0, np.deg2rad(89.999), 40_000)
    profile = np.array([beam_profile(c, beam) for c in np.cos(angle)])
    radius = np.tan(angle)
    on_plane = peak * profile * np.cos(angle) ** 3  # I cos / d^2 at a height of 1 m
    caught = np.trapezoid(2.0 * np.pi * radius * on_plane, radius)
    assert caught == pytest.approx(power, rel=1e-3)
    assert beam_profile(1.0, beam) == 1.0
    assert beam_profile(np.cos(beam), beam) == pytest.approx(0.5 * np.cos(beam))
    assert beam_profile(np.cos(min(beam + 0.22, 1.57)), beam) < 1e-3


def test_all_scattered_light_goes_somewhere_and_little_of_it_backward() -> None:
    total, _ = quad(lambda c: 2 * np.pi * float(phase_per_sr(np.array(c))), -1, 1)
    mean, _ = quad(lambda c: 2 * np.pi * c * float(phase_per_sr(np.array(c))), -1, 1)
    back, _ = quad(lambda c: 2 * np.pi * float(phase_per_sr(np.array(c))), -1, 0)
    assert total == pytest.approx(1.0, abs=1e-6)
    assert mean == pytest.approx(ASYMMETRY, abs=1e-6)
    assert back == pytest.approx(0.0183, abs=0.002)


def test_backscatter_of_a_strobe_behind_the_camera_is_its_integral() -> None:
    """Strobe on the ray, 0.5 m behind: the light turns by 180 degrees everywhere."""
    water = WaterOptics(
        absorption_per_m=np.array([0.2, 0.1, 0.05]), scattering_per_m=np.array([0.1, 0.2, 0.3])
    )
    path = np.linspace(0.0, 3.0, 600)
    strobe = np.array([[0.0, 0.0, -0.5]])
    got = backscatter_along(np.zeros(3), DOWN, path, strobe, DOWN, 1.0, 7.0, water)
    for channel in range(3):
        c, b = water.attenuation_per_m[channel], water.scattering_per_m[channel]
        integral, _ = quad(lambda s, c=c: np.exp(-c * (2 * s + 0.5)) / (s + 0.5) ** 2, 0.0, 3.0)
        truth = 7.0 * b * float(phase_per_sr(np.array(-1.0))) * integral
        assert got[-1, channel] == pytest.approx(truth, rel=1e-4)
    assert np.all(np.diff(got, axis=0) > 0)
    assert np.all(got[0] == 0)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return flat_port_camera(
        width_px=211, height_px=169, fx_px=212.0, fy_px=212.0, cx_px=105.5, cy_px=84.5,
        port_distance_m=0.02, glass_thickness_m=0.01,
    )  # fmt: skip


def test_the_table_of_backscatter_gives_the_integral_of_any_ray(camera: Camera) -> None:
    imaging, water = ImagingConfig(), water_optics("III")
    body_from_cam = RigidTransform.from_components([0.55, -0.05, 0.05], BODY_FROM_NADIR_CAM)
    light = camera_light(camera, body_from_cam, imaging, water, 5.0)
    np.testing.assert_allclose(light.axis_cam, DOWN, atol=1e-12)
    # Forward of the camera is up in its picture: y < 0.
    np.testing.assert_allclose(light.positions_cam[0], [0.05, -0.2, 0.03], atol=1e-12)
    power = light.peak_w_per_sr * beam_solid_angle_sr(light.beam_rad) * 3 * LUMENS_PER_WATT
    assert power == pytest.approx(imaging.strobe_lumens)
    rng = np.random.default_rng(2)
    rows, columns, steps, _ = light.backscatter.shape
    grid = RegularGridInterpolator(
        (np.arange(rows), np.arange(columns), np.arange(steps)), light.backscatter
    )
    for pixel, path in zip(
        rng.uniform([0, 0], [211, 169], (15, 2)), rng.uniform(0.5, 4, 15), strict=True
    ):
        column, row = pixel / [211, 169] * [columns - 1, rows - 1]
        out, of_row = np.empty(3), np.empty(light.backscatter.shape[1:])
        backscatter_of_row(light.backscatter, row, of_row)
        backscatter_at(of_row, light.reach_m, column, path, out)
        step = np.sqrt(path / light.reach_m) * (steps - 1)
        np.testing.assert_allclose(out, grid([[row, column, step]])[0], rtol=1e-9)
        origin, direction = camera.unproject(pixel)
        exact = backscatter_along(
            origin, direction, np.linspace(0, path, 3000), light.positions_cam, light.axis_cam,
            light.beam_rad, light.peak_w_per_sr, water,
        )[-1]  # fmt: skip
        np.testing.assert_allclose(out, exact, rtol=0.01)


@settings(deadline=None)
@given(near=st.floats(0.3, 5.0), factor=st.floats(1.1, 5.0))
def test_light_falls_with_the_square_of_the_distance(near: float, factor: float) -> None:
    np.testing.assert_allclose(irradiance(near), irradiance(near * factor) * factor**2, rtol=1e-9)
    np.testing.assert_allclose(irradiance(near), 5.0 / near**2, rtol=1e-12)


def test_a_surface_that_faces_away_or_is_in_shadow_is_dark() -> None:
    assert np.all(irradiance(2.0, normal=DOWN) == 0.0)
    assert np.all(irradiance(2.0, lit=0.0) == 0.0)
