"""Speed of feature extraction beside COLMAP's on the CPU, measured in the same run.

    .venv/bin/python -m benchmarks.features PICTURE...

Each row is the median of several alternating runs, so that a busy machine slows both alike.
"""

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
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
    from reconstruct.pictures.normalise import normalise

    settings = SurveyConfig().reconstruct

    def ours() -> None:
        colour = cv2.imread(str(picture))
        grey = normalise(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))
        find_features(grey, None, scale=1.0, most=settings.max_features)

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


def main() -> None:
    """Print a row for each picture."""
    if not sys.argv[1:]:
        raise SystemExit("name one or more pictures")
    rows = [row for path in sys.argv[1:] for row in features(Path(path))]
    print(f"{'what':62} {'ours':>9} {'peer':>9}  ratio")
    for what, ours, peer in rows:
        print(f"{what:62} {1e3 * ours:7.1f}ms {1e3 * peer:7.1f}ms  {ours / peer:.3f}")


if __name__ == "__main__":
    main()
