"""Annotations from a picture to the plane of the mosaic, and from there into pictures.

The exact ray of every vertex is cut with the DEM. The sigma of the place is that of the picture's
pose within the model (`sparse/covariance.npz`), of the surface along the ray, and of the pixel.
Where the model as a whole lies in the world is not in it: mosaic and pictures move together.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window
from scipy.spatial.transform import RigidTransform

from alice_survey.base.artefacts import need_stage
from alice_survey.base.errors import ReconstructionError, WorkspaceError
from alice_survey.base.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.adjustment.uncertainty import Uncertainty, read_uncertainty
from reconstruct.annotations.values import Annotation, DrawnShape, Kind, Place
from reconstruct.evaluate.elevation import Elevation
from reconstruct.planes import read_plane
from reconstruct.raster import opened_raster
from reconstruct.views.model import points_of_views, read_model, read_warps

PIXEL_SIGMA_PX = 0.5
"""Of a vertex that a person sets, in either coordinate."""
_STEP_CELLS = 0.5
_MARGIN_CELLS = 8
_MOST_CELLS = 25_000_000
_MOST_SAMPLES = 4_000_000
_CLEAR_CELLS, _CLEAR_SIGMAS = 2.0, 4.0
"""A ray that meets the surface so far before a place does not see it."""
_EN = [1, 0]
"""East and north of a point of the world."""
_LEVEL = 1e-3
"""A ray that descends less meets no surface."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Posed:
    """A registered picture."""

    image: str
    warp: PinholeWarp
    world_from_cam: RigidTransform
    """From the camera's entrance pupil."""
    row: int
    """Of its station in the covariances; -1 where these are unknown."""
    depths: tuple[float, float]
    """Between which the sea floor is that it shows, world, positive down."""


