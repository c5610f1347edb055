"""Where the mosaics of the harbour put things: patches are compared with the true texture.

The texture is a function of the place in space. Each pixel's place on the DEM is moved onto the
true surface by its closed form and painted there; a patch of the mosaic that is shifted against it
shows something that lies elsewhere.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import read_json
from alice_survey.core.frames import Array
from alice_survey.sim.seafloor.terrain import CERAMIC, ROCK, SAND
from alice_survey.sim.seafloor.texture import survey_texture
from benchmarks.harbour_scene import PARTS
from benchmarks.harbour_survey import SEED
from benchmarks.harbour_truth import distances, normals

PATCH_PX = 64
_STEP_PX = 48
_CLEAR = 0.15
"""Response of phase correlation (1 for equal patches) from which a match counts."""
_MATERIALS = {"floor": SAND, "wall": ROCK, "hull": CERAMIC, "pile": ROCK, "ladder": CERAMIC,
              "boulder": ROCK}  # fmt: skip
_NEAR_M = 0.03
"""A place on the DEM farther than this from the true surface shows nothing that could be found."""
_HOLES = 0.02
"""Share of a patch that may be unknown."""


def score_plane(dense: Path, mosaic: Path, truth_from_world: RigidTransform) -> dict[str, Any]:
    """Shifts of a plane's mosaic against the truth, by part of the harbour.

    Args:
        dense: folder with the plane's `dem.tif` and `plane.json`.
        mosaic: folder with its `mosaic.tif`.
        truth_from_world: alignment of the cameras.
    """
    axes = read_json(dense / "plane.json")
    with rasterio.open(dense / "dem.tif") as raster:
        heights, to_cell = raster.read(1).astype(np.float64), ~raster.transform
    with rasterio.open(mosaic / "mosaic.tif") as raster:
        picture, at = raster.read(), raster.transform
    texture = survey_texture(SEED)
    found: dict[str, list[Array]] = {}
    looked: dict[str, int] = {}
    for shown, rows, columns in windows_in(picture):
        x, y = at.c + columns * at.a, at.f + rows * at.e
        column, row = to_cell * (x.ravel(), y.ravel())
        height = map_coordinates(heights, [row - 0.5, column - 0.5], order=1, cval=np.nan)
        places = truth_from_world.apply(plane_points_ned(axes, x.ravel(), y.ravel(), height))
        known = np.isfinite(places).all(axis=1)
        if not known.mean() > 1 - _HOLES:
            continue
        places[~known] = places[known].mean(axis=0)
        off, part = distances(places)
        if np.abs(off[known]).max() > _NEAR_M:
            continue
        places = places - off[:, None] * normals(places)
        name = PARTS[int(np.bincount(part).argmax())]
        material = np.array([_MATERIALS[one] for one in PARTS], np.float32)[part]
        footprint = np.full(len(places), at.a, np.float32)
        true = texture.albedo(places, material, footprint).mean(axis=1)
        looked[name] = looked.get(name, 0) + 1
        shift = shift_px(
            shown[:-1].mean(axis=0), true.reshape(PATCH_PX, PATCH_PX).astype(np.float64)
        )
        if shift is not None:
            found.setdefault(name, []).append(shift)
    every = [shift for shifts in found.values() for shift in shifts]
    parts = {name: _figures(found.get(name, []), count, at.a) for name, count in looked.items()}
    return {"pixel_mm": 1e3 * at.a, "all": _figures(every, sum(looked.values()), at.a), "by": parts}


def windows_in(picture: NDArray[np.uint8]) -> Iterator[tuple[NDArray[np.uint8], Array, Array]]:
    """Patches of a mosaic (bands, H, W) without holes, and rows and columns of their pixels."""
    for row in range(0, picture.shape[1] - PATCH_PX, _STEP_PX):
        for column in range(0, picture.shape[2] - PATCH_PX, _STEP_PX):
            window = (slice(row, row + PATCH_PX), slice(column, column + PATCH_PX))
            shown = picture[(slice(None), *window)]
            if (shown[-1] == 0).mean() <= _HOLES:
                rows, columns = np.mgrid[window] + 0.5
                yield shown, rows, columns


def plane_points_ned(axes: dict[str, Any], x: Array, y: Array, height: Array) -> Array:
    """Points (N, 3) of a plane's coordinates, by its `plane.json`."""
    right, up, out = (np.array(axes[f"{name}_enu"]) for name in ("right", "up", "out"))
    enu = np.array(axes["origin_enu"]) + np.outer(x, right) + np.outer(y, up)
    enu = enu + np.outer(height, out)
    ned: Array = enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    return ned


def _figures(shifts: list[Array], patches: int, pixel_m: float) -> dict[str, float]:
    figures: dict[str, float] = {"patches": patches, "clear": len(shifts)}
    if shifts:
        length = np.linalg.norm(np.array(shifts), axis=1)
        figures |= {
            "rms_px": float(np.sqrt((length**2).mean())),
            "median_px": float(np.median(length)),
            "percentile_95_px": float(np.percentile(length, 95)),
            "rms_mm": 1e3 * pixel_m * float(np.sqrt((length**2).mean())),
        }
    return figures


def shift_px(picture: Array, true: Array) -> Array | None:
    """Columns and rows by which a picture is off; None where that is not clear."""
    window = cv2.createHanningWindow((PATCH_PX, PATCH_PX), cv2.CV_64F)
    flat = [np.log(one + 1e-2 * one.max() + 1e-9) for one in (true, picture.astype(np.float64))]
    flat = [one - cv2.GaussianBlur(one, (0, 0), 8) for one in flat]
    (x, y), response = cv2.phaseCorrelate(flat[0], flat[1], window)
    return np.array([x, y]) if response > _CLEAR else None
