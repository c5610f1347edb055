"""Score a reconstruction of a simulated survey against its truth.

Cameras are compared after a rigid alignment: the scale comes from the rig and is not fitted. The
surface is moved by the same alignment and compared with the terrain's mesh, cell by cell, outliers
included; the mosaic is compared with the true sea floor painted at the same places.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from scipy.spatial.transform import RigidTransform
from shapely.geometry import MultiPolygon

from alice_survey.core.artefacts import read_stage, write_csv
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.manifest import read_manifest
from alice_survey.core.products import ERROR
from alice_survey.core.records import RegistrationRecord, ScoreRecord
from alice_survey.core.run import progress
from alice_survey.kit.figure import even_limit, figure_style, new_figure, save_figure
from alice_survey.sim.seafloor.terrain import read_terrain
from alice_survey.sim.seafloor.texture import survey_texture
from camera_calib.rig import read_rig
from missions.values.plan_file import read_plan
from reconstruct.elevation import elevation_in
from reconstruct.evaluate.figures import compare_lengths, map_errors, rms
from reconstruct.evaluate.scores import (
    SurfaceScore,
    read_mesh,
    score_mesh,
    score_mosaic,
    score_surface,
)
from reconstruct.evaluate.truth import ground_pixel_m, overlaps_reached, read_true_poses
from reconstruct.placing.alignment import align_rigid, align_similarity
from reconstruct.placing.track import read_track_poses


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraScore:
    """How well the cameras were placed."""

    registered: int
    total: int
    truth_from_world: RigidTransform
    """The rigid alignment; the surface and the mosaic are moved by it too."""
    names: tuple[str, ...]
    errors_m: Array
    """(N, 3) aligned minus true position, north, east, down."""
    turns_deg: Array
    """(N,) angle between aligned and true attitude."""
    scale_error: float
    """Scale of a similarity alignment minus one, sign as of the model: positive when too large."""
    georeference_m: Array
    """(3,) mean miss before the alignment, north, east, down."""

    @property
    def rms_m(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt((self.errors_m**2).sum(axis=1).mean()))

    def to_json(self) -> dict[str, Any]:
        """Figures in millimetres, degrees and parts per million."""
        return {
            "registered": self.registered,
            "total": self.total,
            "rms_mm": round(1e3 * self.rms_m, 3),
            "max_mm": round(1e3 * float(np.linalg.norm(self.errors_m, axis=1).max()), 3),
            "rms_north_east_down_mm": [
                round(1e3 * rms(self.errors_m[:, axis]), 3) for axis in range(3)
            ],
            "attitude_rms_deg": round(rms(self.turns_deg), 4),
            "scale_error_ppm": round(1e6 * self.scale_error, 1),
            "georeference_north_east_down_m": [round(float(m), 4) for m in self.georeference_m],
        }


@progress.step("score the cameras")
def score_cameras(
    estimated: Mapping[str, RigidTransform], truth: Mapping[str, RigidTransform], total: int
) -> CameraScore:
    """Compare entrance pupils with the true poses of a simulated survey.

    Args:
        estimated: `world_from_cam` by picture, in metres.
        truth: `ned_from_cam` by picture.
        total: how many pictures there are.

    Raises:
        WorkspaceError: fewer than three pictures are registered.
    """
    names = tuple(sorted(estimated))
    if len(names) < 3:
        raise WorkspaceError(f"{len(names)} registered pictures; 3 or more are needed to align")
    found = np.stack([estimated[name].translation for name in names])
    true = np.stack([truth[name].translation for name in names])
    alignment = align_rigid(found, true)
    similarity = align_similarity(found, true)
    turns = [
        (truth[n].rotation.inv() * alignment.rotation * estimated[n].rotation).magnitude()
        for n in names
    ]
    return CameraScore(
        registered=len(names),
        total=total,
        truth_from_world=alignment,
        names=names,
        errors_m=alignment.apply(found) - true,
        turns_deg=np.rad2deg(turns),
        scale_error=1.0 / similarity.scale - 1.0,
        georeference_m=(found - true).mean(axis=0),
    )


_SEED_STREAM = 6100


def run_evaluate(workspace: Path, folder: Path, executor: Executor, *, seed: int) -> None:
    """Score what `reconstruct` made of a simulated survey."""
    images, sparse, dense, mesh = (
        workspace / name for name in ("images", "sparse", "dense", "mesh")
    )
    truth = images / "truth"
    flown = read_plan(workspace / "plan" / "plan.json")
    area = flown.area.survey
    terrain = read_terrain(truth / "terrain.ply")
    rig, poses = read_rig(truth / "rig.json"), read_true_poses(truth / "poses.csv")
    records = read_manifest(images / "manifest.csv")
    total = RegistrationRecord.read(sparse / "registration.json").total
    cameras = score_cameras(read_track_poses(sparse / "track.csv"), poses, total)
    moved = cameras.truth_from_world
    pixel_m = ground_pixel_m(rig, {r.image: r.camera for r in records}, poses, terrain)
    heights = elevation_in(dense)
    surface = score_surface(heights, area, terrain, moved, pixel_m)
    mosaic, texture = workspace / "mosaic" / "mosaic.tif", survey_texture(seed)
    painted = score_mosaic(mosaic, heights, area, terrain, texture, moved)
    rng = np.random.default_rng([seed, _SEED_STREAM])
    score: dict[str, Any] = {
        "cameras": cameras.to_json(),
        "surface": surface.to_json(),
        "mosaic": painted.to_json(),
        "lengths": compare_lengths(painted.points_world, painted.points_true, rng),
    }
    if read_stage(mesh) is not None:
        score["mesh"] = score_mesh(*read_mesh(mesh), area, terrain, moved, pixel_m, rng)
    triggers = workspace / "flight" / "triggers.csv"
    overlaps = overlaps_reached(triggers, flown, rig, records, poses)
    score["overlaps"] = {name: round(value, 4) for name, value in overlaps.items()}
    ScoreRecord.save(folder / "score.json", score)
    write_cameras(folder / "cameras.csv", cameras)
    _write_errors(folder / ERROR.path.name, dense / "dem.tif", surface.map_m)
    plot_errors(folder / "errors.png", surface, area)


def _write_errors(path: Path, dem: Path, errors: Array) -> None:
    """Height minus the true height, on the DEM's own grid."""
    with rasterio.open(dem) as source:
        profile = source.profile
    with rasterio.open(path, "w", **profile) as raster:
        raster.write(errors.astype(np.float32), 1)
        raster.set_band_description(1, ERROR.band)


