"""Errors of a flat port against the field of view: nothing sudden happens at 70 degrees."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.seawater import n_water as n_water_of_colour
from camera_calib.approximation.pinhole_warp import best_warp, residual_px
from camera_calib.camera import Camera
from camera_calib.fov.focus import FocusedLens, apparent_depths, apparent_distance_m, axial_pixel_m
from camera_calib.fov.table import check_range
from camera_calib.rig import design_rig
from camera_calib.water import WAVELENGTH_NM

ANGLES_DEG = (40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 110.0)

RELIEF = 0.25
"""Working ranges from (1 - this) to (1 + this) times the altitude: 1.5 to 2.5 m at 2 m."""

_TEMPERATURE_C, _SALINITY_PSU = 20.0, 35.0
"""Conditions of the water for its dispersion, which hardly depends on them."""


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
    """The same over the distance of that spot from the centre."""
    viewpoint_shift_mm: float
    """Place where a corner's ray in water meets the axis minus that of central rays."""
    residual_rms_px: float
    """Residual of the best virtual pinhole, warped at the working range, over frame and relief."""
    residual_max_px: float
    chromatic_px: float
    """Blue (460 nm) minus red (600 nm) in the corner of a colour camera, without correction."""
    corner_blur_px: float
    """Blur circle in the corner when the centre is sharp: the port bends the field."""


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
        ConfigError: an angle or altitude is out of range.
    """
    check_range("angle", angles_deg, 1.0, 170.0, "deg")
    check_range("altitude", [altitude_m], 0.01, 1000.0, "m")
    check_range("n_water", [n_water], 1.0, 1.4, "")
    return [_angle_row(camera_config, n_water, altitude_m, float(angle)) for angle in angles_deg]


def _blue_red(n_green: float) -> tuple[float, float]:
    """Indices in blue and red light of water that has n_green in green; air (1) has no colours."""
    if n_green == 1.0:
        return 1.0, 1.0
    red, green, blue = n_water_of_colour(_TEMPERATURE_C, _SALINITY_PSU, 0.0, WAVELENGTH_NM)
    return float(n_green + blue - green), float(n_green + red - green)


def _camera(config: CameraConfig, n_water: float, angle_deg: float) -> Camera:
    diagonal_mm = math.hypot(config.width_px, config.height_px) * config.pixel_um * 1e-3
    focal_mm = diagonal_mm / 2 / math.tan(math.radians(angle_deg) / 2)
    lens = config.model_copy(update={"focal_mm": focal_mm})
    return design_rig(lens, WaterConfig(n_water=n_water)).cameras["left"]


def _displacement(camera: Camera, altitude_m: float) -> tuple[float, float]:
    """Distortion of the corner, in px and percent."""
    floor_z = float(camera.front_cam[2]) + altitude_m
    radius_px = math.hypot(camera.cx_px, camera.cy_px)
    spot = camera.at_depth(np.zeros((1, 2)), floor_z)[0]
    at_glass_m, per_m = axial_pixel_m(camera)
    ideal_px = math.hypot(spot[0], spot[1]) / (at_glass_m + per_m * altitude_m)
    return radius_px - ideal_px, 100.0 * (radius_px / ideal_px - 1.0)


def _angle_row(
    config: CameraConfig,
    n_water: float,
    altitude_m: float,
    angle_deg: float,
) -> AngleRow:
    camera = _camera(config, n_water, angle_deg)
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

    spot = camera.at_depth(corner, glass_z + altitude_m)
    colours = [camera.in_water(n).project(spot)[0] for n in _blue_red(n_water)]
    centre_to_corner = corner[0] - np.array([camera.cx_px, camera.cy_px])
    outward = centre_to_corner / np.linalg.norm(centre_to_corner)

    lens = FocusedLens(
        focal_m=camera.fx_px * config.pixel_um * 1e-6,
        f_number=config.f_number,
        pixel_m=config.pixel_um * 1e-6,
        focus_m=apparent_distance_m(camera, altitude_m),
    )
    displacement = _displacement(camera, altitude_m)
    return AngleRow(
        fov_air_deg=angle_deg,
        altitude_m=altitude_m,
        n_water=n_water,
        port=camera.port.words,
        lens_mm=camera.fx_px * config.pixel_um * 1e-3,
        fov_water_deg=2 * math.degrees(math.atan(tangent)),
        displacement_px=displacement[0],
        displacement_percent=displacement[1],
        viewpoint_shift_mm=(meets_axis - paraxial) * 1e3,
        residual_rms_px=float(np.sqrt(np.mean(residual**2))),
        residual_max_px=float(residual.max()),
        chromatic_px=float((colours[0] - colours[1]) @ outward),
        corner_blur_px=float(lens.blur_px(apparent_depths(camera, corner).at(altitude_m)).max()),
    )
