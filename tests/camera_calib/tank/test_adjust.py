from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from alice_survey.base.errors import CalibrationError
from camera_calib.rig import read_rig, write_rig
from camera_calib.tank.adjust import (
    Tank,
    noise_px,
    place_cameras,
    point_covariance,
    refine,
    tank_rig,
)
from camera_calib.tank.clock import estimate_lags, pixel_speeds
from camera_calib.tank.files import Detections
from camera_calib.tank.single_lens import KnownLens
from tests.oracles_interface import LENS, SIZE_M, points_in_tank, seen, true_tank

Array = NDArray[np.float64]
TRUE = true_tank()
CORNER_PX = 2.0
LENS_SIGMAS = {"fx_px": 1.5, "fy_px": 1.5, "cx_px": 0.8, "cy_px": 0.8}


def drawn_lens(rng: np.random.Generator) -> KnownLens:
    """A calibration of the true lens, with its errors."""
    values = {n: LENS.parameter(n) + s * rng.normal() for n, s in LENS_SIGMAS.items()}
    return KnownLens(
        camera=LENS.with_parameters(values),
        free=tuple(LENS_SIGMAS),
        covariance=np.diag(np.square(list(LENS_SIGMAS.values()))),
    )


def drawn_tank(rng: np.random.Generator, lens: KnownLens, corner_px: float = CORNER_PX) -> Tank:
    """Cameras placed from reference points that were clicked with noise."""
    references = [
        replace(r, pixels=r.pixels + corner_px * rng.normal(size=r.pixels.shape))
        for r in (camera.reference for camera in TRUE.cameras)
    ]
    return place_cameras(
        [lens, lens],
        references,
        n_water=1.333,
        glass_thickness_m=[c.glass_thickness_m for c in TRUE.cameras],
        reference_sigma_px=corner_px,
    )


def test_without_noise_all_is_exact() -> None:
    lens = KnownLens(camera=LENS)
    tank = place_cameras(
        [lens, lens],
        [camera.reference for camera in TRUE.cameras],
        n_water=1.333,
        glass_thickness_m=[0.0, 0.006],
        reference_sigma_px=1.0,
    )
    points = points_in_tank(np.random.default_rng(1), 200)

    found = tank.triangulate(seen(TRUE, points))

    np.testing.assert_allclose(found.points_world, points, atol=1e-9)
    refined = refine(tank, seen(TRUE, points) + 1e-7).tank.triangulate(seen(TRUE, points))
    np.testing.assert_allclose(refined.points_world, points, atol=1e-7)


def test_sigma_of_reference_points_comes_from_their_residuals() -> None:
    rng = np.random.default_rng(2)
    lens = KnownLens(camera=LENS)
    sigmas = []
    for _ in range(100):
        references = [
            replace(c.reference, pixels=c.reference.pixels + 3.0 * rng.normal(size=(4, 2)))
            for c in TRUE.cameras
        ]
        sigmas.append(place_cameras([lens, lens], references, n_water=1.333).reference_sigma_px)
    # 16 coordinates less 12 of the poses: 4 degrees of freedom.
    assert np.sqrt(np.mean(np.square(sigmas))) == pytest.approx(3.0, rel=0.12)


