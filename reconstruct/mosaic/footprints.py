"""What each picture shows: its outline on the surface, area, ground pixel and range.

Rays around the edge of a picture, and over it, are followed to the DEM, exactly through a flat port
(`View.at_depth`).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.warp import transform as to_crs

from alice_survey.core.artefacts import write_csv, write_json
from alice_survey.core.frames import Array
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
