"""Accuracy of our own models and of other programs' against the truth of a simulated survey."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio

from alice_survey.core.frames import Array
from alice_survey.sim.seafloor.terrain import Terrain, read_terrain
from reconstruct.evaluate.figures import rms
from reconstruct.evaluate.truth import read_true_poses, surface_distance
from reconstruct.placing.alignment import Similarity, align_rigid, align_similarity, sag_weights
from reconstruct.placing.track import read_track_poses
from reconstruct.views.model import read_model

_CELLS = 300_000


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Millimetres after alignment to the true camera positions; NaN where there is nothing."""

    registered: int
    cameras_mm: float
    bend_mm: float
    """Sag of the cameras' heights along the block or across it, whichever is larger."""
    points_mm: float
    """rms distance of sparse points from the true surface, all of them."""
    points_median_mm: float
    surface_mm: float
    """The same of the cells of the elevation model."""
    surface_median_mm: float


def score_ours(workspace: Path) -> Accuracy:
    """Our model, moved rigidly: its scale is its own."""
    poses = read_track_poses(workspace / "sparse" / "track.csv")
    truth = workspace / "images" / "truth"
    true = read_true_poses(truth / "poses.csv")
    names = sorted(poses)
    found = np.array([poses[n].translation for n in names])
    target = np.array([true[n].translation for n in names])
    pose = align_rigid(found, target)
    terrain = read_terrain(truth / "terrain.ply")
    points = _distance_mm(terrain, pose.apply(read_model(workspace / "sparse").points_world))
    cells = np.empty(0)
    if (workspace / "dense" / "dem.tif").exists():
        enu = cells_of(workspace / "dense" / "dem.tif")
        cells = _distance_mm(terrain, pose.apply(enu[:, [1, 0, 2]] * [1, 1, -1]))
    return _accuracy(target, pose.apply(found), points, cells)


def score_peer(out: Path, truth: Path) -> Accuracy:
    """Another program's model, moved and scaled: it knows no scale."""
    data = json.loads((out / "cameras.json").read_text())
    true = read_true_poses(truth / "poses.csv")
    names = sorted(set(data["centres"]) & set(true))
    found = np.array([data["centres"][n] for n in names])
    target = np.array([true[n].translation for n in names])
    pose: Similarity = align_similarity(found, target)
    terrain = read_terrain(truth / "terrain.ply")
    points = _distance_mm(terrain, pose.apply(np.array(data["points"]).reshape(-1, 3)))
    cells = np.empty(0)
    if (out / "dsm.tif").exists():
        cells = _distance_mm(terrain, pose.apply(cells_of(out / "dsm.tif")))
    return _accuracy(target, pose.apply(found), points, cells)


def bend_mm(true_ned: Array, found_ned: Array) -> float:
    """Sag of the heights of a track (N, 3): positive where its ends are too high."""
    sags = sag_weights(true_ned[:, :2]) @ (true_ned - found_ned)[:, 2]
    return 1e3 * float(sags[np.abs(sags).argmax()])


def cells_of(dem: Path) -> Array:
    """(N, 3) map x, map y and height of the known cells of an elevation model, thinned."""
    with rasterio.open(dem) as source:
        height = source.read(1, masked=True).astype(np.float64).filled(np.nan)
        rows, columns = np.nonzero(np.isfinite(height))
        step = max(1, len(rows) // _CELLS)
        rows, columns = rows[::step], columns[::step]
        x, y = rasterio.transform.xy(source.transform, rows, columns)
    return np.column_stack([x, y, height[rows, columns]])


def _distance_mm(terrain: Terrain, points_ned: Array) -> Array:
    return 1e3 * surface_distance(terrain, points_ned) if len(points_ned) else np.empty(0)


def _accuracy(true_ned: Array, found_ned: Array, points: Array, cells: Array) -> Accuracy:
    def median(values: Array) -> float:
        return float(np.median(values)) if len(values) else float("nan")

    misses_m = found_ned - true_ned
    return Accuracy(
        registered=len(true_ned),
        cameras_mm=1e3 * float(np.sqrt((misses_m**2).sum(axis=1).mean())),
        bend_mm=bend_mm(true_ned, found_ned),
        points_mm=rms(points),
        points_median_mm=median(points),
        surface_mm=rms(cells),
        surface_median_mm=median(cells),
    )
