"""Rendered surveys, each with a calibration of its own, and their errors over what they state.

    .venv/bin/python -m benchmarks.draws --work FOLDER [--only KIND ...] [--seeds 5] [--quick]
        [--json FILE]

A survey has 10 to 15 stations at an eighth of the resolution. Its rig is built with errors of
manufacture; the program calibrates it in air and then in water, from corners that the rig as built
projects, with noise; its pictures are rendered, and reconstructed to the surface. FOLDER keeps
them, with a file for each that is done, and the next run goes on from there.

What cells share (the rig, above all) moves all heights of a survey: their median is compared with
what `covariance.npz` says of the mean of such motions too, and the scale with what it says of that.
A rig has some 30 parameters: of those of 20 right surveys, 8 lie beyond 2.5 of their sigmas.
"""

import json
import shutil
import sys
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import write_json
from alice_survey.core.config import load_config
from alice_survey.core.executor import SERIAL
from alice_survey.core.manifest import read_manifest
from alice_survey.sim.seafloor.as_built import true_rig
from alice_survey.sim.seafloor.terrain import read_terrain
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over, plain
from benchmarks.machine import commit
from benchmarks.reconstruct_surveys import demo_like
from camera_calib.rig import Rig, read_rig, write_rig
from missions.values.plan_file import read_plan
from reconstruct.adjustment.uncertainty import read_uncertainty
from reconstruct.elevation import elevation_in
from reconstruct.evaluate.figures import rms
from reconstruct.evaluate.run import score_cameras
from reconstruct.evaluate.scores import score_surface
from reconstruct.evaluate.truth import ground_pixel_m, read_true_poses
from reconstruct.placing.track import read_track_poses
from tests.camera_calib.calibration_scenes import errors_over_sigmas, rig_of_corners

_SCALE = 8
_GLASS = "glass_thickness_m = 0.006\nn_glass = 1.49\n"
_DOME = f'port = "dome"\ndome_radius_m = 0.08\n{_GLASS}'
KINDS = {
    "flat": (1.5, 1.3, ""),
    "tilted": (1.5, 1.3, "port_distance_m = 0.1\nport_tilt_deg = [2, 0]\n" + _GLASS),
    "dome": (1.5, 1.3, f"focal_mm = 16.75\ndome_centre_m = [0, 0, 0.005]\n{_DOME}"),
    "fisheye": (3.6, 3.2, f'focal_mm = 7.64\nlens = "fisheye"\n{_DOME}'),
}
"""Length and width of the area, and the camera."""
HEIGHT, MEAN, SCALE, SURFACE = (
    "median of height error over sigma", "median height error over the sigma of what cells share",
    "scale error over sigma", "surface, error over sigma",
)  # fmt: skip
RIG, BEFORE = "rig, error over sigma", "rig as calibrated, error over sigma"


def main() -> None:
    """Make the surveys that are missing, and judge all together."""
    parser = Parser(__doc__, quick="one survey of each kind", work="keeps the surveys")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=[*KINDS])
    parser.add_argument("--seeds", type=int, default=5, help="surveys of each kind")
    options, about = parser.begin("numpy", "numba", "pycolmap")
    rows, seeds, code = [], range(1 if options.quick else options.seeds), commit()
    for seed, kind in product(seeds, options.only):
        kept = options.work / f"{kind}-{seed}.json"
        if not kept.exists():
            began = time.process_time()
            row = survey(options.work / f"{kind}-{seed}", kind, seed)
            made = {"cpu_s": time.process_time() - began, "made": f"{datetime.now(UTC):%F %R}"}
            made |= {"commit": code, "processor": about["processor"]}
            write_json(kept, plain({"kind": kind, "seed": seed, **row, **made}))
        rows.append(json.loads(kept.read_text()))
        print({k: v for k, v in rows[-1].items() if not k.startswith("rig")}, flush=True)
    figures = _figures("all", rows, judged=not options.quick)
    for kind in options.only:
        figures += _figures(kind, [row for row in rows if row["kind"] == kind])
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures)), {"surveys": rows}))


