"""Annotations from a picture to the plane of the mosaic, and from there into pictures.

The exact ray of every vertex is cut with the DEM. The sigma of the place is that of the pixel, of
the surface along the ray, and of what poses and calibration do to the model there
(`reconstruct.measure.errors`). Where the model as a whole lies in the world is not in it: mosaic
and pictures move together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import need_stage
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.annotations.values import DrawnShape, Kind, Place
from reconstruct.evaluate.elevation import StoredElevation
from reconstruct.measure.errors import shared_errors
from reconstruct.picking.registered import RegisteredPictures
from reconstruct.picking.surface import hidden, shown_places
from reconstruct.planes import LEVEL_PLANE
from reconstruct.raster import grid_of

PIXEL_SIGMA_PX = 0.5
"""Of a vertex that a person sets, in either coordinate."""
_EN = [1, 0]
"""East and north of a point of the world."""
_NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_UP = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class OnPlane:
    """Vertices on the plane of the mosaic."""

    points: Array
    """(N, 3) north, east, down of the world; a row is NaN where a ray meets no known surface."""
    own: Array
    """(N, 2, 2) covariance of east and north of each vertex alone: it was set by hand."""
    shared: Array
    """(N, 2, K) how all move together with K errors of sigma 1: of the pose and the surface."""

    @property
    def places(self) -> Array:
        """(N, 2) east and north."""
        return self.points[:, [1, 0]]

    @property
    def covariance(self) -> Array:
        """(N, 2, 2) of east and north."""
        found: Array = self.own + self.shared @ self.shared.swapaxes(1, 2)
        return found

    @property
    def sigma(self) -> Array:
        """(N,) of the place: square root of the sum of both variances."""
        found: Array = np.sqrt(np.trace(self.covariance, axis1=1, axis2=2))
        return found

    @classmethod
    def drawn(cls, ring: Sequence[Place], sigma: float) -> "OnPlane":
        """Vertices that were set on the mosaic, each with a sigma; their heights are unknown."""
        count = len(ring)
        east, north = np.array(ring, dtype=np.float64).T
        return cls(
            points=np.column_stack([north, east, np.full(count, np.nan)]),
            own=np.broadcast_to(sigma**2 * np.eye(2), (count, 2, 2)),
            shared=np.zeros((count, 2, 1)),
        )

    def parts(self, lengths: Sequence[int]) -> list["OnPlane"]:
        """Rings of these lengths, one after the other."""
        ends = np.cumsum(lengths)[:-1]
        fields = (np.split(field, ends) for field in (self.points, self.own, self.shared))
        return [OnPlane(points=p, own=o, shared=s) for p, o, s in zip(*fields, strict=True)]


@dataclass(frozen=True, kw_only=True, eq=False)
class InPicture:
    """Vertices in a picture as taken."""

    image: str
    pixels: Array
    """(N, 2); NaN where the picture cannot show them."""
    covariance: Array
    """(N, 2, 2), px squared."""
    seen: NDArray[np.bool_]
    """(N,) within the frame, with nothing between."""
    size_px: tuple[int, int]
    """Width and height of the picture."""

    @property
    def sigma(self) -> Array:
        """(N,) px: square root of the sum of both variances."""
        found: Array = np.sqrt(np.trace(self.covariance, axis1=1, axis2=2))
        return found


class Projector:
    """The pictures and the surface of a reconstructed workspace."""

    def __init__(self, workspace: Path) -> None:
        """Read the model.

        Raises:
            WorkspaceError: there is no surface yet, or a file is damaged.
            ReconstructionError: the mosaic is on a plane that is not level.
        """
        dense = need_stage(workspace, "dense", "reconstruct")
        self.pictures, self._dem = RegisteredPictures.read(workspace), StoredElevation.of(dense)
        grid, mosaic = self._dem.grid, workspace / "mosaic" / "mosaic.tif"
        south, east = float(grid.north_of(grid.rows)), float(grid.east_of(grid.columns))
        self._errors = shared_errors(
            workspace, LEVEL_PLANE, self.pictures.frame, (grid.west, south, east, grid.north)
        )
        self._pixel = grid_of(mosaic).cell if mosaic.is_file() else grid.cell

    def to_plane(self, image: str, pixels: Array, sigma_px: float = PIXEL_SIGMA_PX) -> OnPlane:
        """Where the surface is that a picture shows at pixels.

        Args:
            image: its name.
            pixels: (N, 2) as taken, from the outer corner of the first.
            sigma_px: with which they were set.

        Raises:
            ReconstructionError: it is no registered picture.
        """
        shown = shown_places(self._dem, self.pictures.picture(image), pixels)
        own = sigma_px * shown.by_pixel[:, _EN]
        places = shown.points[:, _EN]
        raised = shown.by_height * self._errors.own_sigma(places, shown.sigma)[:, None]
        return OnPlane(
            points=shown.points, own=own @ own.swapaxes(1, 2),
            shared=np.concatenate([self._moves(places)[:, _EN], raised[:, _EN, None]], axis=2),
        )  # fmt: skip

    def on_surface(self, places: Array, sigma: float | None = None) -> OnPlane:
        """Places drawn on the mosaic, with the height of the surface.

        Args:
            places: (N, 2) east and north.
            sigma: with which they were drawn, in either coordinate; half a pixel of the mosaic if
                not given. What poses do to the mosaic is added.
        """
        surface = self._dem.around(places)
        own = self._pixel / 2 if sigma is None else sigma
        return OnPlane(
            points=np.column_stack([places[:, _EN], -surface.at(surface.height, places)]),
            own=np.broadcast_to(own**2 * np.eye(2), (len(places), 2, 2)),
            shared=self._moves(places)[:, _EN],
        )

    def to_picture(self, image: str, spots: OnPlane) -> InPicture:
        """Where a picture as taken shows places of the surface.

        Args:
            image: its name.
            spots: on the plane, with their covariances.

        Raises:
            ReconstructionError: it is no registered picture.
        """
        row, warp = self.pictures.row(image), self.pictures.warp(image)
        centre, turn = self.pictures.centres[row], self.pictures.turns[row]
        pixels, by_point, _ = warp.camera.project_jacobian((spots.points - centre) @ turn)
        slopes = by_point @ turn.T
        surface = self._dem.around(spots.places)
        sigma = surface.at(surface.sigma, spots.places)
        moves = self._moves(spots.places)
        total = moves @ moves.swapaxes(1, 2)
        total[:, :2, :2] += spots.covariance[:, ::-1, ::-1]
        total[:, 2, 2] += sigma**2
        seen = ((pixels >= 0) & (pixels <= np.array(warp.size_px))).all(axis=1)
        seen &= (spots.points - centre) @ turn[:, 2] > 0
        eyes = np.broadcast_to(centre, (int(seen.sum()), 3))
        seen[seen] = ~hidden(self._dem, spots.points[seen], sigma[seen], eyes)
        return InPicture(
            image=image, pixels=pixels, covariance=slopes @ total @ slopes.swapaxes(1, 2),
            seen=seen, size_px=warp.size_px,
        )  # fmt: skip

    def shown_in(self, spots: OnPlane, maximum: int = 12) -> list[InPicture]:
        """Pictures that show most of some places, the best of their middle first.

        Args:
            spots: on the plane.
            maximum: pictures.
        """
        known = np.isfinite(spots.points).all(axis=1)
        if not known.any():
            return []
        found = []
        for sight in self.pictures.seeing(spots.points[known].mean(axis=0), _UP):
            here = self.to_picture(sight.image, spots)
            if here.seen[known].mean() > 0.5:
                found.append(here)
            if len(found) == maximum:
                break
        return found

    def on_plane(
        self, shape: DrawnShape, image: str, sigma_px: float = PIXEL_SIGMA_PX
    ) -> tuple[DrawnShape, list[OnPlane]]:
        """A shape in a picture on the mosaic.

        Args:
            shape: in pixels of the picture.
            image: name of the picture.
            sigma_px: with which its vertices were set.

        Returns:
            The shape, which of an area is a polygon, and its vertices ring by ring.

        Raises:
            ReconstructionError: a vertex meets no known surface, or the picture is not registered.
        """
        rings = [np.array(ring, dtype=np.float64) for ring in shape.rings]
        lengths, whole = [len(ring) for ring in rings], np.concatenate(rings)
        spots = self.to_plane(image, whole, sigma_px)
        lost = np.flatnonzero(~np.isfinite(spots.points).all(axis=1))
        if len(lost):
            x, y = whole[lost[0]]
            raise ReconstructionError(
                f"{len(lost)} of {len(whole)} vertices meet no known surface, the first at "
                f"{image}:{x:.1f},{y:.1f}: draw it within what the model knows, or on the mosaic"
            )
        parts = spots.parts(lengths)
        outer, *holes = (_places(part.places) for part in parts)
        kind: Kind = "polygon" if shape.is_area else shape.kind
        return DrawnShape(kind=kind, points=outer, holes=tuple(holes)), parts

    def _moves(self, places: Array) -> Array:
        """How (N, 3, K) the model at places (N, 2) moves with errors of sigma 1, in the world."""
        found: Array = _NED_FROM_ENU @ self._errors.together(places)
        return found


def _places(points: Array) -> tuple[Place, ...]:
    return tuple((float(x), float(y)) for x, y in points)
