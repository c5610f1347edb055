"""Settings of a survey: `survey.toml` as frozen sections that reject unknown keys."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.config import JsonDict

from alice_survey.core.contents import as_line, nearest, one_line, ordinary_file, parse_toml
from alice_survey.core.errors import ConfigError, offer, why
from alice_survey.core.seawater import GREEN_NM, n_water, n_water_sigma

Jerlov = Literal["I", "II", "III", "1C", "3C", "5C", "7C", "9C"]
Latitude = Annotated[float, Field(ge=-85, le=85)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Ring = tuple[tuple[float, float], ...]
GeoRing = tuple[tuple[Latitude, Longitude], ...]
Gust = Annotated[float, Field(ge=0, le=1000)]
SHAPEFILE_SIDES = (".shx", ".dbf", ".prj", ".cpg")


def setting(
    default: Any, about: str, *, example: str = "", template: str = "", above: str = "", **how: Any
) -> Any:
    """A setting of `survey.toml`: all that the file, the checks and a form have to know of it.

    Args:
        default: its value where the file has none.
        about: what it is, in a line.
        example: TOML that stands in a new file as a comment, in place of the default.
        template: TOML that a new file has instead of the default.
        above: comment lines above it in a new file.
        how: limits, as of pydantic's `Field`.
    """
    extra: JsonDict = {"example": example, "template": template, "above": above}
    return Field(default, description=about, json_schema_extra=extra, **how)


class Config(BaseModel):
    """A settings section: immutable, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def __repr__(self) -> str:
        """What differs from the defaults."""
        return f"{type(self).__name__}({self.model_dump(exclude_defaults=True)})"

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_booleans_as_numbers(cls, value: object, info: ValidationInfo) -> object:
        if cls.model_fields[str(info.field_name)].annotation is not bool and _holds_bool(value):
            raise ValueError("true and false are no numbers")
        return value


def _holds_bool(value: object) -> bool:
    if isinstance(value, list | tuple):
        return any(map(_holds_bool, value))
    return isinstance(value, bool)


class AreaConfig(Config):
    """The area to survey and the limits of the vehicle's movement.

    The shape to survey is one of: a rectangle at the datum, a polygon, a corridor, well-known text,
    or a file. The datum is the origin of the local North-East-Down frame, on the sea surface; of a
    shape in geographic or projected coordinates it is the middle unless it is given.
    """

    latitude_deg: Latitude = setting(
        32.8236, "the datum: origin of local north, east, down, on the sea surface"
    )
    longitude_deg: Longitude = setting(34.9553, "longitude of the datum")
    length_m: float = setting(15.0, "along the heading, from the datum", gt=0, le=10_000)
    width_m: float = setting(17.0, "to the right of the heading", gt=0, le=10_000)
    heading_deg: float = setting(0.0, "of the rectangle, from north", ge=0, lt=360)
    polygon_ne_m: Ring | None = setting(
        None, "any number of corners", example="[[0, 0], [15, 0], [15, 17], [0, 17]]",
        above="... or a polygon, in metres north and east of the datum:",
    )  # fmt: skip
    polygon_latlon_deg: GeoRing | None = setting(
        None, "the same in degrees",
        example="[[32.8236, 34.9553], [32.8237, 34.9553], [32.8237, 34.9555]]",
    )  # fmt: skip
    corridor_ne_m: Ring | None = setting(
        None, "points of the line", example="[[0, 0], [20, 5], [40, 0]]",
        above="... or a corridor along a line:",
    )  # fmt: skip
    corridor_width_m: float = setting(
        5.0, "also of the lines of a file", example="5.0", gt=0, le=1000
    )
    closed_lines: Literal["corridor", "inside"] | None = setting(
        None, 'of a file\'s lines that close; "corridor": the line itself is meant',
        example='"inside"', exclude_if=lambda c: c is None,
    )  # fmt: skip
    wkt: str | None = setting(
        None, "x = east, y = north",
        example='"POLYGON ((0 0, 17 0, 17 15, 0 15, 0 0))"', above="... or well-known text:",
    )  # fmt: skip
    file: Path | None = setting(
        None, "holes are no-go zones; leave out the datum above: it is its middle",
        example='"reef.geojson"',
        above="... or a file: GeoJSON, KML, KMZ, GPX, GeoPackage, shapefile, WKT, CSV, .poly",
    )  # fmt: skip
    layer: str | None = setting(None, "of a file that holds several", example='"survey"')
    crs: str | None = setting(
        None, "of files, a raster or wkt that do not say", example='"EPSG:32636"'
    )
    no_go_ne_m: tuple[Ring, ...] = setting(
        (), "polygons", example="[[[4, 4], [6, 4], [6, 6], [4, 6]]]",
        above="Where the vehicle must not be, besides the holes of the area: polygons, or a file",
    )  # fmt: skip
    no_go_file: Path | None = setting(None, "polygons, lines and points", example='"wrecks.kml"')
    no_go_clearance_m: float = setting(0.0, "distance kept from all no-go zones", ge=0, le=100)
    allowed_ne_m: Ring | None = setting(
        None, "a polygon", example="[[-3, -3], [18, -3], [18, 20], [-3, 20]]",
        above="Where it may be: a polygon, or a file; the area with room to turn when left out",
    )  # fmt: skip
    allowed_file: Path | None = setting(None, "polygons and corridors", example='"permit.gpkg"')
    turn_margin_m: float | None = setting(
        None, "room to turn around the area; as turns need it when left out",
        example="3.0", ge=0, le=1000,
    )  # fmt: skip
    seafloor_depth_m: float = setting(
        15.0, "mean depth of the sea floor below the surface", gt=0, le=6000
    )
    bathymetry_file: Path | None = setting(
        None, "BAG or GeoTIFF: lines follow its terrain", example='"site.bag"'
    )
    bathymetry_values: Literal["auto", "heights", "depths"] = setting(
        "auto", "heights, depths, or auto: what the file or its signs say"
    )

    @property
    def datum_given(self) -> list[str]:
        """Coordinates of the datum that are set; the others have no meaning.

        The middle of a shape in degrees is the datum unless one is set.
        """
        return sorted({"latitude_deg", "longitude_deg"} & self.model_fields_set)

    @property
    def files(self) -> list[Path]:
        """The files that shapes come from, a shapefile's side files too; those that exist."""
        files = []
        for path in (self.file, self.no_go_file, self.allowed_file):
            if path is not None:
                files += [path, *(sides_of(path) if path.suffix.lower() == ".shp" else [])]
        return [path for path in dict.fromkeys(files) if path.exists()]

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        for names in (("polygon_ne_m", "polygon_latlon_deg", "corridor_ne_m", "wkt", "file"),
                      ("allowed_ne_m", "allowed_file")):  # fmt: skip
            given = [name for name in names if getattr(self, name) is not None]
            if len(given) > 1:
                raise ValueError(f"give {' or '.join(given)}, not both")
        for corners in (self.polygon_ne_m, self.polygon_latlon_deg):
            if corners is not None and len(corners) < 3:
                raise ValueError(f"a polygon needs 3 corners or more, got {len(corners)}")
        if self.corridor_ne_m is not None and len(self.corridor_ne_m) < 2:
            raise ValueError(f"a corridor needs 2 points or more, got {len(self.corridor_ne_m)}")
        return self


