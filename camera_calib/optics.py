"""Points to pixels and back through any lens and port: the one entry for all kernels.

A new lens or port is one file, and its kernels in `_OF_LENS` or `_OF_PORT`; those of cameras that a
process meets are compiled. Rows without a solution are NaN.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from alice_survey.core.frames import Array
from camera_calib.lenses import opencv
from camera_calib.lenses.fisheye import FisheyeLens, fisheye_pixels, fisheye_rays, fisheye_slopes
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.ports.dome import DomePort, dome_leave, dome_rays, dome_slopes
from camera_calib.ports.flat import FlatPort, flat_leave, flat_rays, flat_slopes
from camera_calib.ports.none import NoPort, bare_leave, bare_rays, bare_slopes
from camera_calib.ports.values import PortValues

LENSES: dict[str, type[LensValues]] = {lens.model: lens for lens in (OpenCVLens, FisheyeLens)}
PORTS: dict[str, type[PortValues]] = {port.shape: port for port in (NoPort, FlatPort, DomePort)}
_Kernel = Callable[..., Any]
_OF_LENS: dict[type[LensValues], tuple[_Kernel, _Kernel, _Kernel]] = {
    OpenCVLens: (opencv.opencv_pixels, opencv.opencv_rays, opencv.opencv_slopes),
    FisheyeLens: (fisheye_pixels, fisheye_rays, fisheye_slopes),
}
"""Pixels of rays in air, the inverse, and pixels with their slopes."""
_OF_PINHOLE = opencv.pinhole_pixels, opencv.pinhole_rays, opencv.pinhole_slopes
_OF_PORT: dict[type[PortValues], tuple[_Kernel, _Kernel, _Kernel]] = {
    NoPort: (bare_rays, bare_leave, bare_slopes),
    FlatPort: (flat_rays, flat_leave, flat_slopes),
    DomePort: (dome_rays, dome_leave, dome_slopes),
}
"""Rays in air of points, the inverse for rays, and slopes by points of those by rays."""
_BLOCK = 4096
"""Points at a time: their rays stay in the processor's cache."""


def _of_lens(lens: LensValues) -> tuple[_Kernel, _Kernel, _Kernel]:
    is_pinhole = isinstance(lens, OpenCVLens) and not lens.distorts
    return _OF_PINHOLE if is_pinhole else _OF_LENS[type(lens)]


def _blocks(count: int) -> Iterator[tuple[slice, int]]:
    """Parts of so many rows, and how many each has."""
    for first in range(0, count, _BLOCK):
        end = min(first + _BLOCK, count)
        yield slice(first, end), end - first


def project(points: Array, lens: LensValues, port: PortValues) -> Array:
    """(N, 2) pixels of (N, 3) points."""
    pixels, size = np.empty((len(points), 2)), min(len(points), _BLOCK)
    air, turns = np.empty((size, 3)), np.empty(size)
    for part, count in _blocks(len(points)):
        _OF_PORT[type(port)][0](points[part], port.values, air[:count], turns)
        _of_lens(lens)[0](air[:count], lens.values, pixels[part])
    return pixels


def unproject(pixels: Array, lens: LensValues, port: PortValues) -> tuple[Array, Array]:
    """Points on the outer surface and unit directions in water, (N, 3) each, of (N, 2) pixels."""
    points, directions = np.empty((2, len(pixels), 3))
    air = np.empty((min(len(pixels), _BLOCK), 3))
    for part, count in _blocks(len(pixels)):
        _of_lens(lens)[1](pixels[part], lens.values, air[:count])
        _OF_PORT[type(port)][1](air[:count], port.values, points[part], directions[part])
    return points, directions


def project_jacobian(
    points: Array, lens: LensValues, port: PortValues
) -> tuple[Array, Array, Array]:
    """Pixels (N, 2) of points (N, 3), with their slopes by point and by parameter.

    Returns:
        (N, 2), (N, 2, 3) and (N, 2, P), of which the lens's parameters come first.
    """
    count, of_lens, of_port = len(points), _of_lens(lens), _OF_PORT[type(port)]
    pixels, by_point, by_ray = (
        np.empty((count, 2)),
        np.empty((count, 2, 3)),
        np.empty((count, 2, 3)),
    )
    by_lens = np.empty((count, 2, len(lens.parameters)))
    by_port = np.empty((count, 2, len(port.parameters)))
    rays, turns = np.empty((count, 3)), np.empty(count)
    of_port[0](points, port.values, rays, turns)
    of_lens[2](rays, lens.values, pixels, by_ray, by_lens)
    of_port[2](points, turns, port.values, by_ray, by_point, by_port)
    return pixels, by_point, np.concatenate([by_lens, by_port], axis=2)
