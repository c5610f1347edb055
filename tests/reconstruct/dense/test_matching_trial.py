from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.base.executor import SERIAL
from reconstruct.dense.matching_trial import find_conditions, matching_scale
from reconstruct.dense.stereo_pairs import choose_partners
from reconstruct.views.model import points_of_views
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


def conditions(workspace: Path, model, scale: float | None = None):
    partners = choose_partners(model, 3)
    return find_conditions(
        workspace, model.views, partners, points_of_views(model).__getitem__, scale, SERIAL
    )


def test_clear_pictures_are_matched_as_they_are_and_better_than_assumed(survey):
    found = conditions(*survey)
    assert found.scale == 1.0
    assert 0.15 <= found.match_sigma_px < 0.3


def test_a_given_scale_is_kept(survey):
    assert conditions(*survey, scale=0.5).scale == 0.5


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
    found = conditions(tmp_path, model)
    assert found.scale < 1.0
    assert conditions(workspace, model).match_sigma_px < found.match_sigma_px <= 1.5


def test_large_pictures_are_halved_until_they_fit():
    view = stereo_views(np.zeros(1), np.zeros(1))[0]
    assert matching_scale(view) == 1.0
    large = replace(view, pinhole=view.pinhole.resized(3384, 2710))
    assert matching_scale(large) == 0.5