def sides_of(shapefile: Path) -> list[Path]:
    """The files next to a shapefile that belong to it, whatever the case of their endings."""
    if not shapefile.parent.is_dir():
        return []
    return sorted(
        other
        for other in shapefile.parent.iterdir()
        if other.stem == shapefile.stem and other.suffix.lower() in SHAPEFILE_SIDES
    )


PortTilt = Annotated[float, Field(ge=-15, le=15)]


_DOME_M = 0.08


class CameraConfig(Config):
    """The stereo pair as designed: two Manta G-917 behind flat ports (paper, section III.B).

    Lens, kind of port and dome are left out where they are as usual: workspaces made before there
    was a choice stay as they are.
    """

    width_px: int = setting(3384, "of a picture", ge=64, le=20_000)
    height_px: int = setting(2710, "of a picture", ge=64, le=20_000)
    pixel_um: float = setting(3.69, "side of a pixel", ge=0.5, le=100)
    focal_mm: float = setting(12.5, "the paper's other lens: 25", ge=0.5, le=500)
    f_number: float = setting(4.0, "of the lens", ge=0.7, le=64)
    baseline_m: float = setting(0.1, "distance between the cameras", ge=0.001, le=2)
    lens: Literal["opencv", "fisheye"] = setting(
        "opencv", "or fisheye (equidistant)", exclude_if="opencv".__eq__
    )
    port: Literal["flat", "dome", "none"] = setting(
        "flat", "flat, dome or none", exclude_if="flat".__eq__
    )
    port_distance_m: float = setting(0.02, "flat: entrance pupil to inner glass", ge=0, le=0.5)
    port_tilt_deg: tuple[PortTilt, PortTilt] = setting(
        (0.0, 0.0), "flat: normals towards the pictures' right and bottom"
    )
    dome_radius_m: float = setting(
        _DOME_M, "dome: of its outer surface", gt=0, le=1, exclude_if=lambda r: r == _DOME_M
    )
    dome_centre_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "dome: its centre from the pupil, right, down, forward",
        exclude_if=lambda c: not any(c),
    )  # fmt: skip
    glass_thickness_m: float = setting(0.01, "of the port", ge=0, le=0.5)
    n_glass: float = setting(1.52, "index of refraction of the port", ge=1, le=2)
    position_body_m: tuple[float, float, float] = setting(
        (0.55, -0.05, 0.08), "left port's outer glass: forward, right, down"
    )
    dvl_position_body_m: tuple[float, float, float] = setting(
        (-0.4145, 0.0, 0.11), "where the DVL is: forward, right, down"
    )
    shortest_interval_s: float = setting(
        0.1, "the trigger controller's limit of 10 frames a second", gt=0, le=60
    )
    quantum_efficiency: float = setting(0.5, "electrons per photon", ge=0.01, le=1)
    full_well_e: float = setting(9000.0, "electrons that saturate a pixel", gt=100, le=1e7)
    read_noise_e: float = setting(12.0, "of a pixel, standard deviation", ge=0, le=1000)


