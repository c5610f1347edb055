"""Score a reconstruction of a simulated survey against its truth.

Cameras are compared after a rigid alignment: the scale comes from the rig and is not fitted. The
surface is moved by the same alignment and compared with the terrain's mesh, cell by cell, outliers
included; the mosaic is compared with the true sea floor painted at the same places.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform
from shapely.geometry import MultiPolygon

from alice_survey.artefacts import Stage, need_stage, read_json, run_stage, write_csv, write_json
from alice_survey.config import SurveyConfig
from alice_survey.errors import WorkspaceError
from alice_survey.frames import Array
from alice_survey.seafloor.terrain import Terrain, read_terrain
from alice_survey.seafloor.texture import survey_texture
from missions.plan_file import read_plan
from reconstruct.evaluate.mosaic import MosaicScore, score_mosaic
from reconstruct.evaluate.overlap import overlaps_reached
from reconstruct.evaluate.plots import plot_errors, plot_sheet, plot_track
from reconstruct.evaluate.truth import read_true_poses, surface_depth, surface_distance
from reconstruct.sparse.alignment import align_rigid, align_similarity
from reconstruct.sparse.track import read_track_poses

GOOD_M = 0.01
"""A cell counts as accurate when its distance from the true surface is below this."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraScore:
    """How well the cameras were placed."""

    registered: int
    total: int
    truth_from_world: RigidTransform
    """The rigid alignment; the surface and the mosaic are moved by it too."""
    names: tuple[str, ...]
    positions_ned: Array
    """(N, 3) aligned entrance pupils."""
    misses_m: Array
    """(N, 3) aligned less true position, north, east, down."""
    turns_deg: Array
    """(N,) angle between aligned and true attitude."""
    scale_error: float
    """Scale of a similarity alignment less one, sign as of the model: positive when too large."""
    georeference_m: Array
    """(3,) mean miss before the alignment, north, east, down."""

    @property
    def rms_m(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt((self.misses_m**2).sum(axis=1).mean()))


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceScore:
    """How well the surface fits, over all cells of the survey area."""

    cells: int
    """Cells in the area, filled or not."""
    distance_m: Array
    """(N,) distance of each filled cell from the nearest point of the true surface."""
    height_m: Array
    """(N,) height of each filled cell less the true height straight below or above it."""
    map_m: Array
    """(rows, columns) of `height_m`; NaN where there is no cell."""
    extent_m: tuple[float, float, float, float]
    """West, east, south, north edges of the map, moved (not turned) to the true frame."""

    @property
    def completeness(self) -> float:
        """Share of the area's cells that are filled."""
        return len(self.distance_m) / self.cells

    def to_json(self) -> dict[str, Any]:
        """Figures in millimetres."""
        distance, height = 1e3 * self.distance_m, 1e3 * self.height_m
        return {
            "cells": self.cells,
            "completeness": round(self.completeness, 4),
            "accurate_share": round(float((self.distance_m < GOOD_M).sum() / self.cells), 4),
            "distance_rms_mm": round(_rms(distance), 3),
            "distance_median_mm": round(float(np.median(distance)), 3),
            "distance_95_mm": round(float(np.percentile(distance, 95)), 3),
            "distance_max_mm": round(float(distance.max()), 3),
            "height_rms_mm": round(_rms(height), 3),
            "height_median_mm": round(float(np.median(height)), 3),
            "height_95_mm": round(float(np.percentile(np.abs(height), 95)), 3),
        }


def score_cameras(estimated: dict[str, RigidTransform], truth: Path, total: int) -> CameraScore:
    """Compare entrance pupils with the true poses of a simulated survey.

    Args:
        estimated: `world_from_cam` by picture, in metres.
        truth: `poses.csv` of the truth.
        total: how many pictures there are.

    Raises:
        WorkspaceError: fewer than three pictures are registered.
    """
    true_poses = read_true_poses(truth)
    names = tuple(sorted(estimated))
    if len(names) < 3:
        raise WorkspaceError(f"{len(names)} registered pictures; 3 or more are needed to align")
    found = np.stack([estimated[name].translation for name in names])
    true = np.stack([true_poses[name].translation for name in names])
    alignment = align_rigid(found, true)
    similarity = align_similarity(found, true)
    turns = [
        (true_poses[n].rotation.inv() * alignment.rotation * estimated[n].rotation).magnitude()
        for n in names
    ]
    return CameraScore(
        registered=len(names),
        total=total,
        truth_from_world=alignment,
        names=names,
        positions_ned=alignment.apply(found),
        misses_m=alignment.apply(found) - true,
        turns_deg=np.rad2deg(turns),
        scale_error=1.0 / similarity.scale - 1.0,
        georeference_m=(found - true).mean(axis=0),
    )


