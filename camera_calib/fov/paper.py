"""The paper's table of its two lenses, and its other claims on optics, checked one by one.

The paper (Gutnik, Avni, Treibitz, Groper 2021) states what its lenses see at 2 m (its table of
section III.B), trusts a flat port up to 70 degrees, and sets focus, aperture and exposure in its
section VII.A. It names neither the index of the water, nor the port, nor a circle of confusion;
every check here says which it takes.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

from scipy.optimize import brentq

from alice_survey.base.config import CameraConfig
from camera_calib.fov.angles import AngleRow, angle_of_displacement, angle_table
from camera_calib.fov.table import MATCH_SIGMA_PX, TRUSTED_FOV_DEG, FovChoices, FovRow, fov_table

PAPER_RULE = (
    "n_water = 1.33, altitude 2 m from the entrance pupil, port of zero thickness at zero "
    "distance; a value passes within one unit of its last printed digit"
)

_ALTITUDE_M = 2.0
_N_PAPER = 1.33
_N_SEA = 1.34
_GREEN_UM = 0.53
_DIAGONAL_SHARE = 1500.0
"""Photography's customary circle of confusion: the sensor's diagonal over 1500."""

_DEPTH_OF_FIELD_M = 2.0
_DEPTH_OF_FIELD_RULE_M = 0.1

PAPER_TABLE = (
    (12.5, "horizontal", "m", "1.4"),
    (12.5, "vertical", "m", "1.16"),
    (12.5, "pixel", "mm", "0.45"),
    (25.0, "horizontal", "m", "0.75"),
    (25.0, "vertical", "m", "0.6"),
    (25.0, "pixel", "mm", "0.22"),
)


@dataclass(frozen=True, kw_only=True)
class PaperCheck:
    """One value of the paper's table beside the computed one."""

    lens_mm: float
    quantity: str
    unit: str
    computed: float
    paper: str
    """As printed."""
    difference: float
    """Computed less printed."""
    tolerance: float
    """One unit of the last printed digit."""
    passed: bool
    note: str
    """What the paper rounded, and how."""

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class PaperClaim:
    """One reading of a claim that the paper makes in words."""

    claim: str
    """What the paper says."""
    assumption: str
    """What this line takes where the paper is silent."""
    computed: str
    holds: bool
    """Whether the claim is true under this assumption."""
    rule: str
    """When it counts as true; empty on lines that only tell what follows (never a failure)."""

    @property
    def passed(self) -> bool:
        """False when a line with a rule does not hold."""
        return self.holds or not self.rule

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values, and `passed`."""
        return asdict(self) | {"passed": self.passed}


@dataclass(frozen=True, kw_only=True)
class Validation:
    """Everything the paper says on optics, checked."""

    table: tuple[PaperCheck, ...]
    claims: tuple[PaperClaim, ...]
    angles: tuple[AngleRow, ...]
    """What happens up to and beyond 70 degrees."""

    @property
    def passed(self) -> bool:
        """Every check that has a rule holds."""
        return all(c.passed for c in self.table) and all(c.passed for c in self.claims)

    def to_json(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return {
            "passed": self.passed,
            "rule": PAPER_RULE,
            "table": [check.to_json() for check in self.table],
            "claims": [claim.to_json() for claim in self.claims],
            "angles": [row.to_json() for row in self.angles],
        }


def validate_paper() -> Validation:
    """Check the table, the 70 degrees, the focus, the depth of field and the exposure."""
    angles = angle_table(CameraConfig(), _N_SEA, altitude_m=_ALTITUDE_M)
    return Validation(
        table=tuple(validate_paper_table()),
        claims=(*_angle_claims(angles), *_focus_claims(), *_depth_claims(), *_blur_claims()),
        angles=tuple(angles),
    )


def validate_paper_table() -> list[PaperCheck]:
    """Compare with the paper's table of its two lenses under `PAPER_RULE`."""
    checks = []
    for lens_mm, quantity, unit, printed in PAPER_TABLE:
        row = _paper_row(lens_mm)
        computed = {
            "horizontal": row.horizontal_m,
            "vertical": row.vertical_m,
            "pixel": row.pixel_centre_mm,
        }[quantity]
        tolerance = last_digit(printed)
        difference = computed - float(printed)
        checks.append(
            PaperCheck(
                lens_mm=lens_mm,
                quantity=quantity,
                unit=unit,
                computed=computed,
                paper=printed,
                difference=difference,
                tolerance=tolerance,
                passed=abs(difference) <= tolerance,
                note=_rounding_note(computed, printed, unit),
            )
        )
    return checks


def last_digit(printed: str) -> float:
    """One unit of the last digit of a printed decimal number: 0.01 for `1.16`."""
    return float(10.0 ** -len(printed.partition(".")[2]))


