"""The surface within annotations: its area and its rugosity, of each or of all, with sigmas.

Two things move them: errors of the surface, as of any polygon (`reconstruct.measure.areas`), and
how an outline was drawn. Where an outline goes outwards by δ along ds, the plan gains δ ds, and the
surface that times its slant there. An outline that was drawn in a picture moves with the pose and
so does the surface in it, so that of an outline only what each vertex has alone is added.
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.annotations.marks import MeasuredMark, own_covariance
from reconstruct.measure.areas import SurfaceAreas, figures_of_all, surface_within
from reconstruct.measure.surface import MeasuredSurface

_MAX_STEPS = 4000
"""Steps along a ring in which the slant is taken."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MarkPart:
    """An annotation with an area, or the part of it in a square."""

    mark: MeasuredMark
    geometry: BaseGeometry
    square: tuple[float, float, float, float] | None = None
    """West, south, east and north; None of all of it."""

    @property
    def key(self) -> Hashable:
        """What its surface is of."""
        return self.mark.key, self.square

    @property
    def share(self) -> float:
        """Of the annotation's area; its outline there is as large a share of the variance."""
        return min(1.0, float(self.geometry.area) / self.mark.area) if self.square else 1.0

    def holds(self, places: Array) -> NDArray[np.bool_]:
        """Which of places (N, 2) are in the square."""
        if self.square is None:
            return np.ones(len(places), np.bool_)
        west, south, east, north = self.square
        x, y = places.T
        return np.asarray((x >= west) & (x < east) & (y >= south) & (y < north))


@dataclass(frozen=True, kw_only=True, eq=False)
class PartSurface:
    """The surface within a part, and how the part was drawn."""

    areas: SurfaceAreas
    drawn: Array
    """(2, 2) covariance of the areas of the surface and of its plan, by the vertices."""


@dataclass(frozen=True, kw_only=True)
class SurfaceFigures:
    """The surface within annotations."""

    area: float
    area_sigma: float
    rugosity: float
    rugosity_sigma: float
    known: float
    """Share of their area in plan where the surface is known, of which the others are."""


class MarkSurfaces:
    """The surfaces within annotations, each measured once while the surface stays as it is."""

    def __init__(self, surface: MeasuredSurface) -> None:
        """Take the surface."""
        self._surface = surface
        self._kept: dict[Hashable, PartSurface | str] = {}

    def waiting(self, parts: Iterable[MarkPart]) -> list[MarkPart]:
        """Those that were not measured yet."""
        return [part for part in parts if part.key not in self._kept]

    def measure(self, part: MarkPart) -> None:
        """Measure one, or keep why that cannot be."""
        try:
            self._kept[part.key] = _measured(self._surface, part)
        except ReconstructionError as error:
            self._kept[part.key] = str(error)

    def keep(self, parts: Iterable[MarkPart]) -> None:
        """Forget all others."""
        self._kept = {part.key: self._kept[part.key] for part in parts if part.key in self._kept}

    def fault(self, part: MarkPart) -> str | None:
        """Why one that was measured has no surface."""
        found = self._kept[part.key]
        return found if isinstance(found, str) else None

    def figures(self, parts: Sequence[MarkPart]) -> SurfaceFigures | None:
        """Of all of some parts together, which were measured; None where none has a surface."""
        found = [one for part in parts if isinstance(one := self._kept[part.key], PartSurface)]
        if not found:
            return None
        area, ratio = figures_of_all(self._surface, [one.areas for one in found])
        plan = sum(one.areas.plan for one in found)
        by_areas = np.array([1.0, -ratio.value]) / plan
        drawn = np.sum([one.drawn for one in found], axis=0)
        return SurfaceFigures(
            area=area.value, area_sigma=float(np.hypot(area.sigma, np.sqrt(drawn[0, 0]))),
            rugosity=ratio.value,
            rugosity_sigma=float(np.sqrt(ratio.sigma**2 + by_areas @ drawn @ by_areas)),
            known=min(1.0, plan / sum(float(part.geometry.area) for part in parts)),
        )  # fmt: skip


def _measured(surface: MeasuredSurface, part: MarkPart) -> PartSurface:
    """The surface within a part.

    Raises:
        ReconstructionError: it is too large, or no surface is known in it.
    """
    mark = part.mark
    rings = [np.array(ring, dtype=np.float64) for ring in mark.shape.rings]
    steps = [_Steps(ring, surface.grid.cell) for ring in rings]
    places = np.concatenate([one.places for one in steps])
    areas, slant = surface_within(surface, part.geometry, places)
    # Neither area changes where nothing is known, nor beyond the square.
    gains = np.column_stack([slant, slant > 0]) * part.holds(places)[:, None]
    ends = np.cumsum([len(one.places) for one in steps])[:-1]
    slopes = [one.slopes(gain) for one, gain in zip(steps, np.split(gains, ends), strict=True)]
    return PartSurface(
        areas=areas, drawn=own_covariance(mark.annotation.shape, rings, mark.own, slopes)
    )


class _Steps:
    """A closed ring in short steps."""

    def __init__(self, ring: Array, longest: float) -> None:
        self._count = len(ring)
        way = np.roll(ring, -1, axis=0) - ring
        length = np.linalg.norm(way, axis=1)
        step = max(longest, float(length.sum()) / _MAX_STEPS)
        counts = np.maximum(1, np.ceil(length / step)).astype(np.int64)
        self._edge: NDArray[np.int64] = np.repeat(np.arange(self._count), counts)
        nth = np.arange(len(self._edge)) - np.repeat(np.cumsum(counts) - counts, counts)
        self._along = (nth + 0.5) / counts[self._edge]
        here = way[self._edge]
        self.places = ring[self._edge] + self._along[:, None] * here
        """(M, 2) their middles."""
        self._outward = np.column_stack([here[:, 1], -here[:, 0]]) / counts[self._edge, None]

    def slopes(self, gains: Array) -> Array:
        """Derivatives (N, 2, F) by the vertices of figures that grow by (M, F) for each area."""
        found = np.zeros((self._count, 2, gains.shape[1]))
        moved = self._outward[:, :, None] * gains[:, None, :]
        np.add.at(found, self._edge, moved * (1.0 - self._along)[:, None, None])
        np.add.at(found, (self._edge + 1) % self._count, moved * self._along[:, None, None])
        return found
