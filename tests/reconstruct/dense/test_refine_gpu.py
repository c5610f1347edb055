"""The kernels of a GPU on numba's simulator, in processes of their own: a variable chooses it.

The simulator runs kernels in plain Python. It shows that they, launches and transfers are right,
not that they compile; the last test shows that, where NVVM is installed.
"""

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reconstruct.dense.refine_depth import ComparedView, prepare, refine
from reconstruct.views.model import scaled_view
from tests.oracles_dense import port_view, render
from tests.reconstruct.dense.test_refine_depth import SCENE

ROOT = Path(__file__).parents[3]
SCALE = 1 / 7
CENTRES = ([0.2, 0.3, 10.0], [0.2, 0.5, 10.0], [0.45, 0.3, 10.0], [0.2, 0.18, 10.02])

REFINED = """
import pickle, sys
from alice_survey.app.commands.base import is_gpu_chosen
from reconstruct.dense.refine_gpu import refine_on_gpu
assert is_gpu_chosen("gpu")
with open(sys.argv[1], "rb") as file:
    found = refine_on_gpu(*pickle.load(file))
with open(sys.argv[2], "wb") as file:
    pickle.dump(found, file)
"""
FEW_THREADS = """
from reconstruct.dense import refine_gpu
refine_gpu.grid_of = lambda shape: ((2, 1), (2, 3))
"""
OUT_OF_MEMORY = """
from reconstruct.dense import refine_gpu
def fail(*_):
    raise refine_gpu.CudaAPIError("Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")
refine_gpu.cuda.to_device = fail
"""
COMPILED = """
from types import SimpleNamespace
import numba, numba.cuda.dispatcher
import numpy as np
numba.cuda.dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=(7, 5))
from numba import cuda
from reconstruct.dense import refine_depth, refine_gpu
f, b = np.zeros((5, 6), np.float32), np.zeros((5, 6), np.bool_)
lens = np.zeros(4), (np.zeros((3, 3, 2)), 0.1, 0.1), 0.5
six, one = np.zeros((6, 5, 6), np.float32), np.float32(1)
move = np.zeros((3, 4))
for kernel, arguments in (
    (refine_depth.compare, (f, f, six, f, b, lens, move, f, f, f)),
    (refine_depth.weigh, (f, f, b, one, six)),
    (refine_depth.add, (six, f, f, b, one, one, f, f, f, f, b.view(np.uint8))),
    (refine_gpu.blur, (six, f[0], (0, 1), six)),
):
    launch = refine_gpu.launcher(kernel).py_func
    code, _ = cuda.compile_ptx(launch, (numba.typeof(arguments),), cc=(7, 5))
    print(code.count(".visible .entry"), code.count(".approx"))
"""


@pytest.fixture(scope="module")
def case() -> tuple[Any, ...]:
    """A reference, its depth with errors and holes, sigma, two others and a spare one."""
    looks = []
    for number, centre in enumerate(CENTRES):
        large = port_view(centre, [0.5 * number, -0.7, 20.0])
        view = replace(scaled_view(large, SCALE), image=f"{number}.png")
        grey = cv2.cvtColor(render(large, SCENE), cv2.COLOR_BGR2GRAY)
        grey = cv2.resize(grey, view.pinhole.size_px, interpolation=cv2.INTER_AREA)
        valid = np.ones(grey.shape, bool)
        valid[5:9, 30:36] = number != 1
        contrast, spline, valid = prepare(grey, valid)
        looks.append(ComparedView(view=view, contrast=contrast, spline=spline, valid=valid))
    shape = looks[0].contrast.shape
    assert 30 < shape[0] < 50
    assert 35 < shape[1] < 65
    rng = np.random.default_rng(0)
    wrong = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 3) * 1.5
    depth = (2.05 + wrong).astype(np.float32)
    depth[20:24, 10:20] = np.nan
    return looks[0], depth, np.full_like(depth, 0.01), looks[1:3], looks[3:]


def simulated(folder: Path, case: tuple[Any, ...], before: str = "", **environment: str) -> Any:
    """What `refine_on_gpu` gives on the simulator, and what it says."""
    with (folder / "case").open("wb") as file:
        pickle.dump(case, file)
    done = subprocess.run(
        [sys.executable, "-c", before + REFINED, folder / "case", folder / "found"],
        cwd=ROOT, env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1", **environment},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    with (folder / "found").open("rb") as file:
        return pickle.load(file), done.stderr  # noqa: S301 (its own)


@pytest.mark.slow
def test_a_gpu_gives_what_the_processor_gives(tmp_path: Path, case: tuple[Any, ...]) -> None:
    found, said = simulated(tmp_path, case, FEW_THREADS, NUMBA_DISABLE_JIT="1")

    expected = refine(*case)
    both = np.isfinite(found.depth) & np.isfinite(expected.depth)
    reference, start, _, others, _ = case
    apart_m = np.linalg.norm(
        (others[1].view.world_from_cam.inv() * reference.view.world_from_cam).translation
    )
    px_per_inverse = apart_m * reference.view.pinhole.fx_px
    moved_px = px_per_inverse * (1 / expected.depth - 1 / start)[both]
    off_px = px_per_inverse * (1 / found.depth - 1 / expected.depth)[both]
    assert both.mean() > 0.5
    assert np.percentile(np.abs(moved_px), 90) > 0.5
    assert np.abs(off_px).max() < 1e-3
    assert (np.isfinite(found.depth) != np.isfinite(expected.depth)).mean() < 1e-3
    assert (found.seen != expected.seen).mean() < 1e-3
    np.testing.assert_allclose(found.sigma[both], expected.sigma[both], rtol=1e-3)
    assert "simulated" in said


@pytest.mark.slow
def test_without_memory_of_the_gpu_the_processor_does_it_and_says_so(
    tmp_path: Path, case: tuple[Any, ...]
) -> None:
    found, said = simulated(tmp_path, case, OUT_OF_MEMORY)

    expected = refine(*case)
    np.testing.assert_array_equal(found.depth, expected.depth)
    np.testing.assert_array_equal(found.sigma, expected.sigma)
    assert "warning: 0.png" in said


@pytest.mark.skipif(
    not find_spec("nvidia") or not find_spec("nvidia.cuda_nvcc"),
    reason="the extra gpu, which has NVVM, is not installed",
)
def test_kernels_compile_for_a_gpu_without_short_cuts_in_divisions() -> None:
    done = subprocess.run(
        [sys.executable, "-c", COMPILED], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["1", "0"] * 4
