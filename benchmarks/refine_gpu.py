"""Depth refined on the GPU, next to the processor that does the same, in the same run.

    python -m benchmarks.refine_gpu [--megapixels 0.6 2.3] [--quick] [--json FILE]

A wavy sea floor is seen by seven cameras behind tilted ports, and the depth of one of them is wrong
by pixels. Both refine it from the other six; times are the median of runs that alternate, after one
run each to warm up. Disparities must agree within 0.001 px but for single
pixels. The processor's time is that of one of
its cores. As many processes as there are cores then refine views at the same time, as they do in
the dense stage.
"""

import os
import pickle
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from alice_survey.app.commands.base import is_gpu_chosen
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from reconstruct.dense.refine_depth import ComparedView, Float32, RefinedDepth, prepare, refine
from reconstruct.views.model import View, scaled_view
from tests.oracles_dense import Scene, hits, port_view, speckle

_CENTRES = [
    (0.2, 0.3, 10.0), (0.2, 0.5, 10.0), (0.45, 0.3, 10.0), (0.2, 0.1, 10.02), (-0.05, 0.3, 9.98),
    (0.45, 0.5, 10.0), (0.2, 0.4, 10.0),
]  # fmt: skip
_WAVES = 6.0
_WRONG_PX, _WRONG_OVER_PX = 1.0, 40.0
_MAX_APART_PX, _MAX_PX = 1e-3, 0.1
"""Where rounding decides whether a window gets a second round, results differ by more."""
_FULL_MEGAPIXELS = 3384 * 2710 / 1e6
_PORT_VIEW_SCALE = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """What is refined."""

    reference: ComparedView
    depth: Float32
    sigma: Float32
    others: Sequence[ComparedView]

    @property
    def px_per_inverse_m(self) -> float:
        """Pixels of disparity for a unit of inverse depth, by the longest baseline."""
        one = self.reference.view
        centre = one.world_from_cam.translation
        apart = [np.linalg.norm(o.view.world_from_cam.translation - centre) for o in self.others]
        return float(max(apart)) * one.pinhole.fx_px


def _depth_of(north: np.ndarray, east: np.ndarray) -> np.ndarray:
    relief = np.sin(_WAVES * north) * np.cos((_WAVES - 1) * east)
    return np.asarray(12.0 + 0.06 * relief + 0.1 * north)


def _looked(view: View) -> tuple[ComparedView, Float32]:
    """A picture without noise, and its true depth."""
    points = hits(view, Scene(depth_of=_depth_of, paint=speckle()))
    grey = speckle()(points[..., 0], points[..., 1])[..., 0]
    contrast, spline, valid = prepare(np.rint(grey).astype(np.uint8), np.ones(grey.shape, bool))
    depth = view.world_from_cam.inv().apply(points.reshape(-1, 3))[:, 2].reshape(grey.shape)
    one = ComparedView(view=view, contrast=contrast, spline=spline, valid=valid)
    return one, depth.astype(np.float32)


