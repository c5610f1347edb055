"""What views see through is judged against sight along exact rays."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from reconstruct.dense.surface_tiles import look_at_points
from reconstruct.dense.view_store import ViewStore
from reconstruct.views.model import View
from tests.oracles_dense import block_scene, hits, stereo_views

SCENE = block_scene()
VIEW = stereo_views(np.array([0.1]), np.array([0.2]))[0]
CELL_M = 0.01


def looks(view: View, world: np.ndarray, sigma_m: float = 1e-4) -> tuple[np.ndarray, np.ndarray]:
    shape = view.pinhole.size_px[::-1]
    depth = view.world_from_cam.inv().apply(hits(view, SCENE).reshape(-1, 3))[:, 2].reshape(shape)
    depth = depth.astype(np.float32)
    depth[:20] = np.nan
    with TemporaryDirectory() as folder:
        store = ViewStore(Path(folder))
        store.save_depth(0, "fine", depth, np.full(shape, sigma_m, np.float32))
        sigmas = np.full(len(world), sigma_m, np.float32)
        return look_at_points(world, sigmas, view, store.stored_depth(0, "fine"), 1.0, CELL_M)


def rays(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, the spots that they show, and unit vectors from there towards the camera."""
    rng = np.random.default_rng(3)
    width, height = VIEW.pinhole.size_px
    columns, rows = rng.integers(3, width - 3, count), rng.integers(3, height - 3, count)
    spots = hits(VIEW, SCENE)[rows, columns]
    way = VIEW.world_from_cam.translation - spots
    return (
        np.column_stack([columns, rows]),
        spots,
        way / np.linalg.norm(way, axis=1, keepdims=True),
    )


def test_a_view_finds_what_it_shows_and_sees_through_what_stands_before_it() -> None:
    pixels, spots, way = rays(3000)
    there = pixels[:, 1] > 22
    found, through = looks(VIEW, spots)
    assert found[there].mean() > 0.995
    assert not through.any()
    assert not found[pixels[:, 1] < 18].any()  # nothing is known there

    found, through = looks(VIEW, spots + 0.02 * way)
    step = np.hypot(spots[:, 0] - 0.3, spots[:, 1] - 0.35) < 0.4  # the block and what is beside it
    assert through[there & ~step].mean() > 0.98
    assert not (found & through).any()

    found, through = looks(VIEW, spots + 0.02 * way, sigma_m=0.005)  # no more than the noise
    assert not through.any()
    assert found[there].mean() > 0.98

    found, through = looks(VIEW, spots - 0.05 * way)  # hidden: the view says nothing
    assert not through[~step].any()
    assert found[~step].mean() < 0.01


def test_what_is_out_of_sight_is_neither_found_nor_seen_through() -> None:
    away = np.array([[30.0, 30.0, 12.0], [0.0, 0.0, 9.0]])  # aside, and behind the camera
    found, through = looks(VIEW, away)
    assert not found.any() and not through.any()
