"""Masks of what moves, by pictures into which bodies were drawn that float above the sea floor."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.app.stages import spec
from alice_survey.core.config import SurveyConfig
from alice_survey.core.executor import SERIAL
from reconstruct.dense import moving
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import View
from tests import oracles_dense

SCENE = oracles_dense.block_scene()
SEMI_AXES_M = (0.14, 0.06)


VIEWS = oracles_dense.two_lines(-0.05, 0.2, 0.45, 0.7)


def body_mask(view: View, middle: np.ndarray) -> np.ndarray:
    """Where a level ellipse around a place (3,) is seen, (H, W)."""
    turn = np.linspace(0, 2 * np.pi, 90)
    rim = np.column_stack([SEMI_AXES_M[0] * np.cos(turn), SEMI_AXES_M[1] * np.sin(turn), 0 * turn])
    at = view.project(middle + rim)
    drawn = np.zeros((oracles_dense.HEIGHT, oracles_dense.WIDTH), np.uint8)
    cv2.fillPoly(drawn, [np.rint(at - 0.5).astype(np.int32)], 1)
    return drawn > 0


def place_of(station: int) -> np.ndarray:
    """Where the body is at a station's time: it crosses the survey, 0.4 m above the floor."""
    return np.array(
        [
            0.1 + 0.08 * station,
            -0.1 + 0.12 * station,
            oracles_dense.DEPTH_M - 0.2 * oracles_dense.ALTITUDE_M,
        ]
    )


def with_light(folder: Path, views: list[View], bodies: bool) -> dict[str, np.ndarray]:
    """Draw bodies, a lamp's pattern and noise into the pictures; where the bodies are."""
    rng = np.random.default_rng(4)
    x, y = np.meshgrid(
        np.linspace(-1, 1, oracles_dense.WIDTH), np.linspace(-1, 1, oracles_dense.HEIGHT)
    )
    lamp = np.exp(-0.35 * (x - 0.2) ** 2 - 0.25 * y**2)
    found = {}
    for view in views:
        path = folder / "images" / view.image
        picture = cv2.imread(str(path)).astype(np.float64)
        mask = body_mask(view, place_of(view.station)) & bodies
        scales = 60.0 + 40.0 * np.sin(x * 70 + view.station) * np.sin(y * 55)
        picture[mask] = (scales[..., None] * [0.9, 1.0, 1.2])[mask]
        gain = 1.0 + 0.1 * np.sin(view.station)
        picture = picture * lamp[..., None] * gain + rng.normal(0, 2.0, picture.shape)
        cv2.imwrite(str(path), np.clip(np.rint(picture), 0, 255).astype(np.uint8))
        found[view.image] = mask
    return found


def made(folder: Path, bodies: bool) -> dict[str, np.ndarray]:
    oracles_dense.write_workspace(folder, VIEWS, SCENE)
    truth = with_light(folder, VIEWS, bodies)
    assert spec("dense").make(folder, SurveyConfig(), SERIAL)
    return truth


def masks(folder: Path) -> dict[str, np.ndarray]:
    """What is left out of each picture."""
    still = Pictures.still(folder)
    usable = {view.image: still.usable(view.image) for view in VIEWS}
    nothing = np.ones((oracles_dense.HEIGHT, oracles_dense.WIDTH), bool)
    return {name: ~(nothing if mask is None else mask) for name, mask in usable.items()}


@pytest.fixture(scope="module")
def crossed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    folder = tmp_path_factory.mktemp("crossed")
    return folder, made(folder, True)


@pytest.mark.slow
def test_a_body_that_crosses_is_masked(crossed: tuple[Path, dict[str, np.ndarray]]):
    folder, truth = crossed
    found = masks(folder)
    kernel = np.ones((13, 13), np.uint8)
    body = sum(int(mask.sum()) for mask in truth.values())
    assert body > 20_000
    hit = sum(int((found[name] & truth[name]).sum()) for name in truth)
    assert hit / body > 0.9
    wrong = sum(
        int((found[name] & ~(cv2.dilate(truth[name].astype(np.uint8), kernel) > 0)).sum())
        for name in truth
    )
    assert wrong / sum(mask.size for mask in truth.values()) < 0.002
    either = sum(int((found[name] | truth[name]).sum()) for name in truth)
    assert 0.6 < hit / either < 1.0  # rims are left out too


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("still")
    made(folder, False)
    return folder


@pytest.mark.slow
def test_a_still_survey_keeps_its_pictures_whole(still: Path):
    found = masks(still)
    assert np.mean([mask.mean() for mask in found.values()]) < 5e-4
    assert not (still / "dense" / "moving.png").exists() or any(m.any() for m in found.values())


def test_the_nearest_depth_that_two_stations_share():
    nan = np.nan
    stack = np.array([[1.0, 1.0, 2.0, nan], [1.01, 1.01, 2.02, 3.0], [1.5, 0.5, 2.5, nan]])
    found = moving.shared_depth(stack[:, None].astype(np.float32), np.array([0, 0, 1]), 0.02)
    assert np.isnan(found).all()  # the first two share a station
    found = moving.shared_depth(stack[:, None].astype(np.float32), np.array([0, 1, 1]), 0.02)[0]
    np.testing.assert_allclose(found[:3], [1.005, 1.005, 2.01], rtol=1e-6)
    assert np.isnan(found[3])


