"""The surface of a model where a person points: a place, its normal, and what hides it.

Of a DEM only the cells around are read. Where there is none yet, the nearest points of the sparse
model determine a plane, and nothing hides anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.windows import Window
from scipy.spatial import KDTree

from alice_survey.base.artefacts import read_stage
from alice_survey.base.errors import ReconstructionError
from alice_survey.base.frames import Array
from reconstruct.evaluate.elevation import Elevation
from reconstruct.planes import read_plane
from reconstruct.raster import opened_raster
from reconstruct.views.model_files import all_points

_SLOPE_CELLS = 3
"""The normal is that of a plane through the cells this far around."""
_MOST_CELLS = 1024
"""Cells a side that are read at once; of more, averages."""
_STEPS = 256
"""Steps of a ray over the window."""
_CLEAR_CELLS, _CLEAR_SIGMAS = 2.0, 4.0
"""The surface must stand this much above a way to hide what is at its end."""
_NEIGHBOURS = 15
_LEVEL = 1e-3
"""A ray that descends less meets no surface."""
_ROUNDS, _SETTLED = 50, 1e-6
_COARSE = 256
_FARTHEST = 3.0
"""Times the usual distance of neighbours within which points of a sparse model make a surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePlace:
    """A place of a surface."""

    point: Array
    """(3,) in the world."""
    normal: Array
    """(3,) unit vector, upwards."""
    sigma: float
    """Of its height."""