class WaterConfig(Config):
    """The water between port and sea floor.

    Its index of refraction is `n_water`, or follows from temperature and salinity; then
    `SurveyConfig` sets `n_water` for the depth of its sea floor.
    """

    n_water: float = setting(
        1.34, "index of refraction; or leave it out and give the next keys:", ge=1, le=1.4
    )
    temperature_c: float | None = setting(
        None, "with salinity: the index after Quan & Fry (1995), at the depth of",
        example="22.0", ge=-2, le=35,
    )  # fmt: skip
    salinity_psu: float | None = setting(None, "  the sea floor", example="39.0", ge=0, le=43)
    n_water_sigma: float | None = setting(
        None, "of the index; by 1 degree, 1 psu and the formula when left out",
        example="0.0002", ge=0, le=0.1, exclude_if=lambda s: s is None,
    )  # fmt: skip
    jerlov: Jerlov = setting(
        "II", "I, II, III (ocean), 1C, 3C, 5C, 7C, 9C (coast, ever more turbid)"
    )

    @model_validator(mode="after")
    def _both_or_none(self) -> Self:
        if (self.temperature_c is None) != (self.salinity_psu is None):
            raise ValueError("give temperature_c and salinity_psu both, or n_water")
        return self

    @property
    def index_sigma(self) -> float:
        """Sigma of the index: as set, or as temperature and salinity leave it."""
        if self.n_water_sigma is not None:
            return self.n_water_sigma
        if self.temperature_c is None or self.salinity_psu is None:
            return n_water_sigma()
        return n_water_sigma(self.temperature_c, self.salinity_psu, GREEN_NM)


class PlanConfig(Config):
    """Settings of the plan: altitude, speed, overlap, lines and turns."""

    strobe_lead_s: ClassVar[float] = 0.0002
    """The strobe lights so long before the exposure and after it."""

    altitude_m: float = setting(2.0, "of the left port's outer glass", ge=0.3, le=10)
    relief_m: float = setting(
        0.35, "how far the sea floor rises and falls about its mean", ge=0, le=10
    )
    speed_mps: float = setting(0.2, "over ground", ge=0.01, le=3)
    forward_overlap: float = setting(0.6, "of pictures along the line", ge=0, le=0.95)
    line_spacing_m: float | None = setting(
        None, "between lines: the paper's at 2 m; at other altitudes set the next key instead",
        template="1.0", gt=0, le=20,
    )  # fmt: skip
    side_overlap: float = setting(
        0.28, "of neighbouring lines: their spacing follows from it", example="0.28", ge=0, le=0.95
    )
    overlap_over_relief: bool = setting(
        False, "whether the highest ground gets this side overlap too"
    )
    track_error_m: float = setting(
        0.0, "off the line to which neighbours still overlap as requested", ge=0, le=5
    )
    line_heading_deg: float | None = setting(
        None, "the one that costs least energy when left out", example="0.0", ge=0, lt=360
    )
    cross_lines: int = setting(
        1, "lines across the others: they keep the model from bending", ge=0, le=50
    )
    closing_line: bool = setting(
        True, "a line back over the start: it ties the end to the beginning"
    )
    margin_m: float = setting(0.0, "area to add on every side", ge=0, le=50)
    allowed_blur_px: float = setting(
        1.0, "motion blur: sets the exposure, with the rates below", gt=0, le=20
    )
    yaw_rate_deg_s: float = setting(1.0, "on a line", ge=0, le=90)
    roll_pitch_rate_deg_s: float = setting(1.0, "on a line", ge=0, le=90)
    sharp_px: float = setting(
        3.0, "a blur circle of this size still counts as in focus", ge=0.1, le=20
    )
    turns: Literal["auto", "arcs", "spot", "sway"] = setting(
        "auto", "auto (the cheapest that fits), arcs, spot (stop and yaw), sway"
    )
    turn_radius_m: float = setting(0.5, "of arcs", ge=0.05, le=20)
    turn_rate_limit_deg_s: float = setting(30.0, "that the vehicle turns with", ge=0.5, le=180)
    run_in_m: float = setting(0.5, "straight way before each line", ge=0.1, le=20)
    least_clearance_m: float = setting(1.0, "above the terrain of bathymetry_file", ge=0.1, le=10)
    steepest_deg: float = setting(20.0, "that the vehicle climbs or descends", gt=0, le=60)
    home_ne_m: tuple[float, float] | None = setting(
        None, "where it is launched and taken in; else the corner nearest the datum",
        example="[0.0, 0.0]",
    )  # fmt: skip
    dive_s: float | None = setting(
        None, "longest dive; what takes longer becomes several",
        example="7200.0", gt=0, le=1e6,
    )  # fmt: skip

    @property
    def arc_radius_m(self) -> float:
        """Radius of arcs: as set; with `turns = "auto"` at least what the limit of rate asks."""
        if self.turns != "auto":
            return self.turn_radius_m
        min_m = self.speed_mps / math.radians(self.turn_rate_limit_deg_s)
        return max(self.turn_radius_m, math.ceil(100.0 * min_m) / 100.0)


