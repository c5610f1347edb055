"""The coloured point cloud: all points of the surface as LAS, and an even thinning of very many."""

import math
import shutil
from collections.abc import Iterable, Sequence
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.executor import Executor
from alice_survey.core.records import CloudRecord
from reconstruct.copc import PointSpool, SpooledPart, write_copc
from reconstruct.ply import write_ply
from reconstruct.raster import crs_of
from reconstruct.views.model import WorldFrame

if TYPE_CHECKING:
    import laspy

    from reconstruct.dense.surface_tiles import SurfaceTile
    from reconstruct.dense.view_store import ViewStore

VERTEX = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4"),
        ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("sigma", "<f4"),
    ]
)  # fmt: skip
"""One point: x east, y north, z up from the cloud's offset, normal, colour, standard deviation."""
_MAX_OVERVIEW_POINTS = 40_000_000
"""That programs without levels of detail hold at once, and meshes are made of."""
_OVERVIEW = "overview"
_LAS_STEP, _STEPS_OF_A_CELL = 1e-4, 10.0
_CHUNK = 1_000_000
_LAS_EXTRA = {
    "nx": "normal, east",
    "ny": "normal, north",
    "nz": "normal, up",
    "sigma": "standard deviation",
}
_NO_DATE = date(2000, 1, 1)
"""Date in the header, the same bytes on every day."""


def vertices_of(surface: NDArray[Any], cell: float, edge: float) -> NDArray[Any]:
    """Points of a surface as vertices, averaged in cubes where these are larger than its cells.

    Means of a cube are weighted by certainty. Its sigma is the weighted mean of those of its
    points, which mostly come from the same few matches and share their errors.

    Args:
        surface: records of `SURFACE_POINT`.
        cell: of the surface.
        edge: of the cubes, which start at whole multiples of it.

    Returns:
        (M,) records of `VERTEX`.
    """
    sigma = np.hypot(surface["sigma"], surface["shared"])
    values = np.column_stack([surface["enu"], surface["normal"], surface["colour"], sigma])
    if edge > cell:
        cubes = np.floor(surface["enu"] / np.float32(edge)).astype(np.int64)
        _, cube = np.unique(cubes, axis=0, return_inverse=True)
        weight = 1.0 / np.square(sigma.astype(np.float64))
        sums = [np.bincount(cube.reshape(-1), weight * column) for column in values.T]
        values = np.column_stack(sums) / np.bincount(cube.reshape(-1), weight)[:, None]
    vertices = np.empty(len(values), VERTEX)
    vertices["x"], vertices["y"], vertices["z"] = values[:, :3].T
    length = np.maximum(np.linalg.norm(values[:, 3:6], axis=1), 1e-6)
    vertices["nx"], vertices["ny"], vertices["nz"] = values[:, 3:6].T / length
    vertices["red"], vertices["green"], vertices["blue"] = np.rint(values[:, 6:9]).T
    vertices["sigma"] = values[:, 9]
    return vertices


def frame_comments(frame: WorldFrame, offset_enu: Sequence[float]) -> list[str]:
    """Lines for the header of a PLY or OBJ: where its coordinates lie."""
    return [
        f"offset_east_north_up {' '.join(repr(float(o)) for o in offset_enu)}",
        f"frame {frame.name}, unit {frame.unit}, x east, y north, z up",
        f"vertical datum: {frame.vertical_datum}",
    ]


def write_cloud(
    path: Path, parts: Iterable[NDArray[Any]], offset_enu: Sequence[float], frame: WorldFrame
) -> int:
    """Write parts of `VERTEX` records as a PLY; return how many points there are."""
    return write_ply(path, parts, frame_comments(frame, offset_enu))


def write_clouds(
    folder: Path,
    store: "ViewStore",
    tiles: Sequence["SurfaceTile"],
    offset_enu: Sequence[float],
    frame: WorldFrame,
    cell: float,
    executor: Executor,
) -> None:
    """Write all points of a surface as COPC; and of too many for memory an overview as PLY.

    Args:
        folder: for `cloud.copc.laz`, `cloud.json` and, if need be, `cloud.ply`.
        store: with the surface.
        tiles: of it, with one point or more in all.
        offset_enu: of the points of tiles.
        frame: that the offset is in.
        cell: of the surface.
        executor: runs the tiles.
    """
    count = sum(tile.count for tile in tiles)
    edge = cell * max(1.0, math.sqrt(count / _MAX_OVERVIEW_POINTS))  # of the overview's cubes
    header = las_header(offset_enu, frame, cell)
    scratch = store.folder / "copc"
    shutil.rmtree(scratch, ignore_errors=True)  # of a run that was interrupted
    spool = PointSpool.of(scratch, header, cell)
    spool_tile = partial(_spool_tile, store, header, spool, (cell, edge))
    parts = list(executor.map(spool_tile, tiles, label="lay out the point cloud"))
    if edge > cell:
        overview = (np.asarray(store.load(tile.number, _OVERVIEW)) for tile in tiles)
        count = write_cloud(folder / "cloud.ply", overview, offset_enu, frame)
    write_cloud_json(folder / "cloud.json", count, offset_enu, edge, frame)
    write_copc(folder / "cloud.copc.laz", header, spool, parts, executor)


