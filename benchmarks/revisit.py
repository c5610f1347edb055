"""A survey with a hole, a strip of blur and a loose corner, before and after the planned dive.

    python -m benchmarks.revisit --work FOLDER

The survey (5 lines and a cross line over 4.5 x 3.6 m, at an eighth of the resolution) is flown and
rendered whole, then spoilt: pictures of a hole in its middle and around a corner are removed, those
of a strip are blurred over 31 pixels. It is reconstructed, revisited and joined with the pictures
of the planned dive; both models are scored against the truth in the same weak places.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from scipy.spatial.transform import RigidTransform

from alice_survey.app.pipeline import run, settings
from alice_survey.core.executor import local_executor
from alice_survey.core.manifest import read_manifest, write_manifest
from alice_survey.core.records import RegistrationRecord
from alice_survey.sim.seafloor.terrain import read_terrain
from missions.values.area import multipolygon
from missions.values.plan_file import read_plan
from reconstruct.elevation import elevation_in
from reconstruct.evaluate.run import score_cameras
from reconstruct.evaluate.scores import score_surface
from reconstruct.evaluate.truth import read_true_poses
from reconstruct.pictures.importing import join_dives
from reconstruct.placing.track import read_track_poses
from reconstruct.revisit.run import revisit_report

SURVEY = """
seed = 3
[area]
length_m = 4.5
width_m = 3.6
seafloor_depth_m = 12.0
[plan]
side_overlap = 0.45
[seafloor]
relief_m = 0.2
grid_m = 0.02
[imaging]
scale = 8
pool_views = 12
[reconstruct]
max_features = 1200
"""
HOLE = {*range(16, 21), *range(23, 28), *range(57, 61)}
STRIP = {*range(46, 53), 55}
AROUND_CORNER = {7, 8, 11, 12, 13}
BLUR_PX = 31
MODEL = ["mapping", "placing", "dense"]


def spoil(images: Path) -> None:
    """Remove and blur pictures of a survey."""
    records = read_manifest(images / "manifest.csv")
    for record in records:
        if record.station in STRIP:
            path = str(images / record.image)
            kernel = np.full((1, BLUR_PX), 1.0 / BLUR_PX)
            cv2.imwrite(path, cv2.filter2D(cv2.imread(path), -1, kernel))
    left = [r for r in records if r.station not in HOLE | AROUND_CORNER]
    write_manifest(images / "manifest.csv", left)


def figures_of(
    workspace: Path, truth: Path, poses: dict[str, RigidTransform], weak: Any
) -> dict[str, Any]:
    """How good a model is over the weak places and over the whole area."""
    plan = read_plan(workspace / "plan" / "plan.json")
    registered = RegistrationRecord.read(workspace / "sparse" / "registration.json")
    track = read_track_poses(workspace / "sparse" / "track.csv")
    cameras = score_cameras(track, poses, registered.total)
    terrain, elevation = read_terrain(truth / "terrain.ply"), elevation_in(workspace / "dense")
    found: dict[str, Any] = {
        "registered": [registered.registered, registered.total],
        "cameras_rms_mm": round(1e3 * cameras.rms_m, 2),
    }
    areas = {"weak": multipolygon(weak), "area": plan.area.survey}
    for name, area in areas.items():
        score = score_surface(elevation, area, terrain, cameras.truth_from_world, 1.0)
        found[name] = {
            "m2": round(area.area, 2),
            "completeness": round(score.completeness, 4),
            "height_rms_mm": round(1e3 * float(np.sqrt(np.mean(score.height_m**2))), 2),
            "height_95_mm": round(1e3 * float(np.percentile(np.abs(score.height_m), 95)), 2),
            "sigma_median_mm": round(1e3 * float(np.nanmedian(score.sigma_m)), 2),
        }
    return found


def main() -> None:
    """Run all, and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--work", type=Path, required=True, help="folder to work in")
    work: Path = parser.parse_args().work
    first, dive, both = work / "first", work / "first" / "revisit" / "dive", work / "both"
    executor = local_executor()
    if not (first / "images" / "manifest.csv").exists():
        first.mkdir(parents=True, exist_ok=True)
        (first / "survey.toml").write_text(SURVEY)
        run(["plan", "fly", "pool", "image", "calibrate"], first, None, executor=executor)
        spoil(first / "images")
    run(MODEL, first, None, executor=executor)
    config = settings(first, None, needed=True)
    text, before = revisit_report(first, config, executor)
    print(text)
    run(["fly", "image"], dive, first / "survey.toml", executor=executor)
    join_dives(both, [first, dive])
    run(MODEL, both, None, executor=executor)
    after_text, after = revisit_report(both, config, executor)
    print(after_text)
    shown = json.loads((first / "revisit" / "weak.geojson").read_text())["features"]
    datum = read_plan(first / "plan" / "plan.json").datum
    rings = shapely.union_all([shapely.geometry.shape(each["geometry"]) for each in shown])
    weak = shapely.transform(
        rings,
        lambda lon_lat: datum.ned_from_geodetic(
            np.column_stack([lon_lat[:, ::-1], np.zeros(len(lon_lat))])
        )[:, :2],
    )
    truth = first / "images" / "truth"
    own = read_true_poses(truth / "poses.csv")
    new = read_true_poses(dive / "images" / "truth" / "poses.csv")
    merged = {f"dive1/{name}": pose for name, pose in own.items()}
    merged |= {f"dive2/{name}": pose for name, pose in new.items()}
    found = {
        "before": {**figures_of(first, truth, own, weak), "revisit": _shares(before)},
        "after": {**figures_of(both, truth, merged, weak), "revisit": _shares(after)},
    }
    (work / "revisit.json").write_text(json.dumps(found, indent=1))
    shutil.copyfile(first / "revisit" / "weak.png", work / "weak.png")
    print(json.dumps(found, indent=1))


def _shares(report: dict[str, Any]) -> dict[str, Any]:
    names = ("covered_share", "share_at_overlap", "weak_m2")
    return {**{name: round(report[name], 4) for name in names}, "places": len(report["places"])}


if __name__ == "__main__":
    main()
