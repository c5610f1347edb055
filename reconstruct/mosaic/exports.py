"""What is made of a mosaic for other programs: outlines of pictures, and tiles.

What each picture shows is its outline on the surface, area, ground pixel and range. Rays around the
edge of a picture, and over it, are followed to the DEM, exactly through a flat port
(`View.at_depth`).

Tiles are pictures of bounded size with their scale. TagLab takes at most 32,767 pixels a side,
BIIGLE needs plain pictures with their area. Each tile has a world file (six lines: pixel size,
turns, and the centre of the first pixel) and a line in `tiles.csv`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.warp import transform as to_crs
from rasterio.windows import Window

from alice_survey.core import executor
from alice_survey.core.artefacts import atomic_path, need_stage, write_csv, write_json
from alice_survey.core.errors import ConfigError
from alice_survey.core.frames import Array
from alice_survey.core.records import MosaicRecord
from alice_survey.core.run import progress
from reconstruct.elevation import Elevation
from reconstruct.raster import DemGrid, crs_of
from reconstruct.views.model import View, WorldFrame

_MAX_CELLS = 512
"""Cells along the longer side of the part of a DEM that rays are followed to."""
_NODES = 17
"""Rays along the width and along the height of a picture."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureFootprint:
    """Footprint of one picture; lengths in the unit of the model."""

    outline: Array
    """(N, 2) east and north around the picture, those rays alone that meet the surface."""
    area: float
    """Plan area of the surface within the grid of rays that meet it; 0 where none do."""
    ground_pixel: float
    """Root of the plan's area that a pixel of the picture covers; NaN where nothing is met."""
    mean_range: float
    """Mean distance from the pinhole's centre; NaN where nothing is met."""
    seen: float
    """Share of the rays over the picture that meet the surface."""


