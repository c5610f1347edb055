"""The light budget against closed forms, the simulator, and photons traced one by one.

The tracer draws free paths and the angles of Henyey and Greenstein, any number of turns, any way
back and forth; it uses nothing of the budget but the water's absorption and scattering.
"""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from alice_survey.core.config import Jerlov
from alice_survey.sim.seafloor.light import camera_light, make_sensor, nominal_gain
from alice_survey.sim.seafloor.renderer import flat_floor_radiance
from alice_survey.sim.seafloor.texture import SAND_ALBEDO
from camera_calib.water import ASYMMETRY, WaterOptics, phase_per_sr, water_optics
from missions.exposure.light import (
    FLOOR_REFLECTANCE,
    LED_B3,
    LED_NM,
    LIT_SHARE,
    MIDDLE_GREY,
    SEEN_SHARE,
    cone_intensity,
    electrons_per_radiance,
    floor_radiance,
    lens_falloff,
    light_budget,
    light_for_snr_e,
    scatter,
    shadows,
    share_within,
    signal_to_noise,
    veil_radiance,
    watts_per_lumen,
    weakened_per_m,
)
from tests.missions.exposure.surveys import survey

CLEAR = WaterOptics(absorption_per_m=np.zeros(3), scattering_per_m=np.zeros(3))