class Surface:
    """The surface of a reconstructed workspace."""

    def __init__(self, workspace: Path) -> None:
        """Take a workspace whose `sparse/` is finished."""
        dense = workspace / "dense"
        made = read_stage(dense) is not None and (dense / "dem.tif").is_file()
        self._dense = dense if made and read_plane(dense).is_level else None
        self._points = None if self._dense else all_points(workspace / "sparse" / "model")[1]
        self._tree = None if self._points is None else KDTree(self._points[:, :2])

    @property
    def is_dense(self) -> bool:
        """Whether it is a DEM's."""
        return self._dense is not None

    def below(self, north: float, east: float) -> SurfacePlace:
        """The surface at a place of the map.

        Raises:
            ReconstructionError: none is known there.
        """
        if self._dense is None:
            return self._by_points(np.array([north, east]))
        at = np.array([[east, north]])
        with opened_raster(self._dense / "dem.tif") as source:
            reach = (_SLOPE_CELLS + 2) * abs(source.transform.a)
        dem = self._window(self._dense, np.concatenate([at[0] - reach, at[0] + reach]))
        height = float(dem.at(dem.height, at)[0])
        around = dem.points()
        if not np.isfinite(height) or len(around) < 3:
            raise ReconstructionError(
                f"no surface of the model is at {north:.3f} north, {east:.3f} east"
            )
        slope = np.linalg.lstsq(
            np.column_stack([around[:, :2] - at, np.ones(len(around))]), around[:, 2], rcond=None
        )[0]
        normal = np.array([-slope[1], -slope[0], -1.0])
        sigma = float(dem.at(dem.sigma, at)[0])
        return SurfacePlace(
            point=np.array([north, east, -height]),
            normal=normal / np.linalg.norm(normal),
            sigma=sigma if np.isfinite(sigma) else dem.cell,
        )

    def met_by(self, start: Array, direction: Array) -> SurfacePlace:
        """Where a ray from a camera meets the surface.

        Args:
            start: (3,) in the world.
            direction: (3,) unit vector.

        Raises:
            ReconstructionError: it meets none that is known.
        """
        low, high = self._heights
        if direction[2] > _LEVEL:
            ends = start + np.outer((-np.array([high, low]) - start[2]) / direction[2], direction)
            if self._dense is not None:
                box = ends[:, [1, 0]]
                dem = self._window(self._dense, np.concatenate([box.min(axis=0), box.max(axis=0)]))
                met = dem.hit(start, direction)
                if met is not None:
                    return self.below(met[0], met[1])
            else:
                here = self._by_points(ends.mean(axis=0)[:2])
                for _ in range(_ROUNDS):
                    reach = (here.point - start) @ here.normal / (direction @ here.normal)
                    met = start + reach * direction
                    here = self._by_points(met[:2])
                    if abs(here.point[2] - met[2]) < _SETTLED * reach:
                        return here
        raise ReconstructionError(
            "the ray of this pixel meets no known surface of the model: pick the spot in a second "
            "picture by hand"
        )

    def hidden(self, place: SurfacePlace, centres: Array) -> NDArray[np.bool_]:
        """(N,) whether the surface stands between a place and cameras at (N, 3)."""
        if self._dense is None or not len(centres):
            return np.zeros(len(centres), np.bool_)
        ways = centres - place.point
        ends = np.concatenate([place.point[None], centres])[:, [1, 0]]
        dem = self._window(self._dense, np.concatenate([ends.min(axis=0), ends.max(axis=0)]))
        clear = _CLEAR_CELLS * dem.cell + _CLEAR_SIGMAS * place.sigma
        highest = float(np.nanmax(dem.height)) if dem.known.any() else -np.inf
        lift = highest + place.point[2]  # the surface near stands at most this far above it
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip(np.where(ways[:, 2] < 0, -lift / ways[:, 2], 1.0), 0.0, 1.0)
        steps = np.linspace(0.0, 1.0, _STEPS)[1:]
        over = place.point + (share[:, None] * steps)[..., None] * ways[:, None]
        floor = dem.at(dem.height, over.reshape(-1, 3)[:, [1, 0]]).reshape(over.shape[:2])
        with np.errstate(invalid="ignore"):
            return np.asarray((floor + over[..., 2] > clear).any(axis=1))

    @cached_property
    def _heights(self) -> tuple[float, float]:
        """Heights below and above all of the surface, by a coarse look at it."""
        if self._dense is None:
            known = np.zeros(1) if self._points is None else -self._points[:, 2]
        else:
            with opened_raster(self._dense / "dem.tif") as source:
                shape = min(_COARSE, source.height), min(_COARSE, source.width)
                coarse = source.read(1, out_shape=shape, resampling=Resampling.nearest)
                known = coarse[np.isfinite(coarse)].astype(np.float64)
        if not len(known):
            raise ReconstructionError("the model has no surface yet")
        spare = 0.5 * float(np.ptp(known)) + 1e-3 * float(np.abs(known).max())
        return float(known.min()) - spare, float(known.max()) + spare

    def _by_points(self, at: Array) -> SurfacePlace:
        if self._points is None or self._tree is None or len(self._points) < _NEIGHBOURS:
            raise ReconstructionError("the model has too few points to make a surface")
        away, rows = (np.asarray(one) for one in self._tree.query(at, _NEIGHBOURS))
        near = self._points[rows]
        usual = float(np.median(np.asarray(self._tree.query(near[:, :2], _NEIGHBOURS)[0])[:, -1]))
        if away[0] > _FARTHEST * usual:
            raise ReconstructionError(
                f"no point of the model is near {at[0]:.3f} north, {at[1]:.3f} east"
            )
        design = np.column_stack([near[:, :2] - at, np.ones(len(near))])
        weights = np.ones(len(near))
        for _ in range(5):
            plane = np.linalg.lstsq(weights[:, None] * design, weights * near[:, 2], rcond=None)[0]
            miss = np.abs(design @ plane - near[:, 2])
            weights = 1.0 / np.sqrt(1.0 + (miss / max(float(np.median(miss)), 1e-9)) ** 2)
        normal = np.array([plane[0], plane[1], -1.0])
        return SurfacePlace(
            point=np.array([*at, plane[2]]),
            normal=normal / np.linalg.norm(normal),
            sigma=1.4826 * float(np.median(miss)),
        )

    @staticmethod
    def _window(dense: Path, bounds: Sequence[float] | Array) -> Elevation:
        """Cells around a box of west, south, east, north."""
        with opened_raster(dense / "dem.tif") as source:
            cell = float(source.transform.a)
            west, south, east, north = (float(one) for one in bounds)
            edge = source.transform
            first = np.floor([(west - edge.c) / cell, (edge.f - north) / cell]) - 2
            end = np.ceil([(east - edge.c) / cell, (edge.f - south) / cell]) + 2
            column, row = np.maximum(first, 0).astype(int).tolist()
            size = np.minimum(end, [source.width, source.height]).astype(int)
            columns, rows = (size - [column, row]).tolist()
            if columns < 2 or rows < 2:
                raise ReconstructionError("no surface of the model is there")
            window = Window(column, row, columns, rows)
            by = max(1, -(-max(rows, columns) // _MOST_CELLS))
            shape = (max(1, rows // by), max(1, columns // by))
            height = source.read(
                1, window=window, out_shape=shape, resampling=Resampling.nearest
            ).astype(np.float64)
        with opened_raster(dense / "sigma.tif") as source:
            sigma = source.read(
                1, window=window, out_shape=shape, resampling=Resampling.nearest
            ).astype(np.float64)
        return Elevation(
            height=height,
            sigma=np.where(sigma > 0, sigma, np.nan),
            west=float(edge.c + column * cell),
            north=float(edge.f - row * cell),
            cell=by * cell,
        )
