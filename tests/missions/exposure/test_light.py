import math

import numpy as np
import pytest

from alice_survey.sim.seafloor.light import camera_light, make_sensor, nominal_gain
from alice_survey.sim.seafloor.renderer import flat_floor_radiance
from alice_survey.sim.seafloor.texture import SAND_ALBEDO
from camera_calib.water import WaterOptics, water_optics
from missions.exposure.light import (
    FLOOR_REFLECTANCE,
    LED_B3,
    LED_NM,
    MIDDLE_GREY,
    cone_intensity,
    electrons_per_radiance,
    floor_radiance,
    lens_falloff,
    light_budget,
    light_for_snr_e,
    scatter,
    shadows,
    signal_to_noise,
    veil_radiance,
    watts_per_lumen,
)
from tests.missions.exposure.surveys import survey

CLEAR = WaterOptics(absorption_per_m=np.zeros(3), scattering_per_m=np.zeros(3))


@pytest.mark.parametrize("jerlov", ["I", "II", "3C", "7C"])
@pytest.mark.parametrize("altitude_m", [1.5, 2.0, 3.0])
def test_the_budget_agrees_with_a_rendered_flat_floor(jerlov: str, altitude_m: float) -> None:
    """The simulator has an even spectrum, a soft cone, and of scattered light only the veil."""
    rig, config = survey(water={"jerlov": jerlov})
    camera, optics = rig.cameras["left"], water_optics(config.water.jerlov)
    light = camera_light(
        camera, rig.body_from_cam("left"), config.imaging, optics, 2 * altitude_m + 1
    )
    range_m = altitude_m + 0.03
    step = 423
    rendered = flat_floor_radiance(camera, light, range_m, SAND_ALBEDO, step).astype(np.float64)
    veil = flat_floor_radiance(camera, light, range_m, np.zeros(3), step)
    pixels = camera.pixel_centres(step)
    lossy = WaterOptics(absorption_per_m=optics.attenuation_per_m, scattering_per_m=np.zeros(3))
    ours = floor_radiance(rig, config.imaging, lossy, altitude_m, pixels, "even").total
    ours *= lens_falloff(rig, pixels)[..., None]

    np.testing.assert_array_equal(FLOOR_REFLECTANCE, SAND_ALBEDO)
    # The renderer's single precision hides what is a millionth of the veil.
    np.testing.assert_allclose(ours, rendered - veil, rtol=0.10, atol=1e-6 * veil.max())
    seen = rendered - veil > 1e-4 * veil.max()
    assert np.median(ours[seen] / (rendered - veil)[seen]) == pytest.approx(1.0, abs=0.04)

    middle = (rendered.shape[0] // 2, rendered.shape[1] // 2)
    lost = optics.attenuation_per_m
    mine = veil_radiance(rig, config.imaging, optics, altitude_m, lost, "even")
    np.testing.assert_allclose(mine, veil[middle], rtol=0.15)


def test_electrons_agree_with_the_simulators_sensor() -> None:
    config = survey()[1]
    ours = electrons_per_radiance(config.camera, 1.34, 2e-3)
    theirs = make_sensor(config.camera, 1.34, 2e-3, 1).electrons_per_radiance
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    sensor = make_sensor(config.camera, 1.34, 2e-3, 1)
    gain = nominal_gain(np.full((2, 2, 3), 100.0), sensor)
    assert gain * 100 == pytest.approx(MIDDLE_GREY)


def lobe(nm: np.ndarray, middle: float, below: float, above: float) -> np.ndarray:
    return np.exp(-0.5 * ((nm - middle) / np.where(nm < middle, below, above)) ** 2)


def test_the_led_has_the_colour_that_cie_states() -> None:
    """LED-B3 is x 0.3756, y 0.3723 (CIE 015:2018); colour matching by Wyman, Sloan and Shirley 2013
    (JCGT 2, multi-lobe fit of CIE 1931)."""
    nm, power = LED_NM, LED_B3
    x = 1.056 * lobe(nm, 599.8, 37.9, 31.0) + 0.362 * lobe(nm, 442.0, 16.0, 26.7)
    x -= 0.065 * lobe(nm, 501.1, 20.4, 26.2)
    y = 0.821 * lobe(nm, 568.8, 46.9, 40.5) + 0.286 * lobe(nm, 530.9, 16.3, 31.1)
    z = 1.217 * lobe(nm, 437.0, 11.8, 36.0) + 0.681 * lobe(nm, 459.0, 26.0, 13.8)
    xyz = np.array([power @ x, power @ y, power @ z])
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), [0.3756, 0.3723], atol=0.004)
    watts = watts_per_lumen("led")
    assert 683.0 * (power @ y) / power.sum() == pytest.approx(1 / watts.sum(), rel=0.03)
    red, green, blue = watts
    assert green > red > blue