@pytest.mark.parametrize("jerlov", ["I", "II", "3C", "7C"])
@pytest.mark.parametrize("altitude_m", [1.5, 2.0, 3.0])
def test_the_budget_agrees_with_a_rendered_flat_floor(
    jerlov: str, altitude_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The simulator has an even spectrum, a soft cone, and of scattered light only the veil."""
    monkeypatch.setattr("missions.exposure.light.LED_NM", np.array([399.99, 400, 700, 700.01]))
    monkeypatch.setattr("missions.exposure.light.LED_B3", np.array([0.0, 1.0, 1.0, 0.0]))
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
    ours = floor_radiance(rig, config.imaging, lossy, altitude_m, pixels).total
    ours *= lens_falloff(rig, pixels)[..., None]

    np.testing.assert_array_equal(FLOOR_REFLECTANCE, SAND_ALBEDO)
    # The renderer's single precision hides what is a millionth of the veil.
    np.testing.assert_allclose(ours, rendered - veil, rtol=0.10, atol=1e-6 * veil.max())
    seen = rendered - veil > 1e-4 * veil.max()
    assert np.median(ours[seen] / (rendered - veil)[seen]) == pytest.approx(1.0, abs=0.04)

    middle = (rendered.shape[0] // 2, rendered.shape[1] // 2)
    lost = optics.attenuation_per_m
    mine = veil_radiance(rig, config.imaging, optics, altitude_m, lost)
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
    watts = watts_per_lumen()
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
    power = 30_000 * watts_per_lumen()
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


Arr = np.ndarray
PHOTONS = 60_000
GREEN = 1


def turned(directions: Arr, rng: np.random.Generator) -> Arr:
    """Directions (N, 3) after one scattering each."""
    g, count = ASYMMETRY, len(directions)
    ratio = (1 - g * g) / (1 - g + 2 * g * rng.random(count))
    cosine = (1 + g * g - ratio * ratio) / (2 * g)
    side = np.cross(directions, rng.normal(size=(count, 3)))
    side /= np.linalg.norm(side, axis=1)[:, None]
    return cosine[:, None] * directions + np.sqrt(1 - cosine**2)[:, None] * side


def traced(
    places: Arr, directions: Arr, a: float, b: float, floor_m: float, rng: np.random.Generator
) -> tuple[Arr, Arr, Arr]:
    """Where photons land on a black floor (N, 2), the weight that absorption leaves, their turns.

    A photon that does not land has no weight.
    """
    p, d = places.copy(), directions.copy()
    landed, turns = np.zeros((len(p), 2)), np.zeros(len(p), dtype=int)
    weight, arrived = np.ones(len(p)), np.zeros(len(p))
    flying = np.arange(len(p))
    while len(flying):
        step = rng.exponential(1 / b, len(flying))
        down = np.maximum(d[flying, 2], 1e-12)
        to_floor = np.where(d[flying, 2] > 0, (floor_m - p[flying, 2]) / down, np.inf)
        hits = to_floor <= step
        step = np.minimum(step, to_floor)
        p[flying] += step[:, None] * d[flying]
        weight[flying] *= np.exp(-a * step)
        down_now = flying[hits]
        landed[down_now], arrived[down_now] = p[down_now, :2], weight[down_now]
        flying = flying[~hits]
        flying = flying[(weight[flying] > 1e-4) & (p[flying, 2] > -4.0)]
        turns[flying] += 1
        d[flying] = turned(d[flying], rng)
    return landed, arrived, turns


def lambert_cone(half_rad: float, count: int, rng: np.random.Generator) -> Arr:
    sine = math.sin(half_rad) * np.sqrt(rng.random(count))
    around = 2 * np.pi * rng.random(count)
    return np.stack([sine * np.cos(around), sine * np.sin(around), np.sqrt(1 - sine**2)], axis=1)


def test_shares_of_scattered_light_are_between_forward_and_all() -> None:
    forward, _ = quad(lambda c: 2 * math.pi * float(phase_per_sr(np.array(c))), 0, 1)
    assert 0.9 < SEEN_SHARE < LIT_SHARE < forward < 1
    for angle in (1e-4, 0.01, 0.3, math.pi):
        whole, _ = quad(
            lambda t: 2 * math.pi * math.sin(t) * float(phase_per_sr(np.cos(t))), 0, angle
        )
        assert share_within(angle) == pytest.approx(whole, rel=1e-6)


@pytest.mark.parametrize(("jerlov", "height_m"), [("II", 2.0), ("3C", 1.5)])
def test_photons_light_the_floor_as_the_budget_says(jerlov: Jerlov, height_m: float) -> None:
    """The ratio of all light to unscattered light, in rings below a strobe, within 5 %."""
    water, rng = water_optics(jerlov), np.random.default_rng(5)
    a, b = float(water.absorption_per_m[GREEN]), float(water.scattering_per_m[GREEN])
    start = np.zeros((4 * PHOTONS, 3))
    cone = lambert_cone(math.radians(60), len(start), rng)
    landed, weight, turns = traced(start, cone, a, b, height_m, rng)
    radius = np.hypot(*landed.T)
    for inner, outer in ((0.0, 0.6), (0.6, 1.2)):
        ring = (weight > 0) & (radius >= inner) & (radius < outer)
        ratio = weight[ring].sum() / weight[ring & (turns == 0)].sum()
        slant = math.hypot(height_m, math.sqrt((inner**2 + outer**2) / 2))
        assert ratio > 1.2
        assert ratio == pytest.approx(math.exp(LIT_SHARE * b * slant), rel=0.05)


@pytest.mark.parametrize(
    ("jerlov", "altitude_m", "off_axis_deg"), [("II", 2.0, 0.0), ("3C", 1.5, 25.0)]
)
def test_photons_reach_a_pixel_as_the_budget_says(
    jerlov: Jerlov, altitude_m: float, off_axis_deg: float
) -> None:
    """Light goes back its own way: photons sent from the pixel find the floor that lights it."""
    water, rng = water_optics(jerlov), np.random.default_rng(6)
    a, b = float(water.absorption_per_m[GREEN]), float(water.scattering_per_m[GREEN])
    rig, config = survey(water={"jerlov": jerlov})
    camera = rig.cameras["left"]
    pixel = np.array([camera.cx_px, camera.cy_px])
    pixel[1] += math.tan(math.radians(off_axis_deg)) * camera.fy_px
    found = floor_radiance(rig, config.imaging, water, altitude_m, pixel)

    outer, direction = camera.unproject(pixel)
    start, ahead = np.tile(outer, (PHOTONS, 1)), np.tile(direction, (PHOTONS, 1))
    floor_z = float(camera.front_cam[2]) + altitude_m
    landed, weight, turns = traced(start, ahead, a, b, floor_z, rng)
    strobes = rig.body_from_cam("left").inv().apply(np.array(config.imaging.strobes_body_m))
    lit = np.zeros(len(landed))
    for x, y, z in strobes:
        distance = np.hypot(np.hypot(landed[:, 0] - x, landed[:, 1] - y), floor_z - z)
        cosine = (floor_z - z) / distance
        loss = np.exp(-(a + (1 - LIT_SHARE) * b) * distance)
        lit += np.where(cosine > 0.5, cosine**2 / distance**2 * loss, 0.0)
    seen = lit * weight
    ratio = seen.sum() / seen[turns == 0].sum()
    assert ratio > 1.2
    expected = float(found.total[GREEN] / found.sharp[GREEN])
    assert expected == pytest.approx(ratio, rel=0.05)


@pytest.mark.parametrize(("jerlov", "within"), [("II", 0.12), ("3C", 0.2)])
def test_photons_make_the_veil_that_the_budget_says(jerlov: Jerlov, within: float) -> None:
    """Sent down the axis, each photon asks every strobe at each turn what would come from it."""
    water, rng = water_optics(jerlov), np.random.default_rng(7)
    a, b = float(water.absorption_per_m[GREEN]), float(water.scattering_per_m[GREEN])
    rig, config = survey(water={"jerlov": jerlov})
    camera, altitude_m, count = rig.cameras["left"], 2.0, 4 * PHOTONS
    top = float(camera.front_cam[2])
    strobes = rig.body_from_cam("left").inv().apply(np.array(config.imaging.strobes_body_m))
    p = np.tile([0.0, 0.0, top], (count, 1))
    d, weight = np.tile([0.0, 0.0, 1.0], (count, 1)), np.ones(count)
    by_turn, flying = [], np.arange(count)
    for turn in range(9):
        step = rng.exponential(1 / b, len(flying))
        if turn == 0:  # all turn before the floor
            reach = 1 - math.exp(-b * altitude_m)
            step = -np.log(1 - reach * rng.random(len(flying))) / b
            weight *= reach
        p[flying] += step[:, None] * d[flying]
        weight[flying] *= np.exp(-a * step)
        flying = flying[(p[flying, 2] > top) & (p[flying, 2] < top + altitude_m)]
        got = 0.0
        for strobe in strobes:
            away = strobe - p[flying]
            distance = np.linalg.norm(away, axis=1)
            cos_turn = (away * d[flying]).sum(axis=1) / distance
            cos_beam = -away[:, 2] / distance
            sent = np.where(cos_beam > 0.5, cos_beam / (math.pi * 0.75), 0.0) / distance**2
            sent = sent * np.exp(-(a + b) * distance) * phase_per_sr(cos_turn)
            got += float((weight[flying] * sent).sum()) / count
        by_turn.append(got)
        d[flying] = turned(d[flying], rng)

    watts = config.imaging.strobe_lumens * float(watts_per_lumen()[GREEN])
    lost, forward = water.attenuation_per_m, weakened_per_m(water, LIT_SHARE)
    once, kept = (
        float(veil_radiance(rig, config.imaging, water, altitude_m, k)[GREEN]) / watts
        for k in (lost, forward)
    )
    assert once == pytest.approx(_single(strobes, top, altitude_m, a, b), rel=0.01)
    assert by_turn[0] == pytest.approx(once, rel=0.03)
    assert kept == pytest.approx(sum(by_turn), rel=within)
    assert sum(by_turn) > 1.1 * once


def _single(strobes: Arr, top: float, altitude_m: float, a: float, b: float) -> float:
    """Single scattering on the axis from strobes of one watt, by quadrature."""

    def sent(s: float) -> float:
        away = np.array([0.0, 0.0, top + s]) - strobes
        distance = np.linalg.norm(away, axis=1)
        cosine = away[:, 2] / distance
        got = b * phase_per_sr(-cosine) * cosine / (math.pi * 0.75) / distance**2
        return float((got * np.exp(-(a + b) * (distance + s)))[cosine > 0.5].sum())

    return quad(sent, 0.0, altitude_m, limit=200)[0]
