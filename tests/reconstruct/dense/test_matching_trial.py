from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.base.executor import SERIAL
from alice_survey.base.frames import Array
from reconstruct.dense.matching_trial import find_scale, matching_scale
from reconstruct.dense.stereo_pairs import choose_partners
from reconstruct.dense.view_store import ViewStore
from reconstruct.dense.views import ViewTask, find_match_sigma, prepare_view, view_depth
from reconstruct.views.model import points_of_views, scaled_view
from tests.oracles_dense import (
    Scene,
    sloped_with_step,
    sparse_model,
    speckle,
    stereo_views,
    write_workspace,
)

SCENE = Scene(depth_of=sloped_with_step, paint=speckle())


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory):
    views = stereo_views(np.array([0.0, 0.3, 0.6]), np.array([0.3, 0.3, 0.3]))
    model = sparse_model(views, SCENE)
    return write_workspace(tmp_path_factory.mktemp("survey"), model, SCENE), model


def conditions(workspace: Path, model, folder: Path) -> tuple[float, float]:
    """Scale, and the standard deviation of a match."""
    partners, points = choose_partners(model, 3), points_of_views(model)
    scale = find_scale(workspace, model.views, partners, points.__getitem__, SERIAL)
    return scale, find_match_sigma(matched(workspace, model, scale, folder)[:2], SERIAL)


def matched(workspace: Path, model, scale: float, folder: Path) -> list[tuple[ViewTask, Array]]:
    """All views with their partners, prepared."""
    views = [scaled_view(view, scale) for view in model.views]
    store = ViewStore(folder)
    folder.mkdir()
    tasks = [
        ViewTask(store=store, index=n, view=views[n], others=tuple((m, views[m]) for m in chosen))
        for n, chosen in enumerate(choose_partners(model, 3))
    ]
    for task in tasks:
        prepare_view(workspace, task)
    return list(zip(tasks, points_of_views(model), strict=True))


def test_clear_pictures_are_matched_as_they_are_and_better_than_assumed(survey, tmp_path):
    scale, sigma_px = conditions(*survey, tmp_path / "store")
    assert scale == 1.0
    assert 0.15 <= sigma_px < 0.3


def test_views_in_which_partners_were_compared_get_the_depth_of_any_other(survey, tmp_path):
    workspace, model = survey
    depths = []
    for chosen in ([0], []):
        found = matched(workspace, model, 1.0, tmp_path / f"store{len(chosen)}")
        find_match_sigma([found[n] for n in chosen], SERIAL)
        store = found[0][0].store
        assert store.has(0, "apart") == bool(chosen)
        view_depth(0.25, found[0])
        assert not store.has(0, "apart") and not store.has(0, "apart.scales")
        depths.append(store.load_depth(0, "depth"))
    assert np.isfinite(depths[0][0]).mean() > 0.3
    np.testing.assert_array_equal(depths[0], depths[1])


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


def test_large_pictures_are_halved_until_they_fit():
    view = stereo_views(np.zeros(1), np.zeros(1))[0]
    assert matching_scale(view) == 1.0
    large = replace(view, pinhole=view.pinhole.resized(3384, 2710))
    assert matching_scale(large) == 0.5
