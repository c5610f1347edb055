"""The paper's table of its two lenses, and its claims on optics that can be computed.

The paper (Gutnik, Avni, Treibitz, Groper 2021) states what its lenses see at 2 m (its table of
section III.B), trusts a flat port up to 70 degrees, and sets focus and aperture in its section
VII.A. It gives neither the index of the water, nor the port, nor a circle of confusion; each check
states its values. Other readings, and where the paper rounds, are in docs/paper-optics.md.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import CameraConfig
from camera_calib.fov.angles import AngleRow, angle_table
from camera_calib.fov.table import MATCH_SIGMA_PX, TRUSTED_FOV_DEG, FovChoices, FovRow, fov_table

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

_ALTITUDE_M = 2.0
_BARE = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)
_N_PAPER = 1.33
_PORT = CameraConfig()
_N_SEA = 1.34
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


@dataclass(frozen=True, kw_only=True)
class PaperClaim:
    """A claim of the paper in words, and the number that decides it."""

    claim: str
    assumption: str
    """Assumption where the paper states nothing."""
    computed: float
    unit: str
    minimum: float = 0.0
    maximum: float

    @property
    def passed(self) -> bool:
        """The number is within its bounds."""
        return self.minimum <= self.computed <= self.maximum


@dataclass(frozen=True, kw_only=True)
class PaperValidation:
    """Everything of the paper's optics that can be checked."""

    table: tuple[PaperCheck, ...]
    claims: tuple[PaperClaim, ...]
    angles: tuple[AngleRow, ...]
    """Errors up to and beyond 70 degrees."""

    @property
    def passed(self) -> bool:
        """Every check and every claim holds."""
        return all(c.passed for c in self.table) and all(c.passed for c in self.claims)

    def to_json(self) -> dict[str, Any]:
        """Everything as JSON values."""
        judged = ("difference", "tolerance", "passed")
        data: dict[str, Any] = json_values(
            {
                "passed": self.passed,
                "rule": PAPER_RULE,
                "table": [
                    asdict(check) | {name: getattr(check, name) for name in judged}
                    for check in self.table
                ],
                "claims": [asdict(claim) | {"passed": claim.passed} for claim in self.claims],
                "angles": self.angles,
            }
        )
        return data


def validate_paper() -> PaperValidation:
    """Check the table, the 70 degrees, the focus and the depth of field."""
    angles = tuple(angle_table(_PORT, _N_SEA, altitude_m=_ALTITUDE_M))
    return PaperValidation(table=_table(), claims=(*_angles(angles), *_focus()), angles=angles)


def paper_settings() -> tuple[CameraConfig, float, float]:
    """Camera, index of the water and altitude that `PAPER_RULE` takes."""
    return _BARE, _N_PAPER, _ALTITUDE_M


def _row(lens_mm: float, *, in_sea: bool = False) -> FovRow:
    """The paper's set-up, or behind a port in the sea; the customary circle of confusion."""
    camera, n_water = (_PORT, _N_SEA) if in_sea else (_BARE, _N_PAPER)
    diagonal_px = math.hypot(camera.width_px, camera.height_px)
    choices = FovChoices(coc_px=diagonal_px / _DIAGONAL_SHARE)
    return fov_table([lens_mm], [_ALTITUDE_M], n_water, camera, choices)[0]


def _table() -> tuple[PaperCheck, ...]:
    rows = {lens_mm: _row(lens_mm) for lens_mm, *_ in PAPER_TABLE}
    fields = {"horizontal": "horizontal_m", "vertical": "vertical_m", "pixel": "pixel_centre_mm"}
    return tuple(
        PaperCheck(
            lens_mm=lens_mm,
            quantity=quantity,
            unit=unit,
            computed=getattr(rows[lens_mm], fields[quantity]),
            paper=printed,
        )
        for lens_mm, quantity, unit, printed in PAPER_TABLE
    )


def _angles(angles: tuple[AngleRow, ...]) -> list[PaperClaim]:
    at_limit = next(row for row in angles if row.fov_air_deg == TRUSTED_FOV_DEG)
    lenses = [
        PaperClaim(
            claim=f"lenses of up to {TRUSTED_FOV_DEG:g} deg: the {lens_mm:g} mm lens",
            assumption="the angle is the diagonal's, in air (its widest)",
            computed=_row(lens_mm).diagonal_air_deg,
            unit="deg",
            maximum=TRUSTED_FOV_DEG,
        )
        for lens_mm in (12.5, 25.0)
    ]
    distortion = PaperClaim(
        claim=f"a flat port up to {TRUSTED_FOV_DEG:g} deg avoids distortion",
        assumption="residual rms of the best virtual pinhole, relief of +/-25 %, against the noise "
        f"of matching; {_IN_SEA}, {_ALTITUDE_M:g} m",
        computed=at_limit.residual_rms_px,
        unit="px",
        maximum=MATCH_SIGMA_PX,
    )
    return [*lenses, distortion]


def _focus() -> list[PaperClaim]:
    readings = ((_row(12.5), _IN_PAPER), (_row(12.5, in_sea=True), _IN_SEA))
    claims = (
        ("focused at 2 m in water, 1.5 m in air",
         "near the axis, distance in air from the entrance pupil; ", "focus_air_m", 1.4, 1.6),
        ("F/4 gives a depth of field of 2 m at 2 m",
         "circle of confusion of the diagonal/1500; 12.5 mm, ", "depth_of_field_m", 1.9, 2.1),
    )  # fmt: skip
    return [
        PaperClaim(
            claim=claim,
            assumption=assumption + setup,
            computed=getattr(row, field),
            unit="m",
            minimum=minimum,
            maximum=maximum,
        )
        for claim, assumption, field, minimum, maximum in claims
        for row, setup in readings
    ]
