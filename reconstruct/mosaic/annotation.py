"""The mosaic cut for annotation tools: pictures of bounded size with their scale.

TagLab takes at most 32,767 pixels a side, BIIGLE needs plain pictures with their area. Each tile
has a world file (six lines: pixel size, turns, and the centre of the first pixel) and a line in
`tiles.csv`.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.core.artefacts import atomic_path, need_stage, write_csv
from alice_survey.core.errors import ConfigError
from alice_survey.core.executor import progress
from alice_survey.core.records import MosaicRecord

MAX_SIDE_PX = 32_767
_STRIP = 512
_BAR_SHARE = 0.2
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
    scale_bar: bool = False,
) -> tuple[str, dict[str, Any]]:
    """Cut the mosaic of a workspace.

    Args:
        workspace: with a finished mosaic.
        folder: to write `tile_RRR_CCC.KIND`, their world files and `tiles.csv` to.
        side_px: width and height of tiles, less at the mosaic's edges.
        overlap_px: by which neighbours overlap.
        kind: of picture; `tif` keeps the coordinate system.
        scale_bar: draw one into the lower left corner of each tile.

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
            known = _write_tile(raster, window, folder / name, kind, scale_bar, unit)
            if known == 0:
                continue
            t = raster.window_transform(window)
            rows.append(
                (name, window.col_off, window.row_off, window.width, window.height, t.a,
                 unit, t.c, t.f, round(known / (window.width * window.height), 4),
                 round(known * t.a**2, 6))
            )  # fmt: skip
    write_csv(folder / "tiles.csv", _HEADER, rows)
    data = {
        "folder": str(folder),
        "tiles": len(rows),
        "side_px": side_px,
        "pixel": pixel,
        "unit": unit,
    }
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


def _write_tile(
    raster: rasterio.DatasetReader, window: Window, path: Path, kind: Kind, bar: bool, unit: str
) -> int:
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
            marks = _scale_bar(window.width, window.height, transform.a, unit) if bar else None
            for top in range(0, int(window.height), _STRIP):
                high = min(_STRIP, int(window.height) - top)
                part = raster.read(
                    window=Window(window.col_off, window.row_off + top, window.width, high)
                )
                known += int((part[3] > 0).sum())
                if marks is not None:
                    _draw(part, top, *marks)
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


def _scale_bar(
    width: int, height: int, pixel: float, unit: str
) -> tuple[NDArray[np.uint8], int, int]:
    """A bar of a round length with its text, (h, w, 4) RGBA, and where its first pixel goes."""
    requested = _BAR_SHARE * width * pixel
    decade = 10.0 ** math.floor(math.log10(requested))
    length = max(digit * decade for digit in (1, 2, 5) if digit * decade <= requested * (1 + 1e-9))
    bar_px = max(2, round(length / pixel))
    size = max(0.4, min(width, height) / 1500)
    thick = max(1, round(2 * size))
    text = f"{length:g} {unit}"
    (wide, high), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, thick)
    pad = max(4, high // 2)
    box = np.zeros((high + below + 4 * pad, max(bar_px, wide) + 2 * pad, 4), np.uint8)
    box[..., 3] = 255
    box[-2 * pad : -pad, pad : pad + bar_px, :3] = 255
    cv2.putText(
        box, text, (pad, pad + high), cv2.FONT_HERSHEY_SIMPLEX, size, (255, 255, 255, 255), thick
    )
    box = box[:height, :width]
    return box, max(0, height - box.shape[0] - pad), min(pad, width - box.shape[1])


def _draw(part: NDArray[np.uint8], top: int, box: NDArray[np.uint8], row: int, column: int) -> None:
    """Draw the part of a box that lies in a strip (4, h, w) which starts at a row."""
    first, last = max(row, top), min(row + box.shape[0], top + part.shape[1])
    if first < last:
        shown = box[first - row : last - row].transpose(2, 0, 1)
        part[:, first - top : last - top, column : column + box.shape[1]] = shown
