"""Settings of a survey: `survey.toml` as frozen sections that reject unknown keys."""

import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from alice_survey.core.contents import one_line, shown
from alice_survey.core.errors import ConfigError
from alice_survey.core.plane_settings import parse_planes
from alice_survey.core.seawater import GREEN_NM, n_water, n_water_sigma

Jerlov = Literal["I", "II", "III", "1C", "3C", "5C", "7C", "9C"]
Latitude = Annotated[float, Field(ge=-85, le=85)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Share = Annotated[float, Field(ge=0, le=1)]
Seconds = Annotated[float, Field(ge=0, le=1e6)]
Ring = tuple[tuple[float, float], ...]
GeoRing = tuple[tuple[Latitude, Longitude], ...]
Gust = Annotated[float, Field(ge=0, le=1000)]
SHAPEFILE_SIDES = (".shx", ".dbf", ".prj", ".cpg")


class Config(BaseModel):
    """A settings section: immutable, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _true_is_no_number(cls, value: object, info: ValidationInfo) -> object:
        wanted = cls.model_fields[str(info.field_name)].annotation
        if isinstance(value, dict) and get_origin(wanted) is dict:
            value_of = list(value.values())
        else:
            value_of = [value]
        if wanted is not bool and _holds_bool(value_of):
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

    latitude_deg: Latitude = 32.8236
    longitude_deg: Longitude = 34.9553
    length_m: float = Field(15.0, gt=0, le=10_000)
    width_m: float = Field(17.0, gt=0, le=10_000)
    heading_deg: float = Field(0.0, ge=0, lt=360)
    datum_at: Literal["corner", "center"] = "corner"
    polygon_ne_m: Ring | None = None
    polygon_latlon_deg: GeoRing | None = None
    corridor_ne_m: Ring | None = None
    corridor_latlon_deg: GeoRing | None = None
    corridor_width_m: float = Field(5.0, gt=0, le=1000)
    closed_lines: Literal["corridor", "inside"] | None = Field(None, exclude_if=lambda c: c is None)
    wkt: str | None = None
    file: Path | None = None
    layer: str | None = None
    crs: str | None = None
    no_go_ne_m: tuple[Ring, ...] = ()
    no_go_latlon_deg: tuple[GeoRing, ...] = ()
    no_go_file: Path | None = None
    no_go_layer: str | None = None
    no_go_clearance_m: float = Field(0.0, ge=0, le=100)
    allowed_ne_m: Ring | None = None
    allowed_latlon_deg: GeoRing | None = None
    allowed_file: Path | None = None
    allowed_layer: str | None = None
    turn_margin_m: float | None = Field(None, ge=0, le=1000)
    seafloor_depth_m: float = Field(15.0, gt=0, le=6000)
    bathymetry_file: Path | None = None
    bathymetry_values: Literal["auto", "heights", "depths"] = "auto"
    bathymetry_crs: str | None = None

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
        shapes = (
            "polygon_ne_m", "polygon_latlon_deg", "corridor_ne_m", "corridor_latlon_deg",
            "wkt", "file",
        )  # fmt: skip
        given = [name for name in shapes if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"give {' or '.join(given)}, not both")
        for name in ("polygon_ne_m", "polygon_latlon_deg"):
            corners = getattr(self, name)
            if corners is not None and len(corners) < 3:
                raise ValueError(f"a polygon needs 3 corners or more, got {len(corners)}")
        for name in ("corridor_ne_m", "corridor_latlon_deg"):
            points = getattr(self, name)
            if points is not None and len(points) < 2:
                raise ValueError(f"a corridor needs 2 points or more, got {len(points)}")
        allowed = ("allowed_ne_m", "allowed_latlon_deg", "allowed_file")
        given = [name for name in allowed if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"give {' or '.join(given)}, not both")
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

    width_px: int = Field(3384, ge=64, le=20_000)
    height_px: int = Field(2710, ge=64, le=20_000)
    pixel_um: float = Field(3.69, ge=0.5, le=100)
    focal_mm: float = Field(12.5, ge=0.5, le=500)
    f_number: float = Field(4.0, ge=0.7, le=64)
    baseline_m: float = Field(0.1, ge=0.001, le=2)
    lens: Literal["opencv", "fisheye"] = Field("opencv", exclude_if="opencv".__eq__)
    port: Literal["flat", "dome", "none"] = Field("flat", exclude_if="flat".__eq__)
    port_distance_m: float = Field(0.02, ge=0, le=0.5)
    port_tilt_deg: tuple[PortTilt, PortTilt] = (0.0, 0.0)
    dome_radius_m: float = Field(_DOME_M, gt=0, le=1, exclude_if=lambda r: r == _DOME_M)
    dome_centre_m: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), exclude_if=lambda c: not any(c)
    )
    glass_thickness_m: float = Field(0.01, ge=0, le=0.5)
    n_glass: float = Field(1.52, ge=1, le=2)
    position_body_m: tuple[float, float, float] = (0.55, -0.05, 0.08)
    dvl_position_body_m: tuple[float, float, float] = (-0.4145, 0.0, 0.11)
    shortest_interval_s: float = Field(0.1, gt=0, le=60)
    quantum_efficiency: float = Field(0.5, ge=0.01, le=1)
    full_well_e: float = Field(9000.0, gt=100, le=1e7)
    read_noise_e: float = Field(12.0, ge=0, le=1000)


class WaterConfig(Config):
    """The water between port and sea floor.

    Its index of refraction is `n_water`, or follows from temperature and salinity; then
    `SurveyConfig` sets `n_water` for the depth of its sea floor.
    """

    n_water: float = Field(1.34, ge=1, le=1.4)
    n_water_sigma: float | None = Field(None, ge=0, le=0.1, exclude_if=lambda s: s is None)
    jerlov: Jerlov = "II"
    temperature_c: float | None = Field(None, ge=-2, le=35)
    salinity_psu: float | None = Field(None, ge=0, le=43)
    wavelength_nm: float | None = Field(None, ge=380, le=750)

    @model_validator(mode="after")
    def _both_or_none(self) -> Self:
        if (self.temperature_c is None) != (self.salinity_psu is None):
            raise ValueError("give temperature_c and salinity_psu both, or n_water")
        if self.wavelength_nm is not None and self.temperature_c is None:
            raise ValueError("wavelength_nm needs temperature_c and salinity_psu")
        return self

    @property
    def index_sigma(self) -> float:
        """Sigma of the index: as set, or as temperature and salinity leave it."""
        if self.n_water_sigma is not None:
            return self.n_water_sigma
        if self.temperature_c is None or self.salinity_psu is None:
            return n_water_sigma()
        return n_water_sigma(self.temperature_c, self.salinity_psu, self.wavelength_nm or GREEN_NM)


class PlanConfig(Config):
    """Settings of the plan: altitude, speed, overlap, lines and turns."""

    altitude_m: float = Field(2.0, ge=0.3, le=10)
    speed_mps: float = Field(0.2, ge=0.01, le=3)
    forward_overlap: float = Field(0.6, ge=0, le=0.95)
    side_overlap: float = Field(0.28, ge=0, le=0.95)
    line_spacing_m: float | None = Field(None, gt=0, le=20)
    line_heading_deg: float | None = Field(None, ge=0, lt=360)
    overlap_over_relief: bool = False
    track_error_m: float = Field(0.0, ge=0, le=5)
    cross_lines: int = Field(1, ge=0, le=50)
    closing_line: bool = True
    margin_m: float = Field(0.0, ge=0, le=50)
    relief_m: float = Field(0.35, ge=0, le=10)
    allowed_blur_px: float = Field(1.0, gt=0, le=20)
    yaw_rate_deg_s: float = Field(1.0, ge=0, le=90)
    roll_pitch_rate_deg_s: float = Field(1.0, ge=0, le=90)
    sharp_px: float = Field(3.0, ge=0.1, le=20)
    strobe_lead_s: float = Field(0.0002, ge=0, le=0.1)
    least_clearance_m: float = Field(1.0, ge=0.1, le=10)
    steepest_deg: float = Field(20.0, gt=0, le=60)
    turns: Literal["auto", "arcs", "spot", "sway"] = "auto"
    turn_radius_m: float = Field(0.5, ge=0.05, le=20)
    turn_rate_limit_deg_s: float = Field(30.0, ge=0.5, le=180)
    run_in_m: float = Field(0.5, ge=0.1, le=20)
    home_ne_m: tuple[float, float] | None = None
    split_dives: bool = True
    tie_dives: bool = Field(True, exclude_if=bool)
    dive_s: float | None = Field(None, gt=0, le=1e6)

    @property
    def arc_radius_m(self) -> float:
        """Radius of arcs: as set; with `turns = "auto"` at least what the limit of rate asks."""
        if self.turns != "auto":
            return self.turn_radius_m
        min_m = self.speed_mps / math.radians(self.turn_rate_limit_deg_s)
        return max(self.turn_radius_m, math.ceil(100.0 * min_m) / 100.0)


_INTACT = dict.fromkeys(("starboard", "port", "vertical", "bow", "stern"), 1.0)
"""As workspaces have always recorded it; thrusters that are not named are intact, too."""
VEHICLE_FILES = (".toml", ".json")
"""Endings of the files that describe a vehicle."""


DEFAULT_VEHICLE = "alice"


class VehicleConfig(Config):
    """The vehicle and how it is controlled.

    Battery and hotel load are ALICE's; of another vehicle its own, where they are not set.
    """

    name: str = Field(DEFAULT_VEHICLE, min_length=1)
    """Of a known vehicle, or a file that describes one."""
    coefficients: Literal["estimated", "cfd", "calibrated", "computed"] = "calibrated"
    coefficients_file: Path | None = None
    controller: Literal["sway", "los"] = "sway"
    allocation: Literal["exact", "rpi"] = "exact"
    thruster_health: dict[str, Share] = Field(default_factory=lambda: dict(_INTACT))
    """Share of its greatest thrust that each thruster has left: 0 failed, 1 intact."""
    health_known: bool = True
    failures: tuple[tuple[str, Seconds, Share], ...] = Field((), exclude_if=lambda f: not f)
    """Thrusters that fail on the way: name, seconds from the start, share that is left."""
    lost_propellers: tuple[tuple[str, Seconds, Share], ...] = Field((), exclude_if=lambda f: not f)
    """Thrusters that go on turning with less thrust: name, seconds, share of it that is left."""
    finds_failures: bool = Field(True, exclude_if=bool)
    """Whether the vehicle watches how its thrusters turn, and what they push."""
    battery_wh: float = Field(1400.0, ge=0.01, le=1_000_000)
    battery_reserve: float = Field(0.2, ge=0, lt=1)
    hotel_w: float = Field(60.0, ge=0, le=5000)
    dive: int | None = Field(None, ge=1)
    mission_file: Path | None = Field(None, exclude_if=lambda path: path is None)
    """A mission that is flown instead of the plan, as an autopilot follows it."""
    follower: Literal["cola2", "ardusub"] | None = Field(None, exclude_if=lambda f: f is None)
    """That autopilot; the one that the file is for where it is not set."""
    cola2_delta_m: float | None = Field(None, gt=0, le=100, exclude_if=lambda d: d is None)
    """COLA2's look-ahead, `section/delta`; as `about.txt` of the exports says where not set."""

    @property
    def file(self) -> Path | None:
        """The file that describes the vehicle; None for a known one."""
        path = Path(self.name)
        return path if path.suffix.lower() in VEHICLE_FILES else None

    def __hash__(self) -> int:
        """As of other sections, which hold nothing that cannot be hashed."""
        return hash(self.model_dump_json())

    @property
    def impaired(self) -> dict[str, float]:
        """Thrusters that are not intact."""
        return {name: share for name, share in self.thruster_health.items() if share < 1.0}


class SeaConfig(Config):
    """Current and swell that act on the vehicle.

    The current near the sea floor; where `surface_current_mps` is set it changes evenly up to the
    surface; a slow Gauss-Markov process is added. `current_file` holds a measured series instead.
    Swell comes on top.
    """

    current_mps: float = Field(0.05, ge=0, le=3)
    current_towards_deg: float = Field(90.0, ge=0, lt=360)
    surface_current_mps: float | None = Field(None, ge=0, le=3)
    current_sigma_mps: float = Field(0.01, ge=0, le=1)
    current_correlation_s: float = Field(300.0, ge=1, le=1e6)
    current_file: Path | None = None
    swell_m: float = Field(0.0, ge=0, le=20)
    swell_period_s: float = Field(6.0, ge=1, le=30)
    swell_towards_deg: float = Field(90.0, ge=0, lt=360)
    gust_n: tuple[Gust, Gust, Gust] = (0.5, 0.5, 0.5)
    gust_correlation_s: float = Field(2.0, ge=0.05, le=1000)


class NavigationConfig(Config):
    """Navigation sensors of the vehicle; the rest as in `vehicle.navigation.sensors`."""

    gps_bias_m: float = Field(0.03, ge=0, le=100)
    gps_noise_m: float = Field(0.02, gt=0, le=100)
    compass_bias_deg: float = Field(0.3, ge=0, le=30)
    compass_noise_deg: float = Field(0.3, gt=0, le=30)
    dvl_noise_mps: float = Field(0.0035, gt=0, le=1)
    dvl_dropouts_s: tuple[tuple[float, float], ...] = ()
    bottom_dropouts_s: tuple[tuple[float, float], ...] = Field((), exclude_if=lambda d: not d)
    """Seconds (from, to) in which the DVL hears the water, and not the bottom."""
    blind_sigma_m: float = Field(0.0, ge=0, le=100, exclude_if=lambda sigma: sigma == 0.0)
    """Horizontal sigma up to which the vehicle goes on without bottom lock; 0: it does not."""
    usbl: bool = True
    usbl_noise_m: float = Field(0.5, gt=0, le=100)


class SeafloorConfig(Config):
    """The simulated sea floor."""

    relief_m: float = Field(0.35, ge=0, le=5)
    grid_m: float = Field(0.01, gt=0, le=1)
    rocks_per_m2: float = Field(0.5, ge=0, le=20)
    largest_rock_m: float = Field(0.35, gt=0, le=2)
    amphora: bool = True


class ImagingConfig(Config):
    """Settings of taking and rendering pictures."""

    scale: int = Field(1, ge=1, le=16)
    image_format: Literal["png", "jpg"] = "png"
    strobe_lumens: float = Field(30_000.0, ge=1, le=1e8)
    strobe_beam_deg: float = Field(120.0, gt=1, lt=180)
    strobes_body_m: tuple[tuple[float, float, float], ...] = ((0.75, 0.0, 0.08), (-0.6, 0.0, 0.08))
    samples: int = Field(2, ge=1, le=8)
    noise: bool = True
    range_maps: bool = False
    pool_views: int = Field(25, ge=8, le=200)


class ReconstructConfig(Config):
    """Settings of the reconstruction."""

    feature_scale: float | None = Field(None, gt=0.05, le=1)
    max_features: int = Field(8000, ge=200, le=50_000)
    learned_features: bool = False
    working_range_m: float | None = Field(None, gt=0, le=100)
    mapper: Literal["auto", "global", "incremental"] = "auto"
    mount_sigma_deg: float = Field(0.0, ge=0, le=20)
    lever_sigma_m: float = Field(0.02, gt=0, le=10)
    clock_sigma_s: float = Field(0.2, gt=0, le=3600)
    refine_port: bool = False
    refine_rig: Literal["auto", "on", "off"] = "auto"
    dense_scale: float | None = Field(None, gt=0.05, le=1)
    dense_partners: int = Field(4, ge=1, le=12)
    dem_cell_m: float | None = Field(None, gt=0, le=10)
    planes: tuple[str, ...] = ("level",)
    mask_moving: bool = True
    mosaic_pixel_m: float | None = Field(None, gt=0, le=10)
    mesh_triangles: int | None = Field(None, ge=100, le=50_000_000)
    mesh_error_px: float = Field(0.25, ge=0.01, le=10)
    mesh_tiles: Literal["auto", "on", "off"] = "auto"
    mesh_page_px: int = Field(8192, ge=512, le=16_384)
    colour: Literal["even", "water", "raw"] = "water"
    dispersion: Literal["auto", "on", "off"] = "auto"

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

    name: str = Field("survey", min_length=1, max_length=80, pattern=r"^[\w .-]+$")
    seed: int = Field(1, ge=0, lt=2**32)
    area: AreaConfig = AreaConfig()
    camera: CameraConfig = CameraConfig()
    water: WaterConfig = WaterConfig()
    plan: PlanConfig = PlanConfig()
    vehicle: VehicleConfig = VehicleConfig()
    sea: SeaConfig = SeaConfig()
    navigation: NavigationConfig = NavigationConfig()
    seafloor: SeafloorConfig = SeafloorConfig()
    imaging: ImagingConfig = ImagingConfig()
    reconstruct: ReconstructConfig = ReconstructConfig()

    @field_validator("water")
    @classmethod
    def _index_at_the_sea_floor(cls, water: WaterConfig, info: ValidationInfo) -> WaterConfig:
        area = info.data.get("area")
        if water.temperature_c is None or water.salinity_psu is None or area is None:
            return water
        try:
            index = float(
                n_water(
                    water.temperature_c,
                    water.salinity_psu,
                    area.seafloor_depth_m,
                    water.wavelength_nm or GREEN_NM,
                )
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


_LONGEST = 1_000_000
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
    if path.exists() and not path.is_file():
        raise ConfigError(f"{path}: not a file: give the settings as a plain file")
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; 'alice-survey init DIR' writes one") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
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
    if len(text) > _LONGEST:
        raise ConfigError(
            f"{origin}: {len(text) / 1e6:.1f} million characters: no settings file is that long"
        )
    try:
        return tomllib.loads(text)
    # A number of thousands of digits is a ValueError.
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{origin}: not valid TOML: {one_line(error)}") from None


def checked_settings(settings: dict[str, Any], path: Path) -> SurveyConfig:
    """Check settings as a file holds them; arguments and errors as of `parse_settings`."""
    return parse_config(_with_resolved_files(settings, path.parent), str(path))


_FILES = (
    ("area", "file"), ("area", "no_go_file"), ("area", "allowed_file"), ("area", "bathymetry_file"),
    ("sea", "current_file"), ("vehicle", "coefficients_file"), ("vehicle", "mission_file"),
)  # fmt: skip


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
    for section, key in (*_FILES, ("vehicle", "name")):
        values = settings.get(section)
        name = values.get(key) if isinstance(values, Mapping) else None
        if isinstance(name, str) and (key != "name" or name.lower().endswith(VEHICLE_FILES)):
            yield section, key, name


def parse_config(settings: dict[str, Any], origin: str) -> SurveyConfig:
    """Check settings that came from `origin`.

    Raises:
        ConfigError: as `load_config`.
    """
    try:
        return SurveyConfig.model_validate(settings)
    except ValidationError as error:
        raise ConfigError(f"{origin}: {_one_line(error)}") from None


def changed(config: SurveyConfig, section: str, **values: Any) -> SurveyConfig:
    """A survey with some settings of a section changed; those that are None stay as they are.

    Raises:
        ConfigError: a value is out of range.
    """
    return with_settings(
        config, {f"{section}.{key}": value for key, value in values.items() if value is not None}
    )


def with_settings(
    config: SurveyConfig, values: Mapping[str, Any], origin: str = "command line"
) -> SurveyConfig:
    """A survey with settings changed.

    Args:
        config: of the survey.
        values: by names such as `plan.speed_mps`.
        origin: of the values, in messages.

    Raises:
        ConfigError: a value is out of range.
    """
    if not values:
        return config
    settings = config.model_dump(mode="json", exclude_unset=True)
    for name, value in values.items():
        section, key = name.split(".")
        settings[section] = {**settings.get(section, {}), key: value}
    return parse_config(settings, origin)


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


class Health(NamedTuple):
    """What is left of thrusters."""

    at_start: dict[str, float] | None
    """Shares by name; None of none."""
    later: list[tuple[str, float, float]] | None
    """Name, seconds from the start, share."""
    propellers: list[tuple[str, float, float]] | None
    """The same of those that turn on, without that share of their thrust."""


def parse_health(texts: Sequence[str] | None) -> Health:
    """Thrusters and what is left of them, from `NAME` (nothing), `NAME=SHARE` and `...@SECONDS`.

    `NAME:propeller`, and so on, is of one that turns on with that share of its thrust.

    Raises:
        ConfigError: a share or a time is not a number.
    """
    at_start: dict[str, float] = {}
    later: list[tuple[str, float, float]] = []
    propellers: list[tuple[str, float, float]] = []
    for text in texts or ():
        what, at, seconds = text.partition("@")
        name, _, share = what.partition("=")
        try:
            left = float(share or 0.0)
            if name.endswith(_PROPELLER):
                start_s = float(seconds) if at else 0.0
                propellers.append((name.removesuffix(_PROPELLER), start_s, left))
            elif at:
                later.append((name, float(seconds), left))
            else:
                at_start[name] = left
        except ValueError:
            raise ConfigError(
                f"thruster {text!r}: give NAME, or NAME=SHARE of its thrust that is left, as "
                "stern=0.5, and @SECONDS for a failure on the way, as stern@600; NAME:propeller "
                "turns on without it"
            ) from None
    return Health(at_start or None, later or None, propellers or None)


def _one_line(error: ValidationError) -> str:
    faults = []
    for fault in error.errors()[:_MAX_FAULTS]:
        key = shown(".".join(str(part) for part in fault["loc"])) or "settings"
        if fault["type"] == "extra_forbidden":
            faults.append(f"{key} is not a known setting{_nearest(fault['loc'])}")
        elif fault["type"] == "value_error":
            faults.append(f"{key}: {fault['ctx']['error']}")
        elif fault["loc"] == ("name",) and fault["type"] == "string_pattern_mismatch":
            faults.append(f"name = {_shown(fault['input'])}: use letters, digits, spaces, . _ -")
        else:
            faults.append(f"{key} = {_shown(fault['input'])}: {_requirement(fault)}")
    more = error.error_count() - len(faults)
    return "; ".join(faults) + (f"; and {more} more" if more else "")


def _shown(value: object) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _requirement(fault: Any) -> str:
    message = str(fault["msg"])
    section: type[BaseModel] = SurveyConfig
    for part in fault["loc"]:
        if not (isinstance(part, str) and part in section.model_fields):
            return message
        field = section.model_fields[part]
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            section = field.annotation
            continue
        signs = {"Gt": (">", "gt"), "Ge": (">=", "ge"), "Lt": ("<", "lt"), "Le": ("<=", "le")}
        bounds = [
            f"{signs[type(limit).__name__][0]} {getattr(limit, signs[type(limit).__name__][1])}"
            for limit in field.metadata
            if type(limit).__name__ in signs
        ]
        return f"{message} (allowed: {' and '.join(bounds)})" if bounds else message
    return message


def _nearest(location: tuple[str | int, ...]) -> str:
    import difflib

    section: type[BaseModel] = SurveyConfig
    for part in location[:-1]:
        annotation = section.model_fields[str(part)].annotation
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return ""
        section = annotation
    close = difflib.get_close_matches(str(location[-1]), section.model_fields, n=1)
    return (
        f"; did you mean {close[0]}?" if close else f"; known are {', '.join(section.model_fields)}"
    )
