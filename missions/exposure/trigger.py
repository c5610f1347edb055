"""How often to take a picture: by the footprint, and by the paper's rule next to it."""

import math
from dataclasses import dataclass

from alice_survey.base.config import CameraConfig, PlanConfig
from alice_survey.base.errors import PlanError
from camera_calib.flat_port import FlatPortCamera
from missions.exposure.settings_table import Setting
from missions.exposure.ways_out import Way, conflict
from missions.values.footprint import footprint_size_m, overlap, step_for_overlap

_INTERVAL_STEP_S = 1e-3
_LEAST_ALTITUDE_M = 0.3
_HIGHEST_M = 10.0
"""Altitudes that `plan.altitude_m` allows."""


@dataclass(frozen=True, kw_only=True)
class PaperRule:
    """What the paper's frame rate r = u / (H (1 - O)) gives (its section VII.A).

    It takes the altitude H for the footprint along the track, which fits no lens of the paper.
    """

    rate_hz: float
    interval_s: float
    wanted_forward_overlap: float
    forward_overlap: float
    """What it really gives with this footprint."""


def interval_for_overlap_s(along_m: float, plan: PlanConfig) -> float:
    """Longest interval between pictures that overlap as requested, in steps of 1 ms."""
    return floor_to(step_for_overlap(along_m, plan.forward_overlap) / plan.speed_mps, 1e-3)


def paper_rule(
    speed_mps: float, altitude_m: float, forward_overlap: float, *, footprint_along_m: float
) -> PaperRule:
    """The paper's frame rate and the overlap that it really gives."""
    rate_hz = speed_mps / (altitude_m * (1.0 - forward_overlap))
    return PaperRule(
        rate_hz=rate_hz,
        interval_s=1.0 / rate_hz,
        wanted_forward_overlap=forward_overlap,
        forward_overlap=overlap(footprint_along_m, speed_mps / rate_hz),
    )


def floor_to(value: float, step: float) -> float:
    """The largest multiple of a step that is not above the value (up to rounding)."""
    return round(math.floor(value / step + 1e-6) * step, 9)


def too_fast(
    camera: FlatPortCamera, limits: CameraConfig, plan: PlanConfig, along_m: float
) -> PlanError:
    """The camera cannot take pictures as fast as overlap, speed and altitude need."""
    shortest_s = limits.shortest_interval_s
    needed_s = step_for_overlap(along_m, plan.forward_overlap) / plan.speed_mps
    speed = floor_to(step_for_overlap(along_m, plan.forward_overlap) / shortest_s, 1e-3)
    reached = floor_to(max(0.0, 1.0 - plan.speed_mps * shortest_s / along_m), 1e-3)
    ways = []
    if speed > 0:
        ways.append(
            Way(
                change=f"speed_mps {speed:g} instead of {plan.speed_mps:g}",
                price=f"lines take {plan.speed_mps / speed:.2f} times as long",
                cost=plan.speed_mps / speed - 1.0,
            )
        )
    if reached > 0:
        ways.append(
            Way(
                change=f"forward_overlap {reached:g} instead of {plan.forward_overlap:g}",
                price=f"a point is seen {1 / (1 - reached):.1f} instead of "
                f"{1 / (1 - plan.forward_overlap):.1f} times on a line",
                cost=1.0 - (1.0 - plan.forward_overlap) / (1.0 - reached),
            )
        )
    altitude_m = _altitude_for_interval_m(camera, plan, shortest_s)
    if altitude_m is not None:
        ways.append(
            Way(
                change=f"altitude_m {altitude_m:g} instead of {plan.altitude_m:g}",
                price=f"a pixel grows {altitude_m / plan.altitude_m:.2f} times and light falls",
                cost=(altitude_m / plan.altitude_m) ** 2 - 1.0,
            )
        )
    return conflict(
        f"{plan.forward_overlap:.0%} forward overlap at {plan.speed_mps:g} m/s and "
        f"{plan.altitude_m:g} m altitude needs {1 / needed_s:.3g} pictures a second (one every "
        f"{needed_s:.3f} s), the camera takes {1 / shortest_s:.3g} (every {shortest_s:g} s)",
        ("forward_overlap x speed_mps / footprint", "camera.shortest_interval_s"),
        ways,
    )


def _altitude_for_interval_m(
    camera: FlatPortCamera, plan: PlanConfig, interval_s: float
) -> float | None:
    """Lowest altitude, to the next cm, whose footprint allows an interval; None beyond reach."""
    along_m = interval_s * plan.speed_mps / (1.0 - plan.forward_overlap)
    low, high = _LEAST_ALTITUDE_M, _HIGHEST_M
    if footprint_size_m(camera, high)[1] < along_m:
        return None
    while high - low > 1e-4:
        middle = (low + high) / 2
        if footprint_size_m(camera, middle)[1] < along_m:
            low = middle
        else:
            high = middle
    return math.ceil(high * 100) / 100


def trigger_rows(
    plan: PlanConfig, limits: CameraConfig, along_m: float, along_top_m: float, interval_s: float
) -> list[Setting]:
    """Frame rate by footprint and by the paper's rule, each with the overlap it gives."""
    rule = paper_rule(
        plan.speed_mps, plan.altitude_m, plan.forward_overlap, footprint_along_m=along_m
    )
    step_m = plan.speed_mps * interval_s
    length = "shorter" if along_m < plan.altitude_m else "longer"
    return [
        Setting(
            group="frame rate",
            name="interval",
            value=interval_s,
            unit="s",
            equation="L (1 - O) / u",
            source="geometry of level footprints",
            bound_by="forward_overlap",
            note=f"{1 / interval_s:.3g} pictures a second, one every {step_m:.3g} m; the trigger "
            f"and the cameras take {1 / limits.shortest_interval_s:.3g} (the paper's 10 fps)",
        ),
        Setting(
            group="frame rate",
            name="forward overlap",
            value=(overlap(along_m, step_m), overlap(along_top_m, step_m)),
            unit="%",
            equation="1 - u T / L",
            source="geometry of level footprints",
            bound_by="interval",
            note="at the mean / over the top of the relief",
        ),
        Setting(
            group="frame rate",
            name="the paper's rule",
            value=rule.rate_hz,
            unit="Hz",
            equation="r = u / (H (1 - O))",
            source="Gutnik et al. 2021, section VII.A",
            bound_by="not used",
            note=f"NOT {rule.wanted_forward_overlap:.0%}: the paper's rule gives "
            f"{rule.forward_overlap:.0%} overlap, with the picture's short side along the track. "
            f"It takes the altitude of {plan.altitude_m:g} m for the footprint, which is "
            f"{along_m:.3f} m ({length}): {rule.wanted_forward_overlap:.0%} needs "
            f"{1 / interval_s:.2f} Hz",
        ),
    ]
