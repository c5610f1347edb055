from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.executor import SERIAL
from reconstruct.dense.depth import enlarge
from reconstruct.dense.matching_trial import find_scales, scale_for_cell
from reconstruct.dense.stereo_pairs import choose_partners
from reconstruct.dense.view_store import ViewStore
from reconstruct.dense.views import (
    ViewTask,
    find_match_sigma,
    match_view,
    pairs_once,
    prepare_view,
    refine_view,
)
from reconstruct.mosaic.grid import mean_pixel
from reconstruct.views.model import points_of_views, scaled_view
from tests.oracles_dense import block_scene, hits, sparse_model, stereo_views, write_workspace

SCENE = block_scene()


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory):
    views = stereo_views(np.array([0.0, 0.3, 0.6]), np.array([0.3, 0.3, 0.3]))
    model = sparse_model(views, SCENE)
    return write_workspace(tmp_path_factory.mktemp("survey"), views, SCENE), model


def conditions(workspace: Path, model, folder: Path) -> tuple[float, float]:
    """Scale, and the standard deviation of a match."""
    partners, points = choose_partners(model, 3), points_of_views(model)
    scales = find_scales(workspace, model.views, partners, points.__getitem__, 1.0, SERIAL)
    assert scales.matching == scales.depth
    tasks = matched(workspace, model, scales.depth, 1.0, folder)
    return scales.depth, find_match_sigma(1.0, tasks[:2], SERIAL)


def matched(workspace: Path, model, scale: float, matching: float, folder: Path) -> list[ViewTask]:
    """All views with their partners, matched at a scale."""
    views = [scaled_view(view, scale) for view in model.views]
    store = ViewStore(folder)
    folder.mkdir()
    partners = choose_partners(model, 3)
    tasks, once = (
        [
            ViewTask(store=store, index=n, view=views[n], others=tuple((m, views[m]) for m in own))
            for n, own in enumerate(others)
        ]
        for others in (partners, pairs_once(partners))
    )
    for task in tasks:
        prepare_view(workspace, task)
    for one in zip(once, points_of_views(model), strict=True):
        match_view(matching, one)
    return tasks


def test_clear_pictures_are_matched_as_they_are_and_better_than_assumed(survey, tmp_path):
    workspace, model = survey
    scale, sigma_px = conditions(workspace, model, tmp_path / "store")
    assert scale == 1.0
    assert 0.15 <= sigma_px < 0.3


def test_depth_matched_in_smaller_pictures_is_as_exact_once_it_is_refined(survey, tmp_path):
    workspace, model = survey
    shares, errors = [], []
    for scale in (1.0, 0.5, 0.25):
        tasks = matched(workspace, model, 1.0, scale, tmp_path / f"{scale}")
        store, view = tasks[1].store, model.views[1]
        refine_view(scale, 0.3, tasks[1])
        depth, sigma = store.load_depth(1, "fine")
        points = view.world_from_cam.inv().apply(hits(view, SCENE).reshape(-1, 3))
        error = (depth - points[:, 2].reshape(depth.shape)) / sigma
        shares.append(np.isfinite(depth).mean())
        errors.append(MAD_TO_SIGMA * np.median(np.abs(error[np.isfinite(error)])))
    assert min(shares) > 0.9 * shares[0] > 0.3
    assert min(errors) > 0.5
    assert max(errors) < 1.4 * errors[0]


def test_enlarged_depth_of_a_plane_is_that_plane_and_unknown_stays_unknown():
    rows, columns = np.mgrid[:60, :80] + 0.5
    small = (1 / (0.4 + 0.001 * columns - 0.0007 * rows)).astype(np.float32)
    small[20:30, 30:50] = np.nan
    large = enlarge(small, (160, 120))
    rows, columns = (np.mgrid[:120, :160] + 0.5) / 2
    plane = 1 / (0.4 + 0.001 * columns - 0.0007 * rows)
    unknown = np.isnan(large)
    np.testing.assert_array_equal(unknown, np.repeat(np.repeat(np.isnan(small), 2, 0), 2, 1))
    inside = (slice(1, -1), slice(1, -1))
    away = ~cv2.dilate(unknown.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    np.testing.assert_allclose(large[inside][away[inside]], plane[inside][away[inside]], rtol=2e-6)
    np.testing.assert_allclose(large[~unknown], plane[~unknown], rtol=0.002)
    assert enlarge(small, (80, 60)) is small


@pytest.mark.parametrize(("cell", "scale"), [(None, 1.0), (0.01, 1.0), (0.1, None), (9.0, 0.05)])
def test_scale_follows_from_the_cell_that_is_wanted(survey, cell, scale):
    model = survey[1]
    pixel = mean_pixel(model)
    assert pixel == pytest.approx(2.0 / model.views[0].pinhole.focal_px, rel=0.1)
    expected = 2.5 * pixel / 0.1 if scale is None else scale
    assert scale_for_cell(cell, pixel) == pytest.approx(expected)


def test_grainy_pictures_are_matched_at_a_lower_resolution_with_a_larger_sigma(survey, tmp_path):
    workspace, model = survey
    rng = np.random.default_rng(1)
    for view in model.views:
        picture = cv2.imread(str(workspace / "images" / view.image)).astype(np.float64)
        noisy = 0.25 * cv2.GaussianBlur(picture, (0, 0), 1.5)
        noisy += rng.normal(0, 6.0, picture.shape[:2])[..., None]
        path = tmp_path / "images" / view.image
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    (tmp_path / "sparse").symlink_to(workspace / "sparse")
    scale, sigma_px = conditions(tmp_path, model, tmp_path / "grainy")
    assert scale < 1.0
    assert conditions(workspace, model, tmp_path / "clear")[1] < sigma_px <= 1.5
