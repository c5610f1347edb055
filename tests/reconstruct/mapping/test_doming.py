import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.mapping.acceptance import (
    Bend,
    bend_of,
    down_of,
    ground_pixel,
    measure_doming,
    navigation_rotations,
    scale_trend,
)
from reconstruct.mapping.arrays import observed
from reconstruct.mapping.priors import pinhole_positions
from tests.reconstruct.mapping.test_mapper import block, block_mapped
from tests.reconstruct.scenes import ALTITUDE_M, DATUM

DOWN = np.array([0.0, 0.0, 1.0])


def grid(rng: np.random.Generator, length: float, width: float, count: int) -> np.ndarray:
    place = rng.uniform([0, 0], [length, width], (count, 2))
    return np.column_stack([place, 13.0 + rng.normal(0, 0.05, count)])


@pytest.mark.parametrize("seed", range(5))
def test_a_bent_block_shows_its_curvature(seed: int) -> None:
    """Bent 2 mm/m^2 along and half as much the other way across, in any frame."""
    rng = np.random.default_rng(seed)
    centres = grid(rng, 30.0, 10.0, 150)
    stated = centres[:, 2] + rng.normal(0, 0.005, 150)
    middle = centres[:, :2] - centres[:, :2].mean(axis=0)
    bent = centres.copy()
    bent[:, 2] -= 0.5 * (2e-3 * middle[:, 0] ** 2 - 1e-3 * middle[:, 1] ** 2)  # up is less depth
    turn = Rotation.random(random_state=seed)
    along, across = bend_of(turn.apply(bent), stated, np.full(150, 0.005), turn.apply(DOWN))
    assert along is not None and across is not None
    assert along.curvature_per_m == pytest.approx(2e-3, rel=0.05)
    assert across.curvature_per_m == pytest.approx(-1e-3, rel=0.05, abs=4 * across.sigma_per_m)
    assert along.length_m == pytest.approx(30, rel=0.1)
    assert along.sag_m == pytest.approx(2e-3 * along.length_m**2 / 8, rel=0.05)
    assert along.significant(1e-3)


def test_straight_blocks_are_not_called_bent_and_sigmas_are_true() -> None:
    pulls, warned = [], 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        centres = grid(rng, 20.0, 8.0, 80)
        stated = centres[:, 2] + rng.normal(0, 0.02, 80)
        for bend in bend_of(centres, stated, np.full(80, 0.02), DOWN):
            assert bend is not None
            pulls.append(bend.curvature_per_m / bend.sigma_per_m)
            warned += bend.significant(0.5e-3)
    assert 0.8 < np.std(pulls) < 1.2
    assert warned <= 3  # 0.27 % of 400 by chance


def test_sigmas_that_are_stated_too_small_do_not_make_a_bend() -> None:
    rng = np.random.default_rng(3)
    centres = grid(rng, 20.0, 8.0, 80)
    stated = centres[:, 2] + rng.normal(0, 0.02, 80)
    true, _ = bend_of(centres, stated, np.full(80, 0.02), DOWN)
    small, _ = bend_of(centres, stated, np.full(80, 0.001), DOWN)
    assert true is not None and small is not None
    assert small.sigma_per_m == pytest.approx(true.sigma_per_m, rel=0.35)


def test_jumps_of_the_depth_sensor_do_not_make_a_bend() -> None:
    rng = np.random.default_rng(4)
    centres = grid(rng, 20.0, 8.0, 100)
    stated = centres[:, 2] + rng.normal(0, 0.005, 100)
    clean, _ = bend_of(centres, stated, np.full(100, 0.005), DOWN)
    stated[np.argsort(centres[:, 0])[:5]] += 1.5
    along, _ = bend_of(centres, stated, np.full(100, 0.005), DOWN)
    assert clean is not None and along is not None
    assert abs(along.curvature_per_m - clean.curvature_per_m) < 3 * clean.sigma_per_m
    assert not along.significant(1e-3)


def test_a_line_has_no_curvature_across_and_few_stations_none() -> None:
    rng = np.random.default_rng(5)
    line = grid(rng, 20.0, 0.2, 40)
    along, across = bend_of(line, line[:, 2], np.full(40, 0.01), DOWN)
    assert along is not None and across is None
    assert bend_of(line[:7], line[:7, 2], np.full(7, 0.01), DOWN) == (None, None)


def test_a_mapped_block_is_straight_until_navigation_is_bent(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene, mapped = block(), block_mapped()
    positions, sigmas = pinhole_positions(scene.records, scene.rig, mapped.lenses, DATUM)
    rotations = navigation_rotations(scene.records, scene.rig, mapped.lenses)
    straight = measure_doming(mapped.model, positions, sigmas, rotations)
    assert straight.notes() == []
    assert "bent" not in capsys.readouterr().err
    assert straight.along is not None
    assert abs(straight.along.sag_m) < 5e-3
    focal = mapped.lenses["left"].pinhole.focal_px
    assert straight.pixel_m == pytest.approx(ALTITUDE_M / focal, rel=0.1)
    bent = positions.copy()
    north = positions[:, 0] - positions[:, 0].mean()
    bent[:, 2] += 0.5 * 0.05 * north**2
    found = measure_doming(mapped.model, bent, sigmas, rotations)
    assert found.along is not None and straight.along is not None
    gained = found.along.curvature_per_m - straight.along.curvature_per_m
    assert gained == pytest.approx(0.05, rel=0.05)
    assert "bent along the block" in capsys.readouterr().err
    assert found.to_json()["notes"] == found.notes() != []


def test_without_navigation_only_the_scale_is_measured() -> None:
    scene, mapped = block(), block_mapped()
    unknown = np.full((len(scene.records), 3), np.nan)
    found = measure_doming(mapped.model, unknown, unknown, {})
    assert found.along is None and found.across is None and found.scale is not None
    assert found.scale.mean == pytest.approx(1.0, abs=2e-3)
    assert found.notes() == []


def test_the_scale_shows_a_model_that_stretches_along_the_block() -> None:
    """Every station scaled about its own place, by 1 % more at one end than at the other."""
    mapped = block_mapped()
    model = pycolmap.Reconstruction(mapped.model)
    down = down_of(model, {})
    reference = {}
    for n in sorted(model.images):
        reference.setdefault(model.images[n].frame_id, n)
    before = scale_trend(model, observed(model), reference, down)
    assert before is not None
    assert before.range < 4 * before.range_sigma + 1e-3
    centres = np.array([model.images[n].projection_center() for n in sorted(model.images)])
    middle = centres.mean(axis=0)
    axis = np.linalg.svd(centres - middle)[2][0]
    span = np.ptp((centres - middle) @ axis)
    height = float(np.mean(centres @ down)) + ALTITUDE_M
    for point in model.points3D.values():
        share = (point.xyz - middle) @ axis / span
        above = float(point.xyz @ down) - (height - ALTITUDE_M)
        point.xyz = point.xyz + 0.01 * share * above * down
    after = scale_trend(model, observed(model), reference, down)
    assert after is not None
    assert after.range == pytest.approx(0.01, rel=0.25)
    assert after.significant
    assert ground_pixel(model, observed(model)) > 0


def test_sag_is_that_of_a_parabola() -> None:
    bend = Bend(curvature_per_m=1e-3, sigma_per_m=1e-4, length_m=20.0)
    assert bend.sag_m == pytest.approx(0.05)
    assert bend.sag_sigma_m == pytest.approx(0.005)
    assert bend.significant(0.01)
    assert not bend.significant(0.06)
