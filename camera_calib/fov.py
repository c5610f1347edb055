"""Field of view and resolution of a lens behind the flat port, and the paper's table of them.

Everything follows from the exact flat-port camera. Near the axis a port of distance d and glass g,
seen from the entrance pupil, brings the sea floor at altitude a to the apparent distance
D = d + g / n_glass + a / n_water (paraxial Snell's law), from which the central pixel, the focus
and the depth precision of the pair follow in closed form.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from alice_survey.config import CameraConfig, WaterConfig
from alice_survey.errors import ConfigError
from camera_calib.flat_port import FlatPortCamera
from camera_calib.rig import design_rig

MATCH_SIGMA_PX = 0.3
"""Disparity noise for which the depth precision is stated."""

_TRUSTED_FOV_DEG = 70.0
"""Full angle in air up to which the paper trusts a flat port (its section III.B)."""


@dataclass(frozen=True, kw_only=True)
class FovRow:
    """What one lens sees from one altitude. Altitude is that of the port's outer glass."""

    lens_mm: float
    altitude_m: float
    n_water: float
    port_distance_m: float
    glass_thickness_m: float
    horizontal_m: float
    """Width of the footprint along the middle row."""
    vertical_m: float
    """Height of the footprint along the middle column."""
    pixel_centre_mm: float
    """Size of the central pixel on the sea floor (paraxial)."""
    pixel_mean_mm: float
    """Width of the footprint over the number of columns."""
    pixel_corner_mm: float
    """Root of the area on the sea floor of a corner pixel."""
    diagonal_air_deg: float
    """Full angle of the frame's diagonal in air."""
    diagonal_water_deg: float
    """The same beam after the port."""
    stereo_overlap: float
    """Share of one camera's width that the other sees too."""
    depth_sigma_mm: float
    """Depth precision of the pair at the centre for `MATCH_SIGMA_PX` of disparity noise."""
    focus_air_m: float
    """Distance from the entrance pupil to focus at in air."""
    within_trusted_fov: bool
    """The diagonal is within the 70 degrees for which the paper trusts a flat port."""

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        return asdict(self)


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


PAPER_RULE = (
    "n_water = 1.33, altitude 2 m from the entrance pupil, port of zero thickness at zero "
    "distance; a value passes within one unit of its last printed digit"
)

_PAPER_TABLE = (
    (12.5, "horizontal", "m", "1.4"),
    (12.5, "vertical", "m", "1.16"),
    (12.5, "pixel", "mm", "0.45"),
    (25.0, "horizontal", "m", "0.75"),
    (25.0, "vertical", "m", "0.6"),
    (25.0, "pixel", "mm", "0.22"),
)


def fov_table(
    lenses_mm: Sequence[float],
    altitudes_m: Sequence[float],
    n_water: float,
    camera_config: CameraConfig,
) -> list[FovRow]:
    """Footprint, resolution and stereo of lenses at altitudes, through the configured flat port.

    Args:
        lenses_mm: focal lengths in air.
        altitudes_m: of the left port's outer glass above a level sea floor.
        n_water: index of refraction of the water; 1 is air.
        camera_config: sensor, port and baseline.

    Returns:
        One row per lens and altitude, lenses outside.

    Raises:
        ConfigError: a lens, an altitude or the index is out of range, or a lens is so short that
            light of the frame's edge is totally reflected or never reaches the sea floor.
    """
    _check_range("lens", lenses_mm, 0.5, 500.0, "mm")
    _check_range("altitude", altitudes_m, 0.01, 1000.0, "m")
    _check_range("n_water", [n_water], 1.0, 1.4, "")
    water = WaterConfig(n_water=n_water)
    rows = []
    for lens_mm in lenses_mm:
        config = camera_config.model_copy(update={"focal_mm": float(lens_mm)})
        camera = design_rig(config, water).cameras["left"]
        rows += [_row(camera, config, float(altitude)) for altitude in altitudes_m]
    return rows


def validate_paper_table() -> list[PaperCheck]:
    """Compare with the paper's table of its two lenses under `PAPER_RULE`."""
    config = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)
    checks = []
    for lens_mm, quantity, unit, printed in _PAPER_TABLE:
        row = fov_table([lens_mm], [2.0], 1.33, config)[0]
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


def apparent_distance_m(camera: FlatPortCamera, altitude_m: float) -> float:
    """Where the sea floor seems to be to the entrance pupil, near the axis of the port."""
    air = camera.port_distance_m + camera.glass_thickness_m / camera.n_glass
    return air + altitude_m / camera.n_water