def test_the_cone_sends_all_of_its_power() -> None:
    half = math.radians(60.0)
    angle = np.linspace(0, math.pi / 2, 40_001)
    intensity = cone_intensity(np.cos(angle), half)
    assert np.trapezoid(2 * math.pi * intensity * np.sin(angle), angle) == pytest.approx(
        1, abs=1e-3
    )


def test_one_strobe_over_the_camera_in_clear_water_is_the_closed_form() -> None:
    """E = P / (pi sin^2 60) / H^2 straight below, L = rho E / pi."""
    x, y, z = 0.55, -0.05, 0.08
    rig, config = survey(imaging={"strobes_body_m": [[x, y, z]]})
    camera = rig.cameras["left"]
    centre = np.array([camera.cx_px, camera.cy_px])
    radiance = floor_radiance(rig, config.imaging, CLEAR, 2.0, centre)
    np.testing.assert_array_equal(radiance.total, radiance.sharp)
    power = 30_000 * watts_per_lumen("led")
    expected = FLOOR_REFLECTANCE / math.pi * power / (math.pi * math.sin(math.radians(60)) ** 2) / 4
    np.testing.assert_allclose(radiance.total, expected, rtol=1e-9)


def test_the_budget_scales_as_light_does() -> None:
    rig, config = survey()
    optics = water_optics("II")
    base = light_budget(rig, config.camera, config.imaging, optics, 2.0, 2e-3)
    longer = light_budget(rig, config.camera, config.imaging, optics, 2.0, 4e-3)
    open_ = config.camera.model_copy(update={"f_number": 2.0})
    brighter = light_budget(rig, open_, config.imaging, optics, 2.0, 2e-3)
    assert longer.median_e == pytest.approx(2 * base.median_e)
    assert brighter.median_e == pytest.approx(4 * base.median_e)
    assert base.gain_db - longer.gain_db == pytest.approx(20 * math.log10(2))
    assert longer.full_share == pytest.approx(2 * base.full_share)
    assert brighter.full_share == pytest.approx(4 * base.full_share)
    assert base.corner_e[1] < 0.5 * base.centre_e[1]
    assert 10 ** (base.gain_db / 20) * base.median_e / config.camera.full_well_e == pytest.approx(
        0.2
    )


def test_signal_to_noise_is_poissons_and_the_readers() -> None:
    rng = np.random.default_rng(3)
    draws = rng.poisson(200.0, 200_000) + 12.0 * rng.standard_normal(200_000)
    expected = draws.mean() / draws.std()
    assert signal_to_noise(np.array(200.0), 12.0, 200.0) == pytest.approx(expected, rel=0.01)
    for electrons in (3.0, 200.0, 9000.0):
        ratio = float(signal_to_noise(np.array(electrons), 12.0, 0.6 * electrons))
        assert light_for_snr_e(ratio, 12.0, 0.6) == pytest.approx(electrons)


def test_shadows_follow_from_similar_triangles() -> None:
    rig, config = survey(imaging={"strobes_body_m": [[0.75, 0.0, 0.08], [-0.6, 0.0, 0.08]]})
    shade = shadows(rig, config.imaging, 2.0, 0.35)
    fore, aft = math.hypot(0.2, 0.05), math.hypot(1.15, 0.05)
    assert shade.length_m == pytest.approx((0.35 * fore / 1.65, 0.35 * aft / 1.65), rel=1e-6)
    angle = math.degrees(math.atan2(0.2, 2) + math.atan2(1.15, 2))
    assert shade.between_deg == pytest.approx(angle, abs=0.2)
    assert shade.opposite


def test_the_lit_water_begins_where_the_cone_meets_the_axis() -> None:
    rig, config = survey(imaging={"strobes_body_m": [[0.75, -0.05, 0.08]]})
    veil = scatter(rig, config.imaging, water_optics("II"), 2.0)
    assert veil.lit_from_m == pytest.approx(0.2 / math.tan(math.radians(60)), abs=1e-9)
    assert veil.lit_share == pytest.approx(1 - veil.lit_from_m / 2.0, abs=0.01)
    apart, config = survey(imaging={"strobes_body_m": [[1.55, -0.05, 0.08]]})
    wide = scatter(apart, config.imaging, water_optics("II"), 2.0)
    assert wide.lit_from_m > veil.lit_from_m
    assert max(wide.veil_share) < min(veil.veil_share)
