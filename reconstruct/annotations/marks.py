"""Annotations on the mosaic: their areas in plan, and how these err by how they were drawn.

A vertex that a person sets errs by itself; what errors of the pose and of the surface do to all
vertices of an annotation is carried along together, so that a shift leaves its area as it is.
"""

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from shapely.geometry.base import BaseGeometry

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.annotations.projection import PIXEL_SIGMA_PX, OnPlane, Projector
from reconstruct.annotations.values import Annotation, DrawnShape


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanFigures:
    """A shape on the mosaic, and its figures in plan."""

    shape: DrawnShape
    area: float
    """Of its plan, in squares of the unit; NaN of points and lines."""
    sigma: float
    length: float
    """Of a line; NaN of others."""
    own: tuple[Array, ...]
    """Ring by ring, (N, 2, 2) covariances of what each vertex has alone; empty of points and
    lines."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredMark(PlanFigures):
    """An annotation on the mosaic."""

    annotation: Annotation

    @cached_property
    def geometry(self) -> BaseGeometry:
        """As shapely has it."""
        return self.shape.geometry

    @property
    def key(self) -> Hashable:
        """What its figures are of."""
        return self.annotation.shape, self.annotation.image


class MarkMeasures:
    """Annotations on the mosaic, each projected and measured once while it stays as it is."""

    def __init__(
        self, pixel: float, projector: Callable[[], Projector], sigma_px: float = PIXEL_SIGMA_PX
    ) -> None:
        """Take what they are measured by.

        Args:
            pixel: side of a pixel of the mosaic.
            projector: of the workspace; used where annotations are in pictures.
            sigma_px: with which vertices were set, in pixels of the mosaic or of the picture.
        """
        self._pixel, self._projector, self._sigma_px = pixel, projector, sigma_px
        self._kept: dict[Hashable, PlanFigures | str] = {}

    def of(self, annotations: Sequence[Annotation]) -> tuple[list[MeasuredMark], list[str]]:
        """Those that are on the mosaic, or are found there, and why others are not."""
        found, lost = [], []
        kept: dict[Hashable, PlanFigures | str] = {}
        for one in annotations:
            key = (one.shape, one.image)
            figures = self._kept.get(key)
            if figures is None:
                figures = self._measured(one)
            kept[key] = figures
            if isinstance(figures, str):
                lost.append(f"annotation {one.id}: {figures}")
            else:
                found.append(MeasuredMark(annotation=one, **vars(figures)))
        self._kept = kept
        return found, lost

    def _measured(self, one: Annotation) -> PlanFigures | str:
        shape = one.shape
        if one.image is None:
            rings = [OnPlane.drawn(ring, self._sigma_px * self._pixel) for ring in shape.rings]
        else:
            try:
                shape, rings = self._projector().on_plane(shape, one.image, self._sigma_px)
            except ReconstructionError as error:
                return str(error)
        area, sigma, length = math.nan, math.nan, math.nan
        if shape.is_area:
            area, sigma = shape.area, sigma_of_area(one.shape, rings)
        elif shape.kind == "polyline":
            length = float(shape.geometry.length)
        own = tuple(ring.own for ring in rings) if shape.is_area else ()
        return PlanFigures(shape=shape, area=area, sigma=sigma, length=length, own=own)


def sigma_of_area(drawn: DrawnShape, rings: Sequence[OnPlane]) -> float:
    """Standard deviation of the area of a shape in plan.

    Args:
        drawn: as it was drawn: a circle by its middle and radius, a rectangle by two corners.
        rings: its vertices on the plane, outer ring first.
    """
    slopes = [area_slopes(ring.places) for ring in rings]
    shared = np.zeros(rings[0].shared.shape[2])
    for ring, of_ring in zip(rings, slopes, strict=True):
        # holes turn the other way round, so that signed areas add up
        shared = shared + np.einsum("ni,nik->k", of_ring, ring.shared)
    places, own = [ring.places for ring in rings], [ring.own for ring in rings]
    alone = own_covariance(drawn, places, own, [one[..., None] for one in slopes])
    return math.sqrt(float(alone[0, 0]) + float(shared @ shared))


def own_covariance(
    drawn: DrawnShape, places: Sequence[Array], own: Sequence[Array], slopes: Sequence[Array]
) -> Array:
    """Covariance (F, F) of figures of a shape by what each of its vertices has alone.

    Args:
        drawn: as it was drawn.
        places: ring by ring, (N, 2) vertices on the plane.
        own: (N, 2, 2) their covariances.
        slopes: (N, 2, F) derivatives of the figures by them.
    """
    if drawn.kind == "circle":  # of one radius: all vertices move outwards by the same
        out: Array = np.linalg.norm(slopes[0], axis=1).sum(axis=0)
        return np.outer(out, out) * float(np.trace(own[0].mean(axis=0)))
    if drawn.kind == "rectangle":
        own, slopes = [own[0][::2]], [_by_two_corners(places[0], slopes[0])]
    return np.asarray(
        sum(np.einsum("nif,nij,njg->fg", s, c, s) for s, c in zip(slopes, own, strict=True))
    )


def _by_two_corners(corners: Array, slopes: Array) -> Array:
    """Derivatives (2, 2, F) by the first and third corner of a rectangle, which set the others.

    A corner that moves along a side takes the other end of its other side with it.
    """
    sides = np.stack([corners[1] - corners[0], corners[2] - corners[1]])
    if not abs(np.linalg.det(sides)) > 0.0:
        return np.zeros((2, *slopes.shape[1:]))
    parts = np.linalg.inv(sides)  # columns: what of a motion is along each side
    along = [np.outer(parts[:, k], sides[k]) for k in range(2)]
    first = slopes[0] + along[1] @ slopes[1] + along[0] @ slopes[3]
    third = slopes[2] + along[0] @ slopes[1] + along[1] @ slopes[3]
    return np.stack([first, third])


def area_slopes(ring: Array) -> Array:
    """Derivatives (N, 2) of a ring's signed area by its vertices."""
    chord = np.roll(ring, -1, axis=0) - np.roll(ring, 1, axis=0)
    return 0.5 * np.column_stack([chord[:, 1], -chord[:, 0]])
