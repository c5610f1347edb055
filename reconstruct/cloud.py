"""The coloured point cloud: points of all views, averaged within small cubes, as a PLY file."""

import math
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from alice_survey.artefacts import write_json
from alice_survey.frames import Array
from reconstruct.model import WorldFrame

Float32 = NDArray[np.float32]

VERTEX = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4"),
        ("red", "u1"), ("green", "u1"), ("blue", "u1"),
        ("sigma", "<f4"),
    ]
)  # fmt: skip
"""One point: x east, y north, z up from the cloud's offset, normal, colour, standard deviation."""
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


@njit(cache=True)  # type: ignore[untyped-decorator]
def thin(
    starts: NDArray[np.int64], order: NDArray[np.int64], values: Float32, sigmas: Float32
) -> tuple[Float32, Float32]:
    """Average the points of each cube, weighted by their certainty.

    Args:
        starts: (C + 1,) where the points of each cube start in `order`.
        order: (N,) point numbers sorted by cube.
        values: (N, K) numbers to average, by point number.
        sigmas: (N,) standard deviations.

    Returns:
        (C, K) averages and (C,) standard deviations: the weighted mean of those of the points,
        since points of one cube mostly come from the same few matches and err together.
    """
    cubes, width = starts.size - 1, values.shape[1]
    mean = np.zeros((cubes, width), np.float32)
    sigma = np.zeros(cubes, np.float32)
    total = np.zeros(width)
    for cube in range(cubes):
        total[:] = 0.0
        weights, deviation = 0.0, 0.0
        for i in range(starts[cube], starts[cube + 1]):
            point = order[i]
            w = 1.0 / (sigmas[point] * sigmas[point])
            weights += w
            deviation += w * sigmas[point]
            for k in range(width):
                total[k] += w * values[point, k]
        for k in range(width):
            mean[cube, k] = total[k] / weights
        sigma[cube] = deviation / weights
    return mean, sigma


def thinned_points(
    points_enu: Float32,
    normals_enu: Float32,
    colours: NDArray[np.uint8],
    sigmas: Float32,
    edge: float,
) -> NDArray[Any]:
    """One vertex for every cube that holds points.

    Args:
        points_enu: (N, 3) from the cloud's offset.
        normals_enu: (N, 3) unit vectors.
        colours: (N, 3) RGB.
        sigmas: (N,) standard deviations.
        edge: of the cubes, which are aligned to whole multiples of it.

    Returns:
        (C,) records of `VERTEX`, sorted by cube: east, then north, then up.
    """
    cubes = np.floor(points_enu.astype(np.float64) / edge).astype(np.int64)
    if len(cubes) == 0:
        return np.empty(0, VERTEX)
    order = np.lexsort(cubes.T[::-1])
    step = np.any(np.diff(cubes[order], axis=0) != 0, axis=1)
    starts = np.concatenate([[0], np.flatnonzero(step) + 1, [len(order)]]).astype(np.int64)
    values = np.concatenate([points_enu, normals_enu, colours.astype(np.float32)], axis=1)
    mean, sigma = thin(starts, order, values, sigmas)
    vertices = np.empty(len(mean), VERTEX)
    vertices["x"], vertices["y"], vertices["z"] = mean[:, :3].T
    length = np.maximum(np.linalg.norm(mean[:, 3:6], axis=1), 1e-6)
    vertices["nx"], vertices["ny"], vertices["nz"] = mean[:, 3:6].T / length
    vertices["red"], vertices["green"], vertices["blue"] = np.rint(mean[:, 6:9]).T
    vertices["sigma"] = sigma
    return vertices


def normals_of_depth(depth: Float32, pinhole: Array) -> Float32:
    """Unit normals (H, W, 3) in the camera frame, towards the camera; NaN where unknown.

    The surface is spanned by the points two pixels to either side.

    Args:
        depth: (H, W) along the axis, NaN where unknown.
        pinhole: (4,) fx, fy, cx, cy, px.
    """
    height, width = depth.shape
    x = ((np.arange(width) + 0.5 - pinhole[2]) / pinhole[0]).astype(np.float32)
    y = ((np.arange(height) + 0.5 - pinhole[3]) / pinhole[1]).astype(np.float32)
    points = np.stack([depth * x[None, :], depth * y[:, None], depth], axis=-1)
    normals = np.full(points.shape, np.nan, np.float32)
    along = points[2:-2, 4:] - points[2:-2, :-4]
    down = points[4:, 2:-2] - points[:-4, 2:-2]
    normal = np.cross(down, along)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.float32(1e-20))
    normals[2:-2, 2:-2] = normal
    return normals


def voxel_edge(cell: float, cells: int, most_points: int) -> float:
    """Edge of the cubes: a cell, or more where that many cells would give too many points."""
    return cell * max(1.0, math.sqrt(cells / most_points))


def write_ply(
    path: Path, parts: Iterable[NDArray[Any]], offset_enu: Sequence[float], frame: WorldFrame
) -> int:
    """Write a binary PLY from parts that are dropped once written.

    Returns:
        How many points were written.
    """
    body = path.with_suffix(".body")
    count = 0
    with body.open("wb") as file:
        for part in parts:
            file.write(part.tobytes())
            count += len(part)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment offset_east_north_up {' '.join(repr(float(o)) for o in offset_enu)}",
        f"comment frame {frame.name}, unit {frame.unit}, x east, y north, z up",
        f"comment vertical datum: {frame.vertical_datum}",
        f"element vertex {count}",
        *(f"property {_PLY_TYPES[VERTEX[name].str]} {name}" for name in VERTEX.names or ()),
        "end_header",
    ]
    with path.open("wb") as file, body.open("rb") as source:
        file.write(("\n".join(header) + "\n").encode("ascii", "replace"))
        shutil.copyfileobj(source, file)
    body.unlink()
    return count


def write_cloud_json(
    path: Path, count: int, offset_enu: Sequence[float], edge: float, frame: WorldFrame
) -> None:
    """Write what the PLY cannot say."""
    from reconstruct.raster import crs_of

    crs = crs_of(frame)
    write_json(
        path,
        {
            "format": "alice-survey cloud",
            "version": 1,
            "points": count,
            "axes": ["east", "north", "up"],
            "offset_east_north_up": [float(o) for o in offset_enu],
            "frame": frame.name,
            "scaled": frame.scaled,
            "unit": frame.unit,
            "crs": None if crs is None else crs.to_wkt(),
            "vertical_datum": frame.vertical_datum,
            "thinned_to": edge,
            "notes": list(frame.notes),
        },
    )