VEHICLE_FILES = (".toml", ".json")
"""Endings of the files that describe a vehicle."""
DEFAULT_VEHICLE = "alice"
COEFFICIENTS = ("estimated", "cfd", "calibrated", "computed")
"""Known sets of coefficients."""


class VehicleConfig(Config):
    """The vehicle and how it is controlled.

    Battery and hotel load are ALICE's; of another vehicle its own, where they are not set.
    """

    finds_failures: ClassVar[bool] = True
    """Whether the vehicle watches how its thrusters turn, and what they push."""

    name: str = setting(
        DEFAULT_VEHICLE, "alice, sparus2, bluerov2_heavy, remus100, or a TOML file from here",
        min_length=1,
    )  # fmt: skip
    coefficients: str = setting(
        "calibrated", "estimated, cfd, calibrated, computed from the shape; or a file",
    )  # fmt: skip
    controller: Literal["sway", "los"] = setting(
        "sway", "sway: heading held on the line; los, and without sway: to a point ahead on it"
    )
    allocation: Literal["exact", "rpi"] = setting(
        "exact", "exact (bounded least squares) or rpi (the paper's)"
    )
    failures: tuple[str, ...] = setting(
        (), "share of thrust left; @: from these seconds on",
        example='["bow=0.5", "stern@600", "stern:propeller@600"]', exclude_if=lambda f: not f,
    )  # fmt: skip
    battery_wh: float = setting(
        1400.0, "the vehicle's own where it is left out", example="1400.0", ge=0.01, le=1_000_000
    )
    battery_reserve: float = setting(0.2, "share of it that a dive leaves", ge=0, lt=1)
    hotel_w: float = setting(
        60.0, "everything but thrusters and strobes; the vehicle's own", example="60.0",
        ge=0, le=5000,
    )  # fmt: skip
    dive: int | None = setting(
        None, "of a plan of several, the one to fly; all when left out", example="1", ge=1
    )
    mission_file: Path | None = setting(
        None, "flown instead of the plan's route",
        example='"plan/exports/mission_dive1.xml"', exclude_if=lambda path: path is None,
    )  # fmt: skip

    @field_validator("coefficients")
    @classmethod
    def _known_or_a_file(cls, name: str) -> str:
        if name not in COEFFICIENTS and not name.lower().endswith(VEHICLE_FILES):
            raise ValueError(f"{name!r} is none of {', '.join(COEFFICIENTS)}, and no file .json")
        return name

    @field_validator("failures")
    @classmethod
    def _failures_can_be_read(cls, texts: tuple[str, ...]) -> tuple[str, ...]:
        try:
            parse_failures(texts)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return texts

    @property
    def file(self) -> Path | None:
        """The file that describes the vehicle; None for a known one."""
        return Path(self.name) if self.name.lower().endswith(VEHICLE_FILES) else None

    @property
    def coefficients_file(self) -> Path | None:
        """The file of its coefficients; None for a known set."""
        return None if self.coefficients in COEFFICIENTS else Path(self.coefficients)

    @property
    def impaired(self) -> dict[str, float]:
        """Shares of their thrust of the thrusters that are known not to be intact."""
        at_start = parse_failures(self.failures).at_start
        return {name: share for name, share in at_start.items() if share < 1.0}


class SeaConfig(Config):
    """Current and swell that act on the vehicle.

    The current near the sea floor; where `surface_current_mps` is set it changes evenly up to the
    surface; a slow Gauss-Markov process is added. `current_file` holds a measured series instead.
    Swell comes on top.
    """

    current_correlation_s: ClassVar[float] = 300.0
    gust_correlation_s: ClassVar[float] = 2.0
    """How long slow changes of the current and random forces last."""

    current_mps: float = setting(0.05, "near the sea floor", ge=0, le=3)
    current_towards_deg: float = setting(
        90.0, "direction it flows towards, from north", ge=0, lt=360
    )
    surface_current_mps: float | None = setting(
        None, "changes evenly in between; the same as below when left out",
        example="0.1", ge=0, le=3,
    )  # fmt: skip
    current_sigma_mps: float = setting(0.01, "slow changes", ge=0, le=1)
    current_file: Path | None = setting(
        None, "time_s, depth_m, north_mps, east_mps: instead of the above", example='"adcp.csv"'
    )
    swell_m: float = setting(0.0, "height of regular waves, trough to crest", ge=0, le=20)
    swell_period_s: float = setting(6.0, "of the waves", ge=1, le=30)
    swell_towards_deg: float = setting(90.0, "from north", ge=0, lt=360)
    gust_n: tuple[Gust, Gust, Gust] = setting(
        (0.5, 0.5, 0.5), "random forces in surge, sway and heave, standard deviations"
    )


