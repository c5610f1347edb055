"""Points to pixels and back through any lens and port: the one entry for all kernels.

A camera comes as one value, `Optics`: the kind of its lens with the lens's values, and the kind of
its port with the port's. A new lens or port is one file, and one branch in each function here.
Rows without a solution are NaN.
"""

import numpy as np

from alice_survey.core.compiled import BLOCK as _BLOCK
from alice_survey.core.compiled import compiled, compiled_ieee
from alice_survey.core.frames import Array
from camera_calib.lenses.fisheye import FisheyeLens, fisheye_pixels, fisheye_rays, fisheye_slopes
from camera_calib.lenses.opencv import OpenCVLens, opencv_pixels, opencv_rays, opencv_slopes
from camera_calib.lenses.values import LensValues
from camera_calib.ports.dome import DomePort, dome_leave, dome_rays, dome_slopes
from camera_calib.ports.flat import FlatPort, flat_leave, flat_rays, flat_slopes
from camera_calib.ports.none import NoPort, bare_leave, bare_rays
from camera_calib.ports.values import PortValues

Optics = tuple[int, Array, int, Array]
"""Kind and values of a lens, kind and values of a port."""
LENSES: dict[str, type[LensValues]] = {lens.model: lens for lens in (OpenCVLens, FisheyeLens)}
PORTS: dict[str, type[PortValues]] = {port.shape: port for port in (NoPort, FlatPort, DomePort)}
_BETWEEN = 1.17
"""Between the ratio of focal lengths of a dome, 1, and that of a flat port, the water's index."""
_FISHEYE = FisheyeLens.kind
_FLAT, _DOME = FlatPort.kind, DomePort.kind


def likely_port(focal_ratio: float) -> str:
    """The kind of port that makes focal lengths so many times longer under water than in air."""
    return FlatPort.shape if focal_ratio > _BETWEEN else DomePort.shape


def contradicting_port(focal_ratio: float, given: str) -> str | None:
    """The shape that a ratio says where it contradicts the given one; a dome may pass for none."""
    likely = likely_port(focal_ratio)
    return likely if likely != given and FlatPort.shape in (likely, given) else None


@compiled_ieee
def _air_rays(points: Array, port_kind: int, port: Array, rays: Array, turns: Array) -> None:
    if port_kind == _FLAT:
        flat_rays(points, port, rays, turns)
    elif port_kind == _DOME:
        dome_rays(points, port, rays, turns)
    else:
        bare_rays(points, rays)


@compiled_ieee
def _pixels(rays: Array, lens_kind: int, lens: Array, pixels: Array) -> None:
    if lens_kind == _FISHEYE:
        fisheye_pixels(rays, lens, pixels)
    else:
        opencv_pixels(rays, lens, pixels)


@compiled(nogil=True, error_model="numpy")
def project(points: Array, optics: Optics) -> Array:
    """(N, 2) pixels of (N, 3) points."""
    lens_kind, lens, port_kind, port = optics
    pixels = np.empty((points.shape[0], 2))
    rays, turns = np.empty((_BLOCK, 3)), np.empty(_BLOCK)
    for first in range(0, points.shape[0], _BLOCK):
        block = points[first : first + _BLOCK]
        _air_rays(block, port_kind, port, rays, turns)
        _pixels(rays[: len(block)], lens_kind, lens, pixels[first : first + _BLOCK])
    return pixels


@compiled(nogil=True, error_model="numpy")
def unproject(pixels: Array, optics: Optics) -> tuple[Array, Array]:
    """Points on the outer surface and unit directions in water, (N, 3) each, of (N, 2) pixels."""
    lens_kind, lens, port_kind, port = optics
    points = np.empty((pixels.shape[0], 3))
    directions = np.empty((pixels.shape[0], 3))
    air = np.empty((_BLOCK, 3))
    for first in range(0, pixels.shape[0], _BLOCK):
        block = pixels[first : first + _BLOCK]
        rays = air[: len(block)]
        if lens_kind == _FISHEYE:
            fisheye_rays(block, lens, rays)
        else:
            opencv_rays(block, lens, rays)
        starts, ways = points[first : first + _BLOCK], directions[first : first + _BLOCK]
        if port_kind == _FLAT:
            flat_leave(rays, port, starts, ways)
        elif port_kind == _DOME:
            dome_leave(rays, port, starts, ways)
        else:
            bare_leave(rays, starts, ways)
    return points, directions


@compiled(nogil=True, error_model="numpy")
def project_jacobian(
    points: Array, optics: Optics, of_lens: int, of_port: int
) -> tuple[Array, Array, Array]:
    """Pixels (N, 2) with their slopes by point (N, 2, 3) and by parameter (N, 2, P).

    Args:
        points: (N, 3).
        optics: of the camera.
        of_lens: parameters of the lens, which come first in P.
        of_port: parameters of the port.
    """
    lens_kind, lens, port_kind, port = optics
    count = points.shape[0]
    pixels = np.empty((count, 2))
    by_point = np.empty((count, 2, 3))
    by_parameter = np.empty((count, 2, of_lens + of_port))
    air, turns, by_air = np.empty((_BLOCK, 3)), np.empty(_BLOCK), np.empty((_BLOCK, 2, 3))
    for first in range(0, count, _BLOCK):
        end = min(first + _BLOCK, count)
        block, rays, by_ray = points[first:end], air[: end - first], by_air[: end - first]
        by_lens, by_port = (
            by_parameter[first:end, :, :of_lens],
            by_parameter[first:end, :, of_lens:],
        )
        _air_rays(block, port_kind, port, rays, turns)
        if lens_kind == _FISHEYE:
            fisheye_slopes(rays, lens, pixels[first:end], by_ray, by_lens)
        else:
            opencv_slopes(rays, lens, pixels[first:end], by_ray, by_lens)
        if port_kind == _FLAT:
            flat_slopes(block, turns, port, by_ray, by_point[first:end], by_port)
        elif port_kind == _DOME:
            dome_slopes(block, turns, port, by_ray, by_point[first:end], by_port)
        else:
            by_point[first:end] = by_ray
    return pixels, by_point, by_parameter
