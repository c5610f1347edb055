"""The coloured point cloud: points of all views, averaged in small cubes, as PLY and LAZ."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.records import CloudRecord
from reconstruct.dense.dem import bin_points
from reconstruct.dense.points import Points
from reconstruct.dense.surfaces import sorted_ranks
from reconstruct.ply import VERTEX as MESH_VERTEX
from reconstruct.ply import write_ply
from reconstruct.raster import DemGrid, crs_of
from reconstruct.views.model import WorldFrame

Float32 = NDArray[np.float32]

VERTEX = np.dtype([*MESH_VERTEX.descr, ("sigma", "<f4")])
"""One point: x east, y north, z up from the cloud's offset, normal, colour, standard deviation."""
_LAZ_STEP = 1e-4
_LAZ_EXTRA = {
    "nx": "normal, east",
    "ny": "normal, north",
    "nz": "normal, up",
    "sigma": "standard deviation",
}
_NO_DATE = date(2000, 1, 1)
"""Date in the header, the same bytes on every day."""


@compiled
def thin(
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    enu: Float32,
    normals: Float32,
    colours: NDArray[np.uint8],
    sigmas: Float32,
    edge: float,
) -> tuple[Float32, Float32]:
    """Average the points of each cube, weighted by their certainty.

    Args:
        starts: (C + 1,) where the points of each column of cubes start in `order`.
        order: (M,) point numbers sorted by column.
        enu: (N, 3) east, north, up, by point number.
        normals: (N, 3) unit vectors; points with NaN are left out.
        colours: (N, 3) RGB.
        sigmas: (N,) standard deviations.
        edge: of the cubes; a column's cubes start at whole multiples of it.

    Returns:
        (K, 9) means of position, normal (not of unit length) and colour, and (K,) standard
        deviations, column by column from below. A standard deviation is the weighted mean of those
        of the points, since points of one cube mostly come from the same few matches and share
        their errors.
    """
    mean = np.empty((order.size, 9), np.float32)
    sigma = np.empty(order.size, np.float32)
    sums = np.zeros(9)
    cubes = 0
    for column in range(starts.size - 1):
        inside = order[starts[column] : starts[column + 1]]
        levels = np.empty(inside.size, np.int64)
        for i in range(inside.size):
            levels[i] = math.floor(enu[inside[i], 2] / edge)
        ranks = sorted_ranks(levels)
        first = 0
        while first < ranks.size:
            level = levels[ranks[first]]
            sums[:] = 0.0
            weights, deviation = 0.0, 0.0
            while first < ranks.size and levels[ranks[first]] == level:
                point = inside[ranks[first]]
                first += 1
                if math.isnan(normals[point, 0]):
                    continue
                w = 1.0 / (sigmas[point] * sigmas[point])
                weights += w
                deviation += w * sigmas[point]
                for k in range(3):
                    sums[k] += w * enu[point, k]
                    sums[3 + k] += w * normals[point, k]
                    sums[6 + k] += w * colours[point, k]
            if weights > 0.0:
                for k in range(9):
                    mean[cubes, k] = sums[k] / weights
                sigma[cubes] = deviation / weights
                cubes += 1
    return mean[:cubes], sigma[:cubes]


def thinned_points(grid: DemGrid, points: Points) -> NDArray[Any]:
    """One vertex for every cube over a grid's cells that holds points.

    Args:
        grid: columns of cubes; points outside of it are left out, and those without normal.
        points: in the coordinates of the grid, which are those of the vertices.

    Returns:
        (M,) records of `VERTEX`, by rows from the north, columns from the west, and from below.
    """
    starts, order = bin_points(
        points.enu, grid.north, grid.west, grid.cell, grid.rows, grid.columns
    )
    mean, sigma = thin(
        starts, order, points.enu, points.normals, points.colours, points.sigmas, grid.cell
    )
    vertices = np.empty(len(mean), VERTEX)
    vertices["x"], vertices["y"], vertices["z"] = mean[:, :3].T
    length = np.maximum(np.linalg.norm(mean[:, 3:6], axis=1), 1e-6)
    vertices["nx"], vertices["ny"], vertices["nz"] = mean[:, 3:6].T / length
    vertices["red"], vertices["green"], vertices["blue"] = np.rint(mean[:, 6:9]).T
    vertices["sigma"] = sigma
    return vertices


def voxel_edge(cell: float, cells: int, most_points: int) -> float:
    """Edge of the cubes: a cell, or more where that many cells would give too many points."""
    return cell * max(1.0, math.sqrt(cells / most_points))


def write_cloud(
    path: Path, parts: Iterable[NDArray[Any]], offset_enu: Sequence[float], frame: WorldFrame
) -> int:
    """Write parts of `VERTEX` records as a PLY; return how many points there are."""
    comments = [
        f"offset_east_north_up {' '.join(repr(float(o)) for o in offset_enu)}",
        f"frame {frame.name}, unit {frame.unit}, x east, y north, z up",
        f"vertical datum: {frame.vertical_datum}",
    ]
    return write_ply(path, parts, comments)


@contextmanager
def laz_writer(
    path: Path, offset_enu: Sequence[float], frame: WorldFrame
) -> Iterator[Callable[[Iterable[NDArray[Any]]], Iterator[NDArray[Any]]]]:
    """A LAZ file (1.4, point format 7) that takes parts of `VERTEX` records as they pass.

    Coordinates are east, north and up in steps of 1/10000 of the unit, from the offset that the
    header gives; colours are 16-bit; normals and sigma are extra dimensions. The projection is that
    of the rasters where there is one.

    Yields:
        A function that passes parts on and writes each to the file.
    """
    import laspy
    import pyproj

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.offsets = np.asarray(offset_enu, dtype=np.float64)
    header.scales = np.full(3, _LAZ_STEP)
    header.creation_date = _NO_DATE
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name=name, type="f4", description=text)
            for name, text in _LAZ_EXTRA.items()
        ]
    )
    crs = crs_of(frame)
    if crs is not None:
        header.add_crs(pyproj.CRS.from_wkt(crs.to_wkt()))
    with laspy.open(path, mode="w", header=header) as file:

        def passed(parts: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
            for part in parts:
                if len(part):
                    points = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
                    for axis, name in enumerate("xyz"):
                        points[name] = part[name].astype(np.float64) + offset_enu[axis]
                    for name in ("red", "green", "blue"):
                        points[name] = part[name].astype(np.uint16) * 257
                    for name in _LAZ_EXTRA:
                        points[name] = part[name]
                    file.write_points(points)
                yield part

        yield passed


def write_cloud_json(
    path: Path, count: int, offset_enu: Sequence[float], edge: float, frame: WorldFrame
) -> None:
    """Write what the PLY cannot say."""
    crs = crs_of(frame)
    CloudRecord.save(
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
