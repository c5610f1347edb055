"""An area as compiled code takes it: the edges of its rings."""

from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import MultiPolygon

from alice_survey.base.frames import Array
from missions.values.area import Area


@dataclass(frozen=True, kw_only=True, eq=False)
class Site:
    """Edges of an area's rings: (E, 4) north and east of both ends, metres."""

    survey: Array
    allowed: Array
    parts: tuple[Array, ...]
    """Edges of every part of the survey area."""
    area_m2: float

    @classmethod
    def of(cls, area: Area) -> "Site":
        """The site of an area."""
        parts = tuple(edges_of(MultiPolygon([part])) for part in area.survey.geoms)
        return cls(
            survey=np.concatenate(parts),
            allowed=edges_of(area.allowed),
            parts=parts,
            area_m2=float(area.survey.area),
        )


def edges_of(polygons: MultiPolygon) -> Array:
    """Both ends, (E, 4) north and east, of every edge of every ring."""
    coordinates, ring_of = shapely.get_coordinates(
        shapely.get_rings(list(polygons.geoms)), return_index=True
    )
    both = np.concatenate([coordinates[:-1], coordinates[1:]], axis=1)
    edges: Array = np.ascontiguousarray(both[ring_of[:-1] == ring_of[1:]], dtype=np.float64)
    return edges