def picture_footprint(view: View, dem: NDArray[np.float32], grid: DemGrid) -> PictureFootprint:
    """Follow a picture's rays to the surface.

    Args:
        view: the picture, as warped.
        dem: heights, NaN where unknown; of many only every second, third, ... is looked at.
        grid: its cells.
    """
    size = view.pinhole.size_px
    x, y = np.meshgrid(*(np.linspace(0.0, side, _NODES) for side in size))
    met, ranges = hits_of(view, np.column_stack([x.ravel(), y.ravel()]), dem, grid)
    met = met.reshape(_NODES, _NODES, 2)
    edge = np.concatenate([met[0], met[1:, -1], met[-1, -2::-1], met[-2:0:-1, 0]])
    first, second = met[1:, 1:] - met[:-1, :-1], met[1:, :-1] - met[:-1, 1:]
    cells = 0.5 * np.abs(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
    cells, known = cells[np.isfinite(cells)], ranges[np.isfinite(ranges)]
    cell_px = size[0] * size[1] / (_NODES - 1) ** 2
    return PictureFootprint(
        outline=edge[np.isfinite(edge).all(axis=1)],
        area=float(cells.sum()),
        ground_pixel=float(np.sqrt(cells.mean() / cell_px)) if len(cells) else float("nan"),
        mean_range=float(known.mean()) if len(known) else float("nan"),
        seen=len(known) / len(ranges),
    )


def hits_of(
    view: View, pixels: Array, dem: NDArray[np.float32], grid: DemGrid
) -> tuple[Array, Array]:
    """Where the rays of pixels (N, 2) of a view first meet a DEM; arguments as above.

    Returns:
        (N, 2) east and north, and (N,) distances from the pinhole's centre; NaN where no known
        cell is met.
    """
    every = 1 + max(dem.shape) // _MAX_CELLS
    corner = 0.5 * (1 - every) * grid.cell
    surface = Elevation(
        height=dem[::every, ::every].astype(np.float64),
        sigma=np.empty(0),
        west=grid.west + corner,
        north=grid.north - corner,
        cell=every * grid.cell,
    )
    near, far = (view.at_depth(pixels, np.full(len(pixels), depth)) for depth in (1.0, 2.0))
    ways = (far - near) / np.linalg.norm(far - near, axis=1, keepdims=True)  # straight in the water
    points = surface.met_by(2.0 * near - far, ways)
    return points[:, [1, 0]], np.linalg.norm(points - view.world_from_cam.translation, axis=1)


@progress.step("outline the pictures")
def write_footprints(
    folder: Path, views: tuple[View, ...], found: list[PictureFootprint], frame: WorldFrame
) -> None:
    """Write `footprints.csv`, and `footprints.geojson` where positions on Earth are known."""
    unit = "m" if frame.scaled else "units"
    header = (
        "image", "camera", "station", f"area_{unit}2", f"ground_pixel_{unit}",
        f"mean_range_{unit}", "seen_share",
    )  # fmt: skip
    rows = [
        (v.image, v.camera, v.station, f"{f.area:.6g}", _cell(f.ground_pixel), _cell(f.mean_range),
         f"{f.seen:.3f}")
        for v, f in zip(views, found, strict=True)
    ]  # fmt: skip
    write_csv(folder / "footprints.csv", header, rows)
    crs = crs_of(frame)
    if crs is None:
        return
    features: list[dict[str, Any]] = []
    for row, print_ in zip(rows, found, strict=True):
        geometry = None
        if len(print_.outline) >= 3:
            closed = np.vstack([print_.outline, print_.outline[:1]])
            lon, lat = to_crs(crs, "EPSG:4326", closed[:, 0], closed[:, 1])
            ring = [[round(x, 9), round(y, 9)] for x, y in zip(lon, lat, strict=True)]
            geometry = {"type": "Polygon", "coordinates": [ring[::-1]]}
        named = dict(zip(header, row, strict=True))
        features.append({"type": "Feature", "properties": named, "geometry": geometry})
    write_json(folder / "footprints.geojson", {"type": "FeatureCollection", "features": features})


def _cell(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.6g}"


MAX_SIDE_PX = 32_767
_STRIP = 512
_HEADER = (
    "tile", "column_px", "row_px", "width_px", "height_px", "pixel", "unit", "west", "north",
    "known_share", "known_area",
)  # fmt: skip

Kind = Literal["png", "jpg", "tif"]


def mosaic_tiles(
    workspace: Path, folder: Path, *, side_px: int = 8192, overlap_px: int = 0, kind: Kind = "png"
) -> tuple[str, dict[str, Any]]:
    """Cut the mosaic of a workspace.

    Args:
        workspace: with a finished mosaic.
        folder: to write `tile_RRR_CCC.KIND`, their world files and `tiles.csv` to.
        side_px: width and height of tiles, less at the mosaic's edges.
        overlap_px: by which neighbours overlap.
        kind: of picture; `tif` keeps the coordinate system.

    Returns:
        What was written, as text and as JSON values.

    Raises:
        ConfigError: a size is out of range.
        WorkspaceError: there is no mosaic.
    """
    if not 64 <= side_px <= MAX_SIDE_PX:
        raise ConfigError(f"tiles of {side_px} px: give 64 to {MAX_SIDE_PX}")
    if not 0 <= overlap_px < side_px:
        raise ConfigError(f"overlap of {overlap_px} px: give 0 to {side_px - 1}, less than a side")
    mosaic = need_stage(workspace, "mosaic", "reconstruct")
    about = MosaicRecord.read(mosaic / "mosaic.json")
    unit, pixel = about.unit, about.pixel
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    with rasterio.open(mosaic / "mosaic.tif") as raster:
        windows = list(_windows(raster.width, raster.height, side_px, overlap_px))
        for line, column, window in executor.progress(windows, "tiles", len(windows)):
            name = f"tile_{line:03d}_{column:03d}.{kind}"
            known = _write_tile(raster, window, folder / name, kind)
            if known == 0:
                continue
            t = raster.window_transform(window)
            rows.append(
                (name, window.col_off, window.row_off, window.width, window.height, t.a,
                 unit, t.c, t.f, round(known / (window.width * window.height), 4),
                 round(known * t.a**2, 6))
            )  # fmt: skip
    write_csv(folder / "tiles.csv", _HEADER, rows)
    data = {"folder": str(folder), "tiles": len(rows), "side_px": side_px}
    data |= {"pixel": pixel, "unit": unit}
    text = f"{len(rows)} tiles of up to {side_px} px, {pixel} {unit} a pixel"
    return f"{text}, in {folder}", data


def _windows(
    width: int, height: int, side_px: int, overlap_px: int
) -> Iterator[tuple[int, int, Window]]:
    step = side_px - overlap_px
    for line, row in enumerate(range(0, max(1, height - overlap_px), step)):
        for number, column in enumerate(range(0, max(1, width - overlap_px), step)):
            window = Window(column, row, min(side_px, width - column), min(side_px, height - row))
            yield line, number, window


def _write_tile(raster: rasterio.DatasetReader, window: Window, path: Path, kind: Kind) -> int:
    """Write one tile strip by strip unless it is empty; return how many pixels are known."""
    transform = raster.window_transform(window)
    drivers = {"png": "PNG", "jpg": "JPEG", "tif": "GTiff"}
    bands = 3 if kind == "jpg" else 4
    shared = {"width": window.width, "height": window.height, "dtype": "uint8"}
    known = 0
    with atomic_path(path.with_suffix(".rough.tif"), lasting=False) as rough:
        with rasterio.open(
            rough, "w", driver="GTiff", count=bands, crs=raster.crs, transform=transform,
            photometric="RGB", tiled=True, compress="deflate", zlevel=1, bigtiff="if_safer",
            **shared, **({"alpha": "yes"} if bands == 4 else {}),
        ) as out:  # fmt: skip
            for top in range(0, int(window.height), _STRIP):
                high = min(_STRIP, int(window.height) - top)
                part = raster.read(
                    window=Window(window.col_off, window.row_off + top, window.width, high)
                )
                known += int((part[3] > 0).sum())
                out.write(part[:bands], window=Window(0, top, window.width, high))
        if known and kind == "tif":
            rough.replace(path)
            rough.touch()
        elif known:
            options = {"quality": 95} if kind == "jpg" else {"zlevel": 6}
            rasterio.shutil.copy(rough, path, driver=drivers[kind], **options)
    path.with_suffix(".rough.tif").unlink(missing_ok=True)
    path.with_name(path.name + ".aux.xml").unlink(missing_ok=True)
    if known:
        world = (transform.a, 0.0, 0.0, transform.e,
                 transform.c + transform.a / 2, transform.f + transform.e / 2)  # fmt: skip
        suffix = {"png": ".pgw", "jpg": ".jgw", "tif": ".tfw"}[kind]
        path.with_suffix(suffix).write_text("".join(f"{value:.12g}\n" for value in world))
    return known
