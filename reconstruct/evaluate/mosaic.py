"""Where the mosaic puts things: patches of it are found again on the true sea floor."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.windows import Window
from scipy.spatial.transform import RigidTransform
from shapely.geometry import MultiPolygon, box

from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from alice_survey.sim.seafloor.terrain import Terrain
from alice_survey.sim.seafloor.texture import Texture
from reconstruct.evaluate.truth import surface_depth, surface_material
from reconstruct.raster import opened_raster

_PATCH_PX = 96
_PATCHES = 400
_CLEAR = 0.15
"""Response of phase correlation (1 for equal patches) from which a match is accepted."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MosaicScore:
    """Shifts between the mosaic and the true sea floor."""

    patches: int
    """Patches looked at."""
    shifts_m: Array
    """(N, 2) east and north by which the mosaic is off, where the match was clear."""
    points_world: Array
    """(N, 3) middles of those patches in the model."""
    points_true: Array
    """(N, 3) true places of what they show, NED."""
    pixel_m: float
    coverage: float
    """Share of the survey area that the mosaic shows."""

    def to_json(self) -> dict[str, Any]:
        """Figures in millimetres; no position error where no patch matched clearly."""
        figures: dict[str, Any] = {
            "pixel_mm": round(1e3 * self.pixel_m, 4),
            "coverage": round(self.coverage, 4),
            "patches": self.patches,
            "clear_patches": len(self.shifts_m),
            "clear_share": round(len(self.shifts_m) / max(self.patches, 1), 4),
        }
        if len(self.shifts_m):
            length_mm = 1e3 * np.linalg.norm(self.shifts_m, axis=1)
            figures["position_rms_mm"] = round(float(np.sqrt(np.mean(length_mm**2))), 3)
            figures["position_rms_px"] = round(1e-3 * figures["position_rms_mm"] / self.pixel_m, 4)
            figures["position_median_mm"] = round(float(np.median(length_mm)), 3)
            figures["position_95_mm"] = round(float(np.percentile(length_mm, 95)), 3)
        return figures


@progress.step("score the mosaic")
def score_mosaic(
    mosaic: Path,
    dem: Path,
    area: MultiPolygon,
    terrain: Terrain,
    texture: Texture,
    truth_from_world: RigidTransform,
) -> MosaicScore:
    """Compare patches of the mosaic with the true sea floor painted at the same transform.

    Args:
        mosaic: colour and a last band that is 0 where nothing is known, over local east and north.
        dem: heights the mosaic lies on, positive up.
        area: the survey area, x north and y east.
        terrain: true shape.
        texture: true reflectance.
        truth_from_world: alignment from the model's to the true NED.
    """
    area = area_in_world(area, terrain, truth_from_world)
    half = _PATCH_PX // 2 - 1
    shapely.prepare(area)
    with opened_raster(mosaic) as source, opened_raster(dem) as heights:
        transform = source.transform
        windows = _patches(source.height, source.width, transform, area)
        shifts, middles, true_places = [], [], []
        for window in windows:
            picture = source.read(window=window)
            if picture[-1].min() == 0:
                continue
            points = _points(window, transform, heights)
            if points is None:
                continue
            places = truth_from_world.apply(points)[:, :2]
            true = _true_reflectance(terrain, texture, places, transform.a)
            shift = _shift_px(picture[:-1].mean(axis=0), true)
            if shift is None:
                continue
            shifts.append(shift * [transform.a, transform.e])
            middle = points.reshape(_PATCH_PX, _PATCH_PX, 3)[half:-half, half:-half].mean((0, 1))
            middles.append(middle)
            back = middle - [shifts[-1][1], shifts[-1][0], 0.0]
            true_places.append(truth_from_world.apply(back)[:2])
        coverage = _coverage(source, area)
    true_ne = np.array(true_places).reshape(-1, 2)
    depth = surface_depth(terrain, true_ne) if len(true_ne) else np.empty(0)
    return MosaicScore(
        patches=len(windows),
        shifts_m=np.array(shifts).reshape(-1, 2),
        points_world=np.array(middles).reshape(-1, 3),
        points_true=np.column_stack([true_ne, depth]),
        pixel_m=float(transform.a),
        coverage=coverage,
    )


