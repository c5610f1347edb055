"""What to set on a vehicle so that it flies an exported mission, and what to expect of it."""

import math

from alice_survey.core.errors import warn
from alice_survey.sim.vehicle.pilot.mission import MIN_RADIUS_M, MIN_SPEED_MPS, Cola2Settings
from missions.exports.follower import line_offset_m
from missions.exports.format import Export

COLA2_TOLERANCE_Z_M = 0.3
"""A step down is done this near to its depth; COLA2's own 1 m begins a line a metre too high."""


def cola2_settings(delta_m: float, speed_mps: float) -> Cola2Settings:
    """The pilot's parameters that exported missions count on.

    Speed is the same all along a line: pictures are taken at a constant interval.
    """
    return Cola2Settings(
        delta_m=delta_m,
        tolerance_z_m=COLA2_TOLERANCE_Z_M,
        max_surge_mps=max(Cola2Settings().max_surge_mps, speed_mps),
        min_surge_mps=max(Cola2Settings().min_surge_mps, speed_mps),
    )


def advice(export: Export, formats: list[str], *, chosen: bool) -> list[str]:
    """Lines for people who load missions: parameters to set, and what is to be expected.

    Warns where COLA2 cannot hold the plan's lines in the expected current, if its formats were
    chosen or the vehicle has no sway: others are flown by what holds them better.

    Args:
        export: the plan.
        formats: names of those that are written.
        chosen: whether somebody chose them.
    """
    lines = []
    if "cola2" in formats:
        lines += _cola2(export, chosen=chosen)
    if any(name in ("wpl", "qgc") for name in formats):
        lines += _ardusub(export)
    return lines


def _cola2(export: Export, *, chosen: bool) -> list[str]:
    plan, follower = export.plan, export.options.follower
    if follower is None:
        return []
    if not math.isfinite(follower.delta_m):
        return [f"COLA2: no section/delta keeps {follower.name} from weaving: lower the speed."]
    own, default = cola2_settings(follower.delta_m, plan.speed_mps), Cola2Settings()
    lever_m, allowed_m = export.mount.glass_body_m[0], plan.allowed_offset_m
    offsets = [
        abs(line_offset_m(follower, line.heading_rad, plan.speed_mps, lever_m))
        for line in plan.lines
        if line.kind in ("survey", "fill")
    ]
    offset_m = max(offsets, default=0.0)
    expected = (
        f"in the expected current of {follower.current_mps:g} m/s COLA2 holds {follower.name} up "
        f"to {offset_m:.2f} m off lines {plan.line_spacing_m:.2f} m apart, which allow "
        f"{allowed_m:.2f} m; turns and gusts come on top"
    )
    # Beyond half of its speed turns leave more of the area unseen.
    exceeds = offset_m > allowed_m or follower.current_mps > 0.5 * plan.speed_mps
    if exceeds and (chosen or not follower.sways):
        towards_deg = math.degrees(math.atan2(*follower.current_ne_mps[::-1])) % 180.0
        warn(
            f"{expected}: lay lines along the current (line_heading_deg = {towards_deg:.0f}), wait "
            "for less of it, or fly another autopilot's mission"
        )
    return [
        "COLA2 pilot parameters:",
        f"  section/delta {own.delta_m:.1f} m (default {default.delta_m:g})",
        f"  section/tolerance_z {own.tolerance_z_m:g} m (default {default.tolerance_z_m:g})",
        f"  section/min_surge_velocity {own.min_surge_mps:g} m/s",
        f"  section/max_surge_velocity {own.max_surge_mps:g} m/s",
        f"{expected[0].upper()}{expected[1:]}.",
    ]


def _ardusub(export: Export) -> list[str]:
    plan, follower = export.plan, export.options.follower
    radius_cm = math.ceil(100.0 * max(export.tolerance_m, MIN_RADIUS_M))
    lines = [
        "ArduSub 4.5 parameters:",
        f"  WPNAV_SPEED {100.0 * plan.speed_mps:.0f} cm/s",
        f"  WPNAV_RADIUS {radius_cm} cm (the radii of files are ignored)",
        "  WP_YAW_BEHAVIOR 4 (default) or 1",
        "  WPNAV_RFND_USE 1",
    ]
    if plan.speed_mps < MIN_SPEED_MPS:
        lines.append(f"ArduSub flies {MIN_SPEED_MPS:g} m/s or faster: plan at that speed.")
    if follower is not None and not follower.sways:
        lines.append(f"ArduSub needs thrusters sideways, which {follower.name} does not have.")
    return lines
