"""Navigation without positions: what depths, headings and attitudes give on their own."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.frames import Datum
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import MappingRecord, PicturesRecord
from reconstruct.adjustment.survey_fit import AdjustedSurvey
from reconstruct.placing.alignment import Similarity, level
from reconstruct.placing.fit import fit_navigation
from reconstruct.placing.place import Placed, Placing, find_place, scale_by_altitudes
from reconstruct.views.model_files import as_transform
from tests.oracles_place import is_unit
from tests.reconstruct.placing.test_georeference import (
    exact,
    fit,
    gauge,
    in_model,
    points_in_model,
    site,
    tilt_deg,
)
from tests.reconstruct.scenes import DATUM, make_scene, stating
from tests.reconstruct.true_models import near_truth, warped_scene

NAN = float("nan")


def with_only(records: list[ImageRecord], *names: str) -> list[ImageRecord]:
    readings = ("latitude_deg", "longitude_deg", "depth_m", "roll_deg", "pitch_deg", "heading_deg",
                "altitude_m")  # fmt: skip
    lost: dict[str, Any] = {name: NAN for name in readings if name not in names}
    return [replace(r, **lost) for r in records]


def test_exact_depths_alone_level_a_rigs_model_and_give_its_depth() -> None:
    scene, truth = site(), gauge(4, 1.0)
    depths = with_only(exact(scene), "depth_m")
    found = fit(scene, depths, truth, known=True, datum=None, lean_deg=4)
    assert tilt_deg(found.ned_from_model, truth) < 0.1
    model = points_in_model(scene.points_ned, truth)
    np.testing.assert_allclose(
        found.ned_from_model.apply(model)[:, 2], scene.points_ned[:, 2], atol=0.01
    )
    assert found.ned_from_model.scale == truth.scale
    np.testing.assert_array_equal(found.sigma_position_m[:2], 0.0)
    assert found.sigma_heading_deg == 0.0
    assert 0.0 < found.sigma_position_m[2] < 1.0
    said = found.record.to_json()
    assert [said[f"sigma_{name}"] for name in ("north_m", "east_m", "heading_deg")] == [None] * 3
    assert said["sigma_depth_m"] == found.sigma_position_m[2]


def placed_by_one_camera(
    workspace: Path, truth: Similarity, readings: tuple[str, ...], datum: Datum | None
) -> Placed:
    """A model of the left camera's pictures, in a gauge, with some of the readings."""
    scene = site().left
    seen, warps = warped_scene(scene)
    mapped = near_truth(scene, seen, warps, np.random.default_rng(1), (0.0, 0.0))
    model = mapped.model
    back = truth.rotation.inv()
    model.transform(pycolmap.Sim3d(
        1 / truth.scale, pycolmap.Rotation3d(back.as_quat()),
        -back.apply(truth.translation) / truth.scale,
    ))  # fmt: skip
    pinholes = [as_transform(image.cam_from_world()).inv()
                for _, image in sorted(model.images.items())]  # fmt: skip
    return find_place(
        Placing(
            adjusted=AdjustedSurvey(mapped=mapped, rig=scene.rig, exact=None, shape=None),
            workspace=workspace, records=with_only(scene.records, *readings), pinholes=pinholes,
            datum=datum, mapping=MappingRecord(), settings=ReconstructConfig(),
            survey=PicturesRecord(source="imported", vertical_datum="the sea"),
        )
    )  # fmt: skip


@pytest.mark.parametrize(
    ("readings", "lean_deg", "turn_deg"),
    [(("heading_deg",), 5.0, 0.5), (("roll_deg", "pitch_deg", "heading_deg"), 0.2, 0.2)],
)
def test_attitudes_turn_a_model_of_one_camera_without_a_scale(
    tmp_path: Path, readings: tuple[str, ...], lean_deg: float, turn_deg: float
) -> None:
    truth = gauge(8, 0.3)
    placed = placed_by_one_camera(tmp_path, truth, readings, None)
    assert not placed.frame.scaled and placed.frame.datum is None and placed.fit is None
    assert placed.world_from_model.scale == 1.0
    assert tilt_deg(placed.world_from_model, truth) < lean_deg
    off = placed.world_from_model.rotation * truth.rotation.inv()
    assert abs(off.as_euler("ZYX", degrees=True)[0]) < turn_deg
    assert placed.frame.notes[-1].startswith("unscaled; no latitude and longitude: ")
    assert "heading by navigation" in placed.frame.notes[-1]


