"""Known lamp, water and range, and whether the survey's pictures determine them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reconstruct.light.solve import GRID, LightSamples
from reconstruct.mosaic.colour import Colour, ColourModel, solve_colour
from reconstruct.mosaic.picture_measures import (
    PictureMeasures,
    ReferencePatch,
    encode_srgb,
    linear_table,
)

NODE_X, NODE_Y = np.meshgrid(np.linspace(0, 1, GRID[1]), np.linspace(0, 1, GRID[0]))

IMAGES = [f"left/{n:02d}.png" for n in range(24)]
FALL_OFF = np.array([0.45, 0.5, 0.9])
"""Blue, green, red, 1/m, spreading included."""
MIDDLE_M = 2.0


def lamp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.exp(-1.6 * ((x - 0.45) ** 2 + (y - 0.55) ** 2))[..., None] * [0.9, 1.0, 0.8]


def haze(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Backscatter: strongest next to the lamps at the left and right."""
    return (0.02 + 0.10 * (x - 0.5) ** 2 + 0.02 * y)[..., None] * [1.2, 1.0, 0.4]


def shown(albedo: np.ndarray, place: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    x, y = place[:, 0], place[:, 1]
    water = np.exp(-(ranges[:, None] - MIDDLE_M) * FALL_OFF)
    return albedo * lamp(x, y) * water + haze(x, y)


def shown_twice(
    rng: np.random.Generator, views: np.ndarray, places: np.ndarray, ranges: np.ndarray
) -> LightSamples:
    """Random spots as two views show them each, with 2 % of noise."""
    albedo = rng.uniform(0.08, 0.5, (len(views), 1)) * rng.uniform(0.8, 1.2, (len(views), 3))
    light = np.stack([shown(albedo, places[:, s], ranges[:, s]) for s in range(2)], axis=1)
    light *= np.exp(rng.normal(0, 0.02, light.shape))
    places, levels, ranges = (a.astype(np.float32) for a in (places, np.log(light), ranges))
    return LightSamples(views=views.astype(np.int32), places=places, levels=levels, ranges=ranges)


def survey(relief_m: float, count: int = 4000) -> tuple[LightSamples, list[PictureMeasures]]:
    rng = np.random.default_rng(4)
    views = rng.integers(0, len(IMAGES), (count, 2))
    views = views[views[:, 0] != views[:, 1]].astype(np.int32)
    places = rng.uniform(0, 1, (len(views), 2, 2))
    ranges = MIDDLE_M + rng.uniform(-relief_m, relief_m, (len(views), 2))
    samples = shown_twice(rng, views, places, ranges)
    facts = []
    for image in IMAGES:
        dark = haze(NODE_X, NODE_Y) + 0.004 * rng.uniform(0, 1, (*GRID, 1))
        mean = 0.27 * rng.lognormal(0, 0.05) * lamp(NODE_X, NODE_Y) + haze(NODE_X, NODE_Y)
        facts.append(
            PictureMeasures(
                image=image, camera="left", sharpness=1.0, grey=False, nodes=np.log(mean), dark=dark
            )
        )
    return samples, facts


def ratios(model: ColourModel, relief_m: float) -> np.ndarray:
    """Corrected light over the true albedo of spots all over the picture, minus its mean; logs."""
    rng = np.random.default_rng(9)
    place = rng.uniform(0.05, 0.95, (500, 2))
    ranges = MIDDLE_M + rng.uniform(-relief_m, relief_m, 500)
    albedo = rng.uniform(0.08, 0.5, (500, 1)) * rng.uniform(0.8, 1.2, (500, 3))
    light = shown(albedo, place, ranges).astype(np.float32)[None]
    at = place.astype(np.float32)
    found = model.correct(light, "left", IMAGES[0], at, ranges[None].astype(np.float32))[0]
    ratio = np.log(found / albedo)
    return ratio - ratio.mean(axis=0)


def test_water_finds_albedo_ratios_where_even_light_leaves_the_haze() -> None:
    samples, facts = survey(0.4)
    water = solve_colour("water", samples, facts)
    even = solve_colour("even", samples, facts)
    assert water.water is not None
    assert (np.abs(water.water.share - 1) < 0.25).all()
    slope = water.light.fall_off + water.spread / MIDDLE_M
    np.testing.assert_allclose(slope, FALL_OFF, atol=0.08)
    np.testing.assert_allclose(slope - slope[1], FALL_OFF - FALL_OFF[1], atol=0.04)
    assert ratios(water, 0.4).std() < 0.06
    assert ratios(even, 0.4).std() > 0.07
    assert not water.black.any()
    light, at = np.full((1, 1, 3), 0.3, np.float32), np.full((1, 2), 0.5, np.float32)
    unknown, middle, far = (
        water.correct(light, "left", IMAGES[0], at, np.full((1, 1), range_m, np.float32))
        for range_m in (np.nan, water.light.middle_range, 1.2 * water.light.middle_range)
    )
    np.testing.assert_array_equal(unknown, middle)
    assert (far > middle).all()


def test_white_is_halfway_between_a_white_lamp_and_a_grey_floor() -> None:
    samples, facts = survey(0.4)
    water = solve_colour("water", samples, facts)
    # the floor is grey, so that grey makes up for the lamp too, whose middle colour is 0.9, 1, 0.8
    took = FALL_OFF * MIDDLE_M
    grey = -np.log([0.9, 1.0, 0.8])
    expected = 0.5 * ((took - took[1]) + (grey - grey[1]))
    found = np.log(water.light.white / water.light.white[1])
    np.testing.assert_allclose(found, expected, atol=0.1)


@pytest.mark.parametrize("wanted", ["even", "water"])
def test_a_card_makes_light_its_reflectance(wanted: Colour) -> None:
    samples, facts = survey(0.4)
    number = int(samples.views[0, 0])
    place, near = samples.places[0, 0], samples.ranges[0, :1] if samples.ranges is not None else 0
    card = np.array([0.5, 0.4, 0.3])
    light = shown(card[None], place[None].astype(np.float64), np.asarray(near))[0]
    patch = ReferencePatch(image=IMAGES[number], place=place, light=light, reflectance=card)
    model = solve_colour(wanted, samples, facts, [patch])
    found = model.correct(
        light[None, None].astype(np.float32), "left", IMAGES[number], place[None],
        np.asarray(near, np.float32)[None],
    )  # fmt: skip
    # the range is that of the samples around, which here differ from spot to spot
    np.testing.assert_allclose(found[0, 0], card, rtol=0.25)
    assert not model.black.any()
    rng = np.random.default_rng(5)
    places = rng.uniform(0.05, 0.95, (400, 2))
    ranges = np.full(400, MIDDLE_M)
    seen = shown(np.tile(card, (400, 1)), places, ranges).astype(np.float32)[None]
    several = [
        ReferencePatch(image=IMAGES[0], place=p, light=c.astype(np.float64), reflectance=card)
        for p, c in zip(places.astype(np.float32), seen[0], strict=True)
    ]
    even = replace(samples, ranges=np.full_like(samples.ranges, MIDDLE_M))
    model = solve_colour(wanted, even, facts, several)
    found = model.correct(
        seen, "left", IMAGES[0], places.astype(np.float32), ranges[None].astype(np.float32)
    )
    np.testing.assert_allclose(np.median(found[0], axis=0), card, rtol=0.04)


def test_few_pictures_leave_the_haze_and_no_overlaps_leave_all() -> None:
    samples, facts = survey(0.4)
    full = solve_colour("water", samples, facts)
    few = solve_colour("water", samples.part(np.all(samples.views < 8, axis=1)), facts[:8])
    assert few.water is not None
    assert (few.water.share == 0).all()
    assert set(few.notes) - set(full.notes)
    alone = solve_colour("water", samples.part(np.zeros(len(samples.views), bool)), facts)
    assert alone.water is None
    np.testing.assert_array_equal(alone.light.white, 1.0)


def test_raw_changes_nothing() -> None:
    samples, facts = survey(0.4, 100)
    raw = solve_colour("raw", samples, facts)
    light = np.random.default_rng(1).uniform(0, 1, (4, 5, 3)).astype(np.float32)
    at = np.tile(np.array([0.3, 0.9], np.float32), (20, 1))
    same = raw.correct(light, "left", IMAGES[0], at, np.full((4, 5), 3.0, np.float32))
    np.testing.assert_allclose(same, light, rtol=1e-6)


def test_the_srgb_curve_and_its_inverse_agree() -> None:
    np.testing.assert_allclose(encode_srgb(linear_table()), np.arange(256), atol=0.02)


def test_black_leaves_the_order_of_light_and_takes_less_than_the_dark() -> None:
    samples, facts = survey(0.4)
    model = solve_colour("even", samples, facts)
    assert (model.black > 0).all()
    assert (model.black < 0.08).all()
    light = np.repeat(np.linspace(0, 1, 50, dtype=np.float32)[:, None], 3, axis=1)
    levels = model.levels(light)
    assert (levels[light < model.black] == 0).all()
    assert (np.diff(levels[light[:, 0] > model.black.max()], axis=0) > 0).all()
    np.testing.assert_allclose(levels[-1], 255, atol=0.01)


def oblique_chain() -> tuple[LightSamples, list[PictureMeasures]]:
    """Pictures along a line that look 40 deg ahead: range follows the row, and far meets near."""
    rng = np.random.default_rng(6)
    count = 2 * len(IMAGES)
    heights = 1.5 + 0.08 * np.sin(np.arange(count)) + rng.normal(0, 0.02, count)
    tilts = np.radians(50 + rng.normal(0, 2, count))

    def seen(view: int, ahead: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows, over the height of a picture of 46 deg, and ranges of spots on the floor."""
        angle = np.arctan2(ahead - 0.25 * view, heights[view]) - tilts[view]
        return 0.5 - 0.5 * np.tan(angle) / np.tan(np.radians(23)), np.hypot(
            ahead - 0.25 * view, heights[view]
        )

    rows: list[tuple[Any, ...]] = []
    facts = []
    for view in range(count):
        for other in range(view + 1, min(view + 5, count)):
            ahead = 0.25 * view + rng.uniform(0.5, 5, 400)
            sides = [seen(which, ahead) for which in (view, other)]
            inside = np.all([(y > 0) & (y < 1) for y, _ in sides], axis=0)
            rows.append((view, other, *(side[inside] for pair in sides for side in pair)))
        angle = tilts[view] + np.arctan((0.5 - NODE_Y.ravel()) * 2 * np.tan(np.radians(23)))
        place = np.column_stack([NODE_X.ravel(), NODE_Y.ravel()])
        mean = shown(np.full((place.shape[0], 3), 0.27), place, heights[view] / np.cos(angle))
        facts.append(
            PictureMeasures(
                image=f"left/{view:02d}.png", camera="left", sharpness=1.0, grey=False,
                nodes=np.log(mean.reshape(*GRID, 3) * rng.lognormal(0, 0.05)),
                dark=haze(NODE_X, NODE_Y) + 0.004 * rng.uniform(0, 1, (*GRID, 1)),
            )
        )  # fmt: skip
    views = np.concatenate([np.tile([[a, b]], (len(y), 1)) for a, b, y, *_ in rows])
    x = rng.uniform(0, 1, (len(views), 2))
    y = np.stack([np.concatenate([row[k] for row in rows]) for k in (2, 4)], axis=1)
    ranges = np.stack([np.concatenate([row[k] for row in rows]) for k in (3, 5)], axis=1)
    return shown_twice(rng, views, np.stack([x, y], axis=2), ranges), facts


@pytest.mark.slow
def test_light_does_not_drift_along_a_chain_of_oblique_pictures() -> None:
    samples, facts = oblique_chain()
    model = solve_colour("water", samples, facts)
    gains = np.stack([model.light.gains[fact.image] for fact in facts])
    assert np.abs(gains).max() < 0.5
    drift = np.polyfit(np.linspace(0, 1, len(gains)), gains, 1)[0]
    assert np.abs(drift).max() < 0.8
