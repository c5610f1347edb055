"""The mosaic cut for annotation tools: pictures of bounded size with their scale.

TagLab takes at most 32,767 pixels a side, BIIGLE needs plain pictures with their area. Each tile
has a world file (six lines: pixel size, turns, and the centre of the first pixel) and a line in
`tiles.csv`.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import rasterio
import rasterio.shutil
from rasterio.windows import Window

from alice_survey.core.artefacts import atomic_path, need_stage, write_csv
from alice_survey.core.errors import ConfigError
from alice_survey.core.executor import progress
from alice_survey.core.records import MosaicRecord

MAX_SIDE_PX = 32_767
_STRIP = 512
_HEADER = (
    "tile", "column_px", "row_px", "width_px", "height_px", "pixel", "unit", "west", "north",
    "known_share", "known_area",
)  # fmt: skip

Kind = Literal["png", "jpg", "tif"]


def mosaic_tiles(
    workspace: Path,
    folder: Path,
    *,
    side_px: int = 8192,
    overlap_px: int = 0,
    kind: Kind = "png",
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
        for line, column, window in progress(windows, "tiles", len(windows)):
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
    with atomic_path(path.with_suffix(".rough.tif")) as rough:
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
