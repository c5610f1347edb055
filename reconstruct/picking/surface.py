"""The surface of a model where a person points: a place, its normal, and what hides it.

Of a DEM only the cells around are read. Where there is none yet, the nearest points of the sparse
model determine a plane, and nothing hides anything.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from alice_survey.core.artefacts import read_stage
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.elevation import LEVEL, StoredElevation
from reconstruct.planes import read_plane
from reconstruct.views.model_files import all_points

_SLOPE_CELLS = 7
"""The normal is that of a plane through the cells this far around."""
_CLEAR_CELLS, _CLEAR_SIGMAS = 2.0, 4.0
"""The surface must stand this much above a way to hide what is at its end."""
_NEIGHBOURS = 15
_ROUNDS, _SETTLED = 50, 1e-6
_MAX_APART = 3.0
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


class ModelSurface:
    """The surface of a reconstructed workspace."""

    def __init__(self, workspace: Path) -> None:
        """Take a workspace whose `sparse/` is finished."""
        dense = workspace / "dense"
        made = read_stage(dense) is not None and (dense / "dem.tif").is_file()
        level = made and read_plane(dense).is_level
        self._dem = StoredElevation.of(dense) if level else None
        self._points = None if level else all_points(workspace / "sparse" / "model")[1]
        self._tree = None if self._points is None else KDTree(self._points[:, :2])

    @property
    def is_dense(self) -> bool:
        """Whether it is a DEM's."""
        return self._dem is not None

    def below(self, north: float, east: float) -> SurfacePlace:
        """The surface at a place of the map.

        Raises:
            ReconstructionError: none is known there.
        """
        if self._dem is None:
            return self._by_points(np.array([north, east]))
        at = np.array([[east, north]])
        dem = self._dem.around(at)
        height = float(dem.at(dem.height, at)[0])
        around = dem.points()
        around = around[(np.abs(around[:, :2] - at) <= _SLOPE_CELLS * dem.cell).all(axis=1)]
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
        if self._dem is not None:
            north, east, _ = self._dem.met_by(start[None], direction[None])[1][0]
            if np.isfinite(north):
                return self.below(north, east)
        elif direction[2] > LEVEL:
            here = self._by_points(start[:2] + self._reach(start) * direction[:2] / direction[2])
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

    def hides(self, place: SurfacePlace, centres: Array) -> NDArray[np.bool_]:
        """(N,) whether the surface stands between a place and cameras at (N, 3)."""
        count = len(centres)
        if self._dem is None or not count:
            return np.zeros(count, np.bool_)
        surface = self._dem.around(np.vstack([place.point, centres])[:, [1, 0]])
        clear = _CLEAR_CELLS * surface.cell + _CLEAR_SIGMAS * place.sigma
        points = np.broadcast_to(place.point, (count, 3))
        return surface.hides(points, np.full(count, clear), centres)

    def _reach(self, start: Array) -> float:
        """How far below a camera the middle of all heights is."""
        if self._points is None or not len(self._points):
            raise ReconstructionError("the model has no surface yet")
        return float(self._points[:, 2].min() + self._points[:, 2].max()) / 2 - float(start[2])

    def _by_points(self, at: Array) -> SurfacePlace:
        if self._points is None or self._tree is None or len(self._points) < _NEIGHBOURS:
            raise ReconstructionError("the model has too few points to make a surface")
        away, rows = (np.asarray(one) for one in self._tree.query(at, _NEIGHBOURS))
        near = self._points[rows]
        usual = float(np.median(np.asarray(self._tree.query(near[:, :2], _NEIGHBOURS)[0])[:, -1]))
        if away[0] > _MAX_APART * usual:
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