def coc_for_depth_of_field_px(
    depth_m: float, lens_mm: float, n_water: float, config: CameraConfig
) -> float:
    """The circle of confusion for which the depth of field about 2 m is depth_m, px."""

    def excess(coc_px: float) -> float:
        choices = FovChoices(coc_px=coc_px)
        row = fov_table([lens_mm], [_ALTITUDE_M], n_water, config, choices)[0]
        return min(row.depth_of_field_m, 1e6) - depth_m

    return float(brentq(excess, 0.01, 100.0, xtol=1e-9))


def paper_settings() -> tuple[CameraConfig, float, float]:
    """Camera, index of the water and altitude that `PAPER_RULE` takes."""
    return _no_port(), _N_PAPER, _ALTITUDE_M


def _paper_row(lens_mm: float, coc_px: float = 1.0) -> FovRow:
    """The paper's set-up as `PAPER_RULE` takes it."""
    choices = FovChoices(coc_px=coc_px)
    return fov_table([lens_mm], [_ALTITUDE_M], _N_PAPER, _no_port(), choices)[0]


def _sea_row(lens_mm: float, coc_px: float = 1.0) -> FovRow:
    """The paper's set-up behind a port of this project's default, in the sea."""
    choices = FovChoices(coc_px=coc_px)
    return fov_table([lens_mm], [_ALTITUDE_M], _N_SEA, CameraConfig(), choices)[0]


def _no_port() -> CameraConfig:
    return CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)


def _port_words(config: CameraConfig) -> str:
    return (
        f"port {config.port_distance_m * 1e3:g} mm off, glass {config.glass_thickness_m * 1e3:g} mm"
    )


def _angle_claims(angles: list[AngleRow]) -> list[PaperClaim]:
    config = CameraConfig()
    sea = f"n {_N_SEA:g}, {_port_words(config)}, {_ALTITUDE_M:g} m"
    lines = [
        PaperClaim(
            claim=f"lenses of up to {TRUSTED_FOV_DEG:g} deg: the {lens_mm:g} mm lens",
            assumption="the angle is the diagonal's, in air (its widest)",
            computed=f"{_paper_row(lens_mm).diagonal_air_deg:.1f} deg",
            holds=_paper_row(lens_mm).within_trusted_fov,
            rule=f"at most {TRUSTED_FOV_DEG:g} deg",
        )
        for lens_mm in (12.5, 25.0)
    ]
    by_angle = {row.fov_air_deg: row for row in angles}
    at_70 = by_angle[TRUSTED_FOV_DEG]
    growth = by_angle[80.0].residual_rms_px / at_70.residual_rms_px
    before = at_70.residual_rms_px / by_angle[60.0].residual_rms_px
    bare = angle_table(_no_port(), _N_PAPER, angles_deg=[TRUSTED_FOV_DEG])[0]
    reached = angle_of_displacement(_no_port(), _N_PAPER, 10.0)
    claim = f"a flat port up to {TRUSTED_FOV_DEG:g} deg avoids distortion"
    return [
        *lines,
        PaperClaim(
            claim=claim,
            assumption=f"no correction, 1 px is none; n {_N_PAPER:g}, no port",
            computed=(
                f"the corner is displaced by {bare.displacement_px:.0f} px, "
                f"{bare.displacement_percent:.1f} %; 10 % is reached at {reached:.1f} deg"
            ),
            holds=bare.displacement_px <= 1.0,
            rule="",
        ),
        PaperClaim(
            claim=claim,
            assumption=f"warped to the best virtual pinhole, relief of +/-25 %; {sea}",
            computed=(
                f"{at_70.residual_rms_px:.3f} px rms, {at_70.residual_max_px:.2f} px at most, stay "
                f"at 70 deg; {angles[-1].residual_rms_px:.3f} and "
                f"{angles[-1].residual_max_px:.2f} px at {angles[-1].fov_air_deg:g} deg"
            ),
            holds=at_70.residual_rms_px <= MATCH_SIGMA_PX,
            rule=f"rms at 70 deg at most the {MATCH_SIGMA_PX:g} px of matching",
        ),
        PaperClaim(
            claim=f"{TRUSTED_FOV_DEG:g} deg is a limit of the port",
            assumption=f"light fails or what stays at least doubles in the next 10 deg; {sea}",
            computed=(
                f"light comes through and what stays grows {growth:.2f} times from 70 to 80 deg, "
                f"as it did {before:.2f} times from 60 to 70"
            ),
            holds=not growth < 2.0,
            rule="",
        ),
    ]


def _focus_claims() -> list[PaperClaim]:
    claim = "focused at 2 m in water, 1.5 m in air"
    config = CameraConfig()
    readings = (
        (_paper_row(12.5), f"n {_N_PAPER:g}, no port, 2 m from the entrance pupil"),
        (_sea_row(12.5), f"n {_N_SEA:g}, {_port_words(config)}, 2 m from the outer glass"),
    )
    lines = [
        PaperClaim(
            claim=claim,
            assumption=f"near the axis, distance in air from the entrance pupil; {words}",
            computed=f"{row.focus_air_m:.3f} m in air",
            holds=abs(row.focus_air_m - 1.5) <= last_digit("1.5"),
            rule="within one unit of the last printed digit (0.1 m)",
        )
        for row, words in readings
    ]
    row = readings[1][0]
    blur = row.corner_blur_px
    lines.append(
        PaperClaim(
            claim="focused at 2 m: the whole frame is sharp",
            assumption=f"1 px is sharp; flat-field lens of 12.5 mm at F/4; {readings[1][1]}",
            computed=f"a blur circle of {blur:.1f} px in the corners: the port bends the field",
            holds=blur <= 1.0,
            rule="",
        )
    )
    return lines


