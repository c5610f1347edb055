"""A survey against an independent cloud or elevation model of the same place.

Coordinates in a projection reach 5,000 km: they are taken to local metres in float64 before
anything else is done with them.
"""

import struct
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import need_stage, refuse_links
from alice_survey.core.contents import one_line, where_unknown
from alice_survey.core.errors import ReconstructionError, WorkspaceError, file_faults
from alice_survey.core.executor import run_apart
from alice_survey.core.frames import Array, Datum
from alice_survey.core.records import ReferenceRecord, RegistrationRecord
from alice_survey.core.run import progress
from alice_survey.kit.figure import figure_style, new_figure, save_figure
from reconstruct.evaluate.figures import (
    fit_doming,
    json_number,
    map_errors,
    mean_grid,
    shares_within,
)
from reconstruct.evaluate.registration import (
    CloudDistances,
    ReferenceSurface,
    covers,
    distances,
    register_cloud,
)
from reconstruct.mosaic.grid import mean_pixel
from reconstruct.placing.alignment import Similarity
from reconstruct.ply import read_ply_points
from reconstruct.views.model import read_model

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
        rows, columns = np.nonzero(~where_unknown(height))
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
    return np.asarray(ned[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0]))


def read_own_cloud(workspace: Path) -> Array:
    """Points of the workspace's cloud, (N, 3) east, north, up, float64.

    Raises:
        WorkspaceError: it is not there.
        ReconstructionError: it is empty.
    """
    cloud = need_stage(workspace, "dense", "reconstruct") / "cloud.ply"
    ready = cloud.exists()  # of a cloud that is too large to be read whole
    cloud = cloud if ready else cloud.with_name("cloud.copc.laz")
    with file_faults(cloud, WorkspaceError):
        points = read_ply_points(cloud, _MAX_POINTS) if ready else _apart(cloud)[0]
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise ReconstructionError(f"{cloud}: holds {len(points)} points")
    return points


_NAVIGATION = "navigation"
_CELLS = 320
"""Cells of the map along its longer side."""


