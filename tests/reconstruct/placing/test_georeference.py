from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Datum
from alice_survey.core.manifest import ImageRecord
from reconstruct.placing.alignment import Similarity, align_rigid, align_similarity, level
from reconstruct.placing.fit import PlacementFit, fit_navigation
from tests.oracles_place import is_unit
from tests.reconstruct.placing.test_sigmas import gauss_markov
from tests.reconstruct.scenes import DATUM, Scene, make_scene, stating


def gauge(seed: int, scale: float) -> Similarity:
    """A random `ned_from_model`."""
    rng = np.random.default_rng(seed)
    return Similarity(
        scale=scale, rotation=Rotation.random(rng=rng), translation=rng.normal(0, 30, 3)
    )


def points_in_model(points: np.ndarray, ned_from_model: Similarity) -> np.ndarray:
    moved = ned_from_model.rotation.inv().apply(points - ned_from_model.translation)
    return moved / ned_from_model.scale


def in_model(pose: RigidTransform, ned_from_model: Similarity) -> RigidTransform:
    place = points_in_model(pose.translation, ned_from_model)
    return RigidTransform.from_components(place, ned_from_model.rotation.inv() * pose.rotation)


def fit(
    scene: Scene,
    records: list[ImageRecord],
    truth: Similarity,
    *,
    known: bool,
    levers: bool = True,
    datum: Datum | None = DATUM,
    lean_deg: float = 0.0,
) -> PlacementFit:
    """Of a model that starts level but for a lean; None where navigation does not suffice."""
    poses = [in_model(pose, truth) for pose in scene.ned_from_cam]
    points = points_in_model(scene.points_ned, truth)
    start = level(points, np.stack([p.translation for p in poses]))
    lean = Rotation.from_euler("xy", [lean_deg, -lean_deg], degrees=True)
    arms = {name: scene.rig.body_from_cam(name) for name in scene.rig.cameras}
    found: Any = fit_navigation(
        records, poses, arms if levers else None, datum,
        replace(start, rotation=lean * start.rotation), known_scale=truth.scale if known else None,
    )  # fmt: skip
    return found


def tilt_deg(found: Similarity, truth: Similarity) -> float:
    down = (found.rotation * truth.rotation.inv()).apply([0.0, 0.0, 1.0])
    return float(np.rad2deg(np.arccos(np.clip(down[2], -1, 1))))


def exact(scene: Scene) -> list[ImageRecord]:
    """Navigation that shows the true attitude too."""
    records = []
    for record, ned_from_body in zip(scene.records, scene.bodies, strict=True):
        heading, pitch, roll = np.rad2deg(ned_from_body.rotation.as_euler("ZYX"))
        records.append(replace(record, roll_deg=roll, pitch_deg=pitch, heading_deg=heading % 360))
    return records


def without_attitude(scene: Scene) -> list[ImageRecord]:
    """Positions of the cameras themselves, nothing more, as GPS in EXIF gives them."""
    places = np.stack([pose.translation for pose in scene.ned_from_cam])
    sigmas = {"sigma_horizontal_m": 0.02, "sigma_depth_m": 0.02}
    return stating(scene.records, places, roll_deg=np.nan, **sigmas)


def assert_same(found: Similarity, truth: Similarity, atol: float, scale_rtol: float) -> None:
    places = np.random.default_rng(0).uniform(-3, 3, (20, 3)) + np.array([0, 0, 14])
    model = points_in_model(places, truth)
    np.testing.assert_allclose(found.apply(model), places, atol=atol)
    assert found.scale == pytest.approx(truth.scale, rel=scale_rtol)


@cache
def site() -> Scene:
    return make_scene(points=400)


@settings(deadline=None, max_examples=5)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100))
def test_any_gauge_is_undone_when_navigation_is_exact(seed: int, scale: float) -> None:
    truth = gauge(seed, scale)
    found = fit(site(), exact(site()), truth, known=False)
    assert_same(found.ned_from_model, truth, atol=1e-6, scale_rtol=1e-7)
    said = found.record
    errors_m = (said.rms_north_m, said.rms_east_m, said.rms_depth_m)
    assert all(error_m is not None and error_m < 1e-6 for error_m in errors_m)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("roll_deg", [np.nan, 0.0])
def test_positions_alone_place_a_block(seed: int, roll_deg: float) -> None:
    """Of cameras on an unknown mount, whose vehicle's attitude says nothing of theirs."""
    truth = gauge(seed, 3.0)
    records = [replace(r, roll_deg=roll_deg) for r in without_attitude(site())]
    found = fit(site(), records, truth, known=False, levers=False)
    assert_same(found.ned_from_model, truth, atol=0.02, scale_rtol=2e-3)


