"""The area to survey and the area where the vehicle may be, kept apart.

Geometry is shapely's with x = north and y = east, the order of NED: only files and maps that need
east first swap them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, mapping, shape

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array, Datum

_TOUCH_M = 1e-6


@dataclass(frozen=True, kw_only=True)
class Area:
    """What must be seen, and where the left port's glass may be; metres north and east."""

    datum: Datum
    survey: MultiPolygon
    """What must be covered at the overlap requested, to its edge; holes are no-go zones."""
    allowed: MultiPolygon
    """Where the vehicle may be: by default the survey area and a margin to turn in, without the
    no-go zones."""
    no_go: MultiPolygon
    """Holes of the survey area and other zones to keep out of; may be empty."""

    def __post_init__(self) -> None:
        if self.survey.is_empty:
            raise PlanError("area: nothing is left to survey")
        if self.allowed.is_empty:
            raise PlanError("area: there is no water the vehicle may be in: shrink the no-go zones")

    @property
    def corners_ne(self) -> Array:
        """(N, 2) corners of the survey area, holes too."""
        return shapely.get_coordinates(self.survey)

    @property
    def allowed_corners_ne(self) -> Array:
        """(N, 2) corners of the allowed area: what a simulated sea floor must reach to."""
        return shapely.get_coordinates(self.allowed)

    @cached_property
    def touched(self) -> shapely.Geometry:
        """The allowed area and its edge, whatever rounding does to what lies on it."""
        return self.allowed.buffer(_TOUCH_M)

    @property
    def rings_ne(self) -> list[Array]:
        """Each closed edge of the survey area, (N, 2): of every part its outer one, then holes."""
        polygons = self.survey.geoms
        return [
            np.asarray(ring.coords, dtype=np.float64)[:, :2]
            for polygon in polygons
            for ring in (polygon.exterior, *polygon.interiors)
        ]

    def to_json(self) -> dict[str, Any]:
        """The area as `plan.json` holds it: GeoJSON geometries with north before east, metres."""
        return {name: mapping(getattr(self, name)) for name in ("survey", "allowed", "no_go")}

    @classmethod
    def from_json(cls, data: dict[str, Any], datum: Datum) -> "Area":
        """The inverse of `to_json`."""
        parts = {name: multipolygon(shape(data[name])) for name in ("survey", "allowed", "no_go")}
        return cls(datum=datum, **parts)


def multipolygon(geometry: shapely.Geometry) -> MultiPolygon:
    """All polygons of a geometry, as one value."""
    parts = shapely.get_parts(geometry).tolist()
    nested = [p for part in parts for p in shapely.get_parts(part).tolist()]
    return MultiPolygon([part for part in nested if part.geom_type == "Polygon" and part.area > 0])