def test_sigmas_of_points_poses_and_ports_are_true() -> None:
    rng = np.random.default_rng(3)
    points = points_in_tank(rng, 15)
    truth = tank_rig(TRUE, "truth")
    of_points, of_rig = [], []
    for _ in range(120):
        tank = drawn_tank(rng, drawn_lens(rng))
        pixels = seen(TRUE, points) + 0.7 * rng.normal(size=(2, 15, 2))
        found = tank.triangulate(pixels, 0.7)
        whole = point_covariance(tank, found)
        error = found.points_world - points
        of_points.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(whole), error))
        assert np.all(np.linalg.det(whole) > np.linalg.det(found.covariance))
        rig = tank_rig(tank, "drawn")
        assert rig.covariance is not None
        change = rig.cam_from_rig["cam2"] * truth.cam_from_rig["cam2"].inv()
        shift = rig.cam_from_rig["cam2"].translation - truth.cam_from_rig["cam2"].translation
        of_rig.append(
            [
                *(
                    (rig.cameras[c].parameter(p) - truth.cameras[c].parameter(p))
                    / rig.sigmas[f"{c}.{p}"]
                    for c in ("cam1", "cam2")
                    for p in ("port_distance_m", "normal_x", "normal_y", "fx_px")
                ),
                *(
                    miss / rig.sigmas[f"cam2.{p}"]
                    for p, miss in zip(
                        ("rx_rad", "ry_rad", "rz_rad", "x_m", "y_m", "z_m"),
                        (*change.rotation.as_rotvec(), *shift),
                        strict=True,
                    )
                ),
            ]
        )
    assert 0.8 < np.sqrt(np.mean(of_points) / 3) < 1.25
    normalised = np.sqrt(np.mean(np.square(of_rig), axis=0))
    assert np.all((normalised > 0.8) & (normalised < 1.25)), normalised


def test_refining_brings_cameras_and_points_home() -> None:
    rng = np.random.default_rng(4)
    points = points_in_tank(rng, 600)
    before, after, normalised, noise = [], [], [], []
    for _ in range(12):
        lens = drawn_lens(rng)
        tank = drawn_tank(rng, lens, 6.0)
        pixels = seen(TRUE, points) + 0.5 * rng.normal(size=(2, 600, 2))
        pixels[1, :30] += rng.uniform(-300.0, 300.0, (30, 2))  # wrong partners

        refined = refine(tank, pixels)

        noise.append(refined.sigma_px)
        rough = tank.triangulate(pixels)
        fine = refined.tank.triangulate(pixels, refined.sigma_px)
        before.append(np.median(np.abs(rough.residuals_px[:, 30:])))
        after.append(np.median(np.abs(fine.residuals_px[:, 30:])))
        whole = point_covariance(refined.tank, fine)[30:]
        error = fine.points_world[30:] - points[30:]
        normalised.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(whole), error).mean() / 3)
    assert np.mean(noise) == pytest.approx(0.5, rel=0.12)
    # Half of the noise of four coordinates is left in a residual, most of it along one axis.
    assert 0.05 < np.mean(after) < 0.2 < 0.5 < np.mean(before)
    assert 0.7 < np.sqrt(np.mean(normalised)) < 1.3


def test_refining_agrees_however_memory_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    tank = drawn_tank(rng, drawn_lens(rng))
    pixels = seen(TRUE, points_in_tank(rng, 101)) + 0.5 * rng.normal(size=(2, 101, 2))
    whole = refine(tank, pixels).tank

    monkeypatch.setattr("camera_calib.tank.adjust._CHUNK", 10)
    cut = refine(tank, pixels).tank

    for one, other in zip(whole.cameras, cut.cameras, strict=True):
        np.testing.assert_allclose(one.position_world, other.position_world, atol=1e-10)
    found = whole.triangulate(pixels)
    np.testing.assert_allclose(
        point_covariance(whole, found), point_covariance(cut, found), rtol=1e-6
    )


def test_noise_is_what_keeps_rays_from_meeting() -> None:
    rng = np.random.default_rng(6)
    pixels = seen(TRUE, points_in_tank(rng, 4000)) + 0.8 * rng.normal(size=(2, 4000, 2))

    assert noise_px(TRUE.triangulate(pixels)) == pytest.approx(0.8, rel=0.05)


def test_too_few_detections_do_not_refine() -> None:
    points = points_in_tank(np.random.default_rng(7), 20)
    with pytest.raises(CalibrationError, match=r"20 detections give a point.*use --no-refine"):
        refine(drawn_tank(np.random.default_rng(8), KnownLens(camera=LENS)), seen(TRUE, points))


