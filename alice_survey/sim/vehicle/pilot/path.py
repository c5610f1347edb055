"""The path a vehicle follows: straights, arcs, turns on the spot and sway steps in a row.

Where a turn on the spot or a sway step begins or ends the vehicle stops, so that the course may
kink there; its heading never does.

Progress along the path is the arc length `along_m` within a leg. It is never searched again: a
tick moves it by one Newton step of the projection (`advance`), so that it passes through every leg
in turn. No acceptance circle ends a leg, hence none skips a line nearby.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array

_GAP_M = 1e-3
_KINK_RAD = 1e-3
MIN_SLANT = 0.3
"""Least 1 - k e of the projection: towards an arc's centre the path's length per vehicle's way
grows without bound."""


class Path(NamedTuple):
    """Legs in the order of flight; each begins where, and heads as, the one before ends.

    Compiled code takes the arrays as they are.
    """

    start_n: Array
    """(L,) metres."""
    start_e: Array
    heading_rad: Array
    """(L,) course at the start of each leg, not wrapped: with `side_rad` it is continuous."""
    length_m: Array
    """(L,) 0 of a turn on the spot."""
    curvature_per_m: Array
    """(L,) positive to starboard."""
    line: Array
    """(L,) index of the survey line, or -1 between lines."""
    begins_m: Array
    """(L,) distance along the path at which each leg begins."""
    turn_rad: Array
    """(L,) angle of a turn on the spot, positive to starboard; 0 of all other legs."""
    side_rad: Array
    """(L,) heading minus course: 0 where the vehicle goes ahead, +-pi/2 in a sway step."""
    stands: Array
    """(L,) 1 of turns on the spot and sway steps, else 0."""
    stop: Array
    """(L,) 1 where the vehicle comes to rest at the leg's end, else 0."""
    altitude_m: float
    """Target altitude of the followed point."""
    speed_mps: float
    """Target speed over ground, along the heading."""
    profile_at_m: Array
    """(K,) distances along the path, ascending, where the deepest depth is given; none: anywhere as
    deep as the altitude has it."""
    profile_m: Array
    """(K,) deepest depth of the origin there."""


def path_from_legs(
    start_ne_m: Sequence[tuple[float, float]] | Array,
    heading_rad: Sequence[float] | Array,
    length_m: Sequence[float] | Array,
    curvature_per_m: Sequence[float] | Array,
    line: Sequence[int] | Array,
    altitude_m: float,
    speed_mps: float,
    turn_rad: Sequence[float] | Array | None = None,
    side_rad: Sequence[float] | Array | None = None,
    profile: tuple[Array, Array] | None = None,
) -> Path:
    """A path through legs.

    Args:
        start_ne_m: (L, 2) north and east of each leg's start.
        heading_rad: (L,) course there.
        length_m: (L,) 0 of turns on the spot.
        curvature_per_m: (L,) positive to starboard.
        line: (L,) index of the survey line, -1 between lines.
        altitude_m: target above the sea floor, of the followed point.
        speed_mps: target over ground.
        turn_rad: (L,) of turns on the spot, else 0; there are none if left out.
        side_rad: (L,) heading minus course, +-pi/2 of sway steps, +-pi astern, else 0; there are
            none if left out.
        profile: as `Path.profile_at_m` and `Path.profile_m`.

    Raises:
        VehicleError: there is no leg, a value is out of range, or two legs do not join.
    """
    start = np.asarray(start_ne_m, np.float64).reshape(-1, 2)
    heading = np.array(heading_rad, np.float64)
    length = np.asarray(length_m, np.float64)
    curvature = np.asarray(curvature_per_m, np.float64)
    lines = np.asarray(line, np.float64)
    turns = np.zeros(len(start)) if turn_rad is None else np.asarray(turn_rad, np.float64)
    side = np.zeros(len(start)) if side_rad is None else np.asarray(side_rad, np.float64)
    if not len(start):
        raise VehicleError("the path has no leg: give at least one")
    columns = (heading, length, curvature, lines, turns, side)
    if any(len(column) != len(start) for column in columns):
        raise VehicleError(f"the columns of the path's {len(start)} legs are not equally long")
    values = np.concatenate([start.ravel(), *columns, [altitude_m, speed_mps]])
    if not np.all(np.isfinite(values)):
        raise VehicleError("the path holds a value that is not a finite number")
    if altitude_m <= 0 or speed_mps <= 0:
        raise VehicleError(
            f"the path's altitude ({altitude_m:g} m) and speed ({speed_mps:g} m/s) must be positive"
        )
    pivots, aside, bent = turns != 0, side != 0, curvature != 0
    square = np.abs(np.abs(np.abs(side) - 0.75 * math.pi) - 0.25 * math.pi) <= _KINK_RAD
    bad = np.where(pivots, (length != 0) | bent | aside, (length <= 0) | (aside & (bent | ~square)))
    for i in np.flatnonzero(bad).tolist():
        raise VehicleError(
            f"leg {i} of the path is {length[i]:g} m long, curvature {curvature[i]:g}, turns "
            f"{math.degrees(turns[i]):.1f} deg on the spot and heads {math.degrees(side[i]):.1f} "
            "deg off its course: it must go ahead, turn without length, or step aside or astern"
        )
    for i in range(1, len(start)):
        before = i - 1
        turned = curvature[before] * length[before]
        chord = length[before] * np.sinc(turned / (2 * math.pi))
        mean = heading[before] + turned / 2
        end = start[before] + chord * np.array([math.cos(mean), math.sin(mean)])
        gap_m = float(np.hypot(*(start[i] - end)))
        turned += turns[before] + side[before] - side[i]
        kink_rad = math.remainder(heading[i] - heading[before] - turned, 2 * math.pi)
        if gap_m > _GAP_M or abs(kink_rad) > _KINK_RAD:
            raise VehicleError(
                f"leg {i} of the path starts {gap_m:.3f} m and {math.degrees(kink_rad):.2f} deg "
                f"off the end of leg {before}: legs must join"
            )
        heading[i] = heading[before] + turned + kink_rad
    standing = pivots | aside
    return Path(
        start_n=np.ascontiguousarray(start[:, 0]),
        start_e=np.ascontiguousarray(start[:, 1]),
        heading_rad=heading,
        length_m=length,
        curvature_per_m=curvature,
        line=lines,
        begins_m=np.concatenate([[0.0], np.cumsum(length)[:-1]]),
        turn_rad=turns,
        side_rad=side,
        stands=standing.astype(np.float64),
        stop=(standing | np.append(standing[1:], False)).astype(np.float64),
        altitude_m=float(altitude_m),
        speed_mps=float(speed_mps),
        profile_at_m=np.zeros(0) if profile is None else profile[0],
        profile_m=np.zeros(0) if profile is None else profile[1],
    )


