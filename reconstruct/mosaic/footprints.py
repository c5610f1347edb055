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
from reconstruct.raster import DemGrid, crs_of
from reconstruct.views.model import View, WorldFrame

Float32 = NDArray[np.float32]

_NODES = 17
"""Rays along the width and along the height of a picture."""
_STEPS = 96
"""Depths tried along a ray before the crossing is refined."""
_HALVINGS = 20


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


def picture_footprint(view: View, dem: Float32, grid: DemGrid) -> PictureFootprint:
    """Follow a picture's rays to the surface.

    Args:
        view: the picture, as warped.
        dem: heights, NaN where unknown.
        grid: its cells.
    """
    x = np.linspace(0.0, view.pinhole.width_px, _NODES)
    y = np.linspace(0.0, view.pinhole.height_px, _NODES)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    met, ranges = surface_points(view, pixels, dem, grid)
    met = met.reshape(_NODES, _NODES, 2)
    edge = np.concatenate([met[0], met[1:, -1], met[-1, -2::-1], met[-2:0:-1, 0]])
    one, two, three, four = met[:-1, :-1], met[:-1, 1:], met[1:, 1:], met[1:, :-1]
    first, second = three - one, four - two
    cells = 0.5 * np.abs(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
    whole = np.isfinite(cells)
    area = float(cells[whole].sum())
    pixels_per_cell = view.pinhole.width_px * view.pinhole.height_px / (_NODES - 1) ** 2
    found = np.isfinite(ranges)
    return PictureFootprint(
        outline=edge[np.isfinite(edge).all(axis=1)],
        area=area,
        ground_pixel=float(np.sqrt(area / (whole.sum() * pixels_per_cell)))
        if whole.any()
        else float("nan"),
        mean_range=float(ranges[found].mean()) if found.any() else float("nan"),
        seen=float(found.mean()),
    )


def surface_points(view: View, pixels: Array, dem: Float32, grid: DemGrid) -> tuple[Array, Array]:
    """Where the rays of pixels first meet a DEM.

    Args:
        view: the view.
        pixels: (N, 2) of its warped picture.
        dem: heights, NaN where unknown.
        grid: its cells.

    Returns:
        (N, 2) east and north, and (N,) distances from the pinhole's centre; NaN where no known
        cell is met.
    """
    known = dem[np.isfinite(dem)]
    nothing = np.full((len(pixels), 2), np.nan), np.full(len(pixels), np.nan)
    if not known.size:
        return nothing
    centre = view.world_from_cam.translation
    steepness = view.at_depth(pixels, np.ones(len(pixels)))[:, 2] - centre[2]
    low, high = float(known.min()), float(known.max())
    with np.errstate(divide="ignore", invalid="ignore"):
        down = np.where(steepness > 1e-6, steepness, np.nan)
        nearest = np.maximum((-high - centre[2]) / down * 0.9, 1e-6)
        farthest = np.maximum((-low - centre[2]) / down * 1.1, 2e-6)
    at = np.full(len(pixels), np.nan)
    before = nearest.copy()
    shares = np.linspace(0.0, 1.0, _STEPS)[:, None]
    depths = nearest + shares * (farthest - nearest)
    above = _above(view, np.tile(pixels, (_STEPS, 1)), depths.ravel(), dem, grid)
    below = above.reshape(depths.shape) <= 0  # NaN compares as False
    first, met = below.argmax(axis=0), below.any(axis=0)
    rays = np.arange(len(pixels))
    at[met] = depths[first, rays][met]
    before = np.where(met & (first > 0), depths[np.maximum(first - 1, 0), rays], before)
    under = at.copy()
    for _ in range(_HALVINGS):
        middle = 0.5 * (before + under)
        below = _above(view, pixels, middle, dem, grid) <= 0
        under = np.where(below, middle, under)
        before = np.where(below, before, middle)
    points = view.at_depth(pixels, under)
    missed = ~np.isfinite(under)
    points[missed] = np.nan
    return points[:, [1, 0]], np.linalg.norm(points - centre, axis=1)


def _above(view: View, pixels: Array, depth: Array, dem: Float32, grid: DemGrid) -> Array:
    """Height of rays over the DEM at depths; NaN where that is unknown."""
    safe = np.where(np.isfinite(depth), depth, 1.0)
    points = view.at_depth(pixels, safe)
    column = (points[:, 1] - grid.west) / grid.cell - 0.5
    row = (grid.north - points[:, 0]) / grid.cell - 0.5
    inside = (
        np.isfinite(depth)
        & (column > -0.5) & (column < grid.columns - 0.5)
        & (row > -0.5) & (row < grid.rows - 0.5)
    )  # fmt: skip
    column = np.clip(np.where(inside, column, 0.0), 0.0, grid.columns - 1.0)
    row = np.clip(np.where(inside, row, 0.0), 0.0, grid.rows - 1.0)
    left = np.minimum(column.astype(int), max(grid.columns - 2, 0))
    top = np.minimum(row.astype(int), max(grid.rows - 2, 0))
    right, bottom = np.minimum(left + 1, grid.columns - 1), np.minimum(top + 1, grid.rows - 1)
    p, q = column - left, row - top
    height = (
        (dem[top, left] * (1 - p) + dem[top, right] * p) * (1 - q)
        + (dem[bottom, left] * (1 - p) + dem[bottom, right] * p) * q
    )  # fmt: skip
    return np.where(inside, -points[:, 2] - height, np.nan)


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