@progress.step("compare with the reference")
def evaluate_reference(
    workspace: Path, reference: Path, *, free_scale: bool | None = None, out: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """Compare the cloud of a workspace with a LAZ, LAS, PLY or GeoTIFF of the same place.

    Both are brought together by their georeferences, then by closest points: rigidly where the
    scale of the survey was observed (rig, bar, control points), with a free scale that is
    reported where it comes from navigation or is not known. Writes `reference.json` and
    `reference.png` into `reference/` of the workspace, or `out`.

    Args:
        workspace: with a finished surface.
        reference: the file.
        free_scale: overrules where the scale is held.
        out: folder to write to.

    Returns:
        A few lines of text, and figures as JSON values.

    Raises:
        WorkspaceError: something is missing, or the survey has no georeference.
        ReconstructionError: the two show different places.
    """
    sparse = need_stage(workspace, "sparse", "reconstruct")
    model = read_model(sparse)
    if model.frame.datum is None:
        raise WorkspaceError(
            f"{workspace} is not georeferenced: a reference is compared where the georeference "
            "puts it; give positions in the manifest or control points"
        )
    source = RegistrationRecord.read(sparse / "registration.json").scale_source or "no scale"
    if free_scale is None:
        free_scale = not model.frame.scaled or _NAVIGATION in source
    rng = np.random.default_rng(1)
    own = read_own_cloud(workspace)
    theirs, _ = read_reference(reference, model.frame.datum)
    surface = ReferenceSurface.of(theirs)
    start = first_placement(own, surface)
    fit = register_cloud(own, surface, start, free_scale=free_scale, rng=rng)
    pose, middle = fit.reference_from_cloud, own.mean(axis=0)
    moved, shift = pose.apply(own), pose.apply(middle[None])[0] - middle
    pixel_m = mean_pixel(model) * pose.scale
    ours = distances(moved, surface, rng)
    back = distances(theirs, ReferenceSurface.of(moved), rng)
    figures = {
        "format": "alice-survey reference",
        "version": 1,
        "reference": str(reference),
        "ground_pixel_m": json_number(pixel_m, 6),
        "registration": {
            "transform": "similarity" if free_scale else "rigid",
            "scale_source": source,
            "scale": round(pose.scale, 7),
            "scale_sigma": round(fit.scale_sigma, 7),
            "shift_east_north_up_m": [round(float(v), 4) for v in shift],
            "turn_deg": [round(float(v), 4) for v in np.rad2deg(pose.rotation.as_rotvec())],
            "spread_m": round(fit.spread, 5),
        },
        "survey_to_reference": ours.to_json(pixel_m),
        "reference_to_survey": back.to_json(pixel_m),
        "completeness_within_px": shares_within(np.abs(back.signed_m), pixel_m, len(back.signed_m)),
        "doming": fit_doming(ours.points[:, :2], ours.signed_m).to_json(),
    }
    folder = out or workspace / "reference"
    refuse_links(workspace, folder)
    folder.mkdir(parents=True, exist_ok=True)
    plot_reference(folder / "reference.png", ours, back, pixel_m)
    ReferenceRecord.save(folder / "reference.json", figures)
    return _text(figures, folder), figures


def first_placement(own: Array, surface: ReferenceSurface) -> Similarity:
    """Where both cover the ground their median heights are made equal: datums often differ.

    Where they share no ground the middles are laid on each other.
    """
    covered = covers(surface, own)
    if covered.any():
        below = own[covered][:: max(1, int(covered.sum()) // 20_000)]
        _, nearest = cKDTree(surface.points[:, :2]).query(below[:, :2])
        shift = np.array([0.0, 0.0, float(np.median(surface.points[nearest, 2] - below[:, 2]))])
    else:
        shift = np.median(surface.points, axis=0) - np.median(own, axis=0)
    return Similarity(scale=1.0, rotation=Rotation.identity(), translation=shift)


def _text(figures: dict[str, Any], folder: Path) -> str:
    fit, dome = figures["registration"], figures["doming"]
    lines = [
        f"{name}: median {one['median_m']:.4f} m ({one['median_px']:.2f} ground pixels), rms "
        f"{one['rms_m']:.4f} m, 95 % below {one['95_m']:.4f} m; {one['covered_share']:.1%} covered"
        for name, one in (
            ("survey to reference", figures["survey_to_reference"]),
            ("reference to survey", figures["reference_to_survey"]),
        )
    ]
    scale = f", scale {fit['scale']:.5f}" if fit["transform"] == "similarity" else ""
    lines.append(
        f"registered ({fit['transform']}{scale}) by {fit['shift_east_north_up_m']} m east, north, "
        f"up; {figures['completeness_within_px']['3']:.1%} of the reference within 3 pixels"
    )
    if dome["dome_mm"] is not None:
        lines.append(f"dome {dome['dome_mm']:.1f} +/- {dome['sigma_mm']} mm")
    return "\n".join([*lines, f"map in {folder / 'reference.png'}"])


@figure_style()
def plot_reference(path: Path, ours: CloudDistances, back: CloudDistances, pixel_m: float) -> None:
    """Map of the survey's signed distance from the reference, and both cumulative shares."""
    limit = max(float(np.percentile(np.abs(ours.signed_m), 95)), 1e-9)
    places = ours.points[:, :2]
    side = max(float(np.ptp(places, axis=0).max()) / _CELLS, 1e-12)
    values, west, north = mean_grid(places, ours.signed_m, side)
    extent = (west, west + values.shape[1] * side, north - values.shape[0] * side, north)
    figure = new_figure(5.6, 13)
    plane, curve = figure.subplots(1, 2, width_ratios=[1.3, 1])
    title, label = "Survey minus reference", "survey above reference (m)"
    map_errors(plane, values, limit, title, label, extent=extent)
    for one, name in ((ours, "survey to reference"), (back, "reference to survey")):
        away = np.sort(np.abs(one.signed_m))[:: max(1, len(one.signed_m) // 2000)]
        curve.plot(away / pixel_m, np.linspace(0, 1, len(away)), label=name)
    curve.set(xlim=(0, max(6.0, 2 * limit / pixel_m)), ylim=(0, 1))
    curve.set(xlabel="distance (ground pixels)", ylabel="share of points below")
    curve.legend(loc="lower right")
    save_figure(figure, path)
