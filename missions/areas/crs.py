"""Coordinate systems: from those of files and settings to latitude and longitude, then to NED."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array, Datum, distances_m
from missions.areas.raw import RawShapes

LOCAL = "local"
"""Stands for a coordinate system: metres east (x) and north (y) of the datum."""
MAX_M = 20_000.0
"""Largest distance from the datum: beyond it the local frame is no longer flat."""
_HIGHEST_LATITUDE_DEG = 85.0
"""Nearer to a pole, headings from north change within an area."""
_WGS84_ACCURACY_M = 2.0
"""Accuracy of the ensemble of WGS 84's realisations (EPSG datum 6326)."""
_DATUM_DECIMALS = 6


@dataclass(frozen=True, kw_only=True)
class LocalFrame:
    """The datum's North-East-Down frame, at the depth of the sea floor."""

    datum: Datum
    seafloor_depth_m: float
    datum_is_given: bool

    def ne_from_latlon(self, lat_lon: Array) -> Array:
        """(N, 2) metres north and east of (N, 2) degrees of places on the sea floor."""
        depth_m = np.full((len(lat_lon), 1), self.seafloor_depth_m)
        return self.datum.ned_from_geodetic(np.hstack([lat_lon, depth_m]))[:, :2]

    def latlon_from_ne(self, points_ne: Array) -> Array:
        """The inverse of `ne_from_latlon`, for points at the depth of the sea floor.

        A point of the sea floor is below the datum's horizon by the Earth's curve; three rounds
        bring the depth to below a micrometre within `MAX_M` (each leaves the square of the
        distance over the Earth's radius, 1e-5, of the error).
        """
        down_m = np.full(len(points_ne), self.seafloor_depth_m)
        for _ in range(3):
            found = self.datum.geodetic_from_ned(np.column_stack([points_ne, down_m]))
            down_m = down_m + (self.seafloor_depth_m - found[:, 2])
        return self.datum.geodetic_from_ned(np.column_stack([points_ne, down_m]))[:, :2]

    def place(self, point_ne: Array | Sequence[float], *, geographic: bool) -> str:
        """A point in words; in degrees, too, for shapes that were given so."""
        north, east = (float(value) for value in point_ne)
        text = f"north {north + 0.0:.2f} m, east {east + 0.0:.2f} m"
        if not geographic:
            return text
        lat, lon = self.latlon_from_ne(np.array([[north, east]]))[0]
        return f"{text} ({lat:.7f}, {lon:.7f})"

    def localise(self, raw: RawShapes) -> RawShapes:
        """Shapes in metres north and east of the datum.

        Raises:
            PlanError: a corner is not a number, or farther than `MAX_M` from the datum.
        """

        def change(corners: Array, name: str) -> Array:
            check_finite(corners, raw.origin, name)
            points_ne = self.ne_from_latlon(corners) if raw.geographic else corners
            self._check_near(corners, points_ne, raw, name)
            return points_ne

        return raw.change(change, geographic=False)

    def _check_near(self, corners: Array, points_ne: Array, raw: RawShapes, name: str) -> None:
        datum_deg = np.array([self.datum.latitude_deg, self.datum.longitude_deg])
        if raw.geographic:
            far_m = distances_m(corners, datum_deg)
        else:
            far_m = np.linalg.norm(points_ne, axis=1)
        advice = "move the datum (latitude_deg, longitude_deg), or check the corner and its crs"
        if not self.datum_is_given:
            advice = "the area is too large, or a corner or its crs is wrong"
        if raw.geographic and distances_m(corners[:, ::-1], datum_deg).max(initial=0.0) <= MAX_M:
            advice = "latitude and longitude are swapped"
        max_m, datum = far_m.max(initial=0.0), self.datum
        refuse_corners(
            (far_m > MAX_M) & (far_m == max_m), corners, raw.origin, name,
            f"is {max_m / 1e3:.0f} km from the datum ({datum.latitude_deg:g}, "
            f"{datum.longitude_deg:g}), at most {MAX_M / 1e3:.0f} km: {advice}",
        )  # fmt: skip


def refuse_corners(
    bad: NDArray[np.bool_], corners: Array, origin: str, name: str, fault: str
) -> None:
    """Refuse corners, (N, 2), that a mask, (N,), marks.

    Args:
        bad: the mask.
        corners: as they were given, y (north, latitude) before x.
        origin: of the shapes.
        name: of the ring or line.
        fault: what is wrong with one, as the end of a sentence.

    Raises:
        PlanError: with the first one's number and coordinates, as `area: reef.kml: polygon 2,
            corner 3 at (1, 2): fault`.
    """
    if bad.any():
        first = int(bad.argmax())
        place = ", ".join(f"{value:.10g}" for value in corners[first])
        raise PlanError(
            f"area: {origin}: {name + ', ' if name else ''}corner {first + 1} at ({place}) {fault}"
        )


