"""Rendered surveys of any number of pictures, and how accurate models of them are."""

import csv
import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import rasterio

from alice_survey.base.artefacts import read_stage, write_csv
from alice_survey.base.frames import Array
from alice_survey.seafloor.terrain import Terrain, read_terrain
from benchmarks.measured import python
from reconstruct.evaluate.figures import rms
from reconstruct.evaluate.truth import read_true_poses, surface_distance
from reconstruct.placing.alignment import Similarity, align_rigid, align_similarity
from reconstruct.placing.track import read_track_poses
from reconstruct.views.model import read_model

_SIMULATED = ("plan", "fly", "image", "calibrate")
_CELLS = 300_000


def render(workspace: Path, survey: str) -> None:
    """Plan, fly, take pictures of and calibrate a simulated survey; what is done is skipped."""
    workspace.mkdir(parents=True, exist_ok=True)
    settings = workspace / "survey.toml"
    if not settings.exists() or settings.read_text() != survey:
        settings.write_text(survey)
    for command in _SIMULATED:
        subprocess.run(
            python("-m", "alice_survey", command, "-w", str(workspace)),
            check=True,
            stdout=subprocess.DEVNULL,
        )


def survey_toml(pictures: int, scale: int) -> str:
    """Settings of a survey like the demo's that gives at least a number of pictures.

    Args:
        pictures: of both cameras.
        scale: divides the camera's resolution.
    """
    side = (1.1 * pictures / 116) ** 0.5  # the demo has 116 pictures of 4.5 x 3.7 m; and a margin
    return demo_like(4.5 * side + 0.6, 3.7 * side + 0.6, scale)


def demo_like(length_m: float, width_m: float, scale: int = 4) -> str:
    """Settings of the demo, over an area of another size."""
    text = (resources.files("alice_survey") / "demo.toml").read_text()
    for name, value in (("length_m", length_m), ("width_m", width_m), ("scale", scale)):
        text, count = re.subn(rf"(?m)^{name} = .*$", f"{name} = {value:.6g}", text)
        assert count == 1, name
    return text


def subset(whole: Path, part: Path, pictures: int) -> Path:
    """The first stations of a survey as a workspace of its own, its pictures linked.

    Args:
        whole: workspace whose pictures are rendered.
        part: to make; emptied first.
        pictures: of both cameras; an even number.

    Returns:
        `part`.

    Raises:
        SystemExit: the survey has fewer pictures.
    """
    if part.exists():
        shutil.rmtree(part)
    images = part / "images"
    images.mkdir(parents=True)
    with (whole / "images" / "manifest.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    if len(rows) < pictures:
        raise SystemExit(f"{whole} has {len(rows)} pictures; {pictures} are requested")
    stations = sorted({int(row["station"]) for row in rows})[: pictures // 2]
    rows = [row for row in rows if int(row["station"]) in set(stations)]
    write_csv(images / "manifest.csv", list(rows[0]), ([*row.values()] for row in rows))
    for row in rows:
        target = images / row["image"]
        target.parent.mkdir(exist_ok=True)
        os.link((whole / "images" / row["image"]).resolve(), target)
    for name in ("survey.json", "stage.json"):
        shutil.copyfile(whole / "images" / name, images / name)
    (images / "truth").symlink_to((whole / "images" / "truth").resolve())
    for stage in ("plan", "calibration"):
        if read_stage(whole / stage) is not None:
            (part / stage).symlink_to((whole / stage).resolve())
    shutil.copyfile(whole / "survey.toml", part / "survey.toml")
    return part


def pictures_of(workspace: Path, folder: Path) -> Path:
    """The pictures alone, linked into a folder for programs that read all files of one."""
    with (workspace / "images" / "manifest.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            target = folder / row["image"]
            target.parent.mkdir(parents=True, exist_ok=True)
            os.link((workspace / "images" / row["image"]).resolve(), target)
    return folder


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Millimetres after alignment to the true camera positions; NaN where there is nothing."""

    registered: int
    cameras_mm: float
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
    return _accuracy(len(names), pose.apply(found) - target, points, cells)


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
    return _accuracy(len(names), pose.apply(found) - target, points, cells)


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


def _accuracy(registered: int, misses_m: Array, points: Array, cells: Array) -> Accuracy:
    def median(values: Array) -> float:
        return float(np.median(values)) if len(values) else float("nan")

    return Accuracy(
        registered=registered,
        cameras_mm=1e3 * float(np.sqrt((misses_m**2).sum(axis=1).mean())),
        points_mm=rms(points),
        points_median_mm=median(points),
        surface_mm=rms(cells),
        surface_median_mm=median(cells),
    )
