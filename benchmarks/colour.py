"""Colours of the mosaic against the true reflectance, and against published corrections.

    .venv/bin/python -m benchmarks.colour --work FOLDER [--quick] [--json FILE]
        [--water II 3C] [--relief 1.2 0.35] [--only METHOD ...]

A survey with strobes, 2 m above strong relief and above as little as the demo's, is rendered in
clear and in coastal water; model and surface are the truth. Each method paints the mosaic; the
peers correct the pictures first, which are then painted as they are. Where the mosaic is whole over
a cell of 4 x 4 pixels, its mean linear light is compared with the mean reflectance by CIEDE2000
(white D65), after one factor of brightness, the same for all cells and channels, is fitted to it.
"at true L" gives both the same luminance: it leaves out shade and slope, which no method takes
away. "water, card" knows a grey card of two patches from one picture. Pictures in FOLDER are kept.
"""

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import write_csv
from alice_survey.core.config import ReconstructConfig, SurveyConfig
from alice_survey.core.executor import local_executor
from alice_survey.core.frames import Array
from benchmarks.colour_difference import delta_e_2000, lab_from_rgb
from benchmarks.colour_peers import grey_world, sea_thru
from benchmarks.colour_survey import ColourSurvey, card_rows, from_above, write_survey
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from reconstruct.mosaic.picture_measures import encode_srgb, linear_table

PIXEL_M, CELL_PX = 0.004, 4
OURS = ("raw", "even", "water")
PEERS = {"grey world": grey_world, "sea-thru": sea_thru}
CARD = "water, card"
METHODS = (*OURS, CARD, *PEERS)
_GOAL = Goal(maximum=0.5, of="ratio")
_MIDDLE = 0.2
"""Median light to which a peer's pictures are brought before they are written in eight bits."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Of a mosaic from the truth."""

    median: float
    percentile_90: float
    median_at_true_lightness: float


def compared(shown: Array, true: Array) -> Difference:
    """CIEDE2000 of linear light (N, 3), red, green, blue, from reflectances."""
    lab = lab_from_rgb(true)

    def off(log_factor: float) -> float:
        return float(np.median(delta_e_2000(lab_from_rgb(np.exp(log_factor) * shown), lab)))

    start = float(np.log(true.mean() / shown.mean()))
    factor = np.exp(minimize_scalar(off, bounds=(start - 1, start + 1), method="bounded").x)
    found = lab_from_rgb(factor * shown)
    # the same colour at the true lightness: light scaled to the true luminance
    weights = np.array([0.2126, 0.7152, 0.0722])
    level = shown * ((true @ weights) / np.maximum(shown @ weights, 1e-6))[:, None]
    each = delta_e_2000(found, lab)
    return Difference(
        median=float(np.median(each)),
        percentile_90=float(np.percentile(each, 90)),
        median_at_true_lightness=float(np.median(delta_e_2000(lab_from_rgb(level), lab))),
    )


