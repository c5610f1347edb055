import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.mapping.acceptance import ScaleTrend, check_mapping, judge_model, misses
from reconstruct.mapping.priors import pinhole_positions
from tests.reconstruct.mapping.test_mapper import block, block_mapped
from tests.reconstruct.scenes import DATUM

NAN = float("nan")
SURE = ScaleTrend(mean=1.0, mean_sigma=1e-4, range=0.0, range_sigma=1e-4)


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
    off, sigma = misses(centres, stated, np.full(stated.shape, 0.1))
    assert off[[7, 21, 22]] == pytest.approx([3.0, np.hypot(9, 4), 200.0], abs=0.5)
    rest = np.delete(off, [7, 21, 22])
    assert rest.max() < 0.5
    assert np.sqrt((rest**2).mean() / 3) == pytest.approx(0.1, rel=0.25)
    assert 0.1 <= sigma.max() < 0.13


def test_drift_that_navigation_does_not_own_up_to_widens_the_bounds() -> None:
    centres, stated = survey(2)
    along = stated[:, 0] - stated[:, 0].mean()
    stated[:, 1] += 0.1 * along**2 / 2  # up to 5 m by the ends
    off, sigma = misses(centres, stated, np.full(stated.shape, 0.01))
    assert off.max() > 0.5
    assert (off < 5 * sigma).all()


def test_a_jump_is_reported_by_name_and_small_misses_are_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene, mapped = block(), block_mapped()
    positions, sigmas = pinhole_positions(scene.records, scene.rig, mapped.lenses, DATUM)
    good = check_mapping(mapped.model, scene.records, positions, sigmas, 0.0, SURE)
    assert good.notes() == []
    assert good.far == ()
    assert good.checked == len({r.station for r in scene.records})
    assert "stations lie" not in capsys.readouterr().err
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

    def notes(rig_error: float, scale: ScaleTrend) -> list[str]:
        records = scene.records
        return check_mapping(mapped.model, records, unknown, unknown, rig_error, scale).notes()

    assert notes(0.9e-3, SURE) == []
    assert "-0.20 %" in notes(-2e-3, SURE)[0]
    assert "-0.20 %" in capsys.readouterr().err
    long = replace(SURE, mean=1.002)
    assert "+0.20 +/- 0.01 %" in notes(NAN, long)[0]
    assert notes(NAN, replace(long, mean_sigma=1e-3)) == []


def test_a_survey_is_checked_with_what_it_knows() -> None:
    scene, mapped = block(), block_mapped()
    doming, found = judge_model(mapped, scene.records, scene.rig, DATUM)
    assert found.far == ()
    assert abs(found.rig_error) < 1e-6
    assert doming.across is not None and doming.scale is not None
    stated = json.loads(json.dumps(doming.to_json(), allow_nan=False))
    assert stated["across"]["sag_m"] == doming.across.sag_m
    shrunk = replace(mapped, rig_factor=1.01)
    blind, stated_error = judge_model(shrunk, scene.records, scene.rig, None)
    assert stated_error.rig_error == pytest.approx(-0.01, abs=2e-4)
    assert stated_error.checked == 0
    assert blind.along is None
