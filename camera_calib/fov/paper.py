"""The paper's table of its two lenses, and its claims on optics that can be computed.

The paper (Gutnik, Avni, Treibitz, Groper 2021) states what its lenses see at 2 m (its table of
section III.B), trusts a flat port up to 70 degrees, and sets focus and aperture in its section
VII.A. It gives neither the index of the water, nor the port, nor a circle of confusion; each check
states its values. The errors of a flat port against the field of view show that nothing sudden
happens at 70 degrees. Other readings, and where the paper rounds, are in docs/paper-optics.md.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.seawater import n_water as n_water_of_colour
from camera_calib.approximation.pinhole_warp import best_warp, residual_px
from camera_calib.fov.focus import FocusedLens, apparent_depths, apparent_distance_m, axial_pixel_m
from camera_calib.fov.table import MATCH_SIGMA_PX, TRUSTED_FOV_DEG, FovRow, check_range, fov_table
from camera_calib.rig import design_rig
from camera_calib.water import WAVELENGTH_NM

PAPER_RULE = (
    "n_water = 1.33, altitude 2 m from the entrance pupil, port of zero thickness at zero "
    "distance; a value passes within one unit of its last printed digit"
)
PAPER_TABLE = (
    (12.5, "horizontal", "m", "1.4"),
    (12.5, "vertical", "m", "1.16"),
    (12.5, "pixel", "mm", "0.45"),
    (25.0, "horizontal", "m", "0.75"),
    (25.0, "vertical", "m", "0.6"),
    (25.0, "pixel", "mm", "0.22"),
)
"""Lens (mm), quantity, unit, and the value as printed."""
_FIELDS = {"horizontal": "horizontal_m", "vertical": "vertical_m", "pixel": "pixel_centre_mm"}
_BOUNDS = {"minimum": "least", "maximum": "most"}
"""Names of a claim's bounds in JSON."""
ANGLES_DEG = (40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 110.0)
RELIEF = 0.25
"""Working ranges from (1 - this) to (1 + this) times the altitude: 1.5 to 2.5 m at 2 m."""

_ALTITUDE_M = 2.0
_BARE = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)
_N_PAPER = 1.33
_PORT = CameraConfig()
_N_SEA = 1.34
_TEMPERATURE_C, _SALINITY_PSU = 20.0, 35.0
"""Conditions of the water for its dispersion, which hardly depends on them."""
_DIAGONAL_SHARE = 1500.0
"""Photography's customary circle of confusion: the sensor's diagonal over 1500."""
_IN_PAPER = f"n {_N_PAPER:g}, no port"
_IN_SEA = (
    f"n {_N_SEA:g}, port {_PORT.port_distance_m * 1e3:g} mm off, "
    f"glass {_PORT.glass_thickness_m * 1e3:g} mm"
)


@dataclass(frozen=True, kw_only=True)
class PaperCheck:
    """One value of the paper's table next to the computed one."""

    lens_mm: float
    quantity: str
    unit: str
    computed: float
    paper: str
    """Value as printed."""

    @property
    def difference(self) -> float:
        """Computed minus printed."""
        return self.computed - float(self.paper)

    @property
    def tolerance(self) -> float:
        """One unit of the last printed digit: 0.01 for `1.16`."""
        return float(10.0 ** -len(self.paper.partition(".")[2]))

    @property
    def passed(self) -> bool:
        """The difference is within the tolerance."""
        return abs(self.difference) <= self.tolerance


@dataclass(frozen=True)
class PaperClaim:
    """A claim of the paper in words, and the number that decides it."""

    claim: str
    assumption: str
    """Assumption where the paper states nothing."""
    computed: float
    unit: str
    minimum: float
    maximum: float

    @property
    def passed(self) -> bool:
        """The number is within its bounds."""
        return self.minimum <= self.computed <= self.maximum


