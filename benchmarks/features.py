"""Speed of features, pairs and matches, next to COLMAP and simpler ways, in the same run.

    .venv/bin/python -m benchmarks.features [--data FOLDER] [--quick] [--json FILE]

Each time is the median of several alternating runs, so that a busy machine slows both alike.
Two pictures of a real survey are matched. `--quick` takes one run of each and short surveys.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pycolmap

from alice_survey.core.config import SurveyConfig
from benchmarks.figures import Figure, Findings, add_options, hand_over
from benchmarks.machine import heading, machine

Array = np.ndarray
"""Lines, stations on each, and visits."""


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


def _beside(name: str, ours_s: float, peer: str, theirs_s: float) -> Figure:
    return Figure(name=name, value=1e3 * ours_s, unit="ms", peer=peer, peer_value=1e3 * theirs_s)


def features(picture: Path, runs: int) -> list[Figure]:
    """Normalising a picture and finding features, against COLMAP's SIFT on the CPU."""
    import pycolmap

    from reconstruct.matching.features import find_features
    from reconstruct.pictures.normalise import normalise, read_deep

    pycolmap.logging.minloglevel = 2
    settings = SurveyConfig().reconstruct

    def ours() -> None:
        grey = normalise(read_deep(picture))
        find_features(grey, None, maximum=settings.max_features)

    with TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        options = pycolmap.FeatureExtractionOptions(use_gpu=False)

        def colmap() -> None:
            database.unlink(missing_ok=True)
            pycolmap.extract_features(
                database, picture.parent, [picture.name], extraction_options=options
            )

        times = compare(ours, colmap, runs)
    return [_beside(f"features of {picture.name}", times[0], "COLMAP's on the CPU", times[1])]


def matches(first: Path, second: Path, runs: int) -> list[Figure]:
    """Matching with a narrowed search against all with all; then what alignment does."""
    from reconstruct.matching import matches as matching
    from reconstruct.matching.features import find_features, save_features
    from reconstruct.matching.refinement import affine_from_neighbours, align_coarser
    from reconstruct.pictures.normalise import normalise, read_deep

    maximum = SurveyConfig().reconstruct.max_features
    greys = [normalise(read_deep(path)) for path in (first, second)]
    found = [find_features(grey, None, maximum=maximum) for grey in greys]
    with TemporaryDirectory() as folder:
        files = [Path(folder) / f"{k}.npz" for k in range(2)]
        for file, row in zip(files, found, strict=True):
            save_features(file, row)
        one, other = (_pinhole(*grey.shape) for grey in greys)
        task = matching.PairTask(first=files[0], second=files[1], ratio=0.8, cameras=(one, other))
        worth = matching._WORTH_PROBING
        kept: dict[str, Array] = {}

        def narrowed() -> None:
            kept["narrowed"] = matching.match_pair(task).matches

        def full() -> None:
            matching._WORTH_PROBING = np.inf
            kept["full"] = matching.match_pair(task).matches
            matching._WORTH_PROBING = worth

        times = compare(narrowed, full, runs)
    pair = kept["narrowed"]
    name = f"{first.name} and {second.name}"
    rows = [
        _beside(f"matches of {name}, narrowed", times[0], "all with all", times[1]),
        Figure(
            name=f"matches of {name}, found", value=len(pair), unit="matches",
            peer="all with all", peer_value=len(kept["full"]),
        ),
    ]  # fmt: skip
    if len(pair):
        at, guess = found[0].pixels[pair[:, 0]], found[1].pixels[pair[:, 1]]

        def align() -> None:
            affine = affine_from_neighbours(at, guess, at)
            kept["aligned"] = align_coarser(greys[0], greys[1], at, guess, affine)

        spent, _ = compare(align, lambda: None, runs)
        share = np.isfinite(kept["aligned"][:, 0]).mean()
        move = np.linalg.norm(kept["aligned"] - guess, axis=1)
        where = f"alignment of {name}"
        rows += [
            Figure(name=f"{where}: time a match", value=1e6 * spent / len(pair), unit="us"),
            Figure(name=f"{where}: aligned", value=float(share), unit="1"),
            Figure(name=f"{where}: median move", value=float(np.nanmedian(move)), unit="px"),
        ]
    return rows


def _pinhole(height_px: int, width_px: int) -> dict[str, Any]:
    focal_px = 1.2 * width_px
    params = [focal_px, focal_px, width_px / 2, height_px / 2]
    camera = pycolmap.Camera(model="PINHOLE", width=width_px, height=height_px, params=params)
    fields: dict[str, Any] = camera.todict()
    return fields


def main() -> int:
    """Print a row for each picture and each two in a row, then how pairs grow."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="real pictures")
    add_options(parser, quick="one run of each, short surveys")
    options = parser.parse_args()
    about = machine(("numpy", "numba", "opencv-contrib-python-headless", "pycolmap"))
    print(f"{heading(about)}\n", flush=True)
    runs = 1 if options.quick else 3
    folder = options.data / ("opencv_stereo" if options.quick else "haltbrekken/left")
    pictures = sorted(path for path in folder.glob("*") if path.suffix.lower() in (".jpg", ".png"))
    missing = () if len(pictures) > 1 else (f"no pictures in {folder}",)
    figures = [figure for path in pictures[:2] for figure in features(path, runs)]
    if not missing:
        figures += matches(pictures[0], pictures[1], runs)
    return hand_over(options, about, Findings(figures=tuple(figures), left_out=missing))


if __name__ == "__main__":
    sys.exit(main())
