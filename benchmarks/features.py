"""Speed of features, pairs and matches, next to COLMAP and simpler ways, in the same run.

    .venv/bin/python -m benchmarks.features PICTURE PICTURE... [--quick] [--json FILE]

Each time is the median of several alternating runs, so that a busy machine slows both alike.
Pictures named one after the other are matched. `--quick` takes one run of each and short surveys.
"""

import argparse
import itertools
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pycolmap

from alice_survey.core.config import SurveyConfig
from benchmarks.figures import Figure, Findings, add_options, hand_over
from benchmarks.machine import heading, machine

Array = np.ndarray
_SURVEYS = [(5, 10, 1), (10, 10, 1), (10, 20, 1), (20, 20, 1), (5, 10, 8)]
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
        print(
            f"alignment of {name}: {1e3 * spent:.0f} ms, {1e6 * spent / len(pair):.0f} us a match, "
            f"{share:.0%} aligned, by a median of {np.nanmedian(move):.2f} px"
        )
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


def growth(surveys: list[tuple[int, int, int]]) -> list[Figure]:
    """Pairs of a picture in longer surveys, and in surveys that come back to a place."""
    from reconstruct.matching.pairs import choose_pairs
    from tests.reconstruct.scenes import DATUM, make_scene

    figures = []
    print("stations  visits  partners  coarse looks  choosing, ms a picture")
    for lines, stations, visits in surveys:
        scenes = [make_scene(lines=lines, stations=stations, points=1, seed=k)
                  for k in range(visits)]  # fmt: skip
        records = [
            replace(r, station=r.station + 10_000 * k, image=f"{k}/{r.image}")
            for k, scene in enumerate(scenes)
            for r in scene.records
        ]
        started = time.perf_counter()
        sure, maybe = choose_pairs(records, scenes[0].rig, DATUM)
        spent = time.perf_counter() - started
        print(
            f"{lines * stations * visits:8}{visits:8}{2 * len(sure) / len(records):10.1f}"
            f"{2 * len(maybe) / len(records):14.1f}{1e3 * spent / len(records):14.2f}"
        )
        where = f"{lines * stations * visits} stations in {visits} visits"
        count = len(records)
        figures += [
            Figure(name=f"{where}: partners of a picture", value=2 * len(sure) / count, unit="1"),
            Figure(name=f"{where}: coarse looks", value=2 * len(maybe) / count, unit="1"),
            Figure(name=f"{where}: choosing, a picture", value=1e3 * spent / count, unit="ms"),
        ]
    return figures


def main() -> int:
    """Print a row for each picture and each two in a row, then how pairs grow."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("pictures", nargs="+", type=Path, metavar="PICTURE")
    add_options(parser, quick="one run of each, short surveys")
    options = parser.parse_args()
    about = machine(("numpy", "numba", "opencv-contrib-python-headless", "pycolmap"))
    print(f"{heading(about)}\n", flush=True)
    runs = 1 if options.quick else 3
    figures = [figure for path in options.pictures for figure in features(path, runs)]
    for first, second in itertools.pairwise(options.pictures):
        figures += matches(first, second, runs)
    print(f"{'what':48} {'ours':>9} {'peer':>20} {'its':>9}  ratio")
    for row in figures:
        if row.peer is not None:
            print(f"{row.name:48} {row.value:9.1f} {row.peer:>20} {row.peer_value:9.1f}  "
                  f"{row.ratio:.3f}")  # fmt: skip
    figures += growth(_SURVEYS[:2] if options.quick else _SURVEYS)
    return hand_over(options, about, Findings(figures=tuple(figures)))


if __name__ == "__main__":
    sys.exit(main())
