"""Speed as ratios against a peer or a slow twin, measured in the same run.

    .venv/bin/python benchmarks/speed.py [PICTURE]

Each row is the median of several alternating runs, so that a busy machine slows both alike.
"""

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from alice_survey.config import CameraConfig, SurveyConfig, WaterConfig
from camera_calib.flat_port import FlatPortCamera
from camera_calib.rig import design_rig

Array = np.ndarray


def compare(ours: Callable[[], object], peer: Callable[[], object], runs: int = 5) -> list[float]:
    """Median seconds of both, alternating, after one run each to warm up."""
    times: list[list[float]] = [[], []]
    for run in range(runs + 1):
        for index, work in enumerate((ours, peer)):
            started = time.perf_counter()
            work()
            if run:
                times[index].append(time.perf_counter() - started)
    return [statistics.median(row) for row in times]


def bisected(camera: FlatPortCamera, points: Array) -> Array:
    """The slow twin of `project` for a square port: vectorised bisection on the angle in air."""
    radius, depth = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    water = depth - camera.port_distance_m - camera.glass_thickness_m
    low, high = np.zeros_like(radius), np.full_like(radius, np.pi / 2)
    for _ in range(52):
        angle = (low + high) / 2
        glass = np.arcsin(np.sin(angle) / camera.n_glass)
        inside = np.arcsin(np.sin(angle) / camera.n_water)
        reach = camera.port_distance_m * np.tan(angle)
        reach += camera.glass_thickness_m * np.tan(glass) + water * np.tan(inside)
        low, high = np.where(reach < radius, angle, low), np.where(reach < radius, high, angle)
    slope = np.tan(low) / radius
    return np.column_stack(
        [
            camera.fx_px * points[:, 0] * slope + camera.cx_px,
            camera.fy_px * points[:, 1] * slope + camera.cy_px,
        ]
    )


def projection() -> list[tuple[str, float, float]]:
    """A million points into the flat-port camera, against bisection and OpenCV's pinhole."""
    camera = design_rig(CameraConfig(), WaterConfig()).cameras["left"]
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0, 0], [camera.width_px, camera.height_px], (1_000_000, 2))
    points = camera.at_depth(pixels, rng.uniform(1.5, 2.5, len(pixels)))
    twin = compare(lambda: camera.project(points), lambda: bisected(camera, points), 3)
    miss = np.abs(camera.project(points) - bisected(camera, points)).max()
    if not miss < 1e-6:
        raise SystemExit(f"the twins differ by {miss} px")
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    zero = np.zeros(3)
    peer = compare(
        lambda: camera.project(points),
        lambda: cv2.projectPoints(points, zero, zero, matrix, np.zeros(5)),
    )
    return [
        ("project 1M points: flat port / bisection", *twin),
        ("project 1M points: flat port / OpenCV's pinhole in air", *peer),
    ]


def features(picture: Path) -> list[tuple[str, float, float]]:
    """Normalising a picture and finding features, against COLMAP's SIFT on the CPU."""
    import pycolmap

    from reconstruct.features import find_features
    from reconstruct.normalise import normalise

    settings = SurveyConfig().reconstruct

    def ours() -> None:
        colour = cv2.imread(str(picture))
        grey = normalise(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))
        find_features(grey, None, scale=1.0, most=settings.max_features)

    with TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        options = pycolmap.FeatureExtractionOptions(use_gpu=False)

        def colmap() -> None:
            database.unlink(missing_ok=True)
            pycolmap.extract_features(
                database, picture.parent, [picture.name], extraction_options=options
            )

        times = compare(ours, colmap, 3)
    return [(f"features of {picture.name}: ours / COLMAP's on the CPU", times[0], times[1])]


def main() -> None:
    """Print the table; with a picture's path as argument, feature extraction too."""
    rows = projection()
    for path in sys.argv[1:]:
        rows += features(Path(path))
    print(f"{'what':62} {'ours':>9} {'peer':>9}  ratio")
    for what, ours, peer in rows:
        print(f"{what:62} {1e3 * ours:7.1f}ms {1e3 * peer:7.1f}ms  {ours / peer:.3f}")


if __name__ == "__main__":
    main()
