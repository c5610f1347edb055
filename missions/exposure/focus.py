"""Focus and aperture for a sea floor that rises and falls, through the water and the port.

The lens is set to the dioptric middle of the apparent distances of the relief's top and bottom, so
that both are equally blurred; the blur circle there falls as 1 / N, and the Airy disc grows as N.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

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
from missions.exposure.settings_table import Setting, settings_of
from missions.exposure.ways_out import (
    HIGHEST_ALTITUDE_M,
    MAX_BLUR_PX,
    Way,
    conflict,
    min_that_fits,
)

_GREEN_M = float(WAVELENGTH_NM[1]) * 1e-9
_AIRY = 2.44
"""Diameter of the first dark ring over wavelength and f-number (Born & Wolf, section 8.5.2)."""
_PAPER_DEPTH_M = 2.0
_SOURCE = "thin lens behind the port: camera_calib.fov.focus (Coddington; Born & Wolf 4.6)"
_DIFFRACTION = "Airy disc: Born & Wolf, section 8.5.2, at 530 nm"


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
    papers_depth_px: float
    """Circle of confusion for which the depth of field is 2 m, as the paper states it."""


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
    top, focus_m = _top_and_focus_m(camera, plan)
    mean_m = apparent_distance_m(camera, plan.altitude_m)
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
        raise _cannot_focus(camera, limits, plan, needed, largest)
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
        papers_depth_px=_coc_for_depth_px(
            replace(lens, focus_m=mean_m), _PAPER_DEPTH_M / camera.n_water
        ),
    )


def too_open(focus: Focus, limits: CameraConfig, plan: PlanConfig) -> str:
    """What to say where the f-number as set leaves the relief unsharp; empty where it does not."""
    if focus.f_number_needed <= limits.f_number * (1 + 1e-9):
        return ""
    return (
        f"relief of +-{plan.relief_m:g} m at {plan.altitude_m:g} m blurs {focus.blur_px:.1f} px at "
        f"F/{limits.f_number:g}: set camera.f_number to {_up(focus.f_number_needed):g} for "
        f"sharp_px {plan.sharp_px:g}"
    )


def needed_f_number(camera: Camera, limits: CameraConfig, plan: PlanConfig) -> float:
    """Smallest f-number that keeps the relief within `sharp_px`; inf where the lens cannot focus.

    The relief must lie below the glass.
    """
    (top, focus_m), focal_m = _top_and_focus_m(camera, plan), limits.focal_mm * 1e-3
    if focus_m <= focal_m:
        return math.inf
    lens = FocusedLens(
        focal_m=focal_m, f_number=1.0, pixel_m=limits.pixel_um * 1e-6, focus_m=focus_m
    )
    return float(lens.blur_px(top)) / plan.sharp_px


def largest_f_number(limits: CameraConfig, sharp_px: float) -> float:
    """Largest f-number whose Airy disc, of a far object, is within a circle of confusion."""
    return sharp_px * limits.pixel_um * 1e-6 / (_AIRY * _GREEN_M)


def _top_and_focus_m(camera: Camera, plan: PlanConfig) -> tuple[float, float]:
    """Apparent distance of the relief's top, and the dioptric middle of top and bottom."""
    top, bottom = (
        apparent_distance_m(camera, plan.altitude_m + sign * plan.relief_m) for sign in (-1, 1)
    )
    return top, 2.0 / (1.0 / top + 1.0 / bottom)


def _coc_for_depth_px(lens: FocusedLens, span_m: float) -> float:
    """Circle of confusion for which apparent distances that differ by a span are sharp.

    Apparent distances 1 / (1/s -+ k) differ by 2 k / (1/s^2 - k^2), of which the positive root in k
    counts.
    """
    return lens.defocus_px * (math.sqrt(1.0 + (span_m / lens.focus_m) ** 2) - 1.0) / span_m


def _up(f_number: float) -> float:
    return math.ceil(10 * f_number - 1e-9) / 10