def check_finite(corners: Array, origin: str, name: str) -> None:
    """Refuse coordinates that are not numbers.

    Raises:
        PlanError: with the corner's number.
    """
    bad: NDArray[np.bool_] = np.logical_not(np.isfinite(corners).all(axis=1))
    refuse_corners(bad, corners, origin, name, "is not a place: coordinates must be numbers")


def geographic_shapes(raw: RawShapes, crs: Any) -> RawShapes:
    """Take shapes of any coordinate system to WGS 84.

    Args:
        raw: shapes whose coordinates are y (north, latitude) before x (east, longitude).
        crs: a `pyproj.CRS`.

    Returns:
        Shapes in latitude and longitude, degrees.

    Raises:
        PlanError: no transformation is known, or a corner has no place in the system.
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    flat = crs.to_2d()
    try:
        transformer = Transformer.from_crs(flat, "EPSG:4326", always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise PlanError(
            f"area: {raw.origin}: no transformation from {crs.name} to latitude and longitude is "
            f"known: {error}"
        ) from None
    accuracy_m: list[float] = []

    def change(yx: Array, name: str) -> Array:
        if not len(yx):
            return yx
        check_finite(yx, raw.origin, name)
        if flat.is_geographic:
            # Longitudes to 360 are common where an area lies across the date line.
            refuse_corners(
                (np.abs(yx[:, 1]) > 360.0) | (np.abs(yx[:, 0]) > 90.0), yx, raw.origin, name,
                f"has no latitude and longitude in {crs.name}: set crs to the system that it is "
                "in, or swap the two",
            )  # fmt: skip
        lon, lat = transformer.transform(yx[:, 1], yx[:, 0])
        lat_lon = np.column_stack([lat, lon])
        lost = ~np.isfinite(lat_lon).all(axis=1)
        refuse_corners(lost, yx, raw.origin, name, f"has no place in {crs.name}: check crs")
        # PROJ reports no operation where there is nothing to change.
        with contextlib.suppress(ProjError):
            accuracy_m.append(float(transformer.get_last_used_operation().accuracy))
        refuse_corners(
            np.abs(lat_lon[:, 0]) > _HIGHEST_LATITUDE_DEG, lat_lon, raw.origin, name,
            f"is too near a pole: areas are planned up to {_HIGHEST_LATITUDE_DEG:g} degrees north "
            "and south; are latitude and longitude swapped?",
        )  # fmt: skip
        return lat_lon

    moved = raw.change(change, geographic=True)
    worst_m = max(accuracy_m, default=0.0)
    if worst_m > _WGS84_ACCURACY_M:
        warn(
            f"area: {raw.origin}: positions in {crs.name} are known in WGS 84 to {worst_m:g} m only"
        )
    return moved


def parse_crs(text: str) -> Any:
    """A `pyproj.CRS` from what a user types: `EPSG:32636`, WKT, PROJ.

    Raises:
        PlanError: it is unknown, or has no place on Earth.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        crs = CRS.from_user_input(text)
    except CRSError:
        shown = text if len(text) <= 60 else f"{text[:57]}..."
        raise PlanError(
            f"area: crs = {shown!r} is not known: give a code such as EPSG:32636, EPSG:4326 or "
            f"{LOCAL!r}"
        ) from None
    return usable_crs(crs, "crs")


def usable_crs(crs: Any, origin: str) -> Any:
    """The system itself, when it is a map of the Earth.

    Raises:
        PlanError: it is local to something, vertical or geocentric.
    """
    flat = crs.to_2d()
    if not (flat.is_geographic or flat.is_projected):
        raise PlanError(
            f"area: {origin}: {crs.name} ({crs.type_name}) is not a map of the Earth: give a "
            f"geographic or projected system, or crs = {LOCAL!r} for metres east and north of the "
            "datum"
        )
    return crs


def middle(raw: RawShapes) -> Datum:
    """The middle of the bounds of geographic shapes, rounded so that it can be read and typed."""
    lat_lon = raw.coordinates
    # Within half a turn of the first, so that none jumps at the date line.
    lat, east = lat_lon.T
    lon = east[0] + (east - east[0] + 180.0) % 360.0 - 180.0
    centre_lat = (lat.min() + lat.max()) / 2
    centre_lon = (lon.min() + lon.max()) / 2
    return Datum(
        round(float(centre_lat), _DATUM_DECIMALS),
        round((float(centre_lon) + 180.0) % 360.0 - 180.0, _DATUM_DECIMALS),
    )