def test_a_known_scale_is_kept_and_that_of_navigation_reported() -> None:
    truth = gauge(3, 1.0)
    origin = np.array([1.0, 1.0, 13.0])
    places = np.stack([pose.translation for pose in site().ned_from_cam])
    stretched = stating(without_attitude(site()), origin + 1.05 * (places - origin))
    found = fit(site(), stretched, truth, known=True, levers=False)
    assert found.ned_from_model.scale == 1.0
    assert found.record.scale_of_navigation == pytest.approx(1.05, abs=0.003)


@pytest.mark.parametrize("known", [True, False])
def test_one_wrong_position_hardly_moves_the_model(known: bool) -> None:
    truth = gauge(4, 1.0)
    records = exact(site())
    records[5] = replace(records[5], latitude_deg=records[5].latitude_deg + 1e-3)  # 111 m
    found = fit(site(), records, truth, known=known)
    assert_same(found.ned_from_model, truth, atol=0.1, scale_rtol=1e-12 if known else 0.01)


def test_a_straight_line_is_kept_from_turning_about_itself() -> None:
    """Positions on one line say nothing of the roll about it: the sea floor's plane does."""
    scene = make_scene(lines=1, stations=12, points=600)
    truth = gauge(5, 2.0)
    found = fit(scene, without_attitude(scene), truth, known=False, levers=False)
    assert tilt_deg(found.ned_from_model, truth) < 6.0


def exif(scene: Scene, seed: int) -> list[ImageRecord]:
    """GPS of 3 m as EXIF has it over a block of 4 by 2 m: one error, a little of which drifts."""
    rng = np.random.default_rng(seed)
    count = 1 + max(record.station for record in scene.records)
    errors = 0.3 * gauss_markov(rng, count, 20.0, step_s=2.0)[:, :3]
    errors += rng.normal(0, 3.0, 3) + rng.normal(0, 0.1, errors.shape)
    at = np.array([record.station for record in scene.records])
    places = np.stack([pose.translation for pose in scene.ned_from_cam]) + errors[at]
    unknown = dict.fromkeys(("roll_deg", "pitch_deg", "heading_deg", "altitude_m"), np.nan)
    return stating(scene.records, places, sigma_horizontal_m=3.0, sigma_depth_m=6.0, **unknown)


@pytest.mark.slow
def test_positions_closer_than_their_sigma_give_a_rough_scale_with_an_honest_sigma(
    capsys: pytest.CaptureFixture[str],
) -> None:
    misses, sigmas = [], []
    for seed in range(16):
        found = fit(site(), exif(site(), seed), gauge(seed, 2.0), known=False, levers=False)
        (line,) = capsys.readouterr().err.splitlines()
        assert "rough" in line and "alice-survey control" in line
        misses.append(np.log(found.ned_from_model.scale / 2.0) / found.sigma_scale)
        sigmas.append(found.sigma_scale)
    assert min(sigmas) > 0.02 and max(sigmas) < 0.2
    assert is_unit(misses, 16)


@pytest.mark.parametrize("seed", range(4))
def test_level_puts_the_mean_plane_flat_below_the_cameras(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = gauge(seed, 1.0)
    plane = np.column_stack([rng.uniform(-4, 4, (500, 2)), rng.normal(0, 0.02, 500)])
    rock = np.column_stack([rng.uniform(0, 1, (60, 2)), rng.uniform(-1.5, -0.5, 60)])
    centres = np.column_stack([np.linspace(-3, 3, 9), np.zeros(9), np.full(9, -2.0)])
    placed = level(
        points_in_model(np.concatenate([plane, rock]), truth), points_in_model(centres, truth)
    )
    assert placed.scale == 1.0
    flat = placed.apply(points_in_model(plane, truth))
    assert np.abs(flat[:, 2].mean()) < 0.01
    assert flat[:, 2].std() < 0.03
    cameras = placed.apply(points_in_model(centres, truth))
    np.testing.assert_allclose(cameras[:, 2], -2.0, atol=0.05)
    ahead = cameras[-1] - cameras[0]
    np.testing.assert_allclose(ahead, [6.0, 0.0, 0.0], atol=0.1)
    assert np.linalg.det(placed.rotation.as_matrix()) == pytest.approx(1.0)


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.1, 10.0))
def test_a_similarity_is_recovered(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, 3))
    turn, shift = Rotation.random(rng=rng), rng.normal(size=3)

    found = align_similarity(source, scale * turn.apply(source) + shift)

    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert (found.rotation * turn.inv()).magnitude() < 1e-7
    np.testing.assert_allclose(found.apply(source), scale * turn.apply(source) + shift, atol=1e-8)


def test_a_mirrored_flat_set_is_turned_not_mirrored() -> None:
    rng = np.random.default_rng(1)
    flat = np.column_stack([rng.normal(size=(20, 2)), 1e-3 * rng.normal(size=20)])

    found = align_rigid(flat, flat * [1, 1, -1])

    assert np.linalg.det(found.rotation.as_matrix()) == pytest.approx(1.0)
    assert found.rotation.magnitude() < 1e-2