@cache
def make_case(megapixels: float) -> Case:
    """The views and a depth that is wrong, smoothly, by a pixel."""
    factor = _PORT_VIEW_SCALE * (megapixels / _FULL_MEGAPIXELS) ** 0.5
    views = [
        replace(scaled_view(port_view([*c], [0.5 * n, -0.7, 20.0]), factor), image=f"{n}.png")
        for n, c in enumerate(_CENTRES)
    ]
    with ProcessPoolExecutor(min(len(views), _cores()), get_context("spawn")) as pool:
        (reference, depth), *others = pool.map(_looked, views)
    case = Case(
        reference=reference, depth=depth, sigma=np.full_like(depth, 0.01),
        others=[other for other, _ in others],
    )  # fmt: skip
    noise = np.random.default_rng(0).normal(size=[side // 8 + 1 for side in depth.shape])
    smooth = cv2.GaussianBlur(noise, (0, 0), _WRONG_OVER_PX / 8)
    wrong_px = cv2.resize(smooth * (_WRONG_PX / smooth.std()), depth.shape[::-1])
    inverse = 1.0 / depth + wrong_px / case.px_per_inverse_m
    return replace(case, depth=(1.0 / inverse).astype(np.float32))


def refined_by(on_gpu: bool, case: Case) -> RefinedDepth:
    """The case, refined."""
    if on_gpu:
        from reconstruct.dense.refine_gpu import refine_on_gpu

        return refine_on_gpu(case.reference, case.depth, case.sigma, case.others)
    return refine(case.reference, case.depth, case.sigma, case.others)


def alternating(works: Sequence[Callable[[], object]], runs: int) -> list[float]:
    """Median seconds of each, after one run each to warm up."""
    times: list[list[float]] = [[] for _ in works]
    for run in range(runs + 1):
        for work, row in zip(works, times, strict=True):
            started = time.perf_counter()
            work()
            if run:
                row.append(time.perf_counter() - started)
    return [statistics.median(row) for row in times]


def compared(megapixels: float, runs: int) -> list[Figure]:
    """Time of one view, and how far apart the results are."""
    case = make_case(megapixels)
    cpu, gpu = (partial(refined_by, on_gpu, case) for on_gpu in (False, True))
    cpu_s, gpu_s = alternating([cpu, gpu], runs)
    expected, found = cpu(), gpu()
    both = np.isfinite(found.depth) & np.isfinite(expected.depth)
    off_px = case.px_per_inverse_m * (1 / found.depth - 1 / expected.depth)[both]
    moved_px = case.px_per_inverse_m * (1 / expected.depth - 1 / case.depth)[both]
    name = f"{megapixels:g} MP"
    known = (np.isfinite(found.depth) != np.isfinite(expected.depth)).mean()
    return [
        Figure(name=f"{name}: a view", value=gpu_s, unit="s", peer="one core", peer_value=cpu_s),
        Figure(name=f"{name}: moved by, rms", value=float(np.sqrt(np.mean(moved_px**2))), unit="px",
               goal=Goal(minimum=0.5)),
        Figure(name=f"{name}: apart, of all but one in 100,000",
               value=float(np.quantile(np.abs(off_px), 1 - 1e-5)), unit="px",
               goal=Goal(maximum=_MAX_APART_PX)),
        Figure(name=f"{name}: apart, the farthest", value=float(np.abs(off_px).max()), unit="px",
               goal=Goal(maximum=_MAX_PX)),
        Figure(name=f"{name}: known in one", value=float(known), unit="", goal=Goal(maximum=1e-3)),
    ]  # fmt: skip


_WAIT: Any = None


def _share_barrier(barrier: Any) -> None:
    global _WAIT
    _WAIT = barrier


def _several(case_file: Path, on_gpu: bool, views: int) -> tuple[float, float]:
    """When a process began and ended to refine so many views, after one to warm up."""
    with case_file.open("rb") as file:
        case = pickle.load(file)  # noqa: S301 (written here)
    refined_by(on_gpu, case)
    _WAIT.wait()
    started = time.time()
    for _ in range(views):
        refined_by(on_gpu, case)
    return started, time.time()


def views_a_minute(case_file: Path, on_gpu: bool, processes: int, views: int) -> float:
    """How many views processes that start together refine in a minute."""
    context = get_context("spawn")
    barrier = (context.Barrier(processes),)
    with ProcessPoolExecutor(
        processes, context, initializer=_share_barrier, initargs=barrier
    ) as pool:
        work = partial(_several, case_file, on_gpu)
        times = np.array(list(pool.map(work, [views] * processes)))
    return 60.0 * processes * views / float(times[:, 1].max() - times[:, 0].min())


def all_cores(megapixels: float, views: int) -> Figure:
    """Views a minute of processes on all cores, with the GPU and without."""
    with TemporaryDirectory() as folder:
        case_file = Path(folder) / "case"
        with case_file.open("wb") as file:
            pickle.dump(make_case(megapixels), file, protocol=5)
        cpu, gpu = (views_a_minute(case_file, on_gpu, _cores(), views) for on_gpu in (False, True))
    return Figure(
        name=f"{megapixels:g} MP: {_cores()} processes", value=gpu, unit="views a minute",
        peer="the same without GPU", peer_value=cpu,
    )  # fmt: skip


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def main() -> int:
    """Measure, print and hand over."""
    parser = Parser(__doc__, quick="one run of the smallest pictures")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[0.6, 2.3])
    options, about = parser.begin("numpy", "numba")
    if not is_gpu_chosen("auto"):
        return hand_over(options, about, Findings(left_out=("no GPU that can be used",)))
    sizes = [min(options.megapixels)] if options.quick else options.megapixels
    figures: list[Figure] = []
    for size in sizes:
        found = compared(size, 1 if options.quick else 5)
        found.append(all_cores(size, 1 if options.quick else 3))
        for figure in found:
            peer = "" if figure.peer is None else f"{figure.peer} {figure.peer_value:.4g}"
            print(f"{figure.name:40s} {figure.value:10.4g} {figure.unit:15s} {peer}")
        figures += found
    return hand_over(options, about, Findings(figures=tuple(figures)))


if __name__ == "__main__":
    sys.exit(main())