def _cannot_focus(
    camera: Camera, limits: CameraConfig, plan: PlanConfig, needed: float, largest: float
) -> PlanError:
    """The depth of field cannot hold the relief at any aperture."""

    def fits(setting: str, value: float) -> bool:
        changed = plan.model_copy(update={setting: value})
        best = largest_f_number(limits, changed.sharp_px)
        return needed_f_number(camera, limits, changed) <= 0.99 * best

    def ways() -> Iterator[Way]:
        altitude_m = min_that_fits(partial(fits, "altitude_m"), plan.altitude_m, HIGHEST_ALTITUDE_M)
        if altitude_m is not None:
            shown = math.ceil(100 * altitude_m) / 100
            yield Way(
                change=f"altitude_m {shown:g} instead of {plan.altitude_m:g}",
                price=f"a pixel grows {shown / plan.altitude_m:.2f} times",
                cost=shown / plan.altitude_m - 1.0,
                settings={"plan.altitude_m": shown},
            )
        sharp_px = min_that_fits(partial(fits, "sharp_px"), plan.sharp_px, MAX_BLUR_PX)
        if sharp_px is not None:
            shown = math.ceil(10 * sharp_px) / 10
            changed = plan.model_copy(update={"sharp_px": shown})
            f_number = _up(needed_f_number(camera, limits, changed))
            yield Way(
                change=f"sharp_px {shown:g} instead of {plan.sharp_px:g}, with f_number "
                f"{f_number:g}",
                price=f"detail under {shown:g} px is lost at the top and bottom of the relief",
                cost=shown / plan.sharp_px - 1.0,
                settings={"plan.sharp_px": shown, "camera.f_number": f_number},
            )
        lower_m = min_that_fits(
            lambda lower_m: fits("relief_m", plan.relief_m - lower_m), 0.0, plan.relief_m
        )
        if lower_m is not None:
            shown = math.floor(100 * (plan.relief_m - lower_m)) / 100
            yield Way(
                change=f"relief_m {shown:g} instead of {plan.relief_m:g}",
                price="ground that is higher or lower is not sharp",
                cost=1.0 - shown / plan.relief_m,
                settings={"plan.relief_m": shown},
            )

    return conflict(
        f"the lens of {limits.focal_mm:g} mm cannot keep relief of +-{plan.relief_m:g} m at "
        f"{plan.altitude_m:g} m sharp to {plan.sharp_px:g} px: that needs F/{needed:.3g}, and "
        f"diffraction allows F/{largest:.3g}",
        ("relief_m (depth of field)", "sharp_px (diffraction)"),
        ways(),
    )


def focus_rows(
    focus: Focus, camera: Camera, limits: CameraConfig, plan: PlanConfig
) -> list[Setting]:
    """Focus, depth of field, aperture and diffraction."""
    n = camera.n_water
    enough = focus.f_number_needed <= limits.f_number
    depth_m = focus.far_altitude_m - focus.near_altitude_m
    depth = f"{depth_m:.2f} m deep" if math.isfinite(depth_m) else "at all greater distances too"
    return settings_of("focus and aperture", [
        ("focus, set in air", focus.focus_air_m, "m", "2 / (1/D_top + 1/D_bottom)", _SOURCE,
         "relief_m",
         f"equal blur at the top and the bottom of the relief; sharpest "
         f"{focus.focus_altitude_m:.2f} m below the glass. For the mean altitude alone it is "
         f"{focus.focus_mean_air_m:.2f} m from the pupil (the paper: {plan.altitude_m:g} m / "
         f"{n:.3g} = {plan.altitude_m / n:.2f} m; it sets 1.5 m for 2 m)"),
        ("sharp from, to", (focus.near_altitude_m, focus.far_altitude_m), "m",
         "1 / (1/s +- c N / (f f'))", _SOURCE, "sharp_px",
         f"altitudes in focus to {plan.sharp_px:g} px at F/{limits.f_number:g}, "
         f"{depth}; the relief takes "
         f"{plan.altitude_m - plan.relief_m:.3g} to {plan.altitude_m + plan.relief_m:.3g} m. "
         f"The paper's depth of field of 2 m at F/{limits.f_number:g} takes a circle of "
         f"{focus.papers_depth_px:.1f} px"),
        ("blur at relief's ends", focus.blur_px, "px", "f f' / (N p) |1/D - 1/s|", _SOURCE,
         "sharp_px" if not enough else "f_number", ""),
        ("f-number needed", focus.f_number_needed, "", "N blur / sharp_px", _SOURCE, "relief_m",
         f"F/{limits.f_number:g} is set"
         + (": deeper than the relief needs" if enough else ", which is too open")),
        ("diffraction", focus.airy_px, "px", "2.44 lambda N (f'/f) / p", _DIFFRACTION, "f_number",
         f"closing the aperture is not free: beyond F/{focus.f_number_diffraction:.3g} the "
         f"Airy disc alone exceeds {plan.sharp_px:g} px"),
    ])  # fmt: skip
