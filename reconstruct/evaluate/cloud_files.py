"""Clouds and elevation models of others, read into the local frame of a survey.

Coordinates in a projection reach 5,000 km: they are taken to local metres in float64 before
anything else is done with them.
"""

import struct
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import BinaryIO

import numpy as np

from alice_survey.core.artefacts import need_stage
from alice_survey.core.contents import one_line
from alice_survey.core.errors import ReconstructionError, WorkspaceError, why
from alice_survey.core.executor import run_apart
from alice_survey.core.frames import Array, Datum
from reconstruct.ply import read_ply_points

_MAX_POINTS = 2_000_000
_MAX_BLOCK = 64_000_000
"""Cells that are unpacked at once."""
_LAS_HEADER = 375
_COMPRESSED = 0x80
"""Bit of a header's point format that marks compression (LASzip)."""


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
    from pyproj.exceptions import ProjError

    if not path.is_file():
        raise WorkspaceError(f"{path}: no such file")
    kind = path.suffix.lower()
    try:
        if kind in (".laz", ".las"):
            points, crs = _apart(path) if _check_las(path) else _read_las(path)
        elif kind == ".ply":
            points, crs = read_ply_points(path, _MAX_POINTS), None
        elif kind in (".tif", ".tiff"):
            points, crs = _read_tiff(path)
        else:
            raise WorkspaceError(f"{path}: a reference is a LAZ, LAS, PLY or GeoTIFF file")
    except (OSError, ValueError, RuntimeError, MemoryError) as error:
        raise WorkspaceError(f"{path}: cannot be read: {one_line(error)}") from None
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise WorkspaceError(f"{path}: holds {len(points)} points; 100 or more are needed")
    if crs is None or datum is None:
        centre = np.median(points, axis=0)
        return (points if crs is None else points - centre), False
    try:
        local = _local(points, crs, datum)
    except ProjError as error:
        raise WorkspaceError(
            f"{path}: its coordinate system cannot be used: {one_line(error)}"
        ) from None
    if len(local) < 100:
        raise WorkspaceError(f"{path}: {len(local)} points have a place on Earth; 100 are needed")
    return local, True


def _apart(path: Path) -> tuple[Array, str | None]:
    """As `_read_las`, in a separate process: damaged LAZ data can end the one that unpacks them.

    Raises:
        ValueError: as `_read_las`, or they did.
    """
    try:
        return run_apart(_read_las, path)
    except BrokenExecutor:
        raise ValueError("its points are damaged: they cannot be unpacked") from None


def _read_las(path: Path) -> tuple[Array, str | None]:
    import laspy

    parts = []
    try:
        with laspy.open(path) as file:
            crs = file.header.parse_crs()
            step = -(-file.header.point_count // _MAX_POINTS)
            for chunk in file.chunk_iterator(1_000_000):
                xyz = np.column_stack([chunk.x, chunk.y, chunk.z]).astype(np.float64)
                parts.append(xyz[::step])
    # Neither laspy nor lazrs checks what a header says before it follows it.
    except (
        laspy.LaspyException, RuntimeError, struct.error, IndexError, KeyError, TypeError,
        AttributeError, OverflowError, MemoryError,
    ) as error:  # fmt: skip
        raise ValueError(one_line(error)) from None
    points = np.concatenate(parts) if parts else np.empty((0, 3))
    return points, None if crs is None else crs.to_wkt()


def _read_tiff(path: Path) -> tuple[Array, str | None]:
    import rasterio

    with rasterio.open(path, driver="GTiff") as source:
        rows, columns = source.block_shapes[0]
        if rows * columns > _MAX_BLOCK:
            raise ValueError(
                f"it is stored in blocks of {columns} x {rows} cells: store it in tiles"
            )
        step = max(1, round(np.sqrt(source.height * source.width / _MAX_POINTS)))
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


def _check_las(path: Path) -> bool:
    """Refuse a LAS or LAZ file that counts more records or chunks than it has bytes for.

    laspy reads on past the end for as many as are counted, and the reader of chunks, which makes
    room for all of them, ends the program. Offsets are those of ASPRS' LAS 1.4, table 3; the chunk
    table's place stands before the first chunk or, where that is -1, in the last 8 bytes.

    Returns:
        Whether its points are packed.

    Raises:
        ValueError: it counts so, or the chunk table is beyond its end.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_LAS_HEADER).ljust(_LAS_HEADER, b"\0")
        minor, header_size = head[25], struct.unpack_from("<H", head, 94)[0]
        points_at, records = struct.unpack_from("<II", head, 96)
        if header_size + 54 * records > points_at or points_at > size:
            raise ValueError(f"it counts {records} records before points at {points_at}")
        if minor >= 4:
            more_at, more = struct.unpack_from("<QI", head, 235)
            if more and more_at + 60 * more > size:
                raise ValueError(f"it counts {more} records after its points")
        packed = bool(head[104] & _COMPRESSED)
        if packed:
            _check_chunks(file, points_at, size)
    return packed


def _check_chunks(file: BinaryIO, points_at: int, size: int) -> None:
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

    Their reference level is rarely stated; the registration finds the difference. Points that
    their system puts nowhere on Earth are left out.
    """
    from pyproj import CRS, Transformer

    source = CRS.from_wkt(crs)
    if source.is_compound:
        source = source.sub_crs_list[0]
    longitude, latitude = Transformer.from_crs(
        source.to_2d(), "EPSG:4326", always_xy=True
    ).transform(points[:, 0], points[:, 1])
    place = np.column_stack([latitude, longitude, datum.height_m - points[:, 2]])
    ned = datum.ned_from_geodetic(place[np.isfinite(place).all(axis=1)])
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
        points = read_ply_points(cloud, _MAX_POINTS)
    except (OSError, ValueError) as error:
        raise WorkspaceError(f"{cloud}: cannot be read: {why(error)}") from None
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise ReconstructionError(f"{cloud}: holds {len(points)} points")
    return points
