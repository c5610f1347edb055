"""Depth refined on an NVIDIA GPU: the kernels of `refine_depth`, a thread for each pixel.

A band of N pixels and neighbours of n pixels together take 106 N + 5 n bytes of the device at most:
of the reference contrast (4 N), lines (16), spread (4), inverse depth (4) and totals (17); what
comparing gives (12), where it is known (1), products (24) and those blurred along rows (24); of the
neighbours spline (4 n) and validity (1). With six neighbours of 9.2 megapixels that is 0.35 GB,
besides the few hundred MB that CUDA takes for each process.
"""

import os
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
from numba import cuda
from numba.cuda.cudadrv.driver import CudaAPIError
from numpy.typing import NDArray

from alice_survey.core.errors import warn
from alice_survey.core.run.resources import user_lock
from reconstruct.dense.refine_depth import (
    ComparedView,
    Device,
    Float32,
    RefinedDepth,
    Share,
    refine,
)

_BLOCK = (32, 8)
"""Threads along a row, and rows: a warp reads neighbouring pixels."""
_PROCESS_BYTES = 3 << 29
"""Of the GPU, for a process and for the context of another that waits."""
_MAX_AT_ONCE = 64
_REACH_SIGMAS = 4
"""OpenCV cuts the Gaussian of 32-bit pictures off there."""


def refine_on_gpu(
    reference: ComparedView, depth: Float32, sigma: Float32, others: Sequence[ComparedView],
    spare: Sequence[ComparedView] = (),
) -> RefinedDepth:  # fmt: skip
    """As `refine`, by as many processes of a user at a time as the GPU has memory for.

    Where memory does not suffice after all, the processor does it. Depths differ from those of the
    processor by rounding.
    """
    try:
        with user_lock(f"gpu-{os.getpid() % places()}"):
            return refine(reference, depth, sigma, others, spare, _Gpu())
    except CudaAPIError as error:
        if "OUT_OF_MEMORY" not in str(error):
            raise
    warn(
        f"{reference.view.image}: the GPU's memory does not suffice: refined by the processor; "
        "fewer --threads or a smaller dense_scale take less"
    )
    return refine(reference, depth, sigma, others, spare)


def places() -> int:
    """Processes that work on the GPU at the same time: one alone leaves it idle for most of it."""
    _, total = cuda.current_context().get_memory_info()
    return int(max(1, min(total / _PROCESS_BYTES, _MAX_AT_ONCE)))


class _Gpu(Device):
    """The device of `refine` on the GPU that CUDA names first."""

    def put(self, values: Any) -> Any:
        if isinstance(values, tuple):
            return tuple(map(self.put, values))
        is_array = isinstance(values, np.ndarray)
        return cuda.to_device(np.ascontiguousarray(values)) if is_array else values

    def get(self, array: Any) -> NDArray[Any]:
        return np.asarray(array.copy_to_host())

    def empty(self, *shape: int) -> Any:
        return cuda.device_array(shape, np.float32)

    def run(self, kernel: Callable[..., None], shape: tuple[int, ...], *arguments: Any) -> None:
        launcher(kernel)[grid_of(shape)](arguments)

    def blur(self, planes: Any, sigma_px: float) -> Any:
        side = 2 * round(_REACH_SIGMAS * sigma_px) + 1
        weights = cuda.to_device(cv2.getGaussianKernel(side, sigma_px, cv2.CV_32F)[:, 0])
        between = cuda.device_array_like(planes)
        self.run(blur, planes.shape[1:], planes, weights, (0, 1), between)
        self.run(blur, planes.shape[1:], between, weights, (1, 0), planes)
        return planes


def grid_of(shape: tuple[int, ...]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Blocks, and threads of each, of a launch for (H, W) pixels."""
    height, width = shape
    return (-(-width // _BLOCK[0]), -(-height // _BLOCK[1])), _BLOCK


@cache
def launcher(kernel: Callable[..., None]) -> Any:
    """A kernel that takes a share of the pixels, for the GPU: each thread has its own.

    It is compiled without the options of the processor's, which numba-cuda would take as leave to
    ignore NaN; the functions that it calls keep them, and get finite numbers alone.
    """
    work = cuda.jit(device=True)(getattr(kernel, "py_func", kernel))

    def launch(arguments: Any) -> None:
        columns, rows = cuda.gridsize(2)
        column, row = cuda.grid(2)
        work((row, rows, column, columns), *arguments)

    return cuda.jit(launch)


def blur(
    share: Share, planes: Float32, weights: Float32, step: tuple[int, int], blurred: Float32
) -> None:
    """Take the weighted mean along rows or columns, mirrored at the edges with the edge doubled.

    Args:
        share: which pixels, see `refine_depth.Share`.
        planes: (N, H, W), of half as many pixels as there are weights or more.
        weights: of an odd number of pixels, in a sum of one.
        step: rows and columns to the next pixel of the mean.
        blurred: (N, H, W), to be filled.
    """
    count, height, width = planes.shape
    for row in range(share[0], height, share[1]):
        for column in range(share[2], width, share[3]):
            for plane in range(count):
                total = np.float32(0.0)
                for k in range(len(weights)):
                    i = row + (k - len(weights) // 2) * step[0]
                    j = column + (k - len(weights) // 2) * step[1]
                    i = min(max(i, -1 - i), 2 * height - 1 - max(i, -1 - i))
                    j = min(max(j, -1 - j), 2 * width - 1 - max(j, -1 - j))
                    total += weights[k] * planes[plane, i, j]
                blurred[plane, row, column] = total
