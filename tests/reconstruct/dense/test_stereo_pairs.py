from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import ReconstructionError
from reconstruct.dense.stereo_pairs import (
    PointsInSight,
    choose_partners,
    depths_per_pair,
    in_frame,
    neighbours,
)
from reconstruct.views.model import points_of_views
from tests.oracles_dense import ALTITUDE_M, CODED, sparse_model, stereo_views


def line(stations: int = 5) -> list:
    along = 0.4 * np.arange(stations, dtype=float)
    return stereo_views(along, np.zeros(stations), heading_deg=0.0)


def test_rig_partner_comes_first_then_neighbours_ahead_and_astern():
    model = sparse_model(line(), CODED)
    middle = next(n for n, v in enumerate(model.views) if v.image == "left/002.png")

    chosen = choose_partners(model, per_view=3)[middle]

    partners = [model.views[n] for n in chosen]
    assert partners[0].image == "right/002.png"
    assert {partner.station for partner in partners[1:]} == {1, 3}
    own = points_of_views(model)[middle]
    seen = [in_frame(partner, own).mean() for partner in partners]
    assert all(0.5 < share < 0.8 for share in seen[1:])
    centres = np.array(
        [view.world_from_cam.translation for view in (model.views[middle], *partners)]
    )
    base_to_height = np.linalg.norm(centres[1:] - centres[0], axis=1) / ALTITUDE_M
    assert base_to_height[0] == pytest.approx(0.05, rel=0.05)
    assert ((base_to_height[1:] > 0.15) & (base_to_height[1:] < 0.3)).all()


def test_pictures_without_overlap_are_refused():
    views = sparse_model(line(2)[:2], CODED).views
    away = RigidTransform.from_translation([30.0, 0.0, 0.0])
    far = replace(views[1], world_from_cam=away * views[1].world_from_cam)
    for model in (sparse_model(line(1)[:1], CODED), sparse_model([views[0], far], CODED)):
        with pytest.raises(ReconstructionError):
            choose_partners(model, 4)


def test_points_in_sight_are_all_that_lie_in_the_frame_and_near():
    model = sparse_model(line(), CODED, points=900)
    own = points_of_views(model)
    sight = PointsInSight(model)
    for number, (view, seen) in enumerate(zip(model.views, own, strict=True)):
        points = sight.of(number)
        centre = view.world_from_cam.translation
        away = np.linalg.norm(model.points_world - centre, axis=1)
        reach = 1.2 * np.linalg.norm(seen - centre, axis=1).max()
        expected = model.points_world[in_frame(view, model.points_world) & (away <= reach)]
        np.testing.assert_array_equal(points, expected)
        assert len(points) >= len(seen)


@pytest.mark.parametrize(
    ("looks", "expected"),
    [
        ([[1], [2], [0]], 1.0),
        ([[1, 2], [0, 2], [0, 1]], 2.0),
        ([[1, 2], [0], [], [0]], 4 / 3),
        ([[], []], 1.0),
    ],
)
def test_depths_of_a_pair_are_those_of_views_that_look_at_each_other(looks, expected):
    assert depths_per_pair(looks) == pytest.approx(expected)


def test_neighbours_share_most_points():
    model = sparse_model(line(), CODED)
    found = neighbours(model, 3)
    seen = [set(model.observations[model.observations[:, 1] == v, 0]) for v in range(10)]
    for view, others in enumerate(found):
        shared = sorted((len(seen[view] & seen[n]) for n in range(10) if n != view), reverse=True)
        assert [len(seen[view] & seen[n]) for n in others] == shared[:3]
        assert view not in others