def _spool_tile(
    store: "ViewStore",
    header: "laspy.LasHeader",
    spool: PointSpool,
    sides: tuple[float, float],
    tile: "SurfaceTile",
) -> SpooledPart:
    """Put the points of a tile in the spool, and those of an overview in the store."""
    surface, (cell, edge) = tile.points(store), sides
    if edge > cell:
        store.save(tile.number, _OVERVIEW, vertices_of(surface, cell, edge))
    every = vertices_of(surface, cell, cell)
    return spool.add(f"{tile.number}", las_points(every, header).array)


def cloud_in_parts(dense: Path, folder: Path, frame: WorldFrame) -> Path:
    """A PLY of a cloud, of which any part can be read: the overview, or a copy of the COPC.

    Args:
        dense: folder of the cloud.
        folder: where a copy, `cloud.ply`, may be made.
        frame: of the cloud.
    """
    import laspy

    if (overview := dense / "cloud.ply").exists():
        return overview
    with laspy.open(dense / "cloud.copc.laz") as file:
        parts = (_vertices(part) for part in file.chunk_iterator(_CHUNK))
        write_cloud(folder / "cloud.ply", parts, file.header.offsets.tolist(), frame)
    return folder / "cloud.ply"


def _vertices(points: "laspy.ScaleAwarePointRecord") -> NDArray[Any]:
    """`VERTEX` records (N,) of points with a header of `las_header`."""
    vertices = np.empty(len(points), VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = points[name.upper()] * points.scales[axis]
    for name in ("red", "green", "blue"):
        vertices[name] = points[name] // 257
    for name in _LAS_EXTRA:
        vertices[name] = points[name]
    return vertices


def las_header(offset_enu: Sequence[float], frame: WorldFrame, cell: float) -> "laspy.LasHeader":
    """The header of a LAS 1.4 file of `VERTEX` records (point format 7).

    Coordinates are east, north and up from the offset, in steps of 1/10000 of the unit or, where
    points are closer than ten of these, of the next smaller power of ten; colours are 16-bit;
    normals and sigma are extra dimensions. The projection is that of the rasters where there is
    one.
    """
    import laspy
    import pyproj

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.offsets = np.asarray(offset_enu, dtype=np.float64)
    finest = 10.0 ** math.floor(math.log10(cell / _STEPS_OF_A_CELL))
    header.scales = np.full(3, min(_LAS_STEP, finest))
    header.creation_date = _NO_DATE
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name=name, type="f4", description=text)
            for name, text in _LAS_EXTRA.items()
        ]
    )
    if (crs := crs_of(frame)) is not None:
        header.add_crs(pyproj.CRS.from_wkt(crs.to_wkt()))
    return header


def las_points(vertices: NDArray[Any], header: "laspy.LasHeader") -> "laspy.ScaleAwarePointRecord":
    """Points with a header of `las_header` of `VERTEX` records (N,)."""
    import laspy

    points = laspy.ScaleAwarePointRecord.zeros(len(vertices), header=header)
    for axis, name in enumerate("xyz"):
        points[name] = vertices[name].astype(np.float64) + header.offsets[axis]
    for name in ("return_number", "number_of_returns"):
        points[name] = np.ones(len(vertices), np.uint8)
    for name in ("red", "green", "blue"):
        points[name] = vertices[name].astype(np.uint16) * 257
    for name in _LAS_EXTRA:
        points[name] = vertices[name]
    return points


def write_cloud_json(
    path: Path, count: int, offset_enu: Sequence[float], edge: float, frame: WorldFrame
) -> None:
    """Write what the cloud itself cannot say."""
    crs = crs_of(frame)
    CloudRecord.save(
        path,
        {
            "format": "alice-survey cloud",
            "version": 1,
            "points": count,
            "offset_east_north_up": [float(o) for o in offset_enu],
            "frame": frame.name,
            "unit": frame.unit,
            "crs": None if crs is None else crs.to_wkt(),
            "vertical_datum": frame.vertical_datum,
            "thinned_to": edge,
            "notes": list(frame.notes),
        },
    )