def drawn(depth: np.ndarray, one: View, other: View, step: float) -> np.ndarray:
    """Slow twin of `draw`."""
    rows, columns = np.nonzero(np.isfinite(depth))
    pixels = (np.column_stack([columns, rows]) + 0.5) * step
    points = one.at_depth(pixels.astype(float), depth[rows, columns].astype(float))
    corners = np.floor(other.project(points) / step - 0.5).astype(int)
    found = np.full(depth.shape, np.nan)
    for (left, top), z in zip(corners, other.world_from_cam.inv().apply(points)[:, 2], strict=True):
        for row in range(max(top, 0), min(top + 2, depth.shape[0])):
            for column in range(max(left, 0), min(left + 2, depth.shape[1])):
                found[row, column] = np.fmin(found[row, column], z)
    return found


def port_views() -> tuple[View, View, np.ndarray, int]:
    """Two views through a tilted port, the depth of the first on a lattice, and its step."""
    one, other = (
        oracles_dense.port_view([0, 0, 0], [1.0, -2.0, 30.0]),
        oracles_dense.port_view([0.2, 0.1, 0], [-1, 1, 28]),
    )
    step = 4
    depth = np.ascontiguousarray(oracles_dense.plane_depth(one, 1.2)[2::step, 2::step])
    rng = np.random.default_rng(2)
    depth *= rng.uniform(0.97, 1.03, depth.shape).astype(np.float32)
    depth[:3] = np.nan
    return one, other, depth, step


def look_of(view: View, depth: np.ndarray, step: int) -> moving.Look:
    light, usable = np.zeros((*depth.shape, 3, 3), np.float32), np.ones(depth.shape, bool)
    return moving.Look(view=view, step=step, light=light, usable=usable, depth=depth)


def test_a_surface_is_drawn_into_another_view_as_its_slow_twin_does():
    one, other, depth, step = port_views()
    found = moving.draw(look_of(one, depth, step), look_of(other, depth, step))
    expected = drawn(depth, one, other, step)
    assert 0.3 < np.isfinite(expected).mean() < 1.0
    alike = np.isclose(found, expected, rtol=1e-5, equal_nan=True)
    assert alike.mean() > 0.999  # places at the edge of a cell may be rounded either way


def test_cells_show_points_that_lie_at_their_depth():
    one, _, depth, step = port_views()
    usable = np.ones(depth.shape, bool)
    usable[:, :5] = False
    rng = np.random.default_rng(3)
    width, height = one.pinhole.size_px
    pixels = rng.uniform([-20, -20], [width + 20, height + 20], (4000, 2))
    z = rng.uniform(1.1, 1.3, len(pixels))
    points = one.at_depth(pixels, z)
    here = (1.5 + 0.001 * np.arange(len(points))).astype(np.float32)
    there = np.column_stack([one.project(points), z])
    cells, log_ratio = moving.cells_at(
        there, here, look_of(one, depth, step)._replace(usable=usable)
    )

    columns, rows = np.floor(pixels / step).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < depth.shape[1]) & (rows < depth.shape[0])
    at = rows[inside], columns[inside]
    inside[inside] = usable[at] & (np.abs(depth[at] - z[inside]) <= 0.02 * z[inside])
    expected = np.where(inside, rows * depth.shape[1] + columns, -1)
    assert 0.1 < inside.mean() < 0.5
    assert (cells == expected).mean() > 0.998
    shown = (cells == expected) & inside
    np.testing.assert_allclose(log_ratio[shown], np.log(here / z)[shown], atol=1e-6)


def test_bounds_of_light_are_those_of_the_cells_around():
    light = moving.with_bounds(np.random.default_rng(2).normal(size=(9, 11, 3)).astype(np.float32))
    np.testing.assert_array_equal(light[4, 5, 1], light[3:6, 4:7, 0].min(axis=(0, 1)))
    np.testing.assert_array_equal(light[4, 5, 2], light[3:6, 4:7, 0].max(axis=(0, 1)))


def test_smooth_differences_of_light_are_found_under_what_moves():
    rng = np.random.default_rng(2)
    places, log_ratio = rng.random((3000, 2)), 0.1 * rng.normal(size=3000)
    fit = rng.normal(size=(7, 3))
    x, y = places.T - 0.5
    true = np.stack([x**0, x, y, x * x, x * y, y * y, log_ratio], axis=1) @ fit
    apart = true + rng.normal(0, 0.03, true.shape)
    apart[:300] += 1.5
    features = moving.smooth_features(places, log_ratio)
    found, sigma = moving.smooth_difference(features, apart.astype(np.float32))
    assert 1e-3 < np.sqrt(np.mean((features @ found - true) ** 2)) < 0.04  # without weights 0.15
    assert ((sigma > 0.03) & (sigma < 0.06)).all()  # of noise, and what the ridge leaves


def test_a_cell_is_odd_where_others_agree_on_something_else():
    box = np.array([0.0, -0.1, 0.1])

    def light(level: float) -> np.ndarray:
        return np.tile((level + box)[:, None], (1, 3)).astype(np.float32)

    own = np.stack([light(0.0), light(1.0), light(0.05), light(1.0)])
    levels = ((0.0, 0.0, 0.0, 0.0), (0.02, 0.02, 0.02, 2.0), (0.01, 0.01, 0.01, 4.0))
    shown = np.array([[light(v) for v in row] for row in levels])
    sigma = np.full(3, 0.1, np.float32)
    misfit, votes = moving.find_odd(own, shown, np.array([0, 1, 2]), sigma, 2.0)
    np.testing.assert_allclose(misfit[:3], [0.0, (1.0 - 0.11) / 0.1, 0.0], atol=1e-4)
    assert votes[:3].tolist() == [3, 3, 3]
    assert votes[3] == 0  # they do not agree with each other
    assert moving.find_odd(own, shown, np.array([0, 0, 0]), sigma, 2.0)[1].max() == 1
