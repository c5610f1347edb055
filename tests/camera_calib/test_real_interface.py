"""A real rig behind real flat interfaces: two cameras at an aquarium (3D-ZeF, Aalborg)."""

import csv
import json
import re
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.lenses.opencv import COEFFICIENTS
from camera_calib.targets.detect import detect
from camera_calib.targets.target import parse_target
from camera_calib.triangulate import Triangulation
from tests.cameras import changed, flat_port_camera
from tests.oracles_interface import Tank, behind_interface

pytestmark = pytest.mark.slow

PUBLISHED_MEDIAN_PX = 4.65
"""Of the sum of both cameras' errors: 2.13 + 2.49 px."""
N_WATER = 1.333
HALF_PX = 0.5
CLICKED_PX = 8.0
"""How well the corners of the tank were clicked."""


def columns(path: Path) -> dict[str, Array]:
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    cells = [[float(cell or "nan") for cell in row] for row in rows[1:]]
    return dict(zip(rows[0], np.array(cells).T, strict=True))


def corners(path: Path) -> tuple[Array, Array]:
    """Corners of the tank of one camera: pixels, (P, 2), and world, (P, 3), metres."""
    entries = json.loads(re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL))
    pixels = np.array([[entry["camera"][axis] for axis in "xy"] for entry in entries])
    points = np.array([[entry["world"][axis] for axis in "xyz"] for entry in entries])
    return pixels + HALF_PX, points / 100.0


def lens_in_air(folder: Path) -> Camera:
    """OpenCV's rational model from the product's corners of a chessboard in air."""
    target = parse_target("chessboard 9x6 9.35mm")
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.iterdir())]
    pixels = [
        found for picture in pictures if (found := detect(target, picture).pixels) is not None
    ]
    height, width = pictures[0].shape
    views = [np.isfinite(found).all(axis=1) for found in pixels]
    points = [(target.points[seen] / 0.1).astype(np.float32) for seen in views]
    corners = [
        (found[seen] - HALF_PX).astype(np.float32)
        for found, seen in zip(pixels, views, strict=True)
    ]
    sharp = np.ones(len(views), dtype=bool)
    for _ in range(2):  # the second time without blurred views
        _, matrix, distortion, *_, rms_px = cv2.calibrateCameraExtended(
            list(compress(points, sharp)),
            list(compress(corners, sharp)),
            (width, height),
            None,
            None,
            flags=cv2.CALIB_RATIONAL_MODEL,
        )
        if sharp.all():
            sharp = rms_px.ravel() < 3.0 * np.median(rms_px)
    return flat_port_camera(
        width_px=width,
        height_px=height,
        fx_px=matrix[0, 0],
        fy_px=matrix[1, 1],
        cx_px=matrix[0, 2] + HALF_PX,
        cy_px=matrix[1, 2] + HALF_PX,
        n_water=1.0,
    ).with_parameters(dict(zip(COEFFICIENTS, map(float, distortion.ravel()), strict=False)))


def pose_of(turn_and_shift: Array) -> RigidTransform:
    rotation = Rotation.from_rotvec(turn_and_shift[:3])
    return RigidTransform.from_components(turn_and_shift[3:], rotation)


