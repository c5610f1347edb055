"""Focus and aperture for a sea floor that rises and falls, through the water and the port.

The lens is set to the dioptric middle of the apparent distances of the relief's top and bottom, so
that both are equally blurred; the blur circle there falls as 1 / N, and the Airy disc grows as N.
"""

import math
from dataclasses import dataclass

import numpy as np

from alice_survey.core.config import CameraConfig, PlanConfig
from alice_survey.core.errors import PlanError
from camera_calib.camera import Camera
from camera_calib.fov.focus import (
    FocusedLens,
    altitude_of_apparent_m,
    apparent_depths,
    apparent_distance_m,
)
from camera_calib.water import WAVELENGTH_NM
from missions.exposure.conflict import conflict

_GREEN_M = float(WAVELENGTH_NM[1]) * 1e-9
_AIRY = 2.44
"""Diameter of the first dark ring over wavelength and f-number (Born & Wolf, section 8.5.2)."""


@dataclass(frozen=True, kw_only=True)
class Focus:
    """Where to focus, how far it is sharp, and what the aperture costs."""

    focus_air_m: float
    """Distance from the entrance pupil to set in air."""
    focus_altitude_m: float
    """Altitude of the ground that is sharpest."""
    focus_mean_air_m: float
    """The setting for the mean altitude instead, as the paper does."""
    near_altitude_m: float
    """Nearest altitude that is sharp to `sharp_px` at the centre; 0 from the glass on."""
    far_altitude_m: float
    """Farthest; inf to the horizon."""
    blur_px: float
    """Blur circle at the top and at the bottom of the relief, with the f-number as set."""
    f_number_needed: float
    """Smallest f-number that keeps the relief within `sharp_px`."""
    f_number_diffraction: float
    """Largest f-number whose Airy disc is within `sharp_px`."""
    airy_px: float
    """Diameter of the Airy disc with the f-number as set."""

    @property
    def f_number_to_set(self) -> float:
        """The f-number needed, rounded up to a tenth."""
        return math.ceil(10 * self.f_number_needed - 1e-9) / 10


def plan_focus(camera: Camera, limits: CameraConfig, plan: PlanConfig) -> Focus:
    """Focus and aperture over the relief.

    Args:
        camera: the reference camera, in water.
        limits: lens, sensor and f-number.
        plan: altitude, relief and what counts as sharp.

    Raises:
        PlanError: no f-number keeps the relief within `sharp_px`.
    """
    focal_m, pixel_m = limits.focal_mm * 1e-3, limits.pixel_um * 1e-6
    top, mean_m, bottom = (
        apparent_distance_m(camera, plan.altitude_m + sign * plan.relief_m) for sign in (-1, 0, 1)
    )
    focus_m = 2.0 / (1.0 / top + 1.0 / bottom)
    if focus_m <= focal_m:
        raise PlanError(
            f"a lens of {limits.focal_mm:g} mm cannot focus at {focus_m:.3f} m in air: raise "
            "altitude_m or take a shorter lens"
        )
    lens = FocusedLens(focal_m=focal_m, f_number=limits.f_number, pixel_m=pixel_m, focus_m=focus_m)
    blur_px = float(lens.blur_px(top))
    needed = limits.f_number * blur_px / plan.sharp_px
    # The disc at the sensor grows with the image distance: N f' / f.
    image = focus_m / (focus_m - focal_m)
    airy_px = _AIRY * _GREEN_M * limits.f_number * image / pixel_m
    largest = limits.f_number * plan.sharp_px / airy_px
    if needed > largest:
        # The f-number needed falls as 1 / sharp_px, the one that diffraction allows grows with it.
        sharp_px = plan.sharp_px * math.sqrt(needed / largest)
        raise conflict(
            f"the lens of {limits.focal_mm:g} mm cannot keep relief of +-{plan.relief_m:g} m at "
            f"{plan.altitude_m:g} m sharp to {plan.sharp_px:g} px: that needs F/{needed:.3g}, and "
            f"diffraction allows F/{largest:.3g}",
            ("relief_m (depth of field)", "sharp_px (diffraction)"),
            "plan.sharp_px", math.ceil(10 * sharp_px) / 10,
        )  # fmt: skip
    depths = apparent_depths(camera, np.array([[camera.cx_px, camera.cy_px]]))
    near, far = depths.sharp_altitudes_m(lens, plan.sharp_px)
    return Focus(
        focus_air_m=focus_m,
        focus_altitude_m=altitude_of_apparent_m(camera, focus_m),
        focus_mean_air_m=mean_m,
        near_altitude_m=near,
        far_altitude_m=far,
        blur_px=blur_px,
        f_number_needed=needed,
        f_number_diffraction=largest,
        airy_px=airy_px,
    )


def aperture_warning(focus: Focus, limits: CameraConfig, plan: PlanConfig) -> str:
    """What to say where the f-number as set leaves the relief unsharp; empty where it does not."""
    if focus.f_number_needed <= limits.f_number * (1 + 1e-9):
        return ""
    return (
        f"relief of +-{plan.relief_m:g} m at {plan.altitude_m:g} m blurs {focus.blur_px:.1f} px at "
        f"F/{limits.f_number:g}: set camera.f_number to {focus.f_number_to_set:g} for "
        f"sharp_px {plan.sharp_px:g}"
    )
