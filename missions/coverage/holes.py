"""Where an area is not covered at the overlap requested: places, sizes, outlines."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon

from alice_survey.core.frames import Array, Datum
from missions.coverage.certificate import Certificate
from missions.values.area import multipolygon


@dataclass(frozen=True, kw_only=True)
class Hole:
    """A connected part of the area that is not covered at the overlap requested."""

    outline: MultiPolygon
    """x = north, y = east, metres: the cells of the certificate's grid, cut at the area's edge."""
    place_ne: tuple[float, float]
    """A place inside of it."""
    latitude_deg: float
    longitude_deg: float
    """Longitude of that place."""
    area_m2: float
    """Area of the cells whose middles are short of what was requested."""
    unseen_m2: float
    """The part of that area that is in no picture at all."""
    length_m: float
    width_m: float
    """Width of the smallest rectangle round it."""
    fewest_pictures: int
    """Fewest pictures of a place in it, of the camera that sees least."""
    fewest_lines: int

    def to_json(self) -> dict[str, Any]:
        """Its figures, without the outline."""
        return {
            "area_m2": round(self.area_m2, 6),
            "unseen_m2": round(self.unseen_m2, 6),
            "size_m": [round(self.length_m, 3), round(self.width_m, 3)],
            "latitude_deg": round(self.latitude_deg, 9),
            "longitude_deg": round(self.longitude_deg, 9),
            "north_m": round(self.place_ne[0], 3),
            "east_m": round(self.place_ne[1], 3),
            "fewest_pictures": self.fewest_pictures,
            "fewest_lines": self.fewest_lines,
        }


def find_holes(
    certificate: Certificate, short: NDArray[np.bool_] | None = None
) -> tuple[Hole, ...]:
    """The holes of a certificate: first what is unseen most, then what is largest.

    Cells that touch at a corner belong to one hole.

    Args:
        certificate: what is seen.
        short: (rows, columns) cells that lack something; left out, those that are not covered at
            the overlap requested.
    """
    import cv2
    from rasterio import features

    if short is None:
        short = certificate.inside & ~certificate.at_overlap
    if not short.any():
        return ()
    count, labels = cv2.connectedComponents(short.astype(np.uint8), connectivity=8)
    rows, columns = np.nonzero(short)
    of = labels[rows, columns]
    cell_m2 = certificate.grid.cell_m**2
    cells = np.bincount(of, minlength=count)
    unseen = np.bincount(of, certificate.pictures[rows, columns] == 0, minlength=count)
    pictures, lines = np.full(count, 65535), np.full(count, 65535)
    np.minimum.at(pictures, of, certificate.least_pictures[rows, columns])
    np.minimum.at(lines, of, certificate.least_lines[rows, columns])
    outlines: dict[int, list[shapely.Geometry]] = {}
    for shape, label in features.shapes(labels.astype(np.int32), mask=short, connectivity=8):
        outlines.setdefault(int(label), []).append(shapely.geometry.shape(shape))
    holes = []
    for label, parts in outlines.items():
        # Rings that touch themselves at a corner are not valid polygons before they are repaired.
        cell_outline = shapely.make_valid(shapely.union_all(shapely.make_valid(parts)))
        outline = shapely.transform(
            cell_outline, lambda xy: certificate.grid.places_of(xy[:, ::-1])
        )
        cut = multipolygon(outline.intersection(certificate.area.survey))
        place = cut.representative_point()
        place_ned = np.array([[place.x, place.y, 0.0]])
        ((latitude, longitude, _),) = certificate.area.datum.geodetic_from_ned(place_ned)
        width_m, length_m = sorted(_sides_m(cut))
        holes.append(
            Hole(
                outline=cut,
                place_ne=(float(place.x), float(place.y)),
                latitude_deg=float(latitude),
                longitude_deg=float(longitude),
                area_m2=float(cells[label] * cell_m2),
                unseen_m2=float(unseen[label] * cell_m2),
                length_m=length_m,
                width_m=width_m,
                fewest_pictures=int(pictures[label]),
                fewest_lines=int(lines[label]),
            )
        )
    return tuple(sorted(holes, key=lambda hole: (-hole.unseen_m2, -hole.area_m2, hole.place_ne)))


def geodetic(geometry: shapely.Geometry, datum: Datum) -> MultiPolygon:
    """A geometry of north and east as longitude and latitude, with outer rings to the left."""

    def convert(points_ne: Array) -> Array:
        return np.round(datum.lon_lat_from_en(points_ne[:, ::-1]), 9)

    turned = shapely.transform(geometry, convert)
    parts = [shapely.geometry.polygon.orient(part) for part in multipolygon(turned).geoms]
    return MultiPolygon(parts)


def _sides_m(geometry: shapely.Geometry) -> tuple[float, float]:
    """Both sides of the smallest rectangle round a geometry."""
    corners = shapely.get_coordinates(shapely.oriented_envelope(geometry))
    first, second = np.diff(corners[:3], axis=0)
    return math.hypot(*first), math.hypot(*second)