def score_surface(
    dem: Path, area: MultiPolygon, terrain: Terrain, truth_from_world: RigidTransform
) -> SurfaceScore:
    """Compare every DEM cell of the survey area with the true mesh.

    Args:
        dem: heights, positive up, over local east and north.
        area: the survey area, x north and y east; its holes count as outside.
        terrain: the truth.
        truth_from_world: alignment from the model's to the true NED.
    """
    with rasterio.open(dem) as source:
        heights = source.read(1).astype(np.float64)
        transform = source.transform
    rows, columns = heights.shape
    east = transform.c + (np.arange(columns) + 0.5) * transform.a
    north = transform.f + (np.arange(rows) + 0.5) * transform.e
    easts, norths = np.meshgrid(east, north)
    points = truth_from_world.apply(np.stack([norths, easts, -heights], -1).reshape(-1, 3))
    filled = np.isfinite(heights).ravel()
    plane = truth_from_world.apply(
        np.stack([norths, easts, np.full_like(easts, -np.nanmedian(heights))], -1).reshape(-1, 3)
    )
    place = np.where(filled[:, None], points, plane)
    shapely.prepare(area)
    inside = shapely.contains_xy(area, place[:, 0], place[:, 1])
    shift_ne = (plane - np.stack([norths, easts, 0 * easts], -1).reshape(-1, 3)).mean(axis=0)[:2]
    cell_m2 = abs(transform.a * transform.e)
    expected = round(area.area / cell_m2)
    used = inside & filled
    misses = np.full(filled.shape, np.nan)
    misses[used] = surface_depth(terrain, points[used, :2]) - points[used, 2]
    return SurfaceScore(
        cells=max(expected, int(inside.sum())),
        distance_m=surface_distance(terrain, points[used]),
        height_m=misses[used],
        map_m=misses.reshape(heights.shape),
        extent_m=(
            transform.c + shift_ne[1],
            transform.c + columns * transform.a + shift_ne[1],
            transform.f + rows * transform.e + shift_ne[0],
            transform.f + shift_ne[0],
        ),
    )


def run_evaluate(workspace: Path, config: SurveyConfig, threads: int) -> bool:
    """Score what `reconstruct` made and write `report/`.

    Returns:
        True when done, False when nothing had changed.

    Raises:
        WorkspaceError: a stage is missing, or the survey is not simulated and so has no truth.
    """
    images = need_stage(workspace, "images", "image")
    truth = images / "truth"
    if not truth.is_dir():
        raise WorkspaceError(
            f"{images} has no truth: only simulated surveys can be scored; what is known of this "
            f"one is in {workspace / 'sparse' / 'registration.json'}"
        )
    sparse = need_stage(workspace, "sparse", "reconstruct")
    dense = need_stage(workspace, "dense", "reconstruct")
    mosaic = need_stage(workspace, "mosaic", "reconstruct")
    plan = need_stage(workspace, "plan", "plan")
    inputs = [truth / "poses.csv", truth / "terrain.ply", truth / "rig.json", dense / "dem.tif"]
    inputs += [mosaic / "mosaic.tif", sparse / "track.csv", sparse / "registration.json"]
    inputs += [plan / "plan.json", workspace / "flight" / "triggers.csv"]
    inputs += [images / "manifest.csv"]
    stage = Stage(name="report", version=2, settings={"seed": config.seed}, inputs=inputs)

    def work(folder: Path) -> None:
        area = read_plan(plan / "plan.json").area.survey
        registration = read_json(sparse / "registration.json")
        terrain = read_terrain(truth / "terrain.ply")
        cameras = score_cameras(
            read_track_poses(sparse / "track.csv"), truth / "poses.csv", registration["total"]
        )
        surface = score_surface(dense / "dem.tif", area, terrain, cameras.truth_from_world)
        painted = score_mosaic(
            mosaic / "mosaic.tif",
            dense / "dem.tif",
            area,
            terrain,
            survey_texture(config),
            cameras.truth_from_world,
        )
        overlaps = overlaps_reached(workspace, truth)
        write_json(folder / "report.json", _report(cameras, surface, painted, overlaps))
        write_csv(
            folder / "cameras.csv",
            ("image", "north_error_m", "east_error_m", "down_error_m", "turn_deg"),
            (
                [name, *(f"{v:.6f}" for v in miss), f"{turn:.5f}"]
                for name, miss, turn in zip(
                    cameras.names, cameras.misses_m, cameras.turns_deg, strict=True
                )
            ),
        )
        plot_track(folder / "track.png", plan / "plan.json", cameras)
        plot_errors(folder / "errors.png", surface, area)
        plot_sheet(folder / "sheet.png", workspace, cameras, surface, area)

    return run_stage(workspace, stage, work)


def _report(
    cameras: CameraScore, surface: SurfaceScore, mosaic: MosaicScore, overlaps: dict[str, float]
) -> dict[str, Any]:
    return {
        "cameras": {
            "registered": cameras.registered,
            "total": cameras.total,
            "rms_mm": round(1e3 * cameras.rms_m, 3),
            "max_mm": round(1e3 * float(np.linalg.norm(cameras.misses_m, axis=1).max()), 3),
            "rms_north_east_down_mm": [
                round(1e3 * _rms(cameras.misses_m[:, axis]), 3) for axis in range(3)
            ],
            "attitude_rms_deg": round(_rms(cameras.turns_deg), 4),
            "scale_error_ppm": round(1e6 * cameras.scale_error, 1),
            "georeference_north_east_down_m": [round(float(m), 4) for m in cameras.georeference_m],
        },
        "surface": surface.to_json(),
        "mosaic": mosaic.to_json(),
        "overlaps": {name: round(value, 4) for name, value in overlaps.items()},
    }


def _rms(values: Array | NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
