"""Speed of features, pairs and matches, beside COLMAP and beside simpler ways, in the same run.

    .venv/bin/python -m benchmarks.features PICTURE PICTURE...

Each time is the median of several alternating runs, so that a busy machine slows both alike.
Pictures named one after the other are matched.
"""

import itertools
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from alice_survey.config import SurveyConfig

Array = np.ndarray


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


def features(picture: Path) -> list[tuple[str, float, float]]:
    """Normalising a picture and finding features, against COLMAP's SIFT on the CPU."""
    import pycolmap

    from reconstruct.matching.features import find_features
    from reconstruct.pictures.normalise import normalise, read_deep

    pycolmap.logging.minloglevel = 2
    settings = SurveyConfig().reconstruct

    def ours() -> None:
        grey = normalise(read_deep(picture))
        find_features(grey, None, scale=settings.feature_scale, most=settings.max_features)

    with TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        options = pycolmap.FeatureExtractionOptions(use_gpu=False)

        def colmap() -> None:
            database.unlink(missing_ok=True)
            pycolmap.extract_features(
                database, picture.parent, [picture.name], extraction_options=options
            )

        times = compare(ours, colmap, 3)
    return [(f"features of {picture.name}: ours / COLMAP's on the CPU", times[0], times[1])]


def matches(first: Path, second: Path) -> list[tuple[str, float, float]]:
    """Matching with a narrowed search against all with all; then what alignment does."""
    from reconstruct.matching import matches as matching
    from reconstruct.matching.features import find_features, save_features
    from reconstruct.matching.refinement import affine_from_neighbours, align_coarser
    from reconstruct.pictures.normalise import normalise, read_deep

    most = SurveyConfig().reconstruct.max_features
    greys = [normalise(read_deep(path)) for path in (first, second)]
    found = [find_features(grey, None, scale=None, most=most) for grey in greys]
    with TemporaryDirectory() as folder:
        files = [Path(folder) / f"{k}.npz" for k in range(2)]
        for file, row in zip(files, found, strict=True):
            save_features(file, row)
        cameras = [
            f"PINHOLE {g.shape[1]} {g.shape[0]} 0 {1.2 * g.shape[1]} {1.2 * g.shape[1]} "
            f"{g.shape[1] / 2} {g.shape[0] / 2}"
            for g in greys
        ]
        task = matching.PairTask(
            first=files[0], second=files[1], ratio=0.8, cameras=(cameras[0], cameras[1])
        )
        worth = matching._WORTH_PROBING
        kept: dict[str, Array] = {}

        def narrowed() -> None:
            kept["narrowed"] = matching.match_pair(task).matches

        def full() -> None:
            matching._WORTH_PROBING = np.inf
            kept["full"] = matching.match_pair(task).matches
            matching._WORTH_PROBING = worth

        times = compare(narrowed, full, 3)
    pair = kept["narrowed"]
    name = f"{first.name} and {second.name}"
    counts = f"{len(pair)} / {len(kept['full'])} found"
    rows = [(f"matches of {name}: narrowed / all ({counts})", times[0], times[1])]
    if len(pair):
        at, guess = found[0].pixels[pair[:, 0]], found[1].pixels[pair[:, 1]]

        def align() -> None:
            affine = affine_from_neighbours(at, guess, at)
            kept["aligned"] = align_coarser(greys[0], greys[1], at, guess, affine)

        spent, _ = compare(align, lambda: None, 3)
        share = np.isfinite(kept["aligned"][:, 0]).mean()
        move = np.linalg.norm(kept["aligned"] - guess, axis=1)
        print(
            f"alignment of {name}: {1e3 * spent:.0f} ms, {1e6 * spent / len(pair):.0f} us a match, "
            f"{share:.0%} aligned, by a median of {np.nanmedian(move):.2f} px"
        )
    return rows


def growth() -> None:
    """Pairs of a picture in longer surveys, and in surveys that come back to a place."""
    from reconstruct.matching.pairs import choose_pairs
    from tests.reconstruct.scenes import DATUM, make_scene

    print("stations  visits  partners  coarse looks  choosing, ms a picture")
    for lines, stations, visits in [(5, 10, 1), (10, 10, 1), (10, 20, 1), (20, 20, 1), (5, 10, 8)]:
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


def main() -> None:
    """Print a row for each picture and each two in a row, then how pairs grow."""
    if not sys.argv[1:]:
        raise SystemExit("name one or more pictures")
    paths = [Path(name) for name in sys.argv[1:]]
    rows = [row for path in paths for row in features(path)]
    rows += [row for two in itertools.pairwise(paths) for row in matches(*two)]
    print(f"{'what':72} {'ours':>9} {'peer':>9}  ratio")
    for what, ours, peer in rows:
        print(f"{what:72} {1e3 * ours:7.1f}ms {1e3 * peer:7.1f}ms  {ours / peer:.3f}")
    growth()


if __name__ == "__main__":
    main()