@dataclass(frozen=True, kw_only=True)
class AngleRow:
    """A lens that fills the sensor's diagonal with one angle in air, at one altitude."""

    fov_air_deg: float
    """Full angle of the diagonal; half of it is the incidence on the port in the corner."""
    altitude_m: float
    n_water: float
    port: str
    lens_mm: float
    fov_water_deg: float
    """Full angle of the diagonal after the port."""
    displacement_px: float
    """Outward shift of a corner's picture from where the paraxial pinhole would see it."""
    displacement_percent: float
    """The same over the distance of that point from the centre."""
    viewpoint_shift_mm: float
    """Place where a corner's ray in water meets the axis minus that of central rays."""
    residual_rms_px: float
    """Residual of the best virtual pinhole, warped at the working range, over frame and relief."""
    residual_max_px: float
    chromatic_px: float
    """Blue (460 nm) minus red (600 nm) in the corner of a colour camera, without correction."""
    corner_blur_px: float
    """Blur circle in the corner when the centre is sharp: the port bends the field."""


@dataclass(frozen=True, kw_only=True)
class PaperValidation:
    """Everything of the paper's optics that can be checked."""

    table: tuple[PaperCheck, ...]
    claims: tuple[PaperClaim, ...]
    angles: tuple[AngleRow, ...]
    """Errors up to and beyond 70 degrees."""

    @property
    def checks(self) -> tuple[PaperCheck | PaperClaim, ...]:
        """The table's values, then the claims."""
        return *self.table, *self.claims

    @property
    def passed(self) -> bool:
        """Every check and every claim holds."""
        return all(check.passed for check in self.checks)

    def to_json(self) -> dict[str, Any]:
        """Everything as JSON values."""
        computed = ("difference", "tolerance", "passed")
        table = [asdict(c) | {name: getattr(c, name) for name in computed} for c in self.table]
        claims = [
            {_BOUNDS.get(name, name): value for name, value in asdict(claim).items()}
            | {"passed": claim.passed}
            for claim in self.claims
        ]
        start = {"passed": self.passed, "rule": PAPER_RULE}
        data: dict[str, Any] = json_values(
            {**start, "table": table, "claims": claims, "angles": self.angles}
        )
        return data


def validate_paper() -> PaperValidation:
    """Check the table, the 70 degrees, the focus and the depth of field."""
    rows = {lens_mm: _row(lens_mm) for lens_mm, *_ in PAPER_TABLE}
    table = tuple(
        PaperCheck(
            lens_mm=lens_mm,
            quantity=quantity,
            unit=unit,
            computed=getattr(rows[lens_mm], _FIELDS[quantity]),
            paper=printed,
        )
        for lens_mm, quantity, unit, printed in PAPER_TABLE
    )
    angles = tuple(angle_table(_PORT, _N_SEA, altitude_m=_ALTITUDE_M))
    return PaperValidation(table=table, claims=tuple(_claims(rows, angles)), angles=angles)


def _claims(rows: Mapping[float, FovRow], angles: Sequence[AngleRow]) -> Iterator[PaperClaim]:
    limit = TRUSTED_FOV_DEG
    for lens_mm, row in rows.items():
        yield PaperClaim(
            f"lenses of up to {limit:g} deg: the {lens_mm:g} mm lens",
            "the angle is the diagonal's, in air (its widest)",
            row.diagonal_air_deg, "deg", 0.0, limit,
        )  # fmt: skip
    at_limit = next(row for row in angles if row.fov_air_deg == limit)
    yield PaperClaim(
        f"a flat port up to {limit:g} deg avoids distortion",
        "residual rms of the best virtual pinhole, relief of +/-25 %, against the noise of "
        f"matching; {_IN_SEA}, {_ALTITUDE_M:g} m",
        at_limit.residual_rms_px, "px", 0.0, MATCH_SIGMA_PX,
    )  # fmt: skip
    readings = ((rows[12.5], _IN_PAPER), (_row(12.5, in_sea=True), _IN_SEA))
    for row, setup in readings:
        yield PaperClaim(
            "focused at 2 m in water, 1.5 m in air",
            f"near the axis, distance in air from the entrance pupil; {setup}",
            row.focus_air_m, "m", 1.4, 1.6,
        )  # fmt: skip
    for row, setup in readings:
        yield PaperClaim(
            "F/4 gives a depth of field of 2 m at 2 m",
            f"circle of confusion of the diagonal/1500; 12.5 mm, {setup}",
            row.depth_of_field_m, "m", 1.9, 2.1,
        )  # fmt: skip


def paper_settings() -> tuple[CameraConfig, float, float]:
    """Camera, index of the water and altitude that `PAPER_RULE` takes."""
    return _BARE, _N_PAPER, _ALTITUDE_M