class NavigationConfig(Config):
    """Navigation sensors of the vehicle; the rest as in `vehicle.navigation.sensors`."""

    gps_noise_m: ClassVar[float] = 0.02

    gps_bias_m: float = setting(
        0.03, "of the fix at the surface: RTK; 0.3 with other corrections, 1 without", ge=0, le=100
    )
    compass_bias_deg: float = setting(
        0.3, "of an inertial system; 1 of a magnetic compass", ge=0, le=30
    )
    compass_noise_deg: float = setting(0.3, "of a reading", gt=0, le=30)
    dvl_noise_mps: float = setting(0.0035, "along a beam, of a single ping", gt=0, le=1)
    dvl_dropouts_s: tuple[tuple[float, float], ...] = setting(
        (), "times without bottom lock, as [[120.0, 130.0]]; at most 20 s"
    )
    bottom_dropouts_s: tuple[tuple[float, float], ...] = setting(
        (), "times when the DVL hears the water, and not the bottom",
        example="[[120.0, 180.0]]", exclude_if=lambda d: not d,
    )  # fmt: skip
    blind_sigma_m: float = setting(
        0.0, "without bottom lock go on up to this horizontal sigma; 0: stop",
        example="0.5", ge=0, le=100, exclude_if=lambda sigma: sigma == 0.0,
    )  # fmt: skip
    usbl_noise_m: float = setting(
        0.5, "of fixes from the boat; 1 degree of slant range comes on top; 0: none",
        ge=0, le=100,
    )  # fmt: skip


class SeafloorConfig(Config):
    """The simulated sea floor."""

    relief_m: float = setting(0.35, "how far it rises and falls about its mean", ge=0, le=5)
    grid_m: float = setting(0.01, "cell of its heights", gt=0, le=1)
    rocks_per_m2: float = setting(0.5, "how many rocks lie on it", ge=0, le=20)
    largest_rock_m: float = setting(0.35, "size of the largest", gt=0, le=2)
    amphora: bool = setting(True, "whether an amphora lies in the middle")


class ImagingConfig(Config):
    """Settings of taking and rendering pictures."""

    samples: ClassVar[int] = 2
    """Rays a pixel, along x and along y."""

    scale: int = setting(1, "divides the resolution: 4 renders 16 times faster", ge=1, le=16)
    strobe_lumens: float = setting(30_000.0, "of each", ge=1, le=1e8)
    strobe_beam_deg: float = setting(120.0, "full angle", gt=1, lt=180)
    strobes_body_m: tuple[tuple[float, float, float], ...] = setting(
        ((0.75, 0.0, 0.08), (-0.6, 0.0, 0.08)), "where they are: forward, right, down"
    )
    pool_views: int = setting(
        25, "stereo views of the board that the calibration is made from", ge=8, le=200
    )


LEVEL, AUTO = "level", "auto"
_NUMBER = r"([+-]?\d+(?:\.\d+)?)"
_PLANE = re.compile(
    rf"([A-Za-z][A-Za-z0-9_-]{{0,29}})\s*=\s*facing\s+{_NUMBER}(?:\s+tilt\s+{_NUMBER})?"
)
_FORMS = (
    "give level, auto, or NAME=facing DEGREES [tilt DEGREES], as wall=facing 180: a letter and up "
    "to 29 letters, digits, _ and -, since it names a folder too; 0 to 360 degrees by the compass; "
    "-90 (overhanging) to 90 (lying)"
)


@dataclass(frozen=True, kw_only=True)
class WantedPlane:
    """A plane to project on."""

    name: str
    """Name, also of its folder."""
    facing_deg: float | None = None
    """Compass direction that the surface faces; None of `level` and `auto`."""
    tilt_deg: float = 0.0
    """Of the surface from the vertical: 90 lies and faces up, a negative one overhangs."""


def parse_plane(text: str) -> WantedPlane:
    """Read `level`, `auto`, or `NAME=facing DEGREES [tilt DEGREES]`.

    Raises:
        ValueError: it is not of that form, in words for the person who wrote it.
    """
    if text.strip() in (LEVEL, AUTO):
        return WantedPlane(name=text.strip())
    found = _PLANE.fullmatch(text.strip())
    if found is None or found[1].lower() in (LEVEL, AUTO):
        raise ValueError(f"plane {text!r}: {_FORMS}")
    facing, tilt = float(found[2]), float(found[3] or 0.0)
    if not (0.0 <= facing <= 360.0 and -90.0 <= tilt <= 90.0):
        raise ValueError(f"plane {text!r}: {_FORMS}")
    return WantedPlane(name=found[1], facing_deg=facing, tilt_deg=tilt)


def parse_planes(texts: Sequence[str]) -> tuple[WantedPlane, ...]:
    """Read planes, of which no two have the same name.

    Raises:
        ValueError: one is wrong, there is none, or a name is there twice.
    """
    planes = tuple(parse_plane(text) for text in texts)
    if not planes:
        raise ValueError(f"no plane: {_FORMS}")
    names = [plane.name.lower() for plane in planes]  # some file systems ignore the case
    if len(set(names)) < len(names):
        raise ValueError(f"two of the planes {', '.join(names)} have one name")
    return planes