def test_cameras_may_have_lenses_of_their_own() -> None:
    rng = np.random.default_rng(9)
    first, second = drawn_lens(rng), drawn_lens(rng)
    references = [camera.reference for camera in TRUE.cameras]
    shared = place_cameras([first, first], references, n_water=1.333, reference_sigma_px=1.0)
    parted = place_cameras([first, second], references, n_water=1.333, reference_sigma_px=1.0)

    rig, other = tank_rig(shared, "shared"), tank_rig(parted, "parted")

    assert (shared.uncertain, parted.uncertain) == (16, 20)
    assert rig.covariance is not None and other.covariance is not None
    fx = [rig.covariance.parameters.index(f"{c}.fx_px") for c in ("cam1", "cam2")]
    assert rig.covariance.correlation[fx[0], fx[1]] == pytest.approx(1.0)
    assert other.covariance.correlation[fx[0], fx[1]] == 0.0


def test_the_rig_is_kept_in_its_file(tmp_path: Path) -> None:
    tank = drawn_tank(np.random.default_rng(10), drawn_lens(np.random.default_rng(11)))
    write_rig(tmp_path / "rig.json", tank_rig(tank, "test"))

    rig = read_rig(tmp_path / "rig.json")

    assert rig.reference == "cam1"
    for camera in tank.cameras:
        world = rig.body_from_rig * rig.cam_from_rig[camera.name].inv()
        np.testing.assert_allclose(world.translation, camera.position_world, atol=1e-12)
        assert rig.cameras[camera.name].port_distance_m == camera.camera.port_distance_m


def moving(lag_frames: float, rng: np.random.Generator, frames: int = 600) -> Detections:
    """A thing that swims in loops; the second camera is late by some frames."""
    time = np.arange(frames, dtype=np.float64)

    def place(t: Array) -> Array:
        phases = np.array([0.031, 0.047, 0.023])
        return SIZE_M * (0.45 + 0.3 * np.sin(t[:, None] * phases + [0.0, 1.0, 2.0]))

    pixels = np.stack([seen(TRUE, place(time))[0], seen(TRUE, place(time + lag_frames))[1]])
    return Detections(
        frames=np.arange(frames),
        ids=np.zeros(frames, dtype=np.int64),
        candidates=np.ones(frames, dtype=np.int64),
        pixels=pixels + 0.3 * rng.normal(size=pixels.shape),
        alone=0,
        not_numbers=0,
        doubled=0,
    )


@pytest.mark.parametrize("lag_frames", [0.0, 1.6, -0.7])
def test_lag_of_a_clock_is_told_from_what_moves(lag_frames: float) -> None:
    detections = moving(lag_frames, np.random.default_rng(12))

    lags = estimate_lags(TRUE, detections, TRUE.triangulate(detections.pixels))

    assert [lag.camera for lag in lags] == ["cam2"]
    assert lags[0].points == 598
    assert lags[0].frames == pytest.approx(lag_frames, abs=0.02)
    assert 0.0005 < lags[0].sigma < 0.01


def test_without_motion_no_lag_is_told() -> None:
    detections = moving(1.0, np.random.default_rng(13), frames=50)

    assert estimate_lags(TRUE, detections, TRUE.triangulate(detections.pixels)) == ()


def test_speed_is_unknown_beside_gaps_and_doubles() -> None:
    detections = moving(0.0, np.random.default_rng(14), frames=9)
    frames = np.array([0, 1, 2, 3, 20, 21, 22, 23, 24])
    candidates = np.array([1, 1, 1, 1, 1, 1, 2, 1, 1])

    speeds = pixel_speeds(replace(detections, frames=frames, candidates=candidates))

    known = np.isfinite(speeds).all(axis=(0, 2))
    assert known.tolist() == [False, True, True, False, False, True, False, True, False]
    change = detections.pixels[:, 2] - detections.pixels[:, 0]
    np.testing.assert_allclose(speeds[:, 1], change / 2)
