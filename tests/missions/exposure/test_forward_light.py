"""Photons traced one by one through scattering water judge the closed forms of the light budget.

The tracer draws free paths and the angles of Henyey and Greenstein, any number of turns, any way
back and forth; it uses nothing of the budget but the water's absorption and scattering.
"""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from alice_survey.core.config import Jerlov
from camera_calib.water import ASYMMETRY, phase_per_sr, water_optics
from missions.exposure.light import (
    LIT_SHARE,
    SEEN_SHARE,
    floor_radiance,
    share_within,
    veil_radiance,
    watts_per_lumen,
    weakened_per_m,
)
from tests.missions.exposure.surveys import survey

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

    watts = config.imaging.strobe_lumens * float(watts_per_lumen("led")[GREEN])
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
