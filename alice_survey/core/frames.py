"""Frames and transforms between them: geodetic, NED, body and camera.

World `ned` is local North-East-Down with its origin at the datum on the sea surface; `body` is
forward-right-down; `cam` is right-down-forward. `a_from_b` takes coordinates in b to a.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.contents import as_line
from alice_survey.core.errors import warn

Array = NDArray[np.float64]

_EARTH_M = 6_371_008.8
BODY_FROM_NADIR_CAM = Rotation.from_matrix([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Nadir mount, image top towards the bow: x_cam = y_body, y_cam = -x_body, z_cam = z_body."""


@dataclass(frozen=True)
class Datum:
    """Origin of the local NED frame: a point of the sea surface on the WGS 84 ellipsoid.

    Example:
        >>> import alice_survey as alice
        >>> datum = alice.Datum(32.8236, 34.9553)
        >>> datum.ned_from_geodetic([[32.8237, 34.9553, 5.0]]).round(2) + 0.0
        array([[11.09,  0.  ,  5.  ]])
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    """Height of the sea surface (or of the reference level named elsewhere) above the ellipsoid."""

    @property
    def place(self) -> str:
        """Where it is, to a kilometre: `32.82 N 34.96 E`."""
        north, east = self.latitude_deg, self.longitude_deg
        return f"{abs(north):.2f} {'NS'[north < 0]} {abs(east):.2f} {'EW'[east < 0]}"

    @cached_property
    def _ecef(self) -> Any:
        from pyproj import Transformer

        return Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)

    @cached_property
    def _ned_from_ecef(self) -> Rotation:
        lat, lon = np.deg2rad([self.latitude_deg, self.longitude_deg])
        north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
        east = [-np.sin(lon), np.cos(lon), 0.0]
        down = [-np.cos(lat) * np.cos(lon), -np.cos(lat) * np.sin(lon), -np.sin(lat)]
        return Rotation.from_matrix([north, east, down])

    @cached_property
    def _origin_ecef(self) -> Array:
        xyz = self._ecef.transform(self.longitude_deg, self.latitude_deg, self.height_m)
        return np.asarray(xyz, dtype=np.float64)

    def ned_from_geodetic(self, lat_lon_depth: Array) -> Array:
        """Take (N, 3) rows of latitude and longitude (degrees) and depth (m) to NED metres."""
        rows = np.asarray(lat_lon_depth, dtype=np.float64).reshape(-1, 3)
        ecef = self._ecef.transform(rows[:, 1], rows[:, 0], self.height_m - rows[:, 2])
        return self._ned_from_ecef.apply(np.stack(ecef, axis=1) - self._origin_ecef)

    def ecef_from_ned(self, points_ned: Array) -> Array:
        """Take (N, 3) NED metres to geocentric coordinates (EPSG:4978), metres."""
        points = np.asarray(points_ned, dtype=np.float64).reshape(-1, 3)
        return self._ned_from_ecef.inv().apply(points) + self._origin_ecef

    def geodetic_from_ned(self, points_ned: Array) -> Array:
        """Take (N, 3) NED metres to rows of latitude and longitude (degrees) and depth (m)."""
        ecef = self.ecef_from_ned(points_ned)
        lon, lat, height = self._ecef.transform(*ecef.T, direction="INVERSE")
        return np.stack([lat, lon, self.height_m - height], axis=1)

    def lon_lat_from_en(self, places_en: Array) -> Array:
        """Take (N, 2) metres east and north, at the datum's height, to longitude and latitude."""
        ned = np.column_stack([places_en[:, ::-1], np.zeros(len(places_en))])
        return self.geodetic_from_ned(ned)[:, 1::-1]

    @property
    def utm_epsg(self) -> int:
        """EPSG code of the UTM zone (WGS 84) that holds the datum."""
        zone = min(int((self.longitude_deg + 180.0) // 6.0) + 1, 60)
        return (32600 if self.latitude_deg >= 0 else 32700) + zone


def distances_m(first_deg: Array, second_deg: Array) -> Array:
    """Distances, (N,) metres to 0.5 %, of places (N, 2) of latitude and longitude from others.

    On a sphere by haversines (Sinnott 1984); what is not a place on Earth has a distance too.
    """
    first, second = np.deg2rad(first_deg), np.deg2rad(second_deg)
    north, east = np.moveaxis(np.sin((first - second) / 2.0) ** 2, -1, 0)
    level = np.abs(np.cos(first[..., 0]) * np.cos(second[..., 0]))
    return np.asarray(2.0 * _EARTH_M * np.arcsin(np.sqrt(np.clip(north + level * east, 0.0, 1.0))))


def rotation_from_attitude(roll_rad: Any, pitch_rad: Any, heading_rad: Any) -> Rotation:
    """Rotation `ned_from_body` from SNAME attitude (z-y-x: heading, pitch, roll), radians."""
    angles = np.stack(np.broadcast_arrays(heading_rad, pitch_rad, roll_rad), axis=-1)
    return Rotation.from_euler("ZYX", angles)


def attitude_from_rotation(ned_from_body: Rotation) -> Array:
    """Roll, pitch and heading (radians, last axis) of `ned_from_body`; heading in (-pi, pi]."""
    angles: Array = ned_from_body.as_euler("ZYX")
    return angles[..., ::-1]


def interpolate_poses(time_s: Array, poses: RigidTransform, at_s: Array) -> RigidTransform:
    """Poses at other times: straight between positions, great circle between attitudes.

    Args:
        time_s: (T,) strictly increasing seconds of the poses.
        poses: (T,) transforms.
        at_s: (N,) seconds within the range of time_s.

    Raises:
        ValueError: a time lies outside of the range (no extrapolation).
    """
    from scipy.spatial.transform import Slerp

    at_s = np.asarray(at_s, dtype=np.float64)
    if at_s.size and (at_s.min() < time_s[0] or at_s.max() > time_s[-1]):
        raise ValueError(f"times beyond {time_s[0]} to {time_s[-1]} s")
    positions = np.stack([np.interp(at_s, time_s, p) for p in poses.translation.T], axis=1)
    rotations = Slerp(time_s, poses.rotation)(at_s)
    return RigidTransform.from_components(positions, rotations)


def pose_to_json(pose: RigidTransform) -> dict[str, list[float]]:
    """One pose as a JSON object."""
    return {
        "quaternion_xyzw": [float(q) for q in pose.rotation.as_quat(canonical=True)],
        "translation_m": [float(t) for t in pose.translation],
    }


def pose_from_json(data: dict[str, list[float]]) -> RigidTransform:
    """The inverse of `pose_to_json`."""
    return RigidTransform.from_components(
        np.asarray(data["translation_m"], dtype=np.float64),
        Rotation.from_quat(np.asarray(data["quaternion_xyzw"], dtype=np.float64)),
    )


SYSTEM = re.compile(r"\s*(EPSG:|\+proj|WGS84\b)", re.IGNORECASE)
"""How the line begins that names the coordinate system of a file of OpenDroneMap."""
_UTM = re.compile(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
_POLE_DEG, _BEYOND_DEG = 90.0, 1.0
"""A coordinate system is used so far beyond its own area of use, of neighbouring zones."""


def degrees_from(system: str) -> Callable[[float, float], tuple[float, float]] | None:
    """Latitude and longitude of x (easting or longitude) and y in a coordinate system.

    The first place outside of where the system is used is named in a warning.

    Args:
        system: its name as pyproj takes it, or OpenDroneMap's such as `WGS84 UTM 16N`.

    Returns:
        None of a local grid.

    Raises:
        ValueError: it is no coordinate system; of a place, that it is beyond it.
    """
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError, ProjError

    if (utm := _UTM.match(system)) is not None:
        system = f"EPSG:{(32700 if utm[2].upper() == 'S' else 32600) + int(utm[1])}"
    try:
        crs = CRS.from_user_input(system)
    except CRSError:
        zone = re.search(r"UTM\s*(\d{1,2})\s*([C-X])?", system, re.IGNORECASE)
        number, north = (int(zone[1]), (zone[2] or "N").upper() >= "N") if zone else (0, True)
        hint = f"; EPSG:{(32600 if north else 32700) + number}?" if zone else ""
        raise ValueError(
            f"{as_line(system)!r} is no coordinate system that is known{hint}"
        ) from None
    if crs.is_engineering:
        return None
    to_wgs84 = Transformer.from_crs(crs.to_2d(), 4326, always_xy=True)
    area, outside = crs.area_of_use, list[tuple[float, float]]()

    def degrees(x: float, y: float) -> tuple[float, float]:
        try:
            longitude, latitude = to_wgs84.transform(x, y, errcheck=True)
        except ProjError:
            raise ValueError(f"{x}, {y} is not a place in {as_line(crs.name)}") from None
        if not abs(latitude) <= _POLE_DEG:
            raise ValueError(f"latitude {latitude:g}: are latitude and longitude exchanged?")
        if area is not None and not outside and is_beyond(area, latitude, longitude):
            outside.append((x, y))
            warn(
                f"{x:.10g}, {y:.10g} is latitude {latitude:.4f}, longitude {longitude:.4f}, "
                f"outside of where {as_line(crs.name)} is used ({area.south:g} to {area.north:g}, "
                f"{area.west:g} to {area.east:g}): check its zone, and whether it is north or south"
            )
        return float(latitude), float(longitude)

    return degrees


def is_beyond(area: Any, latitude_deg: float, longitude_deg: float) -> bool:
    """Whether a place lies outside of pyproj's area of use, which may cross the antimeridian."""
    width = ((area.east - area.west) % 360.0 or 360.0) + 2.0 * _BEYOND_DEG
    off = max(area.south - latitude_deg, latitude_deg - area.north)
    return bool(off > _BEYOND_DEG or (longitude_deg - area.west + _BEYOND_DEG) % 360.0 > width)
