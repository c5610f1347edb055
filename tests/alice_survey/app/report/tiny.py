"""A workspace of a few files, as finished stages would leave it: a tilted plane with a hole."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.transform import Affine

from alice_survey.core.artefacts import write_csv, write_json
from tests.missions.exports.plans import line, plan_of

CELL_M, ROWS, COLUMNS = 0.01, 120, 80
HOLE = (slice(100, 120), slice(0, 20))
"""Of the elevation model: 400 of 9600 cells."""
SLOPE = 0.25
"""Rise to the east."""
_SLOPE_DEG = np.degrees(np.arctan(SLOPE))
SIGMA_M = 0.0005


def plane_of(
    name: str, tilt: str = "0", origin_enu: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> dict[str, Any]:
    """The JSON values of an upright plane that faces south."""
    return {
        "name": name, "about": f"facing 180 deg, tilt {tilt} deg", "origin_enu": origin_enu,
        "right_enu": [1.0, 0.0, 0.0], "up_enu": [0.0, 0.0, 1.0], "out_enu": [0.0, -1.0, 0.0],
        "frame": "ned", "unit": "m", "datum": None, "vertical_datum": f"the plane '{name}'",
    }  # fmt: skip


def tiny_workspace(
    folder: Path, *, scaled: bool = True, placed: bool = True, **changes: dict[str, Any]
) -> Path:
    """Write it.

    Args:
        folder: of the workspace.
        scaled: whether the model is in metres.
        placed: whether it is in NED about a datum; else in its own axes.
        changes: values of the JSON files to replace, by stage.
    """
    stage = {"version": 1, "digest": "0" * 32, "took_s": 3.0, "inputs": {}, "settings": {}}
    for name in ("plan", "images", "mapping", "sparse", "dense", "mosaic"):
        write_json(folder / name / "stage.json", {"stage": name, **stage})
    datum = {"latitude_deg": 32.8, "longitude_deg": 34.9, "height_m": 0.0}
    write_json(folder / "plan" / "plan.json", _plan(datum) | changes.get("plan", {}))
    write_json(folder / "images" / "survey.json", {"source": "imported"})
    write_json(folder / "mapping" / "mapping.json", {
        "doming": {"along": None, "across": None, "scale": None, "notes": []},
        "acceptance": {"notes": []}, "refraction": None, **changes.get("mapping", {}),
    })  # fmt: skip
    write_json(folder / "sparse" / "frame.json", {
        "name": "ned" if placed else "model", "datum": datum if placed else None,
        "scaled": scaled, "vertical_datum": "sea surface",
        "notes": ["scale from the calibrated rig"], **changes.get("frame", {}),
    })  # fmt: skip
    write_json(folder / "sparse" / "registration.json", {
        "registered": 4, "total": 4, "points": 1000, "mean_reprojection_px": 0.3,
        "mean_track_length": 3.5, "scale_source": "scale from the calibrated rig",
        **changes.get("sparse", {}),
    })  # fmt: skip
    axes = ("north_m", "east_m", "depth_m") if placed else ("x_m", "y_m", "z_m")
    _write_track(
        folder / "sparse" / "track.csv", axes if scaled else ("x", "y", "z"), placed=placed
    )
    write_json(folder / "dense" / "surface.json", {
        "match_sigma_px": 0.2, "pose_sigma": 0.0002, "vertical_datum": "sea surface",
        "cell": CELL_M,
    })  # fmt: skip
    _write_rasters(folder, "EPSG:32636" if placed else None)
    write_json(
        folder / "mosaic" / "mosaic.json", {"pixel": 0.002, "width_px": 400, "height_px": 600}
    )
    _write_footprints(folder / "mosaic", "m" if scaled else "units", placed=placed)
    return folder


def heights() -> Any:
    """(ROWS, COLUMNS) of the elevation model."""
    east = (np.arange(COLUMNS) + 0.5) * CELL_M
    plane = np.tile(SLOPE * east - 10.0, (ROWS, 1)).astype(np.float32)
    plane[HOLE] = np.nan
    return plane


def _plan(datum: dict[str, float]) -> dict[str, Any]:
    north, east = ROWS * CELL_M, COLUMNS * CELL_M
    ring = [[0.0, 0.0], [north, 0.0], [north, east], [0.0, east], [0.0, 0.0]]
    planned = plan_of([line((0.1, 0.4), (1.1, 0.4))], [(0, 0)])
    area = planned.to_json()["area"]
    return {
        **replace(planned, name="tiny reef").to_json(),
        "datum": datum,
        "area": {**area, "survey": {"type": "MultiPolygon", "coordinates": [[ring]]}},
        "details": {"imaging": {"blur_px": 0.8, "pixel_m": 0.0005}},
    }


def _write_track(path: Path, axes: Sequence[str], *, placed: bool) -> None:
    """With the columns that a model in such axes has; sigmas only where it is placed."""
    header = ("image", "station", "camera", *axes, "points", "reprojection_px", "sigma_north_m",
              "sigma_east_m", "sigma_depth_m")  # fmt: skip
    sigmas = (0.03, 0.04, 0.05) if placed else ("", "", "")
    write_csv(path, header, [
        (f"{camera}/{n}.png", n, camera, 0.3 + 0.4 * n, 0.4, 8.0, 500 + n, 0.3, *sigmas)
        for n in range(2) for camera in ("left", "right")
    ])  # fmt: skip


def _write_footprints(folder: Path, unit: str, *, placed: bool) -> None:
    header = ("image", "camera", "station", f"area_{unit}2", f"ground_pixel_{unit}",
              f"mean_range_{unit}", "seen_share")  # fmt: skip
    rows = [
        (f"{camera}/{n}.png", camera, n, "0.25", "0.0018", "2.1", "0.9")
        for n in range(2) for camera in ("left", "right")
    ]  # fmt: skip
    write_csv(folder / "footprints.csv", header, rows)
    if placed:
        ring = [[34.9, 32.8], [34.900004, 32.8], [34.900004, 32.800004], [34.9, 32.8]]
        write_json(folder / "footprints.geojson", {"type": "FeatureCollection", "features": [
            {"type": "Feature", "properties": dict(zip(header, row, strict=True)),
             "geometry": {"type": "Polygon", "coordinates": [ring]}} for row in rows
        ]})  # fmt: skip


def write_raster(
    path: Path, bands: Any, pixel_m: float, corner: tuple[float, float], **more: Any
) -> Path:
    """Write bands (B, H, W) as a GeoTIFF.

    Args:
        path: of the file.
        bands: its values.
        pixel_m: side of a pixel.
        corner: east and north of the upper left one's outer corner.
        more: of the profile.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {
        "driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2],
        "dtype": bands.dtype, "transform": Affine(pixel_m, 0, corner[0], 0, -pixel_m, corner[1]),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile | more) as raster:
        raster.write(bands)
    return path


def _write_rasters(folder: Path, crs: str | None) -> None:
    corner, known = (0.0, ROWS * CELL_M), np.isfinite(heights())
    for name, value in (("dem", heights()), ("sigma", SIGMA_M), ("slope", _SLOPE_DEG)):
        values = np.where(known, value, np.nan).astype(np.float32)[None]
        path = folder / "dense" / f"{name}.tif"
        write_raster(path, values, CELL_M, corner, nodata=np.nan, crs=crs)
    stations = np.where(known, 4, 0).astype(np.uint8)[None]
    write_raster(folder / "dense" / "stations.tif", stations, CELL_M, corner, crs=crs)
    rows, columns = np.mgrid[:600, :400]
    bands = np.stack([rows % 256, columns % 256, 0 * rows + 90, 0 * rows + 255]).astype(np.uint8)
    bands[3, 500:, :100] = 0
    path = folder / "mosaic" / "mosaic.tif"
    write_raster(path, bands, 0.002, corner, crs=crs, photometric="RGB", alpha="YES")
