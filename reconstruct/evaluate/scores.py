"""How well surface, mesh and mosaic of a simulated survey fit the true sea floor.

Where the mosaic puts things shows where its patches are found again on the true sea floor.
"""

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

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.records import MeshRecord
from alice_survey.core.run import progress
from alice_survey.sim.seafloor.terrain import Terrain
from alice_survey.sim.seafloor.texture import Texture
from reconstruct.elevation import Elevation
from reconstruct.evaluate.figures import (
    fit_doming,
    json_number,
    median,
    percentile,
    rms,
    shares_within,
    spread,
)
from reconstruct.evaluate.truth import surface_depth, surface_distance, surface_material
from reconstruct.mesh.visibility import distances_from
from reconstruct.raster import opened_raster

_STRIP_CELLS = 400_000


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceScore:
    """How well the surface fits, over all cells of the survey area."""

    cells: int
    """Cells in the area, filled or not."""
    places_ne: Array
    """(N, 2) aligned north and east of each filled cell."""
    distance_m: Array
    """(N,) distance of each filled cell from the nearest point of the true surface."""
    height_m: Array
    """(N,) height of each filled cell minus the true height straight below or above it."""

    sigma_m: Array
    """(N,) standard deviation that the model states; NaN where it states none."""

    map_m: Array
    """(rows, columns) of `height_m`; NaN where there is no cell."""
    extent_m: tuple[float, float, float, float]
    """West, east, south, north edges of the map, moved (not turned) to the true frame."""
    ground_pixel_m: float
    """Side of a picture's pixel on the sea floor."""

    @property
    def completeness(self) -> float:
        """Share of the area's cells that are filled."""
        return len(self.distance_m) / self.cells

    def to_json(self) -> dict[str, Any]:
        """Figures in millimetres and ground pixels."""
        distance, height = 1e3 * self.distance_m, 1e3 * self.height_m

        stated = self.sigma_m > 0
        ratio = self.height_m[stated] / self.sigma_m[stated]
        return {
            "cells": self.cells,
            "completeness": round(self.completeness, 4),
            **spread("distance", distance),
            "distance_max_mm": json_number(percentile(distance, 100), 3),
            "height_rms_mm": json_number(rms(height), 3),
            "height_median_mm": json_number(median(height), 3),
            "height_95_mm": json_number(percentile(np.abs(height), 95), 3),
            "doming": fit_doming(self.places_ne, self.height_m).to_json(),
            "ground_pixel_mm": round(1e3 * self.ground_pixel_m, 4),
            "completeness_within_px": shares_within(
                self.distance_m, self.ground_pixel_m, self.cells
            ),
            "error_over_sigma": {
                "rms": json_number(rms(ratio), 3),
                "median": json_number(median(ratio), 3),
                "robust": json_number(MAD_TO_SIGMA * median(np.abs(ratio)), 3),
                "within_1_sigma": json_number(float(np.mean(np.abs(ratio) < 1)), 4),
                "median_sigma_mm": json_number(1e3 * median(self.sigma_m[stated]), 3),
            },
        }


@progress.step("score the surface")
def score_surface(
    surface: Elevation,
    area: MultiPolygon,
    terrain: Terrain,
    truth_from_world: RigidTransform,
    ground_pixel_m: float,
) -> SurfaceScore:
    """Compare every DEM cell of the survey area with the true mesh.

    Args:
        surface: heights over local east and north.
        area: the survey area, x north and y east; its holes count as outside.
        terrain: the truth.
        truth_from_world: alignment from the model's to the true NED.
        ground_pixel_m: side of a picture's pixel on the sea floor.

    """
    heights, cell = surface.height, surface.cell
    rows, columns = heights.shape
    east = surface.west + (np.arange(columns) + 0.5) * cell
    north = surface.north - (np.arange(rows) + 0.5) * cell
    easts, norths = np.meshgrid(east, north)
    level = np.stack([norths, easts, 0 * easts], -1).reshape(-1, 3)
    filled = np.isfinite(heights).ravel()
    points = truth_from_world.apply(level - [0, 0, 1] * heights.reshape(-1, 1))
    plane = truth_from_world.apply(level - [0, 0, np.nanmedian(heights)])
    place = np.where(filled[:, None], points, plane)
    shapely.prepare(area)
    inside = shapely.contains_xy(area, place[:, 0], place[:, 1])
    shift_ne = (plane - level).mean(axis=0)[:2]
    used = np.flatnonzero(inside & filled)
    depth, distance = np.empty(len(used)), np.empty(len(used))
    for start in range(0, len(used), _STRIP_CELLS):  # ray casting needs much memory a ray
        part = slice(start, start + _STRIP_CELLS)
        depth[part] = surface_depth(terrain, points[used[part], :2])
        distance[part] = surface_distance(terrain, points[used[part]])
    errors = np.full(filled.shape, np.nan)
    errors[used] = depth - points[used, 2]

    return SurfaceScore(
        cells=max(round(area.area / cell**2), int(inside.sum())),
        places_ne=points[used, :2],
        distance_m=distance,
        height_m=errors[used],
        sigma_m=surface.sigma.ravel()[used],
        map_m=errors.reshape(heights.shape),
        extent_m=(
            surface.west + shift_ne[1],
            surface.west + columns * cell + shift_ne[1],
            surface.north - rows * cell + shift_ne[0],
            surface.north + shift_ne[0],
        ),
        ground_pixel_m=ground_pixel_m,
    )


