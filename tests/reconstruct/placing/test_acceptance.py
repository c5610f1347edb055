import json

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.records import ScaleOfPairs
from reconstruct.mapping.arrays import ground_pixel, observations
from reconstruct.placing.alignment import bend_of
from reconstruct.placing.navigation import body_from_pinhole
from reconstruct.placing.run import (
    check_mapping,
    measure_doming,
    navigation_residuals,
    pinhole_positions,
    scale_of_pairs,
)
from tests.reconstruct.mapping.test_mapper import block, block_mapped
from tests.reconstruct.scenes import ALTITUDE_M, DATUM

NAN = float("nan")
SURE = ScaleOfPairs(mean=1.0, mean_sigma=1e-4)


def survey(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Places in a frame of their own, and where navigation has them within 0.1 m."""
    rng = np.random.default_rng(seed)
    stated = rng.uniform([0, 0, 12.9], [20, 8, 13.1], (count, 3))
    turn = Rotation.random(random_state=seed)
    centres = turn.apply(stated + rng.normal(0, 0.1, stated.shape))
    return centres + np.array([3.0, -50.0, 7.0]), stated


@pytest.mark.parametrize("seed", range(4))
def test_stations_that_jumped_stand_out_of_those_that_did_not(seed: int) -> None:
    centres, stated = survey(seed)
    stated[[7, 21, 22]] += [[0.0, 3.0, 0.0], [-9.0, 4.0, 0.0], [200.0, 0.0, 0.0]]
    off, sigma = navigation_residuals(centres, stated, np.full(stated.shape, 0.1))
    assert off[[7, 21, 22]] == pytest.approx([3.0, np.hypot(9, 4), 200.0], abs=0.5)
    rest = np.delete(off, [7, 21, 22])
    assert rest.max() < 0.5
    assert np.sqrt((rest**2).mean() / 3) == pytest.approx(0.1, rel=0.25)
    assert 0.1 <= sigma.max() < 0.13


def test_a_jump_is_reported_by_name_and_small_misses_are_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene, mapped = block(), block_mapped()
    capsys.readouterr()  # of a slow machine's progress
    mounts = body_from_pinhole(scene.rig, mapped.warps)
    positions, sigmas = pinhole_positions(scene.records, mounts, DATUM)
    good = check_mapping(mapped.model, scene.records, positions, sigmas, 0.0, SURE)
    assert good.notes == ()
    assert good.far == ()
    assert good.checked == len({r.station for r in scene.records})
    assert not capsys.readouterr().err
    fine = np.full_like(sigmas, 0.02)
    jumped = positions.copy()
    station = scene.records[4].station
    rows = [i for i, r in enumerate(scene.records) if r.station == station]
    jumped[rows] += [0.0, 0.4, 0.0]  # far by sigmas, but not by metres
    assert check_mapping(mapped.model, scene.records, jumped, fine, 0.0, SURE).far == ()
    jumped[rows] += [0.0, 2.0, 0.0]
    found = check_mapping(mapped.model, scene.records, jumped, fine, 0.0, SURE)
    assert [far.station for far in found.far] == [station]
    assert found.far[0].off_m == pytest.approx(2.4, abs=0.1)
    assert f"{scene.records[rows[0]].image} (2." in capsys.readouterr().err
    stated = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert stated["far"][0]["station"] == station


def test_a_rig_that_came_out_another_size_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    scene, mapped = block(), block_mapped()
    unknown = np.full((len(scene.records), 3), NAN)

    def notes(rig_error: float, scale: ScaleOfPairs) -> tuple[str, ...]:
        records = scene.records
        return check_mapping(mapped.model, records, unknown, unknown, rig_error, scale).notes

    assert notes(0.9e-3, SURE) == ()
    assert "-0.20 %" in notes(-2e-3, SURE)[0]
    assert "-0.20 %" in capsys.readouterr().err
    long = SURE.model_copy(update={"mean": 1.002})
    assert "+0.20 " in notes(NAN, long)[0]
    assert notes(NAN, long.model_copy(update={"mean_sigma": 1e-3})) == ()


def test_a_significant_bend_is_reported_and_a_small_one_is_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    mapped = block_mapped()
    capsys.readouterr()  # of a slow machine's progress
    large = bend_of(curvature_per_m=0.05, sigma_per_m=1e-3, length_m=4.0)
    small = bend_of(curvature_per_m=1e-4, sigma_per_m=1e-4, length_m=2.0)
    straight = measure_doming(mapped.model, (small, small))
    assert straight.notes == ()
    assert not capsys.readouterr().err
    focal = mapped.warps["left"].pinhole.focal_px
    assert straight.pixel_m == pytest.approx(ALTITUDE_M / focal, rel=0.1)
    found = measure_doming(mapped.model, (large, small))
    assert found.along == large and found.across == small
    assert "bent along the block: +100.0 +/- 2.0 mm over 4.0 m" in found.notes[0]
    assert len(capsys.readouterr().err.splitlines()) == len(found.notes) == 1


def test_the_scale_shows_a_model_whose_depths_are_stretched() -> None:
    """Points 1 % farther from the cameras than each station's own stereo has them."""
    mapped = block_mapped()
    model = pycolmap.Reconstruction(mapped.model)
    before = scale_of_pairs(model, observations(model))
    assert before is not None
    assert abs(before.mean - 1.0) < 4 * before.mean_sigma + 1e-4
    down = np.median([i.cam_from_world().matrix()[2, :3] for i in model.images.values()], axis=0)
    height = np.median([i.projection_center() @ down for i in model.images.values()])
    for point in model.points3D.values():
        point.xyz = point.xyz + 0.01 * (point.xyz @ down - height) * down
    after = scale_of_pairs(model, observations(model))
    assert after is not None
    assert after.mean == pytest.approx(1.01 * before.mean, abs=4e-4)
    assert after.mean - 1.0 > 3 * after.mean_sigma
    assert ground_pixel(model, observations(model)) > 0