class ReconstructConfig(Config):
    """Settings of the reconstruction."""

    mapper: ClassVar[str] = "auto"
    dispersion: ClassVar[str] = "auto"
    """Only recorded, so that models and mosaics of earlier versions stay up to date."""

    max_features: int = setting(8000, "per picture", ge=200, le=50_000)
    learned_features: bool = setting(
        False, "a network's features too, for pairs that SIFT cannot tie: turbid water"
    )
    mount_sigma_deg: float = setting(
        0.0, "of the rig's mount against navigation's axes; 0: exact", ge=0, le=20
    )
    lever_sigma_m: float = setting(
        0.02, "of the rig's place against navigation's, along each axis", gt=0, le=10
    )
    clock_sigma_s: float = setting(0.2, "of the cameras' clock against navigation's", gt=0, le=3600)
    refine_port: bool = setting(
        False, "find the ports' distance, normal and water from the survey itself"
    )
    refine_rig: Literal["auto", "on", "off"] = setting(
        "auto", "cameras' poses on the rig and the lever arm: if their sigmas are known"
    )
    dense_scale: float | None = setting(
        None, "of the pictures for depth; as dem_cell_m needs when left out",
        example="0.5", gt=0.05, le=1,
    )  # fmt: skip
    dem_cell_m: float | None = setting(
        None, "as fine as the pictures when left out; coarser takes less computing",
        example="0.005", gt=0, le=10,
    )  # fmt: skip
    planes: tuple[str, ...] = setting(
        ("level",), 'of DEM and mosaic: "auto", "wall=facing 180", "hull=facing 90 tilt -30"',
        example='["level"]',
    )  # fmt: skip
    mask_moving: bool = setting(
        True, "fish, weed and moving shadows are left out of mosaic and texture"
    )
    mosaic_pixel_m: float | None = setting(
        None, "as fine as the pictures when left out", example="0.0005", gt=0, le=10
    )
    mesh_error_px: float = setting(
        0.25, "ground pixels that the mesh may lose by fewer triangles",
        example="0.25", ge=0.01, le=10,
    )  # fmt: skip
    colour: Literal["even", "water", "raw"] = setting(
        "water", 'mosaic: light, attenuation and backscatter taken out; "even": light; "raw"',
        example='"water"',
    )  # fmt: skip

    @field_validator("planes")
    @classmethod
    def _planes_can_be_read(cls, planes: tuple[str, ...]) -> tuple[str, ...]:
        parse_planes(planes)
        return planes


class SurveyConfig(Config):
    """Settings of a whole survey, as in `survey.toml`.

    Example:
        >>> import alice_survey as alice
        >>> alice.SurveyConfig().plan.altitude_m
        2.0
    """

    name: str = setting(
        "survey", "of the survey", min_length=1, max_length=80, pattern=r"^[\w .-]+$"
    )
    seed: int = setting(1, "all randomness of the simulation follows from it", ge=0, lt=2**32)
    area: AreaConfig = setting(AreaConfig(), "what to survey: a rectangle at the datum ...")
    camera: CameraConfig = setting(
        CameraConfig(), "the stereo pair as designed: 2 x Manta G-917 behind flat ports"
    )
    water: WaterConfig = setting(WaterConfig(), "between port and sea floor")
    plan: PlanConfig = setting(PlanConfig(), "how densely the sea floor is imaged")
    vehicle: VehicleConfig = setting(VehicleConfig(), "what flies in simulation")
    sea: SeaConfig = setting(SeaConfig(), "current and swell")
    navigation: NavigationConfig = setting(
        NavigationConfig(), "how well the vehicle knows where it is"
    )
    seafloor: SeafloorConfig = setting(SeafloorConfig(), "the simulated sea floor")
    imaging: ImagingConfig = setting(ImagingConfig(), "how simulated pictures are taken")
    reconstruct: ReconstructConfig = setting(ReconstructConfig(), "how pictures become a model")

    @field_validator("water")
    @classmethod
    def _index_at_the_sea_floor(cls, water: WaterConfig, info: ValidationInfo) -> WaterConfig:
        area = info.data.get("area")
        if water.temperature_c is None or water.salinity_psu is None or area is None:
            return water
        try:
            index = float(
                n_water(water.temperature_c, water.salinity_psu, area.seafloor_depth_m, GREEN_NM)
            )
        except ConfigError as error:
            raise ValueError(str(error)) from None
        # Settings that were resolved once come back with their own index.
        if "n_water" in water.model_fields_set and abs(water.n_water - index) > 1e-9:
            raise ValueError(
                f"temperature_c and salinity_psu give n_water = {index:.5f}, and n_water = "
                f"{water.n_water:g} is set too: leave one out"
            )
        return water.model_copy(update={"n_water": index})