def _depth_claims() -> list[PaperClaim]:
    config = CameraConfig()
    um = config.pixel_um
    diagonal_px = math.hypot(config.width_px, config.height_px)
    customary_px = diagonal_px / _DIAGONAL_SHARE
    airy_px = 2.44 * _GREEN_UM * config.f_number / um
    bare = f"n {_N_PAPER:g}, no port"
    sea = f"n {_N_SEA:g}, {_port_words(config)}"
    needed_px = coc_for_depth_of_field_px(_DEPTH_OF_FIELD_M, 12.5, _N_PAPER, _no_port())
    needed_sea_px = coc_for_depth_of_field_px(_DEPTH_OF_FIELD_M, 12.5, _N_SEA, config)

    def line(
        near_m: float, far_m: float, coc_px: float, words: str, *, ruled: bool = False
    ) -> PaperClaim:
        off = abs(far_m - near_m - _DEPTH_OF_FIELD_M)
        return PaperClaim(
            claim="F/4 gives a depth of field of 2 m at 2 m",
            assumption=(
                f"circle of confusion {coc_px * um:.1f} um, {coc_px:.2f} px, "
                f"diagonal/{diagonal_px / coc_px:.0f}{words}"
            ),
            computed=f"{far_m - near_m:.2f} m, from {near_m:.2f} to {far_m:.2f} m",
            holds=off <= _DEPTH_OF_FIELD_RULE_M,
            rule=f"within {_DEPTH_OF_FIELD_RULE_M:g} m" if ruled else "",
        )

    def centre(row: FovRow, words: str, *, ruled: bool = False) -> PaperClaim:
        return line(row.near_altitude_m, row.far_altitude_m, row.coc_px, words, ruled=ruled)

    whole = _paper_row(12.5, needed_px)
    return [
        centre(_paper_row(12.5, customary_px), f" (customary); 12.5 mm, {bare}", ruled=True),
        centre(_sea_row(12.5, customary_px), f" (customary); 12.5 mm, {sea}", ruled=True),
        centre(whole, f" (solved for); 12.5 mm, {bare}"),
        centre(_sea_row(12.5, needed_sea_px), f" (solved for); 12.5 mm, {sea}"),
        centre(
            _paper_row(12.5),
            f" (below the Airy disc of {airy_px:.1f} px at F/4); 12.5 mm, {bare}",
        ),
        line(
            whole.frame_near_altitude_m,
            whole.frame_far_altitude_m,
            needed_px,
            f", in the whole frame of a flat-field lens; 12.5 mm, {bare}",
        ),
        centre(_paper_row(25.0, customary_px), f" (customary); 25 mm, {bare}"),
    ]


def _blur_claims() -> list[PaperClaim]:
    row = _paper_row(12.5)
    pixel_m = row.pixel_centre_mm * 1e-3
    at_limit, at_survey = (speed * 3e-3 / pixel_m for speed in (0.5, 0.2))
    return [
        PaperClaim(
            claim="3 ms avoids motion blur up to 0.5 m/s",
            assumption=f"1 px of blur is none; 12.5 mm, n {_N_PAPER:g}, no port, 2 m",
            computed=(
                f"{at_limit:.2f} px; 1 px needs {pixel_m / 0.5 * 1e3:.2f} ms; true only if "
                f"{at_limit:.1f} px count as none"
            ),
            holds=at_limit <= 1.0,
            rule="",
        ),
        PaperClaim(
            claim="3 ms at the survey's 0.2 m/s",
            assumption=f"1 px of blur is none; 12.5 mm, n {_N_PAPER:g}, no port, 2 m",
            computed=f"{at_survey:.2f} px; 1 px needs {pixel_m / 0.2 * 1e3:.2f} ms",
            holds=at_survey <= 1.0,
            rule="",
        ),
    ]


def _rounding_note(computed: float, printed: str, unit: str) -> str:
    decimals = len(printed.partition(".")[2])
    rounded = f"{computed:.{decimals}f}"
    if float(rounded) == float(printed):
        return f"{computed:.4f} rounds to {printed}"
    step = 5 * last_digit(printed)
    if math.isclose(round(computed / step) * step, float(printed), abs_tol=1e-9):
        return (
            f"{computed:.4f} {unit} rounds to {rounded}; the paper prints {printed}, "
            f"the nearest multiple of {step:g}"
        )
    return f"{computed:.4f} {unit} rounds to {rounded}; the paper prints {printed}"