class Projector:
    """The pictures and the surface of a reconstructed workspace."""

    def __init__(self, workspace: Path) -> None:
        """Read the model.

        Raises:
            WorkspaceError: there is no surface yet, or a file is damaged.
            ReconstructionError: the mosaic is on a plane that is not level.
        """
        sparse, self._dense = (need_stage(workspace, n, "reconstruct") for n in ("sparse", "dense"))
        plane = read_plane(self._dense)
        if not plane.is_level:
            raise ReconstructionError(
                f"the mosaic is on the plane {plane.name!r}: annotations are projected onto a "
                "level one: name 'level' first in reconstruct.planes"
            )
        model, warps = read_model(sparse), read_warps(sparse / "cameras.json")
        self.unit = model.frame.unit
        path = sparse / "covariance.npz"
        self._known = read_uncertainty(path) if path.is_file() else None
        rows = (
            {} if self._known is None else {int(s): n for n, s in enumerate(self._known.stations)}
        )
        reach = model.points_world[:, 2] if len(model.points_world) else np.zeros(1)
        self._posed: dict[str, _Posed] = {}
        self._origins: dict[int, Array] = {}
        for view, points in zip(model.views, points_of_views(model), strict=True):
            warp, depth = warps[view.camera], points[:, 2] if len(points) else reach
            margin = 0.5 * float(np.ptp(depth))
            self._posed[view.image] = _Posed(
                image=view.image,
                warp=warp,
                world_from_cam=view.world_from_cam * warp.pinhole_from_cam,
                row=rows.get(view.station, -1),
                depths=(float(depth.min()) - margin, float(depth.max()) + margin),
            )
            if self._known is not None and view.image in self._known.images:
                self._origins[rows.get(view.station, -1)] = view.world_from_cam.translation

    @property
    def images(self) -> Sequence[str]:
        """Names of the registered pictures."""
        return tuple(self._posed)

    def with_pose(self, image: str, world_from_cam: RigidTransform) -> "Projector":
        """The same with a picture elsewhere: what an error of its pose does."""
        other = copy(self)
        other._posed = {
            **self._posed, image: replace(self._picture(image), world_from_cam=world_from_cam)
        }  # fmt: skip
        return other

    def to_plane(self, image: str, pixels: Array, sigma_px: float = PIXEL_SIGMA_PX) -> OnPlane:
        """Where the surface is that a picture shows at pixels.

        Args:
            image: its name.
            pixels: (N, 2) as taken, from the outer corner of the first.
            sigma_px: with which they were set.

        Raises:
            ReconstructionError: it is no registered picture.
        """
        posed = self._picture(image)
        starts, ways = _rays(posed, pixels)
        surface = self._around(starts, ways, posed.depths)
        points = _met(surface, starts, ways, posed.depths)
        grads = _gradients(surface, points)
        slide = np.eye(3) - ways[:, :, None] * grads[:, None] / _dot(ways, grads)[:, None, None]
        raised = -ways / _dot(ways, grads)[:, None]
        raised = raised * surface.at(surface.sigma, points[:, [1, 0]])[:, None]
        moves = np.concatenate([slide @ self._moves(posed, points), raised[..., None]], axis=2)
        own = np.zeros((len(points), 3, 3))
        for axis in range(2):
            other_starts, other_ways = _rays(posed, pixels + np.eye(2)[axis])
            reach = _dot(points - other_starts, grads) / _dot(other_ways, grads)
            aside = (other_starts + reach[:, None] * other_ways - points) * sigma_px
            own += aside[:, :, None] * aside[:, None]
        return OnPlane(points=points, own=own[:, _EN][:, :, _EN], shared=moves[:, _EN])

    def on_surface(self, places: Array, sigma: float | None = None) -> OnPlane:
        """Places drawn on the mosaic, with the height of the surface.

        Args:
            places: (N, 2) east and north.
            sigma: with which they were drawn, in either coordinate; half a pixel of the mosaic if
                not given. What poses do to the mosaic is added.
        """
        surface = self._window(places.min(axis=0), places.max(axis=0))
        height = surface.at(surface.height, places)
        own = self._mosaic_pixel / 2 if sigma is None else sigma
        return OnPlane(
            points=np.column_stack([places[:, 1], places[:, 0], -height]),
            own=np.broadcast_to(own**2 * np.eye(2), (len(places), 2, 2)),
            shared=np.broadcast_to(self._mosaic_sigma * np.eye(2), (len(places), 2, 2)),
        )

    def to_picture(self, image: str, spots: OnPlane) -> InPicture:
        """Where a picture as taken shows places of the surface.

        Args:
            image: its name.
            spots: on the plane, with their covariances.

        Raises:
            ReconstructionError: it is no registered picture.
        """
        posed = self._picture(image)
        inverse = posed.world_from_cam.inv()
        pixels, by_point, _ = posed.warp.camera.project_jacobian(inverse.apply(spots.points))
        slopes = by_point @ inverse.rotation.as_matrix()
        surface = self._around_points(spots.points, posed)
        sigma = surface.at(surface.sigma, spots.places)
        moves = self._moves(posed, spots.points)
        total = moves @ moves.swapaxes(1, 2)
        total[:, :2, :2] += spots.covariance[:, ::-1, ::-1]
        total[:, 2, 2] += sigma**2
        inside = ((pixels >= 0) & (pixels <= np.array(posed.warp.size_px))).all(axis=1)
        ways = spots.points - posed.world_from_cam.translation
        clear = _CLEAR_CELLS * surface.cell + _CLEAR_SIGMAS * np.nan_to_num(sigma)
        seen = inside & (np.einsum("ni,i->n", ways, inverse.rotation.as_matrix()[2]) > 0)
        if seen.any():
            starts, directions = _rays(posed, pixels[seen])
            met = _met(surface, starts, directions, posed.depths)
            short = np.linalg.norm(spots.points[seen] - met, axis=1)
            seen[seen] = ~(short > clear[seen])
        return InPicture(
            image=image, pixels=pixels, covariance=slopes @ total @ slopes.swapaxes(1, 2),
            seen=seen, size_px=posed.warp.size_px,
        )  # fmt: skip

    def shown_in(self, spots: OnPlane, most: int = 12) -> list[InPicture]:
        """Pictures that show most of some places, the one that shows them nearest its middle first.

        Args:
            spots: on the plane.
            most: pictures.
        """
        known = np.isfinite(spots.points).all(axis=1)
        if not known.any():
            return []
        middle = spots.points[known].mean(axis=0)[None]
        ranked = []
        for posed in self._posed.values():
            pixel = posed.warp.camera.project(posed.world_from_cam.inv().apply(middle))[0]
            half = np.array(posed.warp.size_px) / 2
            away = float(np.abs((pixel - half) / half).max())
            if away <= 1.0:  # NaN where it cannot be seen
                ranked.append((away, posed.image))
        found = []
        for _, image in sorted(ranked):
            here = self.to_picture(image, spots)
            if here.seen[known].mean() > 0.5:
                found.append(here)
            if len(found) == most:
                break
        return found

    def on_plane(
        self, annotation: Annotation, sigma_px: float = PIXEL_SIGMA_PX
    ) -> tuple[DrawnShape, list[OnPlane]]:
        """An annotation in a picture on the mosaic.

        Args:
            annotation: in a picture.
            sigma_px: with which its vertices were set.

        Returns:
            The shape, which of an area is a polygon, and its vertices ring by ring.

        Raises:
            ReconstructionError: a vertex meets no known surface, or the picture is not registered.
        """
        shape, image = annotation.shape, annotation.image or ""
        rings = [np.array(ring, dtype=np.float64) for ring in shape.rings]
        lengths, whole = [len(ring) for ring in rings], np.concatenate(rings)
        spots = self.to_plane(image, whole, sigma_px)
        lost = np.flatnonzero(~np.isfinite(spots.points).all(axis=1))
        if len(lost):
            x, y = whole[lost[0]]
            raise ReconstructionError(
                f"annotation {annotation.id}: {len(lost)} of {len(whole)} vertices meet no known "
                f"surface, the first at {image}:{x:.1f},{y:.1f}: draw it within what the model "
                "knows, or on the mosaic"
            )
        outer, *holes = (_places(part.places) for part in spots.parts(lengths))
        kind: Kind = "polygon" if shape.is_area else shape.kind
        moved = DrawnShape(kind=kind, points=outer, holes=tuple(holes))
        return moved, spots.parts(lengths)

    def _picture(self, image: str) -> _Posed:
        try:
            return self._posed[image]
        except KeyError:
            raise ReconstructionError(
                f"{image!r} is no registered picture: name one of {len(self._posed)}, such as "
                f"{next(iter(self._posed), 'none')}"
            ) from None

    def _moves(self, posed: _Posed, points: Array) -> Array:
        """How (N, 3, 6) what a picture shows at points moves with errors of its pose, sigma 1."""
        if self._known is None or posed.row < 0:
            return np.zeros((len(points), 3, 6))
        arm = points - self._origins.get(posed.row, posed.world_from_cam.translation)
        by_turn = np.zeros((len(points), 3, 3))  # of turn x arm
        by_turn[:, 0, 1], by_turn[:, 0, 2] = arm[:, 2], -arm[:, 1]
        by_turn[:, 1, 0], by_turn[:, 1, 2] = -arm[:, 2], arm[:, 0]
        by_turn[:, 2, 0], by_turn[:, 2, 1] = arm[:, 1], -arm[:, 0]
        slopes = np.concatenate([by_turn, np.broadcast_to(np.eye(3), by_turn.shape)], axis=2)
        values, axes = np.linalg.eigh(self._known.frame_cov[posed.row])
        found: Array = slopes @ (axes * np.sqrt(np.maximum(values, 0.0)))
        return found

    @cached_property
    def _mosaic_pixel(self) -> float:
        """Side of a pixel of the mosaic, or of the DEM while there is none."""
        mosaic = self._dense.parent / "mosaic" / "mosaic.tif"
        with opened_raster(mosaic if mosaic.is_file() else self._dense / "dem.tif") as raster:
            return float(raster.transform.a)

    @cached_property
    def _mosaic_sigma(self) -> float:
        """Usual sigma of a horizontal coordinate of the mosaic by errors of poses."""
        return 0.0 if self._known is None else _sigma_of_poses(self._known)

    def _around(self, starts: Array, ways: Array, depths: tuple[float, float]) -> Elevation:
        """The surface around what rays may meet."""
        ends = []
        for depth in depths:
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = (depth - starts[:, 2]) / ways[:, 2]
            ends.append((starts + reach[:, None] * ways)[ways[:, 2] > _LEVEL])
        box = np.concatenate(ends)[:, [1, 0]]
        if not len(box):
            box = starts[:, [1, 0]]
        return self._window(box.min(axis=0), box.max(axis=0))

    def _around_points(self, points: Array, posed: _Posed) -> Elevation:
        known = points[np.isfinite(points).all(axis=1)]
        both = np.concatenate([known, posed.world_from_cam.translation[None]])[:, [1, 0]]
        return self._window(both.min(axis=0), both.max(axis=0))

    def _window(self, low: Array, high: Array) -> Elevation:
        """A part of the DEM and its sigma, from west and south to east and north."""
        parts = []
        for name in ("dem.tif", "sigma.tif"):
            with opened_raster(self._dense / name) as raster:
                t, cell = raster.transform, float(raster.transform.a)
                left = int(np.floor((low[0] - t.c) / cell)) - _MARGIN_CELLS
                top = int(np.floor((t.f - high[1]) / cell)) - _MARGIN_CELLS
                right = int(np.ceil((high[0] - t.c) / cell)) + _MARGIN_CELLS
                bottom = int(np.ceil((t.f - low[1]) / cell)) + _MARGIN_CELLS
                left, right = np.clip([left, right], 0, raster.width).tolist()
                top, bottom = np.clip([top, bottom], 0, raster.height).tolist()
                if (right - left) * (bottom - top) > _MOST_CELLS:
                    raise WorkspaceError(
                        f"an annotation over {right - left} x {bottom - top} cells of the "
                        f"surface: at most {_MOST_CELLS} are looked at: divide it"
                    )
                if right <= left or bottom <= top:  # beyond the surface: nothing is known
                    parts.append(np.full((2, 2), np.nan))
                    continue
                window = Window(left, top, right - left, bottom - top)
                parts.append(raster.read(1, window=window).astype(np.float64))
        height, sigma = parts
        return Elevation(
            height=height, sigma=np.where(sigma > 0, sigma, np.nan),
            west=float(t.c) + left * cell, north=float(t.f) - top * cell, cell=cell,
        )  # fmt: skip