_GEO = "give the corners as 'wkt', longitude before latitude, with crs = \"EPSG:4326\", or a file"
_HEALTHY = dict.fromkeys(("starboard", "port", "vertical", "bow", "stern"), 1.0)
_ALWAYS = "it is always so: leave it out"
REMOVED: Mapping[str, tuple[Any, str]] = {
    "area.datum_at": ("corner", "the datum is the first corner: move it there"),
    "area.corridor_latlon_deg": (None, _GEO),
    "area.no_go_latlon_deg": ([], "give the corners in a no_go_file"),
    "area.allowed_latlon_deg": (None, "give the corners in an allowed_file"),
    "area.no_go_layer": (None, "save the layer as a file of its own"),
    "area.allowed_layer": (None, "save the layer as a file of its own"),
    "area.bathymetry_crs": (None, "set 'crs', which counts for the raster too"),
    "water.wavelength_nm": (None, "the index is that of green light; else set n_water"),
    "plan.strobe_lead_s": (0.0002, "it is 0.0002 s: leave it out"),
    "plan.split_dives": (True, _ALWAYS),
    "plan.tie_dives": (True, _ALWAYS),
    "vehicle.thruster_health": (_HEALTHY, 'write failures = ["NAME=SHARE"]'),
    "vehicle.health_known": (True, 'a failure from 0 s on is unknown: failures = ["NAME=SHARE@0"]'),
    "vehicle.lost_propellers": (..., 'write failures = ["NAME:propeller@SECONDS"]'),
    "vehicle.finds_failures": (True, _ALWAYS),
    "vehicle.coefficients_file": (None, "write the file's name as 'coefficients'"),
    "vehicle.follower": (..., "a mission file is flown by the autopilot that it is for"),
    "vehicle.cola2_delta_m": (..., "it is what about.txt of the exports says"),
    "sea.current_correlation_s": (300.0, "it is 300 s: leave it out"),
    "sea.gust_correlation_s": (2.0, "it is 2 s: leave it out"),
    "navigation.gps_noise_m": (0.02, "a fix is noisy by 0.02 m: leave it out"),
    "navigation.usbl": (True, "usbl_noise_m = 0 means that there is none"),
    "imaging.samples": (2, "pictures have 2 x 2 rays a pixel: leave it out"),
    "imaging.noise": (True, _ALWAYS),
    "imaging.range_maps": (False, "the truth holds the sea floor and every pose: leave it out"),
    "imaging.image_format": ("png", "rendered pictures are PNG: leave it out"),
    "reconstruct.feature_scale": (None, "it follows from the pictures: leave it out"),
    "reconstruct.working_range_m": (None, "it follows from navigation and the model: leave it out"),
    "reconstruct.mapper": ("auto", "it is chosen by the pictures: leave it out"),
    "reconstruct.dense_partners": (4, "each picture is matched with 4: leave it out"),
    "reconstruct.mesh_triangles": (None, "raise mesh_error_px for fewer triangles"),
    "reconstruct.mesh_tiles": ("auto", "they are made where mesh.glb lacks detail: leave it out"),
    "reconstruct.mesh_page_px": (8192, "it is 8192: leave it out"),
    "reconstruct.dispersion": ("auto", "it is corrected where the rig shows it: leave it out"),
}
"""Settings of version 0.1 that are gone: what now always holds, if anything, and what to do.

Files may still hold that value, for one version, and stages record it, so that those of earlier
versions stay up to date.
"""
UNRECORDED = frozenset({"plan.tie_dives", "vehicle.finds_failures"})
"""Those of them that stages do not record."""


def constants_of(section: str) -> dict[str, Any]:
    """Values that settings of a section which are gone now always have."""
    return {
        key: value
        for name, (value, _) in REMOVED.items()
        if value is not ... and (key := name.removeprefix(f"{section}.")) != name
    }


_MAX_LENGTH = 1_000_000
_MAX_FAULTS = 8
"""Faults reported at once."""


def load_config(path: str | Path) -> SurveyConfig:
    """Read `survey.toml`.

    Raises:
        ConfigError: the file is missing, is not TOML, or holds an unknown key or a value out of
            range; the message names the file, the key, the value and what is allowed.

    Example:
        >>> import alice_survey as alice
        >>> survey = alice.Survey.new("wreck")
        >>> alice.load_config("wreck/survey.toml").plan.speed_mps
        0.2
    """
    path = Path(path)
    try:
        text = ordinary_file(path, 4 * _MAX_LENGTH).read_text(encoding="utf-8")
    except FileNotFoundError:
        begin = offer("init", path.parent)
        raise ConfigError(f"{path}: no such file; {begin!r} writes one") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {why(error)}") from None
    return parse_settings(text, path)


def parse_settings(text: str, path: Path) -> SurveyConfig:
    """Check the text of a settings file.

    Args:
        text: TOML.
        path: of the file, from whose folder relative names of files count.

    Raises:
        ConfigError: as `load_config`.
    """
    return checked_settings(settings_in(text, str(path)), path)


def settings_in(text: str, origin: str) -> dict[str, Any]:
    """The settings that a text holds, as they are written.

    Args:
        text: TOML.
        origin: what messages call it.

    Raises:
        ConfigError: it is not TOML.
    """
    if len(text) > _MAX_LENGTH:
        raise ConfigError(
            f"{origin}: {len(text) / 1e6:.1f} million characters: no settings file is that long"
        )
    try:
        return parse_toml(text)
    # A number of thousands of digits is a ValueError.
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{origin}: not valid TOML: {one_line(error)}") from None


def checked_settings(settings: dict[str, Any], path: Path) -> SurveyConfig:
    """Check settings as a file holds them; arguments and errors as of `parse_settings`."""
    return parse_config(_with_resolved_files(settings, path.parent), str(path))


_FILES = (
    ("area", "file"), ("area", "no_go_file"), ("area", "allowed_file"), ("area", "bathymetry_file"),
    ("sea", "current_file"), ("vehicle", "mission_file"),
)  # fmt: skip
_NAMES_OR_FILES = (("vehicle", "name"), ("vehicle", "coefficients"))


