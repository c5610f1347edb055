"""The shortest turns of bounded curvature: straights and arcs of one radius.

L. E. Dubins 1957: between two places with headings the shortest such path is one of six kinds;
closed forms after A. M. Shkel and V. Lumelsky 2001. Where water is forbidden, the shortest of the
six that stays out of it is taken.
"""

import math

import numpy as np

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.frames import Array
from missions.route.fence import Fence, arc_inside

_SAME_M = 1e-6
_TINY = 1e-9
_SAME_RAD = 1e-9
_FULL = 2 * math.pi


@compiled_ieee
def moved(
    north: float, east: float, heading: float, curvature: float, length: float
) -> tuple[float, float, float]:
    """Place and heading at the end of a straight or an arc."""
    half = 0.5 * curvature * length
    chord = length if abs(half) < 1e-9 else length * math.sin(half) / half
    return (
        north + chord * math.cos(heading + half),
        east + chord * math.sin(heading + half),
        heading + 2.0 * half,
    )


@compiled_ieee
def min_turn(fence: Fence, start: Array, goal: Array, radius: float) -> Array:
    """The shortest path of the six kinds that stays inside.

    Args:
        fence: of the allowed area.
        start: (3,) north, east, heading.
        goal: (3,) the same way.
        radius: of every arc.

    Returns:
        (3, 2) curvature and length of its pieces; the lengths are inf if no kind stays inside.
    """
    words = _words(start, goal, radius)
    best = np.full((3, 2), np.inf)
    tried = np.zeros(words.shape[0], dtype=np.bool_)
    for _ in range(words.shape[0]):
        minimum, chosen = np.inf, -1
        for i in range(words.shape[0]):
            if not tried[i] and words[i, 6] < minimum - _TINY:
                minimum, chosen = words[i, 6], i
        if chosen < 0:
            break
        tried[chosen] = True
        north, east, heading = start[0], start[1], start[2]
        inside = True
        for k in range(3):
            curvature, length = words[chosen, k] / radius, words[chosen, 3 + k] * radius
            if length > _TINY and not arc_inside(fence, north, east, heading, curvature, length):
                inside = False
                break
            north, east, heading = moved(north, east, heading, curvature, length)
        off = math.hypot(north - goal[0], east - goal[1])
        # A closed form outside of its domain does not arrive.
        if inside and off <= _SAME_M * (1.0 + words[chosen, 6] * radius):
            for k in range(3):
                best[k, 0] = words[chosen, k] / radius
                best[k, 1] = words[chosen, 3 + k] * radius
            break
    return best


@compiled_ieee
def _words(start: Array, goal: Array, radius: float) -> Array:
    """(6, 7) senses (+1 starboard, 0 straight, -1 port), lengths and their sum in radii.

    The sum is inf of kinds that do not exist here.
    """
    words = np.full((6, 7), np.inf)
    north, east = (goal[0] - start[0]) / radius, (goal[1] - start[1]) / radius
    distance, bearing = math.hypot(north, east), math.atan2(east, north)
    row = 0
    for side in (1.0, -1.0):  # port is the mirror image of starboard
        a = side * ((start[2] - bearing) % _FULL)
        b = side * ((goal[2] - bearing) % _FULL)
        sa, ca, sb, cb = math.sin(a), math.cos(a), math.sin(b), math.cos(b)
        cab = math.cos(a - b)
        across = math.atan2(cb - ca, distance + sa - sb)
        square = 2 + distance * distance - 2 * cab + 2 * distance * (sa - sb)
        if square >= -_TINY:
            straight = math.sqrt(max(square, 0.0))
            _put(words, row, side, 0.0, side, _wrap(across - a), straight, _wrap(b - across))
        cosine = (6 - distance * distance + 2 * cab - 2 * distance * (sa - sb)) / 8
        if abs(cosine) <= 1:
            middle = _FULL - math.acos(cosine)
            first = _wrap(across - a + middle / 2)
            last = _wrap(b - a - first + middle)
            _put(words, row + 1, side, -side, side, first, middle, last)
        square = -2 + distance * distance + 2 * cab + 2 * distance * (sa + sb)
        if square >= -_TINY:
            straight = math.sqrt(max(square, 0.0))
            across = math.atan2(-ca - cb, distance + sa + sb) - math.atan2(-2.0, straight)
            _put(words, row + 2, side, 0.0, -side, _wrap(across - a), straight, _wrap(across - b))
        row += 3
    return words


@compiled_ieee
def _put(
    words: Array,
    row: int,
    one: float,
    two: float,
    three: float,
    first: float,
    middle: float,
    last: float,
) -> None:
    words[row, 0], words[row, 1], words[row, 2] = one, two, three
    words[row, 3], words[row, 4], words[row, 5] = first, middle, last
    words[row, 6] = first + middle + last


@compiled_ieee
def _wrap(angle: float) -> float:
    """The angle in [0, 2 pi), with 0 for what is a full turn but for rounding."""
    wrapped = angle % _FULL
    return 0.0 if _FULL - wrapped < _SAME_RAD else wrapped