def survey(workspace: Path, kind: str, seed: int) -> dict[str, Any]:
    """Make one and score it."""
    shutil.rmtree(workspace, ignore_errors=True)
    workspace.mkdir()
    length_m, width_m, camera = KINDS[kind]
    text = demo_like(length_m, width_m, _SCALE).replace("seed = 7", f"seed = {seed + 1}")
    text = text.replace("max_features = 3000", "max_features = 1500\nmask_moving = false")
    (workspace / "survey.toml").write_text(f"{text}\n[camera]\n{camera}")
    config = load_config(workspace / "survey.toml")
    for name in ("plan", "fly", "image"):
        spec(name).make(workspace, config, SERIAL)
    truth = true_rig(config.camera, config.water, scale=_SCALE, seed=config.seed)
    rig = rig_of_corners(truth, config.camera, seed, [*KINDS].index(kind))
    write_rig(workspace / "calibration" / "rig.json", rig)
    for name in ("mapping", "placing", "dense"):
        spec(name).make(workspace, config, SERIAL)
    return scores(workspace, rig)


def scores(workspace: Path, before: Rig) -> dict[str, Any]:
    """Errors of a reconstruction, in its sigmas."""
    truth = workspace / "images" / "truth"
    rig, poses = read_rig(truth / "rig.json"), read_true_poses(truth / "poses.csv")
    records = read_manifest(workspace / "images" / "manifest.csv")
    terrain = read_terrain(truth / "terrain.ply")
    track = read_track_poses(workspace / "sparse" / "track.csv")
    cameras = score_cameras(track, poses, len(records))
    pixel_m = ground_pixel_m(rig, {r.image: r.camera for r in records}, poses, terrain)
    area = read_plan(workspace / "plan" / "plan.json").area.survey
    dense = elevation_in(workspace / "dense")
    surface = score_surface(dense, area, terrain, cameras.truth_from_world, pixel_m)
    shared = read_uncertainty(workspace / "sparse" / "covariance.npz").shared
    assert shared is not None
    arms = (shared.places - shared.places.mean(axis=0)) * [1.0, 1.0, 0.0]
    by_height = shared.motions[:, 2].mean(axis=0)
    by_scale = np.einsum("ni,nik->k", arms / (arms**2).sum(), shared.motions)
    height_m, ratio = surface.height_m, surface.height_m / surface.sigma_m
    after = read_rig(workspace / "sparse" / "rig.json")
    return {
        "pictures": len(track), "of": len(records),
        HEIGHT: np.nanmedian(ratio),
        MEAN: np.nanmedian(height_m) / _sigma(by_height, shared.covariance),
        SCALE: cameras.scale_error / _sigma(by_scale, shared.covariance),
        SURFACE: rms(ratio[np.isfinite(ratio)]),
        "median height error mm": 1e3 * np.nanmedian(height_m),
        "scale error ppm": 1e6 * cameras.scale_error,
        "scale sigma ppm": 1e6 * _sigma(by_scale, shared.covariance),
        "surface rms mm": 1e3 * rms(surface.distance_m), "pixel mm": 1e3 * pixel_m,
        BEFORE: errors_over_sigmas(before, rig), RIG: errors_over_sigmas(after, rig),
    }  # fmt: skip


def _sigma(by_each: Any, covariance: Any) -> float:
    return float(np.sqrt(by_each @ covariance @ by_each))


def _figures(kind: str, rows: list[Mapping[str, Any]], *, judged: bool = False) -> list[Figure]:
    """What surveys of a kind, or all, come to."""
    rig, before = (np.array([z for r in rows for z in r[of].values()]) for of in (RIG, BEFORE))
    one = {what: np.array([row[what] for row in rows]) for what in (HEIGHT, MEAN, SCALE, SURFACE)}
    near, height = Goal(minimum=0.8, maximum=1.25), Goal(minimum=-0.3, maximum=0.3)
    values: list[tuple[str, float, Goal | None]] = [
        (f"{HEIGHT}, mean", np.mean(one[HEIGHT]), height),
        *((f"{what}, rms", rms(one[what]), near) for what in (MEAN, SCALE, SURFACE)),
        (f"{BEFORE}, rms", rms(before), None),
        (f"{RIG}, rms", rms(rig), near),
        (f"{RIG}, largest", np.abs(rig).max(), Goal(maximum=2.5)),
        (f"{RIG}, share beyond 2.5", np.mean(np.abs(rig) > 2.5), None),
    ]
    return [
        Figure(name=f"{kind}, {what}", value=float(value), unit="", goal=goal if judged else None)
        for what, value, goal in values
    ]


if __name__ == "__main__":
    main()