def format_fov(rows: Sequence[FovRow]) -> str:
    """The rows as a plain text table."""
    header = (
        "lens", "altitude", "footprint", "pixel centre/mean/corner", "diagonal air/water",
        "stereo", "depth sigma", "focus in air",
    )  # fmt: skip
    cells = [
        (
            f"{r.lens_mm:g} mm",
            f"{r.altitude_m:g} m",
            f"{r.horizontal_m:.3f} x {r.vertical_m:.3f} m",
            f"{r.pixel_centre_mm:.3f} / {r.pixel_mean_mm:.3f} / {r.pixel_corner_mm:.3f} mm",
            f"{r.diagonal_air_deg:.1f} / {r.diagonal_water_deg:.1f} deg"
            + ("" if r.within_trusted_fov else " (!)"),
            f"{r.stereo_overlap:.1%}",
            f"{r.depth_sigma_mm:.2f} mm",
            f"{r.focus_air_m:.3f} m",
        )
        for r in rows
    ]
    notes = []
    if rows:
        notes.append(
            f"n_water {rows[0].n_water:g}, port {rows[0].port_distance_m * 1e3:g} mm + glass "
            f"{rows[0].glass_thickness_m * 1e3:g} mm; altitude of the port's outer glass; depth "
            f"sigma of the pair for {MATCH_SIGMA_PX:g} px of disparity noise"
        )
    if any(not r.within_trusted_fov for r in rows):
        notes.append(f"(!) wider than {_TRUSTED_FOV_DEG:g} deg: the paper trusts no flat port here")
    return "\n".join([_text_table(header, cells), *notes])


def format_checks(checks: Sequence[PaperCheck]) -> str:
    """The comparison with the paper as a plain text table."""
    header = ("lens", "quantity", "computed", "paper", "difference", "allowed", "", "note")
    cells = [
        (
            f"{c.lens_mm:g} mm",
            c.quantity,
            f"{c.computed:.4f} {c.unit}",
            f"{c.paper} {c.unit}",
            f"{c.difference:+.4f}",
            f"{c.tolerance:g}",
            "pass" if c.passed else "FAIL",
            c.note,
        )
        for c in checks
    ]
    return "\n".join([_text_table(header, cells), f"rule: {PAPER_RULE}"])


def _row(camera: FlatPortCamera, config: CameraConfig, altitude_m: float) -> FovRow:
    floor_z = camera.port_distance_m + camera.glass_thickness_m + altitude_m
    w, h = float(camera.width_px), float(camera.height_px)
    edges = np.array([[0.0, h / 2], [w, h / 2], [w / 2, 0.0], [w / 2, h]])
    hits = camera.at_depth(edges, floor_z)
    horizontal, vertical = hits[1, 0] - hits[0, 0], hits[3, 1] - hits[2, 1]
    corner = camera.at_depth(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), floor_z)
    if not (np.all(np.isfinite(hits)) and np.all(np.isfinite(corner))):
        raise ConfigError(
            f"lens {config.focal_mm:g} mm: light of the frame's edge finds no way out"
        )
    apparent_m = apparent_distance_m(camera, altitude_m)
    half_air = math.atan(math.hypot(w, h) / 2 / camera.fx_px)
    diagonal_air_deg = math.degrees(2 * half_air)
    return FovRow(
        lens_mm=config.focal_mm,
        altitude_m=altitude_m,
        n_water=camera.n_water,
        port_distance_m=camera.port_distance_m,
        glass_thickness_m=camera.glass_thickness_m,
        horizontal_m=float(horizontal),
        vertical_m=float(vertical),
        pixel_centre_mm=apparent_m / camera.fx_px * 1e3,
        pixel_mean_mm=float(horizontal) / w * 1e3,
        pixel_corner_mm=math.sqrt(_quad_area(corner[:, :2])) * 1e3,
        diagonal_air_deg=diagonal_air_deg,
        diagonal_water_deg=math.degrees(2 * math.asin(math.sin(half_air) / camera.n_water)),
        stereo_overlap=max(0.0, 1.0 - config.baseline_m / float(horizontal)),
        depth_sigma_mm=MATCH_SIGMA_PX
        * (apparent_m**2 * camera.n_water / (camera.fx_px * config.baseline_m))
        * 1e3,
        focus_air_m=apparent_m,
        within_trusted_fov=diagonal_air_deg <= _TRUSTED_FOV_DEG,
    )


def _quad_area(corners: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    x, y = corners.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)


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


def _check_range(what: str, values: Sequence[float], least: float, most: float, unit: str) -> None:
    for value in values:
        if not least <= value <= most:
            raise ConfigError(
                f"{what} {value} {unit}".rstrip() + f": allowed {least:g} to {most:g}"
            )


def _text_table(header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[i]) for row in [header, *cells]) for i in range(len(header))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [header, ["-" * width for width in widths], *cells]
    ]
    return "\n".join(lines)