@kernel
def place_at(path: Path, leg: int, along_m: float) -> tuple[float, float, float, float]:
    """A place on the path.

    Args:
        path: legs.
        leg: index.
        along_m: from its start; beyond its ends the leg goes on straight.

    Returns:
        North and east, m, heading, rad, and curvature, 1/m.
    """
    k, heading = path.curvature_per_m[leg], path.heading_rad[leg]
    on = min(max(along_m, 0.0), path.length_m[leg])
    half = 0.5 * k * on
    # The chord of an arc points along its mean heading.
    chord = on if abs(half) < 1e-9 else on * math.sin(half) / half
    north = path.start_n[leg] + chord * math.cos(heading + half)
    east = path.start_e[leg] + chord * math.sin(heading + half)
    heading += k * on
    beyond = along_m - on
    if beyond != 0.0:
        north += beyond * math.cos(heading)
        east += beyond * math.sin(heading)
        k = 0.0
    return north, east, heading, k


@kernel
def heading_at(path: Path, leg: int, along_m: float) -> tuple[float, float]:
    """Heading, rad, and curvature, 1/m, at a distance from a leg's start, on whichever leg it is.

    Beyond the ends of the path, and beyond a stop, its heading stays.
    """
    last = path.length_m.shape[0] - 1
    while along_m > path.length_m[leg] and leg < last and path.stop[leg] == 0.0:
        along_m -= path.length_m[leg]
        leg += 1
    while along_m < 0.0 and leg > 0 and path.stop[leg - 1] == 0.0:
        leg -= 1
        along_m += path.length_m[leg]
    if along_m < 0.0:
        return path.heading_rad[leg], 0.0
    if along_m > path.length_m[leg]:
        return path.heading_rad[leg] + path.curvature_per_m[leg] * path.length_m[leg], 0.0
    return path.heading_rad[leg] + path.curvature_per_m[leg] * along_m, path.curvature_per_m[leg]


@kernel
def advance(
    path: Path, leg: int, along_m: float, north_m: float, east_m: float, max_m: float
) -> tuple[int, float, bool]:
    """Move the progress towards the projection of a place on the path, by at most `max_m`.

    One Newton step on (p - P(s)) . t(s) = 0, whose slope is -(1 - k e); on a straight it is exact.
    Progress may fall within a leg but not back into the one before, nor does it pass a stop.

    Returns:
        Leg, distance along it, and whether the path's end is reached.
    """
    n, e, heading, k = place_at(path, leg, along_m)
    c, s = math.cos(heading), math.sin(heading)
    ahead = (north_m - n) * c + (east_m - e) * s
    cross = (east_m - e) * c - (north_m - n) * s
    step = ahead / max(1.0 - k * cross, MIN_SLANT)
    moved = along_m + min(max(step, -max_m), max_m)
    # Before a leg's start only where progress already is there: on the way in.
    moved = max(moved, min(along_m, 0.0))
    last = path.length_m.shape[0] - 1
    while moved >= path.length_m[leg]:
        if leg == last:
            return leg, path.length_m[leg], True
        if path.stop[leg] > 0.0:
            return leg, path.length_m[leg], False
        moved -= path.length_m[leg]
        leg += 1
    return leg, moved, False
