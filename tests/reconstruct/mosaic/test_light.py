from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruct.light import solve
from tests.engines import PicklingThreads

IMAGES = [f"left/{n}.png" for n in range(9)]
UNKNOWN = np.full((len(IMAGES), *solve.GRID, 3), np.nan)
NODES_X, NODES_Y = np.meshgrid(np.linspace(0, 1, solve.GRID[1]), np.linspace(0, 1, solve.GRID[0]))


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Logarithm of a lamp that falls off from a point next to the middle."""
    return -1.2 * ((x - 0.45) ** 2 + (y - 0.6) ** 2)


def seen_by(
    views: tuple[int, int], places: Sequence[np.ndarray], levels: Sequence[np.ndarray]
) -> solve.LightSamples:
    """Spots of two views, where each sees them and what it shows there."""
    return solve.LightSamples(
        views=np.tile(np.array(views, np.int32), (len(places[0]), 1)),
        places=np.stack(places, axis=1).astype(np.float32),
        levels=np.stack(levels, axis=1).astype(np.float32),
    )


def samples(noise: float = 0.02, outliers: float = 0.0, lines: int = 3, count: int = 400):
    """Nine pictures in lines that overlap on all sides, over a sea floor of random colour."""
    rng = np.random.default_rng(3)
    gains = rng.normal(0, 0.1, len(IMAGES))
    parts = []
    places = [(n % (9 // lines), n // (9 // lines)) for n in range(9)]
    for a in range(len(IMAGES)):
        for b in range(len(IMAGES)):
            along, aside = places[b][0] - places[a][0], places[b][1] - places[a][1]
            if a == b or abs(along) > 2 or abs(aside) > 1:
                continue
            here = rng.uniform(0, 1, (count, 2))
            there = here - [0.6 * aside, 0.4 * along]
            seen = ((there > 0) & (there < 1)).all(axis=1)
            here, there = here[seen], there[seen]
            ground = rng.normal(4.2, 0.4, (len(here), 3))
            one = ground + (pattern(*here.T) + gains[a])[:, None]
            two = ground + (pattern(*there.T) + gains[b])[:, None]
            two = two + rng.normal(0, noise, two.shape)
            two[rng.random(len(two)) < outliers] += 0.8
            parts.append(seen_by((a, b), (here, there), (one, two)))
    return gains, solve.joined_samples(parts)


def misfit(found: np.ndarray) -> float:
    """Rms of a pattern against the truth, but for slopes, which gains along lines could undo."""
    error = found - pattern(NODES_X, NODES_Y)
    error = error - error.mean()
    for slope in (NODES_X - 0.5, NODES_Y - 0.5):
        error = error - slope * (error * slope).sum() / (slope**2).sum()
    return float(np.sqrt((error**2).mean()))


def light_of(found: solve.LightSamples, nodes: np.ndarray = UNKNOWN) -> solve.LightModel:
    """The light of pictures of one camera."""
    return solve.solve_light(solve.in_one_part(found), nodes, IMAGES, ["left"] * len(IMAGES))


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_overlaps_alone_separate_the_lamp_from_the_sea_floor(outliers: float):
    gains, found = samples(outliers=outliers)
    light = light_of(found)
    for channel in range(3):
        assert 1e-4 < misfit(light.patterns["left"][..., channel]) < 0.03
    assert misfit(np.zeros(solve.GRID)) > 0.1
    assert np.std([light.gains[n][0] for n in IMAGES]) == pytest.approx(np.std(gains), rel=0.6)


def test_the_median_picture_gives_what_a_single_line_cannot():
    _, found = samples(lines=1)
    rng = np.random.default_rng(9)
    shown = pattern(NODES_X, NODES_Y)[None, ..., None] + rng.normal(4.2, 0.1, (9, *solve.GRID, 3))
    alone, helped = (light_of(found, nodes).patterns["left"][..., 1] for nodes in (UNKNOWN, shown))
    assert misfit(alone) > 0.06
    assert misfit(helped) < 0.04


def drift_of_a_long_line(seed: int, *, pictures: int = 30) -> float:
    """Change of the gains from end to end, a stop free each; the truth is none.

    The lamp is brighter ahead; each picture's ground is darker or brighter, and on one side.
    """
    rng = np.random.default_rng(seed)
    images = [f"left/{n}.png" for n in range(pictures)]
    own = rng.normal(0, 0.2, (pictures, 1, 1))
    own = own + rng.normal(0, 0.5, (pictures, 1, 1)) * (NODES_Y - 0.5)
    lamp = pattern(NODES_X, NODES_Y) + 0.4 * (NODES_Y - 0.5)
    nodes = np.repeat((4.2 + lamp + own)[..., None], 3, axis=-1)
    parts = []
    for a in range(pictures - 1):
        here = rng.uniform([0, 0.3], 1, (280, 2))
        both = (here, here - [0.0, 0.3])
        levels = [
            rng.normal(4.2, 0.02, (280, 3)) + (pattern(*p.T) + 0.4 * p[:, 1])[:, None] for p in both
        ]
        parts.append(seen_by((a, a + 1), both, levels))
    found = solve.in_one_part(solve.joined_samples(parts))
    light = solve.solve_patterns(found, nodes, images, ["left"] * pictures, 1.0)
    gains = [light.gains[n][1] for n in images]
    return float(np.polyfit(np.linspace(0, 1, pictures), gains, 1)[0])


def test_a_long_line_does_not_drift_from_bright_to_dark():
    drifts = [drift_of_a_long_line(seed) for seed in range(6)]
    assert 0.01 < np.sqrt(np.mean(np.square(drifts))) < 0.6  # 0.8 without their brightness


def test_corrected_views_of_a_spot_agree_better_than_raw_ones():
    _, found = samples()
    light = light_of(found)
    raw, even = [], []
    for (a, b), places, levels in zip(found.views, found.places, found.levels, strict=True):
        lift = [
            np.log(solve.at_places(light.factors("left", IMAGES[n]), place[None])[0])
            for n, place in ((a, places[0]), (b, places[1]))
        ]
        raw.append(levels[0] - levels[1])
        even.append(levels[0] + lift[0] - levels[1] - lift[1])
    assert np.std(even) < 0.35 * np.std(raw)
    assert np.std(even) > 0.01  # the noise stays


def test_even_light_is_left_as_it_is_but_for_the_common_white():
    rng = np.random.default_rng(1)
    ground = rng.normal(4.2, 0.4, (900, 3)).astype(np.float32)
    places = rng.uniform(0, 1, (900, 2, 2)).astype(np.float32)
    views = rng.integers(0, 9, (900, 2)).astype(np.int32)
    cameras = ["left", "right", "left"] * 3
    same = solve.LightSamples(views=views, places=places, levels=np.stack([ground, ground], axis=1))
    light = solve.solve_light(solve.in_one_part(same), UNKNOWN, IMAGES, cameras)
    for image, camera in zip(IMAGES, cameras, strict=True):
        factors = light.factors(camera, image)
        np.testing.assert_allclose(factors, np.broadcast_to(light.white, factors.shape), rtol=1e-5)


def test_without_overlap_nothing_is_changed():
    light = light_of(solve.joined_samples([]))
    np.testing.assert_allclose(light.factors("left", IMAGES[0]), 1.0)


def test_light_file_round_trip(tmp_path):
    _, found = samples()
    light = light_of(found)
    solve.write_light(tmp_path / "light.json", light)
    again = solve.read_light(tmp_path / "light.json")
    np.testing.assert_allclose(again.patterns["left"], light.patterns["left"], atol=1e-5)
    np.testing.assert_allclose(again.white, light.white, atol=1e-5)
    assert list(again.gains) == IMAGES


def read_rows(path: Path) -> solve.LightSamples:
    return solve.from_rows(np.load(path))


def test_samples_in_files_give_the_light_of_all_at_once(tmp_path):
    """In parts, each with views of its own, for any number of workers."""
    _, found = samples(outliers=0.1)
    cameras = ["left", "right", "left"] * 3
    shown = pattern(NODES_X, NODES_Y)[None, ..., None] + np.full((9, *solve.GRID, 3), 4.2)
    at_once = solve.solve_light(solve.in_one_part(found), shown, IMAGES, cameras)
    order = np.argsort(found.views[:, 0], kind="stable")
    files = []
    for number, chosen in enumerate(np.array_split(order, 4)):
        part = found.part(chosen)
        files.append(tmp_path / f"{number}.npy")
        np.save(files[-1], solve.as_rows(part))
    by_parts = [
        solve.solve_light(
            solve.Parts(items=files, load=read_rows, label="light", executor=engine.executor),
            shown, IMAGES, cameras,
        )
        for workers in (1, 2, 3)
        for engine in [PicklingThreads(workers)]
    ]  # fmt: skip
    for light in by_parts:
        for camera in ("left", "right"):
            np.testing.assert_allclose(
                light.patterns[camera], at_once.patterns[camera], rtol=1e-9, atol=1e-10
            )
            np.testing.assert_array_equal(light.patterns[camera], by_parts[0].patterns[camera])
        for image in IMAGES:
            np.testing.assert_allclose(light.gains[image], at_once.gains[image], atol=1e-9)
        np.testing.assert_allclose(light.white, at_once.white, rtol=1e-9)
        np.testing.assert_array_equal(light.white, by_parts[0].white)


def test_each_sample_counts_alike_in_many_parts_of_which_the_last_is_short():
    rng = np.random.default_rng(2)
    ground = rng.normal(4.2, 0.1, (16_400, 3)).astype(np.float32)
    ground[16_000:] += [0.3, 0.6, 0.9]  # the last part is bright, and of another colour
    places = rng.uniform(0, 1, (len(ground), 2, 2)).astype(np.float32)
    views = rng.integers(0, 9, (len(ground), 2)).astype(np.int32)
    found = solve.LightSamples(
        views=views, places=places, levels=np.stack([ground, ground], axis=1)
    )
    parts = [found.part(slice(start, start + 2000)) for start in range(0, len(ground), 2000)]
    assert parts[0].levels.base is None  # which would keep all samples in memory
    together = solve.Parts(items=parts, load=replace, label="light")
    light = solve.solve_light(together, UNKNOWN, IMAGES, ["left"] * 9)
    np.testing.assert_allclose(light.white, light_of(found).white, rtol=0.03)