def _row(lens_mm: float, *, in_sea: bool = False) -> FovRow:
    """The paper's set-up, or behind a port in the sea; the customary circle of confusion."""
    camera, n_water = (_PORT, _N_SEA) if in_sea else (_BARE, _N_PAPER)
    coc_px = math.hypot(camera.width_px, camera.height_px) / _DIAGONAL_SHARE
    return fov_table([lens_mm], [_ALTITUDE_M], n_water, camera, coc_px)[0]


def angle_table(
    camera_config: CameraConfig,
    n_water: float,
    *,
    altitude_m: float = 2.0,
    angles_deg: Sequence[float] = ANGLES_DEG,
) -> list[AngleRow]:
    """Distortion, loss of the single centre, colour and sharpness in the corner against the angle.

    Args:
        camera_config: sensor, port and f-number; its lens is not used.
        n_water: index of the water in green light; the dispersion is that of sea water.
        altitude_m: altitude of the outer glass.
        angles_deg: full angles of the frame's diagonal in air.

    Raises:
        ConfigError: an angle is out of range.
    """
    check_range("angle", angles_deg, 1.0, 170.0, "deg")
    return [_angle_row(camera_config, n_water, altitude_m, float(angle)) for angle in angles_deg]


def _blue_red(n_green: float) -> tuple[float, float]:
    """Indices in blue and red light of water that has n_green in green; air (1) has no colours."""
    if n_green == 1.0:
        return 1.0, 1.0
    red, green, blue = n_water_of_colour(_TEMPERATURE_C, _SALINITY_PSU, 0.0, WAVELENGTH_NM)
    return float(n_green + blue - green), float(n_green + red - green)


def _angle_row(
    config: CameraConfig, n_water: float, altitude_m: float, angle_deg: float
) -> AngleRow:
    diagonal_mm = math.hypot(config.width_px, config.height_px) * config.pixel_um * 1e-3
    focal_mm = diagonal_mm / 2 / math.tan(math.radians(angle_deg) / 2)
    lens = config.model_copy(update={"focal_mm": focal_mm})
    camera = design_rig(lens, WaterConfig(n_water=n_water)).cameras["left"]
    glass_z = float(camera.front_cam[2])
    corner = np.zeros((1, 2))
    outer, direction = camera.unproject(corner)
    tangent = float(np.linalg.norm(direction[0, :2]) / direction[0, 2])
    meets_axis = glass_z - float(np.linalg.norm(outer[0, :2])) / tangent
    # Near the axis every ray in water comes from where a pixel is of no size.
    at_glass_m, per_m = axial_pixel_m(camera)
    paraxial = glass_z - at_glass_m / per_m

    near, far = glass_z + altitude_m * (1 - RELIEF), glass_z + altitude_m * (1 + RELIEF)
    residual = residual_px(best_warp(camera, near, far), np.linspace(near, far, 11))

    point = camera.at_depth(corner, glass_z + altitude_m)
    radius_px = math.hypot(camera.cx_px, camera.cy_px)
    ideal_px = math.hypot(point[0, 0], point[0, 1]) / (at_glass_m + per_m * altitude_m)
    blue, red = (camera.in_water(n).project(point)[0] for n in _blue_red(n_water))
    outward = -np.array([camera.cx_px, camera.cy_px]) / radius_px

    focused = FocusedLens(
        focal_m=focal_mm * 1e-3,
        f_number=config.f_number,
        pixel_m=config.pixel_um * 1e-6,
        focus_m=apparent_distance_m(camera, altitude_m),
    )
    return AngleRow(
        fov_air_deg=angle_deg,
        altitude_m=altitude_m,
        n_water=n_water,
        port=camera.port.words,
        lens_mm=focal_mm,
        fov_water_deg=2 * math.degrees(math.atan(tangent)),
        displacement_px=radius_px - ideal_px,
        displacement_percent=100.0 * (radius_px / ideal_px - 1.0),
        viewpoint_shift_mm=(meets_axis - paraxial) * 1e3,
        residual_rms_px=float(np.sqrt(np.mean(residual**2))),
        residual_max_px=float(residual.max()),
        chromatic_px=float((blue - red) @ outward),
        corner_blur_px=float(focused.blur_px(apparent_depths(camera, corner).at(altitude_m)).max()),
    )