def test_depths_of_a_track_without_relief_give_no_scale(capsys: pytest.CaptureFixture[str]) -> None:
    records = [replace(r, sigma_depth_m=1.0) for r in with_only(exact(site()), "depth_m")]
    assert fit(site(), records, gauge(7, 2.0), known=False, datum=None) is None
    assert "too little for its scale" in capsys.readouterr().err


@pytest.mark.parametrize("reading", ["depths", pytest.param("positions", marks=pytest.mark.slow)])
def test_scale_and_level_of_one_camera_lie_within_their_sigmas(reading: str) -> None:
    """Of a track whose depth varies by 0.4 m, over 24 seeds of white errors."""
    scene, sigma_m = site().left, 0.01
    rise = 0.4 * np.random.default_rng(11).standard_normal(len(scene.records))
    lifted = [
        RigidTransform.from_translation([0.0, 0.0, up]) * pose
        for up, pose in zip(rise, scene.ned_from_cam, strict=True)
    ]
    true = np.stack([pose.translation for pose in lifted])
    kept = ("depth_m",) if reading == "depths" else ("latitude_deg", "longitude_deg", "depth_m")
    errors, leans = [], []
    for seed in range(24):
        rng, truth = np.random.default_rng(seed), gauge(seed, 0.3)
        places = true + sigma_m * rng.standard_normal(true.shape)
        records = stating(scene.records, places, sigma_depth_m=sigma_m, sigma_horizontal_m=sigma_m)
        poses = [in_model(pose, truth) for pose in lifted]
        points = points_in_model(scene.points_ned, truth)
        start = level(points, np.stack([pose.translation for pose in poses]))
        found = fit_navigation(
            with_only(records, *kept), poses, None, None if reading == "depths" else DATUM, start,
            known_scale=None,
        )  # fmt: skip
        errors.append(np.log(found.ned_from_model.scale / truth.scale) / found.sigma_scale)
        lean = (found.ned_from_model.rotation * truth.rotation.inv()).as_rotvec(degrees=True)[:2]
        leans.append(lean / np.rad2deg(np.sqrt(np.diag(found.covariance)[:2])))
    assert is_unit(errors, 24)
    assert is_unit(leans, 48)


def test_headings_and_depths_turn_a_model_to_north() -> None:
    truth, known = gauge(5, 1.0), with_only(exact(site()), "depth_m", "heading_deg")
    records = [replace(r, sigma_depth_m=0.001) for r in known]
    found = fit(site(), records, truth, known=True, datum=None)
    turn = found.ned_from_model.rotation * truth.rotation.inv()
    assert np.rad2deg(turn.magnitude()) < 0.2
    assert found.sigma_heading_deg > 0


def test_roll_and_pitch_alone_level_a_model() -> None:
    truth, leans = gauge(6, 1.0), with_only(exact(site()), "roll_deg", "pitch_deg")
    found = fit(site(), leans, truth, known=True, datum=None, lean_deg=5)
    assert tilt_deg(found.ned_from_model, truth) < 0.01


def test_altitudes_scale_a_model_within_their_sigma() -> None:
    """Over 24 seeds of one error that all altitudes share, of 2 % as stated, and white ones."""
    scene, metres = make_scene(points=3000, relief_m=0.02).left, 2.5
    centres = np.stack([pose.translation for pose in scene.ned_from_cam])
    floor = np.median(scene.points_ned[:, 2])
    errors = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        shared = 1.0 + 0.02 * rng.standard_normal()
        heights = (floor - centres[:, 2]) * shared
        heights *= 1.0 + 0.01 * rng.standard_normal(len(heights))
        records = [
            replace(record, altitude_m=h, sigma_altitude_m=0.02 * h)
            for record, h in zip(scene.records, heights, strict=True)
        ]
        found = scale_by_altitudes(records, centres / metres, scene.points_ned / metres)
        assert found is not None
        errors.append(np.log(found[0] / metres) / found[1])
    assert is_unit(errors, 24)
    unknown = with_only(scene.records)
    assert scale_by_altitudes(unknown, centres / metres, scene.points_ned / metres) is None


def test_relief_below_makes_the_scale_less_certain() -> None:
    sigmas = []
    for relief in (0.02, 0.3):
        scene = make_scene(points=3000, relief_m=relief).left
        centres = np.stack([pose.translation for pose in scene.ned_from_cam])
        records = [replace(r, altitude_m=2.0, sigma_altitude_m=0.02) for r in scene.records]
        found: Any = scale_by_altitudes(records, centres, scene.points_ned)
        sigmas.append(found[1])
    assert sigmas[1] > 1.5 * sigmas[0]
    assert sigmas[0] < 0.1