@dataclass(frozen=True, eq=False)
class Aquarium:
    """The lens, the corners of the tank seen by each camera, and pairs of detections."""

    lens: Camera
    corners: tuple[tuple[Array, Array], ...]
    published: dict[str, Array]

    @property
    def pixels(self) -> Array:
        """(2, N, 2)."""
        named = [[self.published[f"cam{c}_{axis}"] for axis in "xy"] for c in (1, 2)]
        return np.array(named).transpose(0, 2, 1) + HALF_PX

    def by_corners(self) -> Tank:
        """Poses from the clicked corners, seen through air alone."""
        poses = []
        for pixels, points in self.corners:
            rays = self.lens.unproject(pixels)[1]
            plane = rays[:, :2] / rays[:, 2:]
            _, turn, shift = cv2.solvePnP(points, plane, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
            start = pose_of(np.concatenate([turn.ravel(), shift.ravel()]))
            best = least_squares(self.corner_misses, np.zeros(6), args=(start, pixels, points))
            poses.append(pose_of(best.x) * start)
        return self.tank(poses)

    def corner_misses(
        self, step: Array, start: RigidTransform, clicked: Array, points: Array
    ) -> Array:
        return (self.lens.project((pose_of(step) * start).apply(points)) - clicked).ravel()

    def tank(self, poses: list[RigidTransform]) -> Tank:
        cameras = [
            behind_interface(self.lens, pose, points, n_water=N_WATER)
            for pose, (_, points) in zip(poses, self.corners, strict=True)
        ]
        return Tank(cameras=tuple(cameras), poses=tuple(poses))

    def refined(self, rows: NDArray[np.intp]) -> Tank:
        """Poses of least squared error of corners and of some detections, by scipy."""
        start, pixels = self.by_corners(), self.pixels[:, rows]

        def moved(step: Array) -> Tank:
            steps = zip(step.reshape(2, 6), start.poses, strict=True)
            return self.tank([pose_of(change) * pose for change, pose in steps])

        def misses(step: Array) -> Array:
            found = np.nan_to_num(moved(step).triangulate(pixels).residuals_px, nan=100.0)
            of_corners = [
                self.corner_misses(step[6 * i : 6 * i + 6], start.poses[i], *self.corners[i])
                for i in range(2)
            ]
            robust = np.sign(found) * np.sqrt(np.log1p(found**2))  # Cauchy's, of detections alone
            return np.concatenate([robust.ravel(), *(miss / CLICKED_PX for miss in of_corners)])

        best = least_squares(misses, np.zeros(12), x_scale=0.01)
        return moved(best.x)


def median_px(found: Triangulation) -> float:
    """Median sum of both cameras' errors; detections without a point count as infinite."""
    sums = np.linalg.norm(found.residuals_px, axis=-1).sum(axis=0)
    return float(np.median(np.nan_to_num(sums, nan=np.inf)))


@pytest.fixture(scope="module")
def aquarium(shared_data: Path) -> Aquarium:
    folder = shared_data / "aau_flat_interface"
    return Aquarium(
        lens=lens_in_air(folder / "checkerboards"),
        corners=tuple(corners(folder / f"cam{c}_references.json") for c in (1, 2)),
        published=columns(folder / "detections_triangulated.csv"),
    )


@pytest.fixture(scope="module")
def tank(aquarium: Aquarium) -> Tank:
    """Refined on every eighth detection."""
    return aquarium.refined(np.arange(0, aquarium.pixels.shape[1], 8))


def test_cameras_stand_above_and_before_the_tank(tank: Tank) -> None:
    top, front = (pose.inv().translation for pose in tank.poses)
    np.testing.assert_allclose(top, [0.18, 0.075, -0.198], atol=0.012)
    np.testing.assert_allclose(front, [0.17, 0.371, 0.073], atol=0.012)
    assert all(0.15 < camera.parameter("port_distance_m") < 0.21 for camera in tank.cameras)


def test_reprojection_error_is_below_the_published(aquarium: Aquarium, tank: Tank) -> None:
    held_out = np.arange(aquarium.pixels.shape[1]) % 8 != 0

    found = tank.triangulate(aquarium.pixels[:, held_out])

    assert np.isfinite(found.points_world).all(axis=1).mean() > 0.998
    assert 1.5 < median_px(found) < 3.2 < PUBLISHED_MEDIAN_PX
    # Corners clicked to 8 px decide little by themselves: about as good as published.
    assert 3.5 < median_px(aquarium.by_corners().triangulate(aquarium.pixels)) < 6.5


def test_without_refraction_the_rays_miss_each_other(aquarium: Aquarium, tank: Tank) -> None:
    in_air = replace(tank, cameras=tuple(changed(c, n_water=1.0) for c in tank.cameras))

    assert median_px(in_air.triangulate(aquarium.pixels)) > 10.0


def test_points_are_near_the_authors(aquarium: Aquarium, tank: Tank) -> None:
    theirs = np.column_stack([aquarium.published[f"3d_{axis}"] for axis in "xyz"]) / 100.0

    apart = np.linalg.norm(tank.triangulate(aquarium.pixels).points_world - theirs, axis=1)

    assert 0.0002 < np.nanmedian(apart) < 0.005
    assert np.nanpercentile(apart, 90) < 0.01


def test_the_second_clock_is_late(aquarium: Aquarium, tank: Tank) -> None:
    """Fish of the second camera, moved back by a frame or so, meet those of the first."""
    frames, ids = (aquarium.published[name].astype(np.int64) for name in ("frame", "id"))
    pixels, speeds = aquarium.pixels, np.full(aquarium.pixels.shape[1:], np.nan)
    for fish in np.unique(ids):
        rows = np.flatnonzero(ids == fish)
        rows = rows[np.argsort(frames[rows], kind="stable")]
        before, after = rows[:-2], rows[2:]
        known = frames[after] - frames[before] == 2
        speeds[rows[1:-1][known]] = 0.5 * (pixels[1, after] - pixels[1, before])[known]
    moving = np.isfinite(speeds).all(axis=1)

    def misses_px(lag_frames: float) -> float:
        seen = pixels[:, moving] - np.array([0.0, lag_frames])[:, None, None] * speeds[moving]
        return median_px(tank.triangulate(seen))

    lags = np.arange(-1.0, 4.0, 0.5)
    misses = np.array([misses_px(lag) for lag in lags])
    assert moving.sum() > 5000
    assert 0.5 <= lags[misses.argmin()] <= 2.0
    assert misses.min() < 0.9 * misses_px(0.0)
