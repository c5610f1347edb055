"""Points per second of the flat-port camera, compared with peers, in the same run.

Peers do less than `project` does (no port), so equal work is compared where there is a peer for it:
- `cv2.projectPoints` projects through a lens without a port. Its Python binding always fills in
  the slopes by the lens and the pose too, so it stands next to `project` and `project_jacobian`.
- COLMAP's OPENCV camera projects and unprojects through a lens without a port, and nothing else.
- `cv2.undistortPoints` inverts the lens, set to iterate until a pixel is right to 1e-9.
All get the same float64 points and the same distortion, after a run each to warm up; runs alternate
and the best of each counts, so that what else the machine does slows nobody alone.
"""

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import pycolmap

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array
from benchmarks.figures import Figure, Goal
from camera_calib.camera import Camera
from camera_calib.rig import design_rig

_SAME_PX = 1e-9
_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One piece of work and a peer's like it, in millions of points per second."""

    what: str
    ours: float
    peer: str
    theirs: float
    goals: tuple[float, ...] = ()
    """The least ratios that are requested."""

    @property
    def ratio(self) -> float:
        """Ours over theirs."""
        return self.ours / self.theirs

    def figure(self) -> Figure:
        """Ours next to theirs."""
        goal = Goal(minimum=max(self.goals), of="ratio") if self.goals else None
        return Figure(
            name=self.what, value=self.ours, unit="M points/s", peer=self.peer,
            peer_value=self.theirs, goal=goal,
        )  # fmt: skip


def lens_camera() -> Camera:
    """The paper's camera with all five common distortion terms."""
    camera = design_rig(CameraConfig(), WaterConfig()).cameras["left"]
    return camera.with_parameters({"k1": -0.12, "k2": 0.08, "p1": 2e-4, "p2": -3e-4, "k3": 0.01})


def measure(points_count: int, runs: int) -> list[Row]:
    """All rows.

    Args:
        points_count: how many points each run takes.
        runs: how many runs of each; the best counts.
    """
    camera = lens_camera()
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0, 0], [camera.width_px, camera.height_px], (points_count, 2))
    points = camera.at_depth(pixels, rng.uniform(0.6, 10.0, points_count))
    matrix = _matrix(camera)
    distortion = np.array([camera.parameter(name) for name in ("k1", "k2", "p1", "p2", "k3")])
    zero = np.zeros(3)
    colmap = pycolmap.Camera(
        model="FULL_OPENCV",
        width=camera.width_px,
        height=camera.height_px,
        params=[*matrix[[0, 1], [0, 1]], *matrix[:2, 2], *distortion, 0.0, 0.0, 0.0],
    )

    def opencv(some: Array) -> Array:
        found: Array = cv2.projectPoints(some, zero, zero, matrix, distortion)[0]
        return found.reshape(-1, 2)

    def opencv_back(some: Array) -> Array:
        found: Array = cv2.undistortPoints(some, matrix, distortion, criteria=_UNTIL)
        return found.reshape(-1, 2)

    in_air = camera.in_air()
    _same("cv2.projectPoints", opencv(points), in_air.project(points), _SAME_PX)
    _same("COLMAP's projection", colmap.img_from_cam(points), in_air.project(points), _SAME_PX)
    rays = np.hstack([opencv_back(pixels), np.ones((points_count, 1))])
    _same("cv2.undistortPoints", in_air.project(rays), pixels, 1e-6)
    _same("unproject", camera.project(np.add(*camera.unproject(pixels))), pixels, _SAME_PX)

    works: dict[str, tuple[Callable[[Array], object], Array]] = {
        "project": (camera.project, points),
        "unproject": (camera.unproject, pixels),
        "project_jacobian": (camera.project_jacobian, points),
        "cv2.projectPoints": (opencv, points),
        "cv2.undistortPoints": (opencv_back, pixels),
        "COLMAP's img_from_cam": (colmap.img_from_cam, points),
        "COLMAP's cam_from_img": (colmap.cam_from_img, pixels),
    }
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        best = race({name: partial(work, rows) for name, (work, rows) in works.items()}, runs)
    finally:
        cv2.setNumThreads(threads)
    speed = {name: points_count / seconds / 1e6 for name, seconds in best.items()}

    def row(what: str, ours: str, peer: str, *goals: float) -> Row:
        return Row(what=what, ours=speed[ours], peer=peer, theirs=speed[peer], goals=goals)

    return [
        row("project", "project", "cv2.projectPoints", 1.0, 2.0),
        row("project", "project", "COLMAP's img_from_cam"),
        row("project with slopes", "project_jacobian", "cv2.projectPoints"),
        row("unproject", "unproject", "cv2.undistortPoints"),
        row("unproject", "unproject", "COLMAP's cam_from_img"),
    ]


def race(works: Mapping[str, Callable[[], object]], runs: int) -> dict[str, float]:
    """Least seconds of each, in turns, after one run each to warm up."""
    best = dict.fromkeys(works, np.inf)
    for run in range(runs + 1):
        for name, work in works.items():
            seconds = _timed(work)
            if run:
                best[name] = min(best[name], seconds)
    return best


def _matrix(camera: Camera) -> Array:
    return np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])


def _timed(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def _same(what: str, found: Array, expected: Array, limit_px: float) -> None:
    miss = np.abs(found - expected).max()
    if not miss < limit_px:
        sys.exit(f"{what} does other work: its pixels differ by {miss:.3g}")
