"""Where pictures were or will be taken: place, height above the sea floor, attitude, line."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array, attitude_from_rotation, interpolate_poses
from camera_calib.rig import Rig
from missions.values.footprint import common_swath
from missions.values.line import Line
from missions.values.pattern import Pattern, pattern
from missions.values.plan_file import Plan

if TYPE_CHECKING:
    from missions.values.flight import Flight

MAX_ALTITUDES = 1.5
"""Pictures from more planned altitudes than this do not count: their pixels on the sea floor are
1.5 times as large, and the light is weaker by more than half (inferred: 1.5^-2 = 0.44, before any
attenuation)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stations:
    """Moments at which every camera takes a picture, in the order of time."""

    glass_ne: Array
    """(S, 2) north and east of the left port's outer glass, metres."""
    altitude_m: Array
    """(S,) height of the left port's outer glass above the sea floor, which is level below it."""
    attitude_rad: Array
    """(S, 3) roll, pitch, heading of the vehicle."""
    line: NDArray[np.intp]
    """(S,) which pass over the area it belongs to: the plan's line, or -1 between lines."""
    time_s: Array | None = None
    """(S,) times, where they are known."""

    def __post_init__(self) -> None:
        count = len(self.glass_ne)
        shapes = {
            "glass_ne": (count, 2), "altitude_m": (count,), "attitude_rad": (count, 3),
            "line": (count,), "time_s": (count,),
        }  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if value.shape != shape:
                raise ValueError(f"stations: {name} has the shape {value.shape}, not {shape}")
            if not np.all(np.isfinite(value)):
                raise ValueError(f"stations: {name} holds a value that is not finite")

    def __len__(self) -> int:
        return len(self.glass_ne)

    def some(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> "Stations":
        """The stations of an index or a mask."""
        return Stations(
            glass_ne=self.glass_ne[chosen],
            altitude_m=self.altitude_m[chosen],
            attitude_rad=self.attitude_rad[chosen],
            line=self.line[chosen],
            time_s=None if self.time_s is None else self.time_s[chosen],
        )


def stations_of_lines(lines: Sequence[Line], altitude_m: Array | float) -> Stations:
    """The stations of lines flown exactly, by a level vehicle.

    Args:
        lines: with their pictures.
        altitude_m: of the left port's glass, of all stations or (S,) of each.
    """
    counts = np.array([line.stations for line in lines], dtype=np.int64)
    headings = np.array([line.heading_rad for line in lines])
    attitude = np.zeros((int(counts.sum()), 3))
    attitude[:, 2] = np.repeat(headings, counts)
    return Stations(
        glass_ne=np.concatenate([np.empty((0, 2)), *(line.stations_ne for line in lines)]),
        altitude_m=np.array(np.broadcast_to(altitude_m, len(attitude)), dtype=np.float64),
        attitude_rad=attitude,
        line=np.repeat(np.arange(len(lines)), counts),
    )


def stations_of_plan(plan: Plan, floor_depth_m: Array | None = None) -> Stations:
    """The stations of a plan flown exactly.

    Args:
        plan: it; the glass keeps the plan's altitude.
        floor_depth_m: (S,) depth of the sea floor below each station, of a plan with depths of its
            own for its lines: then the altitude is what is left below these.
    """
    if floor_depth_m is None or not plan.line_depths_m:
        return stations_of_lines(plan.lines, plan.altitude_m)
    depths = np.concatenate([np.asarray(row, dtype=np.float64) for row in plan.line_depths_m])
    return stations_of_lines(plan.lines, floor_depth_m - depths)


def stations_of_flight(flight: "Flight") -> Stations:
    """Where the pictures of a simulated flight were truly taken."""
    time_s, at_s = flight.truth.time_s, flight.trigger_s
    poses = interpolate_poses(time_s, flight.truth.ned_from_body, at_s)
    glass = [np.interp(at_s, time_s, axis) for axis in flight.glass_ned.T[:2]]
    return Stations(
        glass_ne=np.stack(glass, axis=1),
        altitude_m=np.interp(at_s, time_s, flight.altitude_m),
        attitude_rad=attitude_from_rotation(poses.rotation).reshape(-1, 3),
        line=np.array(flight.trigger_line, dtype=np.intp),
        time_s=at_s,
    )


def at_once(parts: Sequence[Stations]) -> Stations:
    """The stations of several parts of one dive, in their order, without times."""
    return Stations(
        glass_ne=np.concatenate([part.glass_ne for part in parts]),
        altitude_m=np.concatenate([part.altitude_m for part in parts]),
        attitude_rad=np.concatenate([part.attitude_rad for part in parts]),
        line=np.concatenate([part.line for part in parts]),
    )


def join(first: Stations, second: Stations) -> Stations:
    """The stations of two dives, without times; lines of the second count on."""
    after = int(first.line.max(initial=-1)) + 1
    counted_on = np.where(second.line < 0, -1, second.line + after)
    return at_once([first, replace(second, line=counted_on)])


def plan_pattern(plan: Plan, rig: Rig) -> Pattern:
    """The pattern that a plan's lines follow."""
    return sure_pattern(rig, plan.altitude_m, plan.line_spacing_m, plan.station_spacing_m)


def sure_pattern(rig: Rig, altitude_m: float, spacing_m: float, step_m: float) -> Pattern:
    """The pattern of lines and pictures that keeps what it promises at the corners of footprints.

    A footprint bulges: its side reaches less far out at the corners than in the middle. A place
    that `k` pictures of a line are to see must be within reach of the side over `k` steps, so more
    pictures make a narrower swath. Of all that qualify, the one with the most pictures of a place
    is taken, and of equal ones that with the most lines.

    Args:
        rig: the cameras; what every one of them sees counts.
        altitude_m: of the left port's outer glass, the vehicle being level.
        spacing_m: from line to line.
        step_m: from picture to picture.

    Raises:
        PlanError: a picture looks past the sea floor.
    """
    whole = pattern(common_swath(rig, altitude_m, step_m), spacing_m, step_m)
    best = whole
    maximum = 0
    for pictures in range(whole.pictures, 0, -1):
        swath = common_swath(rig, altitude_m, pictures * step_m)
        fewer = whole.half_along_m if pictures == whole.pictures else pictures * step_m / 2
        tried = replace(whole, half_across_m=swath.half_across_m, half_along_m=fewer)
        held = tried.passes * spacing_m <= 2 * swath.half_across_m + 1e-9
        if held and (tried.passes * pictures, tried.passes) > (
            maximum,
            best.passes if maximum else 0,
        ):
            best, maximum = tried, tried.passes * pictures
    return best
