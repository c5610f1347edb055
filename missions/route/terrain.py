"""How deep the glass goes over a known sea floor: as low as altitude, clearance and slope allow.

At each station the highest floor within reach of the vehicle and of its pictures counts. The glass
is to be the plan's altitude above that, or higher: the deepest profile that is never deeper and
whose slope is never steeper than the vehicle can follow is

    z(s) = min over t of (w(t) + g |s - t|)

with the requested depth w and the slope g: the lower envelope of cones. A pass forward and one back
find it exactly on the samples (P. F. Felzenszwalb and D. P. Huttenlocher, Distance Transforms of
Sampled Functions, Theory of Computing 8, 2012). Where the floor is steeper than the vehicle can
follow, the altitude rises.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.vehicle import Hull
from missions.areas.bathymetry import Bathymetry
from missions.values.legs import Leg
from missions.values.line import Line

_CHUNK = 200_000
_PER_CELL = 2.0
"""Places looked at per cell of the bathymetry, each way."""
_FINEST_M = 0.1
_WAY_M, _TURN_RAD = 0.25, math.radians(10.0)
"""Steps along a way, and of a turn."""


@dataclass(frozen=True, kw_only=True)
class Reach:
    """How far from the glass the sea floor counts: of the hull, or of the pictures if farther."""

    ahead_m: float
    astern_m: float
    aside_m: float


@dataclass(frozen=True, kw_only=True)
class TerrainLimits:
    """What a profile has to keep."""

    altitude_m: float
    """Wanted height of the glass above the highest floor within reach."""
    least_clearance_m: float
    """Lowest altitude allowed."""
    steepest_rad: float
    """Slope that the vehicle follows."""

    def __post_init__(self) -> None:
        if self.altitude_m < self.least_clearance_m:
            raise PlanError(
                f"altitude_m {self.altitude_m:g} is less than least_clearance_m "
                f"{self.least_clearance_m:g}: raise plan.altitude_m or lower plan.least_clearance_m"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthProfile:
    """Depth of the glass along a way."""

    along_m: Array
    """(S,) distance from the start, increasing."""
    depth_m: Array
    """(S,) depth of the glass."""
    highest_floor_m: Array
    """(S,) depth of the highest floor within reach."""
    floor_m: Array
    """(S,) depth of the floor below the glass."""

    @property
    def altitude_m(self) -> Array:
        """(S,) height of the glass above the floor below it."""
        return self.floor_m - self.depth_m

    @property
    def clearance_m(self) -> Array:
        """(S,) height of the glass above the highest floor within reach."""
        return self.highest_floor_m - self.depth_m


def reach_of(
    hull: Hull, glass_body_m: Sequence[float], half_swath_m: float, half_along_m: float
) -> Reach:
    """The reach of a hull and of the pictures.

    Args:
        hull: of the vehicle.
        glass_body_m: place of the glass in the body.
        half_swath_m: what pictures see to the farther side of a line.
        half_along_m: what a picture sees ahead or astern, the farther.
    """
    forward_m, right_m = float(glass_body_m[0]), float(glass_body_m[1])
    return Reach(
        ahead_m=max(hull.nose_m - forward_m, half_along_m),
        astern_m=max(hull.tail_m + forward_m, half_along_m),
        aside_m=max(hull.half_breadth_m + abs(right_m), half_swath_m),
    )


def envelope(along_m: Array, requested_m: Array, slope: float) -> Array:
    """The deepest profile that is never deeper than requested and never steeper than a slope.

    Args:
        along_m: (S,) increasing.
        requested_m: (S,) depths.
        slope: metres down per metre along, positive.

    Returns:
        (S,) depths.
    """
    # A cone from the left, w(t) + g (s - t), is least where w(t) - g t is.
    from_left = np.minimum.accumulate(requested_m - slope * along_m) + slope * along_m
    back = np.minimum.accumulate((requested_m + slope * along_m)[::-1])[::-1]
    profile: Array = np.minimum(from_left, back - slope * along_m)
    return profile


def highest_floor(
    bathymetry: Bathymetry, points_ne: Array, headings_rad: Array, reach: Reach
) -> Array:
    """Depth, (N,), of the highest floor within reach of a vehicle at places and headings.

    Args:
        bathymetry: of the sea floor.
        points_ne: (N, 2) of the glass.
        headings_rad: (N,)
        reach: how far the floor counts.

    Returns:
        NaN where the floor is not known everywhere within reach.
    """
    finest = max(bathymetry.cell_m / _PER_CELL, _FINEST_M)
    ahead = _spread(-reach.astern_m, reach.ahead_m, finest)
    across = _spread(-reach.aside_m, reach.aside_m, finest)
    offsets = np.stack(np.meshgrid(ahead, across, indexing="ij"), axis=-1).reshape(-1, 2)
    highest = np.empty(len(points_ne))
    rows = max(_CHUNK // len(offsets), 1)
    for start in range(0, len(points_ne), rows):
        block = slice(start, start + rows)
        sine, cosine = np.sin(headings_rad[block]), np.cos(headings_rad[block])
        axes = np.array([[cosine, sine], [-sine, cosine]])  # ahead and sideways, north and east
        about = np.einsum("oa,axn->nox", offsets, axes)
        # The least of numbers with a NaN among them is NaN: unknown floor is no floor to fly over.
        highest[block] = bathymetry.depth_about(points_ne[block], about).min(axis=1)
    return highest


def depth_profile(
    bathymetry: Bathymetry,
    along_m: Array,
    points_ne: Array,
    headings_rad: Array,
    reach: Reach,
    limits: TerrainLimits,
    name: str,
) -> DepthProfile:
    """The profile along a way.

    Args:
        bathymetry: of the sea floor.
        along_m: (S,) distances, increasing.
        points_ne: (S, 2) where the way is.
        headings_rad: (S,) of the vehicle.
        reach: how far the floor counts; as far along as the samples are apart at least.
        limits: to keep.
        name: of the way, for errors.

    Raises:
        PlanError: the floor is not known somewhere, or the glass would leave the water.
    """
    gap = float(np.diff(along_m).max(initial=0.0))
    reach = Reach(
        ahead_m=max(reach.ahead_m, gap), astern_m=max(reach.astern_m, gap), aside_m=reach.aside_m
    )
    highest = highest_floor(bathymetry, points_ne, headings_rad, reach)
    unknown = np.flatnonzero(np.isnan(highest))
    if len(unknown):
        north, east = points_ne[unknown[0]]
        raise PlanError(
            f"{bathymetry.name} does not know the sea floor near {name}, "
            f"{along_m[unknown[0]]:.1f} m along ({north:.1f} m north, {east:.1f} m east; "
            f"{len(unknown)} of {len(highest)} places): survey less, or give a bathymetry without "
            "gaps"
        )
    depth = envelope(along_m, highest - limits.altitude_m, math.tan(limits.steepest_rad))
    dry = np.flatnonzero(depth <= 0.0)
    if len(dry):
        at = int(dry[np.argmin(depth[dry])])
        raise PlanError(
            f"{name}, {along_m[at]:.1f} m along: the glass would be {-depth[at]:.2f} m above the "
            f"surface over a sea floor at {highest[at]:.2f} m: lower plan.altitude_m, raise "
            "plan.steepest_deg or leave the place out"
        )
    return DepthProfile(
        along_m=along_m,
        depth_m=depth,
        highest_floor_m=highest,
        floor_m=bathymetry.depth_at(points_ne),
    )


def line_profiles(
    lines: Sequence[Line], bathymetry: Bathymetry, reach: Reach, limits: TerrainLimits
) -> list[DepthProfile]:
    """The profile along each line, at its stations.

    Raises:
        PlanError: as `depth_profile`.
    """
    return [
        depth_profile(
            bathymetry,
            np.linspace(0.0, line.length_m, line.stations),
            line.stations_ne,
            np.full(line.stations, line.heading_rad),
            reach,
            limits,
            f"line {index}",
        )
        for index, line in enumerate(lines)
    ]


def way_depths_m(
    legs: Sequence[Leg], bathymetry: Bathymetry, reach: Reach, altitude_m: float
) -> tuple[float, ...]:
    """Deepest depth of the glass on each leg at an altitude above the highest floor within reach.

    NaN where the floor is not known.
    """
    depths = []
    for leg in legs:
        turned_rad = leg.curvature_per_m * leg.length_m + leg.turn_rad
        count = max(math.ceil(leg.length_m / _WAY_M), math.ceil(abs(turned_rad) / _TURN_RAD))
        share = np.linspace(0.0, 1.0, count + 1)
        headings = leg.heading_rad + leg.side_rad + share * turned_rad
        floor_m = highest_floor(bathymetry, leg.places(share * leg.length_m), headings, reach)
        depths.append(float(floor_m.min()) - altitude_m)
    return tuple(depths)


def with_depths_between(depths_m: Array) -> Array:
    """Depths, (N,), along a way; those that are NaN are the shallower of the nearest known ones."""
    known, place = np.flatnonzero(np.isfinite(depths_m)), np.arange(len(depths_m))
    last = len(known) - 1
    after = depths_m[known[np.clip(np.searchsorted(known, place), 0, last)]]
    before = depths_m[known[np.clip(np.searchsorted(known, place, "right") - 1, 0, last)]]
    levels: Array = np.minimum(before, after)
    return levels


def terrain_figures(
    profiles: Sequence[DepthProfile], limits: TerrainLimits, relief_m: float
) -> dict[str, Any]:
    """The figures of following the terrain, and a warning where pictures suffer.

    Args:
        profiles: of each line.
        limits: that they keep.
        relief_m: what the imaging settings allow for beyond the planned altitude.

    Returns:
        Among others what happens if a vehicle keeps one altitude above the floor below instead:
        `max_difference_m` from the profiles, and `min_clearance_m` above the highest floor within
        reach, negative where the vehicle runs into it.
    """
    line = int(np.argmax([profile.altitude_m.max() for profile in profiles]))
    highest = profiles[line].altitude_m
    at_m, high = float(profiles[line].along_m[highest.argmax()]), float(highest.max())
    if high > limits.altitude_m + relief_m:
        warn(
            f"line {line}, {at_m:.1f} m along: the sea floor falls away faster than "
            f"{math.degrees(limits.steepest_rad):g} deg, so that pictures are taken from "
            f"{high:.2f} m, beyond altitude_m + relief_m = {limits.altitude_m + relief_m:g} m: "
            "raise plan.steepest_deg or plan.relief_m, or turn the lines along the slope"
        )
    altitude = np.concatenate([p.altitude_m for p in profiles])
    below = np.concatenate([p.highest_floor_m - p.floor_m for p in profiles])
    return {
        "altitude_m": [float(altitude.min()), high],
        "least_clearance_m": float(min(p.clearance_m.min() for p in profiles)),
        "at_constant_altitude": {
            "max_difference_m": float(np.abs(altitude - limits.altitude_m).max()),
            "min_clearance_m": float((limits.altitude_m + below).min()),
        },
    }


def _spread(low: float, high: float, finest: float) -> Array:
    """Places from low to high, 0 among them, no farther apart than the finest."""
    below = np.linspace(low, 0.0, max(math.ceil(-low / finest), 1) + 1)
    above = np.linspace(0.0, high, max(math.ceil(high / finest), 1) + 1)
    return np.concatenate([below, above[1:]])