def area_in_world(
    area: MultiPolygon, terrain: Terrain, truth_from_world: RigidTransform
) -> MultiPolygon:
    """The survey area where the model has it: navigation may have shifted and turned the model."""
    world_from_truth, depth_m = truth_from_world.inv(), terrain.offset_ned[2]

    def in_world(corners_ne: Array) -> Array:
        corners = np.column_stack([corners_ne, np.full(len(corners_ne), depth_m)])
        return np.asarray(world_from_truth.apply(corners)[:, :2])

    return MultiPolygon(shapely.transform(area, in_world))


def _patches(rows: int, columns: int, transform: Any, area: MultiPolygon) -> list[Window]:
    """Windows spread over the area, each wholly inside."""
    step = max(_PATCH_PX, int(np.sqrt(rows * columns / _PATCHES)))
    windows = []
    for row in range(0, rows - _PATCH_PX, step):
        for column in range(0, columns - _PATCH_PX, step):
            west, north = transform * (column, row)
            east, south = transform * (column + _PATCH_PX, row + _PATCH_PX)
            if area.contains(box(south, west, north, east)):
                windows.append(Window(column, row, _PATCH_PX, _PATCH_PX))
    return windows


def _points(window: Window, transform: Any, heights: Any) -> Array | None:
    """World points, (pixels, 3), of a window's pixels on the DEM; None where it has a hole."""
    rows, columns = np.mgrid[: window.height, : window.width] + 0.5
    east = transform.c + (window.col_off + columns) * transform.a
    north = transform.f + (window.row_off + rows) * transform.e
    inverse = ~heights.transform
    column, row = inverse * (east.mean(), north.mean())
    half = int(np.ceil(_PATCH_PX * transform.a / heights.transform.a / 2)) + 2
    part = Window(int(column) - half, int(row) - half, 2 * half, 2 * half)
    tile = heights.read(1, window=part, boundless=True, fill_value=np.nan)
    if not np.isfinite(tile).all():
        return None
    x, y = inverse * (east.ravel(), north.ravel())
    maps = [
        np.float32(v - o - 0.5).reshape(1, -1) for v, o in ((x, part.col_off), (y, part.row_off))
    ]
    height = cv2.remap(tile, *maps, cv2.INTER_LINEAR).ravel().astype(np.float64)
    return np.column_stack([north.ravel(), east.ravel(), -height])


def _true_reflectance(terrain: Terrain, texture: Texture, places: Array, pixel_m: float) -> Array:
    """True reflectance, grey, (patch, patch), straight below or above (N, 2) north and east."""
    points, material = surface_material(terrain, places)
    footprint = np.full(len(points), pixel_m, dtype=np.float32)
    colour = texture.albedo(points, material, footprint)
    grey: Array = colour.mean(axis=1).reshape(_PATCH_PX, _PATCH_PX).astype(np.float64)
    return grey


def _shift_px(picture: Array, true: Array) -> NDArray[np.float64] | None:
    """Columns and rows by which the picture is off, or None when that is not clear."""
    window = cv2.createHanningWindow((_PATCH_PX, _PATCH_PX), cv2.CV_64F)
    flat = [np.log(p + 1e-2 * p.max() + 1e-9) for p in (true, picture.astype(np.float64))]
    flat = [f - cv2.GaussianBlur(f, (0, 0), 8) for f in flat]
    (x, y), response = cv2.phaseCorrelate(flat[0], flat[1], window)
    return np.array([x, y]) if response > _CLEAR else None


def _coverage(source: Any, area: MultiPolygon) -> float:
    """Share of the area that has colour, from an overview of at most 1000 pixels a side."""
    shrink = max(1.0, max(source.height, source.width) / 1000)
    shape = (max(1, int(source.height / shrink)), max(1, int(source.width / shrink)))
    known = source.read(source.count, out_shape=shape) > 0
    pixel_m2 = source.transform.a * source.width / shape[1]
    pixel_m2 *= -source.transform.e * source.height / shape[0]
    rows, columns = np.nonzero(known)
    east = source.transform.c + (columns + 0.5) * source.transform.a * source.width / shape[1]
    north = source.transform.f + (rows + 0.5) * source.transform.e * source.height / shape[0]
    return min(1.0, float(shapely.contains_xy(area, north, east).sum() * pixel_m2 / area.area))