def _sigma_of_poses(known: Uncertainty) -> float:
    own = known.point_cov - known.point_noise
    own = own[np.isfinite(own).all(axis=(1, 2))]
    if not len(own):
        return 0.0
    return float(np.sqrt(max(0.0, np.median((own[:, 0, 0] + own[:, 1, 1]) / 2))))


def _rays(posed: _Posed, pixels: Array) -> tuple[Array, Array]:
    """Starts and unit directions (N, 3) in the world."""
    starts, ways = posed.warp.camera.unproject(pixels)
    there = posed.world_from_cam
    return there.apply(starts), there.rotation.apply(ways)


def _met(surface: Elevation, starts: Array, ways: Array, depths: tuple[float, float]) -> Array:
    """Where rays first meet a surface, (N, 3); NaN where it is not known that they do."""
    found = np.full(starts.shape, np.nan)
    down = np.flatnonzero(np.isfinite(starts).all(axis=1) & (ways[:, 2] > _LEVEL))
    if not len(down):
        return found
    first = np.maximum((depths[0] - starts[down, 2]) / ways[down, 2], 0.0)
    last = (depths[1] - starts[down, 2]) / ways[down, 2]
    steps = int(np.ceil(float((last - first).max()) / (_STEP_CELLS * surface.cell))) + 2
    size = max(1, _MOST_SAMPLES // steps)
    for start in range(0, len(down), size):
        rows = down[start : start + size]
        part = slice(start, start + size)
        along = np.linspace(first[part], last[part], steps, axis=1)
        points = starts[rows, None] + along[..., None] * ways[rows, None]
        flat = points.reshape(-1, 3)
        floor = surface.at(surface.height, flat[:, [1, 0]]).reshape(along.shape)
        over = -points[..., 2] - floor
        with np.errstate(invalid="ignore"):
            crossed = (over[:, :-1] > 0) & (over[:, 1:] <= 0)
        hit = crossed.any(axis=1)
        n, at = np.arange(len(rows))[hit], crossed[hit].argmax(axis=1)
        share = over[n, at] / (over[n, at] - over[n, at + 1])
        met = points[n, at] + share[:, None] * (points[n, at + 1] - points[n, at])
        found[rows[hit]] = met
    return found


def _gradients(surface: Elevation, points: Array) -> Array:
    """(N, 3) of depth plus height by north, east, down: square to the surface."""
    half = surface.cell
    slopes = []
    for axis in ([0.0, 1.0], [1.0, 0.0]):
        shift, here = half * np.array(axis), points[:, [1, 0]]
        ahead, behind = (surface.at(surface.height, here + s * shift) for s in (1.0, -1.0))
        slope = (ahead - behind) / (2 * half)
        slopes.append(np.where(np.isfinite(slope), slope, 0.0))  # at an edge of what is known
    return np.column_stack([*slopes, np.ones(len(points))])


def _dot(a: Array, b: Array) -> Array:
    found: Array = np.einsum("ni,ni->n", a, b)
    return found


def _places(points: Array) -> tuple[Place, ...]:
    return tuple((float(x), float(y)) for x, y in points)
