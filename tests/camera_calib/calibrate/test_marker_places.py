"""Sheets of which every marker lies a little off its place."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from camera_calib.calibrate.solve import calibrate_in_air
from camera_calib.calibration import Calibration, TargetView
from camera_calib.camera import Camera
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.target_shape import MARKER, ShapeKind, marker_lines, shape_of, usual_shape
from camera_calib.targets.target import Target, parse_target

TARGET = parse_target("apriltag 6x6 88mm 0.3")
OFF_M = 2e-4
NOISE_PX = 0.05
SIZE = (752, 480)
LENS = OpenCVLens(fx_px=458.0, fy_px=457.0, cx_px=367.0, cy_px=249.0, k1=-0.2, k2=0.05)


def displaced(target: Target, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) points of which those of every marker are moved by `OFF_M` in the plane."""
    angle = rng.uniform(0.0, 2.0 * np.pi, target.markers.max() + 1)
    off = OFF_M * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    moved: np.ndarray = target.points + off[target.markers]
    return moved


def calibrated(points: np.ndarray, kind: ShapeKind, rng: np.random.Generator) -> Calibration:
    """From 25 views of a grid that is as `points` say."""
    camera = Camera(width_px=SIZE[0], height_px=SIZE[1], lens=LENS)
    views: list[TargetView] = []
    while len(views) < 25:
        turn = Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True)
        place = camera.at_depth(rng.uniform(0.25, 0.75, 2) * SIZE, rng.uniform(0.7, 1.4))
        pose = RigidTransform.from_components(place - turn.apply(points.mean(axis=0)), turn)
        pixels = camera.project(pose.apply(points))
        pixels[~((pixels > 0) & (pixels < SIZE)).all(axis=1)] = np.nan
        if np.isfinite(pixels[:, 0]).mean() > 0.6:
            noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
            views.append(TargetView(name=f"{len(views):02d}", pixels={"camera": noisy}))
    shape = shape_of(TARGET, kind)
    return calibrate_in_air(views, TARGET.points, {"camera": SIZE}, "opencv4", shape=shape)


def left_over(off: np.ndarray) -> np.ndarray:
    """Offsets in the plane, (N, 2), less what a motion and a size of the whole would give."""
    centred = (TARGET.points - TARGET.points.mean(axis=0))[:, :2]
    x, y = centred.T
    motions = np.stack([[0 * x + 1, 0 * x], [0 * x, 0 * x + 1], [-y, x], [x, y]]).transpose(0, 2, 1)
    flat = motions.reshape(4, -1).T
    return off - (flat @ np.linalg.lstsq(flat, off.ravel(), rcond=None)[0]).reshape(off.shape)


def test_the_places_of_markers_are_found() -> None:
    rng = np.random.default_rng(4)
    points = displaced(TARGET, rng)

    found = calibrated(points, "markers", rng)

    true = left_over((points - TARGET.points)[:, :2])
    missed = left_over((found.shape.offsets_m - (points - TARGET.points))[:, :2])
    assert np.sqrt(np.mean(true**2)) > 0.12e-3
    assert 1e-6 < np.sqrt(np.mean(missed**2)) < 0.015e-3
    assert found.noise_px == pytest.approx(NOISE_PX, rel=0.05)
    sigmas = [found.shape.sigmas[n] for n in found.shape.parameters if n.startswith(MARKER)]
    assert len(sigmas) == 72
    assert max(sigmas) < OFF_M
    (line,) = marker_lines(found.shape)
    assert line.startswith("markers: 36 lie 0.")


def test_displaced_markers_cost_a_calibration_that_takes_them_as_drawn() -> None:
    """Their offsets do not average out: they return in every view."""
    errors: dict[ShapeKind, list[float]] = {"markers": [], "sheet": []}
    for seed in range(6):
        for kind, found in errors.items():
            rng = np.random.default_rng(seed)
            one = calibrated(displaced(TARGET, rng), kind, rng)
            off = one.rig.cameras["camera"].fx_px - LENS.fx_px
            found.append(off / one.rig.sigmas["camera.fx_px"] if kind == "markers" else off)
            if kind == "markers":
                assert one.rig.sigmas["camera.fx_px"] < 0.1
    assert 0.4 < np.sqrt(np.mean(np.square(errors["markers"]))) < 1.7
    assert np.sqrt(np.mean(np.square(errors["sheet"]))) > 0.02


def test_kinds_of_shapes() -> None:
    assert shape_of(TARGET, "flat").parameters == ()
    sheet = usual_shape(TARGET.points)
    assert shape_of(TARGET, "sheet").parameters == sheet.parameters
    board = parse_target("chessboard 5x4 30mm")
    shape = shape_of(board, "markers")
    assert len(shape.parameters) == len(usual_shape(board.points).parameters) + 2 * 20
    at = shape.parameters.index(f"{MARKER}7_y_m")
    moved = shape.with_values(np.eye(len(shape.parameters))[at]).offsets_m
    assert moved[7].tolist() == [0.0, 1.0, 0.0] and np.abs(np.delete(moved, 7, axis=0)).max() == 0.0


def test_tags_count_from_the_bottom_left() -> None:
    for number, place in enumerate(TARGET.marker_places):
        points = TARGET.points[TARGET.markers == number, :2]
        assert len(points) == 4
        np.testing.assert_allclose(points.min(axis=0), place, atol=1e-12)
