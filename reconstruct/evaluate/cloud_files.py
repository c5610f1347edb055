"""Clouds and elevation models of others, read into the local frame of a survey.

Coordinates in a projection reach 5,000 km: they are taken to local metres in float64 before
anything else is done with them.
"""

import struct
from pathlib import Path

import numpy as np

from alice_survey.artefacts import need_stage
from alice_survey.errors import ReconstructionError, WorkspaceError, why
from alice_survey.frames import Array, Datum
from reconstruct.evaluate.ply_points import read_ply_points

_MOST_POINTS = 2_000_000
_LAS_HEADER = 227
_COMPRESSED = 0x80
"""In the point format of a header (LASzip)."""


def read_reference(path: Path, datum: Datum | None) -> tuple[Array, bool]:
    """Points of a LAZ, LAS or PLY cloud, or cells of a GeoTIFF elevation model.

    A file without a coordinate system is taken to be in local east, north, up. Of more than
    2 million points every n-th is read.

    Args:
        path: of the file.
        datum: of the survey; None where it has none, then the file's own metres count from its
            middle.

    Returns:
        (N, 3) east, north, up of the datum, metres in float64; and whether the file's coordinate
        system put them there (False: only the shape is known).

    Raises:
        WorkspaceError: the file is missing, of another kind, or holds no point.
    """
    if not path.is_file():
        raise WorkspaceError(f"{path}: no such file")
    kind = path.suffix.lower()
    try:
        if kind in (".laz", ".las"):
            points, crs = _read_las(path)
        elif kind == ".ply":
            points, crs = read_ply_points(path, _MOST_POINTS), None
        elif kind in (".tif", ".tiff"):
            points, crs = _read_tiff(path)
        else:
            raise WorkspaceError(f"{path}: a reference is a LAZ, LAS, PLY or GeoTIFF file")
    except (OSError, ValueError, RuntimeError) as error:
        raise WorkspaceError(f"{path}: cannot be read: {why(error)}") from None
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise WorkspaceError(f"{path}: holds {len(points)} points; 100 or more are needed")
    if crs is None or datum is None:
        centre = np.median(points, axis=0)
        return (points if crs is None else points - centre), False
    return _local(points, crs, datum), True


def _read_las(path: Path) -> tuple[Array, str | None]:
    import laspy

    parts = []
    _check_chunks(path)
    try:
        with laspy.open(path) as file:
            crs = file.header.parse_crs()
            step = -(-file.header.point_count // _MOST_POINTS)
            for chunk in file.chunk_iterator(1_000_000):
                xyz = np.column_stack([chunk.x, chunk.y, chunk.z]).astype(np.float64)
                parts.append(xyz[::step])
    except laspy.LaspyException as error:
        raise ValueError(str(error)) from None
    points = np.concatenate(parts) if parts else np.empty((0, 3))
    return points, None if crs is None else crs.to_wkt()


def _read_tiff(path: Path) -> tuple[Array, str | None]:
    import rasterio

    with rasterio.open(path) as source:
        step = max(1, round(np.sqrt(source.height * source.width / _MOST_POINTS)))
        # The nearest cell: a mean would round off what is compared
        shape = (-(-source.height // step), -(-source.width // step))
        band = source.read(1, out_shape=shape, masked=True)
        height = band.astype(np.float64).filled(np.nan)
        rows, columns = np.nonzero(np.isfinite(height))
        x = (columns + 0.5) * source.width / shape[1]
        y = (rows + 0.5) * source.height / shape[0]
        east = source.transform.c + x * source.transform.a + y * source.transform.b
        north = source.transform.f + x * source.transform.d + y * source.transform.e
        crs = source.crs.to_wkt() if source.crs is not None else None
    return np.column_stack([east, north, height[rows, columns]]), crs


def _check_chunks(path: Path) -> None:
    """Refuse a LAZ file that counts more chunks than it has bytes: its reader ends the program.

    The chunk table's place stands before the first chunk, or, where that is -1, in the last 8 bytes
    (https://laszip.org, LASzip's "chunk table").

    Raises:
        ValueError: it does, or the table is beyond its end.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_LAS_HEADER)
        if len(head) < _LAS_HEADER:
            raise ValueError("it is too short for its header")
        (points_at,) = struct.unpack_from("<I", head, 96)
        if not head[104] & _COMPRESSED:
            return
        file.seek(points_at)
        (table_at,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
        if table_at == -1:
            file.seek(size - 8)
            (table_at,) = struct.unpack("<q", file.read(8))
        if not points_at < table_at <= size - 8:
            raise ValueError("its table of chunks is missing: it was cut short")
        file.seek(table_at + 4)
        (chunks,) = struct.unpack("<I", file.read(4))
    if chunks > size:
        raise ValueError(f"it counts {chunks} chunks in {size} bytes")


def _local(points: Array, crs: str, datum: Datum) -> Array:
    """East, north, up of a datum, heights as they are.

    What level they count from is seldom stated; the registration finds the difference.
    """
    from pyproj import CRS, Transformer

    source = CRS.from_wkt(crs)
    if source.is_compound:
        source = source.sub_crs_list[0]
    longitude, latitude = Transformer.from_crs(
        source.to_2d(), "EPSG:4326", always_xy=True
    ).transform(points[:, 0], points[:, 1])
    depth = datum.height_m - points[:, 2]
    ned = datum.ned_from_geodetic(np.column_stack([latitude, longitude, depth]))
    enu: Array = ned[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])
    return enu


def read_own_cloud(workspace: Path) -> Array:
    """Points of the workspace's cloud, (N, 3) east, north, up, float64.

    Raises:
        WorkspaceError: it is not there.
        ReconstructionError: it is empty.
    """
    cloud = need_stage(workspace, "dense", "reconstruct") / "cloud.ply"
    try:
        points = read_ply_points(cloud, _MOST_POINTS)
    except (OSError, ValueError) as error:
        raise WorkspaceError(f"{cloud}: cannot be read: {why(error)}") from None
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise ReconstructionError(f"{cloud}: holds {len(points)} points")
    return points
