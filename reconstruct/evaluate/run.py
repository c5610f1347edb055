"""Score a reconstruction of a simulated survey against its truth.

Cameras are compared after a rigid alignment: the scale comes from the rig and is not fitted. The
surface is moved by the same alignment and compared with the terrain's mesh, cell by cell, outliers
included; the mosaic is compared with the true sea floor painted at the same places.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from alice_survey.core.artefacts import read_stage, write_csv
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.manifest import read_manifest
from alice_survey.core.products import ERROR
from alice_survey.core.records import RegistrationRecord, ScoreRecord
from alice_survey.sim.seafloor.terrain import read_terrain
from alice_survey.sim.seafloor.texture import survey_texture
from camera_calib.rig import read_rig
from missions.values.plan_file import read_plan
from reconstruct.evaluate.cameras import CameraScore, score_cameras
from reconstruct.evaluate.elevation import elevation_in
from reconstruct.evaluate.figures import compare_lengths
from reconstruct.evaluate.mesh import read_mesh, score_mesh
from reconstruct.evaluate.mosaic import score_mosaic
from reconstruct.evaluate.overlap import overlaps_reached
from reconstruct.evaluate.plots import plot_errors, plot_sheet, plot_track
from reconstruct.evaluate.surface import score_surface
from reconstruct.evaluate.truth import count_stations, ground_pixel_m, read_true_poses
from reconstruct.placing.track import read_track_poses

_SEED_STREAM = 6100


def run_evaluate(workspace: Path, folder: Path, executor: Executor, *, seed: int) -> None:
    """Score what `reconstruct` made of a simulated survey."""
    folders = ("plan", "images", "sparse", "dense", "mosaic", "mesh")
    plan, images, sparse, dense, mosaic, mesh = (workspace / name for name in folders)
    truth = images / "truth"
    flown = read_plan(plan / "plan.json")
    area = flown.area.survey
    terrain = read_terrain(truth / "terrain.ply")
    rig, poses = read_rig(truth / "rig.json"), read_true_poses(truth / "poses.csv")
    records = read_manifest(images / "manifest.csv")
    total = RegistrationRecord.read(sparse / "registration.json").total
    track = read_track_poses(sparse / "track.csv")
    cameras = score_cameras(track, poses, total)
    moved = cameras.truth_from_world
    pixel_m = ground_pixel_m(rig, {r.image: r.camera for r in records}, poses, terrain)
    counter = partial(
        count_stations,
        rig=rig,
        pictures={r.image: (r.camera, r.station) for r in records},
        poses=poses,
        terrain=terrain,
    )
    surface = score_surface(elevation_in(dense), area, terrain, moved, pixel_m, counter)
    painted = score_mosaic(
        mosaic / "mosaic.tif", dense / "dem.tif", area, terrain, survey_texture(seed), moved
    )
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
    plot_track(folder / "track.png", flown, cameras)
    plot_errors(folder / "errors.png", surface, area)
    plot_sheet(folder / "sheet.png", workspace, cameras, surface, area)


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
                cameras.names, cameras.misses_m, cameras.turns_deg, strict=True
            )
        ),
    )