def _with_resolved_files(settings: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Settings whose relative file names are resolved from the folder of the settings file."""
    result = dict(settings)
    for section, key, name in settings_files(settings):
        file = folder / name
        if key != "name" and file.exists() and not (file.is_file() or file.is_dir()):
            raise ConfigError(f"{section}.{key}: {file} is neither a file nor a folder")
        result[section] = {**result[section], key: str(file)}
    return result


def settings_files(settings: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Section, key and name of each file that settings, as written, name."""
    for section, key in (*_FILES, *_NAMES_OR_FILES):
        values = settings.get(section)
        name = values.get(key) if isinstance(values, Mapping) else None
        is_file = (section, key) in _FILES or str(name).lower().endswith(VEHICLE_FILES)
        if isinstance(name, str) and is_file:
            yield section, key, name


def parse_config(settings: dict[str, Any], origin: str) -> SurveyConfig:
    """Check settings that came from `origin`.

    Raises:
        ConfigError: as `load_config`.
    """
    try:
        return SurveyConfig.model_validate(_without_constants(settings))
    except ValidationError as error:
        raise ConfigError(f"{origin}: {_one_line(error)}") from None


def _without_constants(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings without those that are gone and had the value that now always holds."""
    result = dict(settings)
    for section, values in settings.items():
        if isinstance(values, dict):
            gone = constants_of(section)
            result[section] = {k: v for k, v in values.items() if k not in gone or gone[k] != v}
    return result


def change_section(config: SurveyConfig, section: str, **values: Any) -> SurveyConfig:
    """A survey with some settings of a section changed; those that are None stay as they are.

    A current takes the place of a measured one.

    Raises:
        ConfigError: a value is out of range.
    """
    given = {key: value for key, value in values.items() if value is not None}
    if not given:
        return config
    if "current_mps" in given:
        given = {"current_file": None, **given}
    settings = config.model_dump(mode="json", exclude_unset=True)
    settings[section] = settings.get(section, {}) | given
    return parse_config(settings, "command line")


def parse_current(text: str | None) -> tuple[float | None, float | None]:
    """Speed, m/s, and direction, degrees, of a current given as `SPEED@DIRECTION`.

    Raises:
        ConfigError: it is not of that form.
    """
    if text is None:
        return None, None
    speed, _, direction = text.partition("@")
    try:
        return float(speed), float(direction) % 360.0
    except ValueError:
        raise ConfigError(
            f"current {text!r}: give SPEED@DIRECTION, m/s and degrees from north that it flows "
            "towards, as 0.1@90"
        ) from None


_PROPELLER = ":propeller"


class Failures(NamedTuple):
    """What is left of thrusters."""

    at_start: dict[str, float]
    """Shares of their thrust by name; the vehicle knows of them."""
    later: list[tuple[str, float, float]]
    """Name, seconds from the start, share."""
    propellers: list[tuple[str, float, float]]
    """The same of those that turn on, without that share of their thrust."""


def parse_failures(texts: Sequence[str]) -> Failures:
    """Thrusters and what is left of them, from `NAME` (nothing), `NAME=SHARE` and `...@SECONDS`.

    `NAME:propeller`, and so on, is of one that turns on with that share of its thrust.

    Raises:
        ConfigError: a share is not from 0 to 1, or a time is not a number of seconds.
    """
    found = Failures({}, [], [])
    for text in texts:
        what, at, seconds = text.partition("@")
        name, _, share = what.partition("=")
        try:
            left, start_s = float(share or 0.0), float(seconds) if at else 0.0
        except ValueError:
            left = start_s = math.nan
        if not (0.0 <= left <= 1.0 and 0.0 <= start_s <= 1e6):
            raise ConfigError(
                f"thruster {text!r}: give NAME, or NAME=SHARE of its thrust that is left, as "
                "stern=0.5, and @SECONDS for a failure on the way, as stern@600; NAME:propeller "
                "turns on without it"
            )
        if name.endswith(_PROPELLER):
            found.propellers.append((name.removesuffix(_PROPELLER), start_s, left))
        elif at:
            found.later.append((name, start_s, left))
        else:
            found.at_start[name] = left
    return found


def _one_line(error: ValidationError) -> str:
    faults = []
    for fault in error.errors()[:_MAX_FAULTS]:
        key = as_line(".".join(map(str, fault["loc"]))) or "settings"
        if key in REMOVED:
            faults.append(f"{key} is gone: {REMOVED[key][1]}")
        elif fault["type"] == "extra_forbidden":
            faults.append(f"{key} is not a known setting{_nearest(*map(str, fault['loc']))}")
        elif fault["type"] == "value_error":
            faults.append(f"{key}: {fault['ctx']['error']}")
        else:
            faults.append(f"{key} = {fault['input']!r:.60}: {fault['msg']}")
    more = error.error_count() - len(faults)
    return "; ".join(faults) + (f"; and {more} more" if more else "")


def _nearest(*location: str) -> str:
    section: Any = SurveyConfig
    for name in location[:-1]:
        section = section.model_fields[name].annotation
    return nearest(location[-1], section.model_fields)