def judge(mosaic: Path, survey: ColourSurvey, clip: Path) -> Difference:
    """Compare a mosaic's cells with the truth, and write both side by side."""
    with rasterio.open(mosaic / "mosaic.tif") as raster:
        picture, at = raster.read(), raster.transform
    rows, columns = (n // CELL_PX * CELL_PX for n in picture.shape[1:])
    row, column = np.mgrid[:rows, :columns] + 0.5
    points, material = from_above(survey.scene.terrain, at.f + row * at.e, at.c + column * at.a)
    texture = survey.texture
    flat = points.reshape(-1, 3)
    true = texture.albedo(flat, material.ravel(), np.full(len(flat), at.a, np.float32))
    beside = texture.on_card(flat).reshape(rows, columns) < 0
    light = linear_table()[picture[:3, :rows, :columns]].transpose(1, 2, 0)
    whole = _cells((picture[3, :rows, :columns] > 0)[..., None] & beside[..., None]) == 1
    shown, wanted = _cells(light), _cells(true.reshape(rows, columns, 3))
    known = whole[..., 0]
    found = compared(shown[known].astype(np.float64), wanted[known].astype(np.float64))
    both = np.concatenate([light, true.reshape(rows, columns, 3) * (light.mean() / true.mean())], 1)
    cv2.imwrite(str(clip), np.clip(encode_srgb(both), 0, 255).astype(np.uint8)[..., ::-1])
    return found


def _cells(values: NDArray[Any]) -> Array:
    """Means over cells."""
    rows, columns, channels = values.shape
    parts = values.reshape(rows // CELL_PX, CELL_PX, columns // CELL_PX, CELL_PX, channels)
    found: Array = parts.mean(axis=(1, 3))
    return found


def paint(base: Path, survey: ColourSurvey, method: str, folder: Path) -> Path:
    """Make the mosaic of a method; return its folder."""
    shutil.rmtree(folder, ignore_errors=True)
    for part in ("images", "sparse", "dense"):
        shutil.copytree(base / part, folder / part)
    if method in PEERS:
        pictures = [linear_table()[cv2.imread(str(base / "images" / n))] for n in survey.images]
        ranges = [np.load(path) for path in sorted(base.glob("range*.npy"))]
        for name, light in zip(survey.images, PEERS[method](pictures, ranges), strict=True):
            bright = light * (_MIDDLE / np.median(light)) if method != "grey world" else light
            levels = np.clip(np.rint(encode_srgb(bright.astype(np.float32))), 0, 255)
            cv2.imwrite(str(folder / "images" / name), levels.astype(np.uint8))
    if method == CARD:
        header = ("image", "x", "y", "radius_px", "red", "green", "blue")
        write_csv(folder / "colour_reference.csv", header, card_rows(survey))
    colour: Any = "raw" if method in PEERS else method.split(",")[0]
    reconstruct = ReconstructConfig(colour=colour, mosaic_pixel_m=PIXEL_M)
    spec("mosaic").make(folder, SurveyConfig(reconstruct=reconstruct), local_executor())
    return folder / "mosaic"


def measure(work: Path, survey: ColourSurvey, methods: Sequence[str]) -> dict[str, Difference]:
    """Render a survey, if it is not there, and judge methods."""
    where = f"{survey.jerlov}-{survey.relief_m:g}"
    base = work / f"survey-{where}-{len(survey.poses)}"
    write_survey(base, survey, local_executor())
    found = {}
    for method in methods:
        name = f"{where}-{method.replace(', ', '-').replace(' ', '-')}"
        mosaic = paint(base, survey, method, work / name)
        found[method] = judge(mosaic, survey, work / f"{name}.png")
        print(f"{where}, {method}: painted", flush=True)
    return found


def figures(where: str, found: Mapping[str, Difference], *, quick: bool) -> tuple[Figure, ...]:
    """Median differences, those of ours next to the better peer's."""
    best = min((one.median, name) for name, one in found.items() if name in PEERS) if (
        set(PEERS) & set(found)
    ) else None  # fmt: skip
    made = []
    for method, one in found.items():
        rival = None if method in PEERS else best
        goal = _GOAL if rival and method in ("water", CARD) and not quick else None
        for what, value in (
            ("90 % dE2000", one.percentile_90),
            ("median dE2000 at the true lightness", one.median_at_true_lightness),
        ):
            made.append(Figure(name=f"{where}, {method}: {what}", value=value, unit=""))
        name = f"{where}, {method}: median dE2000"
        peer_value, peer = rival or (None, None)
        made.append(
            Figure(
                name=name, value=one.median, unit="", peer=peer, peer_value=peer_value, goal=goal
            )
        )
    return tuple(made)


def main() -> int:
    """Print a row for each water and method."""
    parser = Parser(
        __doc__,
        quick="two lines of six pictures in the first water",
        work="keeps pictures and mosaics",
    )
    parser.add_argument("--water", nargs="+", default=["II", "3C"], help="Jerlov types")
    parser.add_argument("--relief", nargs="+", type=float, default=[1.2, 0.35], help="metres")
    parser.add_argument("--only", nargs="+", default=METHODS, choices=METHODS)
    options, about = parser.begin("numpy", "opencv-contrib-python-headless")
    findings = Findings()
    cases = [(jerlov, relief_m) for relief_m in options.relief for jerlov in options.water]
    for jerlov, relief_m in cases[:1] if options.quick else cases:
        lines, stations = (2, 6) if options.quick else (5, 11)
        survey = ColourSurvey(jerlov=jerlov, relief_m=relief_m, lines=lines, stations=stations)
        found = measure(options.work, survey, options.only)
        where = f"{jerlov}, relief {relief_m:g} m"
        findings += Findings(figures=figures(where, found, quick=options.quick))
    return hand_over(options, about, findings)


if __name__ == "__main__":
    sys.exit(main())
