"""Control points as files of other programs state them."""

from dataclasses import dataclass, replace

from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from alice_survey.core.contents import shown
from reconstruct.placing.control_file import PICK_SIGMA_PX, Use

Place = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class ForeignPoint:
    """A point of known place."""

    name: str
    place: Place
    """Latitude and longitude (degrees), or north and east (metres); then height, positive up."""
    geodetic: bool
    use: Use = "control"
    sigma_m: float | None = None
    """Of north and of east; None where the file states none."""
    sigma_vertical_m: float | None = None

    def with_sigmas(
        self, sigma_m: float | None, sigma_vertical_m: float | None
    ) -> "ForeignPoint | None":
        """With the given sigmas where it has none of its own; None if one is missing then."""
        level = self.sigma_m or sigma_m
        vertical = self.sigma_vertical_m or sigma_vertical_m or level
        if level is None or vertical is None:
            return None
        return replace(self, sigma_m=level, sigma_vertical_m=vertical)


@dataclass(frozen=True, kw_only=True)
class ForeignPick:
    """A point in one picture; pixels from the outer corner of the first one."""

    picture: str
    """Name of the picture's file, with or without folder and suffix."""
    point: str
    x_px: float
    y_px: float
    sigma_px: float = PICK_SIGMA_PX


@dataclass(frozen=True, kw_only=True)
class ForeignBar:
    """A known distance of two points."""

    name: str
    ends: tuple[str, str]
    length_m: float
    use: Use = "control"
    sigma_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class ForeignControl:
    """All that a file holds."""

    points: tuple[ForeignPoint, ...]
    picks: tuple[ForeignPick, ...]
    bars: tuple[ForeignBar, ...] = ()
    notes: tuple[str, ...] = ()
    """What else it holds that is not used."""


class Coordinates:
    """Coordinates of a file, from the name of their system."""

    def __init__(self, system: str) -> None:
        """`system` is what pyproj takes (EPSG code, PROJ string, WKT).

        Raises:
            ValueError: it is no coordinate system.
        """
        try:
            self._crs = CRS.from_user_input(system)
        except CRSError:
            raise ValueError(f"{shown(system)!r} is no coordinate system that is known") from None
        self.geodetic = not self._crs.is_engineering
        """Whether it says where on Earth a point is; else it is a local grid, metres."""
        self._to_wgs84 = (
            Transformer.from_crs(self._crs.to_2d(), 4326, always_xy=True) if self.geodetic else None
        )

    def place(self, x: float, y: float, height: float) -> Place:
        """Latitude, longitude and height; of a local grid north, east and height.

        Args:
            x: easting or longitude.
            y: northing or latitude.
            height: kept as it is.

        Raises:
            ValueError: they are beyond the system.
        """
        if self._to_wgs84 is None:
            return y, x, height
        try:
            longitude, latitude = self._to_wgs84.transform(x, y, errcheck=True)
        except ProjError:
            raise ValueError(f"{x}, {y} is not a place in {shown(self._crs.name)}") from None
        return float(latitude), float(longitude), height
