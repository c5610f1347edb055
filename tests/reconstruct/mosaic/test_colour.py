"""Known lamp, water and range, and whether the survey's pictures determine them."""

import numpy as np

from reconstruct.light.solve import GRID, LightSamples
from reconstruct.mosaic.colour import ColourModel, solve_colour
from reconstruct.mosaic.finish import curve_by_root, finish_colours
from reconstruct.mosaic.picture_measures import PictureMeasures, encoded, linear_table

IMAGES = [f"left/{n:02d}.png" for n in range(24)]
FALL_OFF = np.array([0.45, 0.5, 0.9])
"""Blue, green, red, 1/m, spreading included."""
MIDDLE_M = 2.0
NODE_X, NODE_Y = np.meshgrid(np.linspace(0, 1, GRID[1]), np.linspace(0, 1, GRID[0]))


def lamp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.exp(-1.6 * ((x - 0.45) ** 2 + (y - 0.55) ** 2))[..., None] * [0.9, 1.0, 0.8]


def haze(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Backscatter: strongest next to the lamps at the left and right."""
    return (0.02 + 0.10 * (x - 0.5) ** 2 + 0.02 * y)[..., None] * [1.2, 1.0, 0.4]


def shown(albedo: np.ndarray, place: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    x, y = place[:, 0], place[:, 1]
    water = np.exp(-(ranges[:, None] - MIDDLE_M) * FALL_OFF)
    return albedo * lamp(x, y) * water + haze(x, y)


def survey(relief_m: float, count: int = 4000) -> tuple[LightSamples, list[PictureMeasures]]:
    rng = np.random.default_rng(4)
    views = rng.integers(0, len(IMAGES), (count, 2))
    views = views[views[:, 0] != views[:, 1]].astype(np.int32)
    places = rng.uniform(0, 1, (len(views), 2, 2))
    ranges = MIDDLE_M + rng.uniform(-relief_m, relief_m, (len(views), 2))
    albedo = rng.uniform(0.08, 0.5, (len(views), 1)) * rng.uniform(0.8, 1.2, (len(views), 3))
    light = np.stack([shown(albedo, places[:, s], ranges[:, s]) for s in range(2)], axis=1)
    light *= np.exp(rng.normal(0, 0.02, light.shape))
    samples = LightSamples(
        views=views,
        places=places.astype(np.float32),
        levels=np.log(light).astype(np.float32),
        ranges=ranges.astype(np.float32),
    )
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
    found = model.corrected(light, "left", IMAGES[0], at, ranges[None].astype(np.float32))[0]
    ratio = np.log(found / albedo)
    return ratio - ratio.mean(axis=0)


def test_water_finds_albedo_ratios_where_even_light_leaves_the_haze() -> None:
    samples, facts = survey(0.4)
    water = solve_colour("water", samples, facts)
    even = solve_colour("even", samples, facts)
    assert (np.abs(water.shares - 1) < 0.2).all()
    np.testing.assert_allclose(water.light.fall_off, FALL_OFF, atol=0.06)
    assert ratios(water, 0.4).std() < 0.06
    assert ratios(even, 0.4).std() > 0.07


def test_water_gives_colours_as_under_a_white_lamp() -> None:
    samples, facts = survey(0.4)
    water = solve_colour("water", samples, facts)
    took = np.exp(FALL_OFF * MIDDLE_M)
    np.testing.assert_allclose(water.light.white / water.light.white[1], took / took[1], rtol=0.15)


def test_without_relief_and_with_few_pictures_it_notes_what_it_leaves() -> None:
    samples, facts = survey(0.0)
    flat = solve_colour("water", samples, facts)
    assert set(flat.notes) - set(solve_colour("water", *survey(0.4)).notes)
    kept = (samples.views < 8).all(axis=1)
    thin = LightSamples(
        views=samples.views[kept], places=samples.places[kept], levels=samples.levels[kept],
        ranges=None if samples.ranges is None else samples.ranges[kept],
    )  # fmt: skip
    few = solve_colour("water", thin, facts[:8])
    assert (few.shares == 0).all()
    assert set(few.notes) - set(flat.notes)


def test_raw_changes_nothing() -> None:
    samples, facts = survey(0.4, 100)
    raw = solve_colour("raw", samples, facts)
    light = np.random.default_rng(1).uniform(0, 1, (4, 5, 3)).astype(np.float32)
    at = np.tile(np.array([0.3, 0.9], np.float32), (20, 1))
    same = raw.corrected(light, "left", IMAGES[0], at, np.full((4, 5), 3.0, np.float32))
    np.testing.assert_allclose(same, light, rtol=1e-6)


def test_the_srgb_curve_and_its_inverse_agree() -> None:
    np.testing.assert_allclose(encoded(linear_table()), np.arange(256), atol=0.02)


def test_one_pass_over_pixels_equals_the_steps_over_pictures() -> None:
    samples, facts = survey(0.4)
    model = solve_colour("even", samples, facts)
    rng = np.random.default_rng(3)
    light = rng.uniform(0.01, 0.6, (7, 9, 3)).astype(np.float32)
    x, y = (rng.uniform(0, n - 1, (7, 9)).astype(np.float32) for n in (640, 480))
    x[0, 0] = -1
    ranges = rng.uniform(1.6, 2.4, (7, 9)).astype(np.float32)
    factor = np.full((3, 3, 3), 1.3, np.float32)
    places = np.column_stack([(x.ravel() + 0.5) / 640, (y.ravel() + 0.5) / 480])
    places = places.astype(np.float32)
    lifted = model.corrected(light, "left", IMAGES[3], places, ranges) * 1.3
    expected = np.minimum(encoded(((lifted - model.black) / (1 - model.black)).clip(0, 4)), 600)
    found = light.copy()
    finish_colours(
        found, (x, y), ranges, model.nodes("left", IMAGES[3]), model.law, (640, 480), factor,
        (0.2, 0.1), 0.125, curve_by_root(),
    )  # fmt: skip
    np.testing.assert_allclose(found.reshape(-1, 3)[1:], expected.reshape(-1, 3)[1:], atol=0.1)
    np.testing.assert_array_equal(found[0, 0], light[0, 0])


def test_black_leaves_the_order_of_light_and_takes_less_than_the_dark() -> None:
    samples, facts = survey(0.4)
    model = solve_colour("even", samples, facts)
    assert (model.black > 0).all()
    assert (model.black < 0.08).all()
    assert (model.law[7:] > 1).all()