_SAMPLES = 200_000


def read_mesh(folder: Path) -> tuple[Array, Array]:
    """Vertices of `mesh.glb`, (V, 3) NED metres in float64, and triangles, (T, 3).

    Raises:
        WorkspaceError: the file holds no triangles.
    """
    import trimesh

    offset = np.array(MeshRecord.read(folder / "mesh.json").offset_east_north_up)
    scene = trimesh.load_scene(folder / "mesh.glb", process=False, skip_materials=True)
    if not scene.geometry:
        raise WorkspaceError(f"{folder / 'mesh.glb'}: holds no triangles")
    mesh = scene.to_mesh()
    east_up_south = mesh.vertices + offset[[0, 2, 1]] * [1.0, 1.0, -1.0]
    return east_up_south[:, [2, 0, 1]] * [-1.0, 1.0, -1.0], mesh.faces


@progress.step("score the mesh")
def score_mesh(
    vertices_ned: Array,
    triangles: Array,
    area: MultiPolygon,
    terrain: Terrain,
    truth_from_world: RigidTransform,
    ground_pixel_m: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Distances of points spread evenly over the mesh from the truth, and of the truth from it.

    Args:
        vertices_ned: (V, 3) metres.
        triangles: (T, 3) corners.
        area: the survey area, x north and y east; only what lies in it counts.
        terrain: the truth.
        truth_from_world: alignment from the model's to the true NED.
        ground_pixel_m: side of a pixel on the sea floor.
        rng: draws the points.
    """
    shapely.prepare(area)
    vertices = truth_from_world.apply(vertices_ned)
    points = spread_over(vertices, triangles, _SAMPLES, rng)
    points = points[shapely.contains_xy(area, points[:, 0], points[:, 1])]
    distance = 1e3 * surface_distance(terrain, points) if len(points) else np.empty(0)
    low, high = np.array(area.bounds).reshape(2, 2)
    places = rng.uniform(low, high, (_SAMPLES, 2))
    places = places[shapely.contains_xy(area, places[:, 0], places[:, 1])]
    truth = np.column_stack([places, surface_depth(terrain, places)])
    away = distances_from(vertices, triangles.astype(np.int32), truth[np.isfinite(truth[:, 2])])
    return {
        "triangles": len(triangles),
        **spread("distance", distance),
        "completeness_within_px": shares_within(away, ground_pixel_m, max(len(places), 1)),
    }


def spread_over(vertices: Array, triangles: Array, count: int, rng: np.random.Generator) -> Array:
    """`count` points, evenly by area, on a mesh (uniform barycentric coordinates by reflection)."""
    corners = vertices[triangles]
    sides = corners[:, 1:] - corners[:, :1]
    size = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    chosen = rng.choice(len(triangles), count, p=size / size.sum())
    share = rng.random((count, 2))
    over = share.sum(axis=1) > 1
    share[over] = 1 - share[over]
    return np.asarray(corners[chosen, 0] + np.einsum("nk,nkj->nj", share, sides[chosen]))


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
            "clear_share": round(len(self.shifts_m) / max(self.patches, 1), 4),
        }
        if len(self.shifts_m):
            figures |= spread("position", 1e3 * np.linalg.norm(self.shifts_m, axis=1))
            figures["position_rms_px"] = round(1e-3 * figures["position_rms_mm"] / self.pixel_m, 4)
        return figures


@progress.step("score the mosaic")
def score_mosaic(
    mosaic: Path,
    surface: Elevation,
    area: MultiPolygon,
    terrain: Terrain,
    texture: Texture,
    truth_from_world: RigidTransform,
) -> MosaicScore:
    """Compare patches of the mosaic with the true sea floor painted at the same transform.

    Args:
        mosaic: colour and a last band that is 0 where nothing is known, over local east and north.
        surface: that the mosaic lies on.
        area: the survey area, x north and y east.
        terrain: true shape.
        texture: true reflectance.
        truth_from_world: alignment from the model's to the true NED.
    """
    area = area_in_world(area, terrain, truth_from_world)
    half = _PATCH_PX // 2 - 1
    shapely.prepare(area)
    with opened_raster(mosaic) as source:
        transform = source.transform
        windows = _patches(source.height, source.width, transform, area)
        shifts, middles, true_places = [], [], []
        for window in windows:
            picture = source.read(window=window)
            if picture[-1].min() == 0:
                continue
            points = _points(window, transform, surface)
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


def _points(window: Window, transform: Any, surface: Elevation) -> Array | None:
    """World points, (pixels, 3), of a window's pixels on the DEM; None where it has a hole."""
    rows, columns = np.mgrid[: window.height, : window.width] + 0.5
    east = transform.c + (window.col_off + columns.ravel()) * transform.a
    north = transform.f + (window.row_off + rows.ravel()) * transform.e
    height = surface.at(surface.height, np.column_stack([east, north]))
    return np.column_stack([north, east, -height]) if np.isfinite(height).all() else None


def _true_reflectance(terrain: Terrain, texture: Texture, places: Array, pixel_m: float) -> Array:
    """True reflectance, grey, (patch, patch), straight below or above (N, 2) north and east."""
    points, material = surface_material(terrain, places)
    footprint = np.full(len(points), pixel_m, dtype=np.float32)
    colour = texture.albedo(points, material, footprint)
    return np.asarray(colour.mean(axis=1).reshape(_PATCH_PX, _PATCH_PX).astype(np.float64))


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
