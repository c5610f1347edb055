"""Stated covariances against what many draws of noise show, and against dense algebra."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from alice_survey.base.frames import Array
from reconstruct.mapping.arrays import observed
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.normal_equations import LinearObservations, moved_points, reduce_points
from reconstruct.mapping.refraction import refract
from reconstruct.mapping.uncertainty import (
    estimate,
    pinhole_observations,
    read_uncertainty,
    save_uncertainty,
    write_uncertainty,
)
from tests.oracles_refraction import dense_normal_equations, laid_onto
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import near_truth, true_stations, warped_scene

NOISE_PX = 0.3


@cache
def clean() -> Scene:
    return make_scene(lines=2, stations=5, points=700, scale=1, port_distance_m=0.05, relief_m=0.3)


def drawn(seed: int, folder: Path) -> tuple[Scene, Mapped]:
    """The same block with other noise, adjusted."""
    rng = np.random.default_rng(seed)
    pixels = [p + rng.normal(0, NOISE_PX, p.shape) for p in clean().pixels]
    scene = replace(clean(), pixels=pixels)
    seen, lenses = warped_scene(scene)
    mapped, _ = refract(near_truth(scene, seen, lenses, rng), seen, folder)
    return scene, mapped


def test_errors_are_as_large_as_stated(tmp_path: Path) -> None:
    frames, points = [], []
    for seed in range(12):
        scene, mapped = drawn(seed, tmp_path)
        found = estimate(mapped, scene.records, None)
        depth = float(
            np.median(np.linalg.norm(_sights(mapped).arm, axis=1))
        )  # weighs turns against positions, as documented
        misses, point_misses = laid_onto(
            mapped.model, found, true_stations(scene, mapped), scene.points_ned, depth
        )
        frames.append(misses / _sigmas(found.frame_cov))
        points.append(point_misses / _sigmas(found.point_cov))
        assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.12)
    ratios = np.sqrt((np.concatenate(frames) ** 2).mean(axis=0))
    assert np.all((ratios > 0.75) & (ratios < 1.3)), ratios
    assert 0.85 < np.sqrt((ratios**2).mean()) < 1.15
    point_ratios = np.sqrt((np.concatenate(points) ** 2).mean(axis=0))
    assert np.all((point_ratios > 0.8) & (point_ratios < 1.25)), point_ratios


def test_points_are_eliminated_as_dense_algebra_does(tmp_path: Path) -> None:
    _, mapped = drawn(0, tmp_path)
    few = _few(_sights(mapped), 40, np.random.default_rng(3))
    stations = int(few.station.max()) + 1
    reduced = reduce_points(few, stations)
    hessian, slope = dense_normal_equations(few, stations)
    size, count = 6 * stations, few.by_shared.shape[2]
    own = np.r_[0:size, len(slope) - count : len(slope)]
    rest = np.r_[size : len(slope) - count]
    back = np.linalg.inv(hessian[np.ix_(rest, rest)])
    expected = (
        hessian[np.ix_(own, own)] - hessian[np.ix_(own, rest)] @ back @ hessian[np.ix_(rest, own)]
    )
    pull = slope[own] - hessian[np.ix_(own, rest)] @ back @ slope[rest]
    whole = np.block(
        [[reduced.matrix.toarray(), reduced.border], [reduced.border.T, reduced.shared]]
    )
    scale = np.abs(expected).max()
    np.testing.assert_allclose(whole, expected, atol=1e-9 * scale)
    together = np.concatenate([reduced.slope, reduced.shared_slope])
    np.testing.assert_allclose(together, pull, atol=1e-9 * np.abs(slope).max())

    rng = np.random.default_rng(1)
    steps, shared_step = rng.normal(0, 1e-3, (stations, 6)), rng.normal(0, 1e-3, count)
    moved = moved_points(
        few.starts, few.station, few.by_point, few.arm, few.by_shared, few.miss,
        reduced.point_inverse, steps, shared_step,
    )  # fmt: skip
    step = np.concatenate([steps.ravel(), shared_step])
    wanted = -back @ (slope[rest] + hessian[np.ix_(rest, own)] @ step)
    np.testing.assert_allclose(moved.ravel(), wanted, atol=1e-9)


def test_given_positions_do_not_place_the_shape_but_firm_it(tmp_path: Path) -> None:
    """Exact positions leave stations only turns, which move all of them; vague ones do nothing."""
    scene, mapped = drawn(1, tmp_path)
    free = estimate(mapped, scene.records, None)
    vague = estimate(mapped, scene.records, np.full((len(scene.records), 3), 2.0))
    np.testing.assert_allclose(
        _sigmas(vague.frame_cov), _sigmas(free.frame_cov), rtol=2e-3, atol=1e-9
    )
    firm = estimate(mapped, scene.records, np.full((len(scene.records), 3), 1e-6))
    stiff, loose = _sigmas(firm.frame_cov)[:, 3:], _sigmas(free.frame_cov)[:, 3:]
    assert np.median(stiff) < 0.3 * np.median(loose)
    assert np.all(_sigmas(firm.point_cov) < 1.001 * _sigmas(free.point_cov) + 1e-4)


def test_the_file_gives_back_what_was_written(tmp_path: Path) -> None:
    scene, mapped = drawn(2, tmp_path)
    found = estimate(mapped, scene.records, None)
    for name in ("a.npz", "b.npz"):
        write_uncertainty(tmp_path / name, found)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = read_uncertainty(tmp_path / "a.npz")
    np.testing.assert_array_equal(back.frame_cov, found.frame_cov)
    np.testing.assert_array_equal(back.stations, found.stations)
    np.testing.assert_allclose(back.point_cov, found.point_cov, rtol=1e-6)
    np.testing.assert_allclose(back.point_noise, found.point_noise, rtol=1e-6)
    assert back.images == tuple(f"left/{s:06d}.png" for s in range(10))
    assert back.sigma_px == found.sigma_px
    for cov in (*found.frame_cov, *found.point_cov):
        np.testing.assert_allclose(cov, cov.T, atol=1e-9 * np.abs(cov).max())
        assert np.linalg.eigvalsh(cov)[0] > -1e-12


def test_a_station_that_sees_next_to_nothing_has_no_covariance(tmp_path: Path) -> None:
    scene, mapped = drawn(3, tmp_path)
    for number in (9, 10):
        for at in mapped.model.images[number].get_observation_point2D_idxs():
            point = mapped.model.images[number].points2D[at].point3D_id
            if len(mapped.model.points3D[point].track.elements) > 2:
                mapped.model.delete_observation(number, at)
    left = {p for n in (9, 10) for p in _points_of(mapped, n)}
    for point in left:
        mapped.model.delete_point3D(point)
    found = estimate(mapped, scene.records, None)
    assert np.isnan(found.frame_cov[4]).all()
    rest = np.delete(found.frame_cov, 4, axis=0)
    assert np.isfinite(rest).all()


def test_too_small_a_model_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, mapped = drawn(4, tmp_path)
    for point in sorted(mapped.model.points3D)[3:]:
        mapped.model.delete_point3D(point)
    save_uncertainty(tmp_path, mapped, warped_scene(scene)[0], scene.rig)
    assert " 3 points" in capsys.readouterr().err
    assert not (tmp_path / "covariance.npz").exists()


def _points_of(mapped: Mapped, number: int) -> list[int]:
    return [p.point3D_id for p in mapped.model.images[number].get_observation_points2D()]


def _sights(mapped: Mapped) -> LinearObservations:
    frames = np.array(sorted(mapped.model.frames), dtype=np.int64)
    return pinhole_observations(mapped.model, observed(mapped.model), frames)[0]


def _few(linear: LinearObservations, points: int, rng: np.random.Generator) -> LinearObservations:
    """The first points only, with two parameters that all share."""
    end = int(linear.starts[points])
    return LinearObservations(
        starts=linear.starts[: points + 1],
        station=linear.station[:end],
        by_point=linear.by_point[:end],
        arm=linear.arm[:end],
        by_shared=rng.normal(0, 100, (end, 2, 2)),
        miss=linear.miss[:end],
    )


def _sigmas(covariances: Array) -> Array:
    sigmas: Array = np.sqrt(np.einsum("nii->ni", covariances))
    return sigmas