def write_cameras(path: Path, cameras: CameraScore) -> None:
    """Write the errors of every camera after the rigid alignment."""
    write_csv(
        path,
        ("image", "north_error_m", "east_error_m", "down_error_m", "turn_deg"),
        (
            [name, *(f"{v:.6f}" for v in miss), f"{turn:.5f}"]
            for name, miss, turn in zip(
                cameras.names, cameras.errors_m, cameras.turns_deg, strict=True
            )
        ),
    )


@progress.step("draw the errors")
@figure_style()
def plot_errors(path: Path, surface: SurfaceScore, area: MultiPolygon) -> None:
    """Map and histogram of height errors of the surface."""
    figures = surface.to_json()
    limit = max(5.0, 3 * figures["height_median_mm"], figures["height_95_mm"])
    shown = even_limit(1e3 * surface.map_m)
    west, east, south, north = surface.extent_m
    figure = new_figure(5.5 * min(max(0.9 * (north - south) / (east - west), 1.0), 1.7), 11.0)
    plane, bars = figure.subplots(1, 2, width_ratios=[1.3, 1])
    map_errors(
        plane, 1e3 * surface.map_m, shown, "Surface minus truth", "height error (mm)",
        extent=surface.extent_m, cmap="PuOr",
    )  # fmt: skip
    for part in area.geoms:
        for ring in (part.exterior, *part.interiors):
            ring_ne = np.asarray(ring.coords)
            plane.plot(ring_ne[:, 1], ring_ne[:, 0], "k--", linewidth=1)
    bars.hist(1e3 * surface.height_m, bins=np.linspace(-4 * limit, 4 * limit, 161), log=True)
    bars.set(xlabel="height error (mm)", ylabel="cells")
    bars.set_title(f"rms {figures['height_rms_mm']:.2f} mm; {surface.completeness:.1%} complete")
    save_figure(figure, path)
