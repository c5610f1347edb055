"""What parallel lines leave unseen, exactly along them and by thin strips across.

Strips lie between all offsets at which something changes: corners of the area, sides of the lines'
swaths, and where the area's edge crosses an end of what is seen next to a gap. On the middle of
each strip the parts that are seen too few times are found exactly.
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.frames import Array
from missions.lines.rows import stretches, united
from missions.values.pattern import Pattern

U, V, LENGTH, WIDTH, LINES, PICTURES = range(6)
"""Columns of a patch: its middle along and across, its size, and how often it is seen."""
_TINY_M = 1e-9


def unseen(
    survey: Array, pattern: Pattern, offsets: Array, pieces: Array, cuts: Array, finest_m: float
) -> Array:
    """What a pattern sees too few times near the places where it could not be laid.

    Args:
        survey: (E, 4) u, v of the edges of what must be seen.
        pattern: what a line sees, and how often a place must be seen.
        offsets: (R,) ascending, of the rows.
        pieces: (P, 4) row, begin, end, steps; by row and begin.
        cuts: (C, 3) row, begin, end of what could not be flown; by row and begin.
        finest_m: largest patch.

    Returns:
        (N, 6) patches.
    """
    if len(cuts) == 0:
        return np.empty((0, 6))
    firsts = np.searchsorted(pieces[:, 0], np.arange(len(offsets) + 1))
    cut_firsts = np.searchsorted(cuts[:, 0], np.arange(len(offsets) + 1))
    rows = np.unique(cuts[:, 0]).astype(np.intp)
    low, high = offsets[rows] - pattern.half_across_m, offsets[rows] + pattern.half_across_m
    sides = np.concatenate(
        [
            offsets - pattern.half_across_m,
            offsets + pattern.half_across_m,
            survey[:, 1],
            _corners(survey, offsets, cuts, pattern.half_across_m, pattern.half_along_m),
        ]
    )
    # Places between the outer sides of two cut rows' swaths that neither sees have no patches.
    levels, widths = _strips(np.unique(sides), low, high, finest_m)
    patches: Array = _patches(
        survey,
        levels,
        widths,
        offsets,
        firsts,
        pieces,
        cut_firsts,
        cuts,
        pattern.half_across_m,
        pattern.half_along_m,
        pattern.passes,
        pattern.passes * pattern.pictures,
        finest_m,
    )
    return patches


def all_patches(survey: Array, finest_m: float) -> Array:
    """An area as patches that nothing has seen yet; arguments and result as of `unseen`."""
    levels, widths = _strips(
        np.unique(survey[:, 1]),
        survey[:, 1].min(keepdims=True),
        survey[:, 1].max(keepdims=True),
        finest_m,
    )
    patches: Array = _patches(
        survey,
        levels,
        widths,
        np.zeros(1),
        np.zeros(2, np.int64),
        np.empty((0, 4)),
        np.array([0, 1]),
        np.array([[0.0, -np.inf, np.inf]]),
        np.inf,
        0.0,
        1,
        1,
        finest_m,
    )
    return patches


def _strips(sides: Array, low: Array, high: Array, finest_m: float) -> tuple[Array, Array]:
    """Middles and widths of strips between sides, within intervals low to high, (R,) ascending."""
    widths = np.diff(sides)
    middles = sides[:-1] + widths / 2
    row = np.searchsorted(low, middles) - 1
    wanted = (row >= 0) & (middles < high[np.maximum(row, 0)]) & (widths > _TINY_M)
    begins, widths = sides[:-1][wanted], widths[wanted]
    parts = np.ceil(widths / finest_m - _TINY_M).astype(np.intp)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    thin = np.repeat(widths / parts, parts)
    return np.repeat(begins, parts) + (part + 0.5) * thin, thin


@compiled
def _corners(
    survey: Array, offsets: Array, cuts: Array, half_across: float, half_along: float
) -> Array:
    """Offsets, (N,), where the area's edge crosses an end of what is seen next to a cut.

    There what is unseen has a corner: without them the middle of a strip may miss most of it.
    """
    found = np.empty(64)
    used = 0
    for c in range(cuts.shape[0]):
        middle = offsets[int(cuts[c, 0])]
        for u in (cuts[c, 1] + half_along, cuts[c, 2] - half_along):
            for e in range(survey.shape[0]):
                u0, v0, u1, v1 = survey[e]
                if (u0 < u) == (u1 < u):
                    continue
                v = v0 + (u - u0) / (u1 - u0) * (v1 - v0)
                if abs(v - middle) >= half_across:
                    continue
                if used == found.size:
                    found = np.concatenate((found, np.empty_like(found)))
                found[used] = v
                used += 1
    return found[:used].copy()


@compiled
def pictures_of(begin: float, end: float, steps: float, u: float, half_along: float) -> int:
    """How many of the pictures of a piece see a place to its side."""
    step = (end - begin) / max(steps, 1.0)
    if step <= 0.0:
        return int(steps) + 1 if abs(u - begin) <= half_along + _TINY_M else 0
    first = max(0, math.ceil((u - half_along - begin - _TINY_M) / step))
    last = min(int(steps), math.floor((u + half_along - begin + _TINY_M) / step))
    return max(0, last - first + 1)


@compiled
def _patches(
    survey: Array,
    levels: Array,
    widths: Array,
    offsets: Array,
    firsts: NDArray[np.int64],
    pieces: Array,
    cut_firsts: NDArray[np.int64],
    cuts: Array,
    half_across: float,
    half_along: float,
    passes: int,
    pictures: int,
    finest: float,
) -> Array:
    """Patches of `unseen`, level by level; see there."""
    starts, inside = stretches(survey, levels)
    found = np.empty((256, 6))
    used = 0
    marks = np.empty((64, 2))
    for i in range(levels.size):
        v = levels[i]
        if half_across == np.inf:
            row_0, row_1 = 0, offsets.size
        else:
            row_0 = np.searchsorted(offsets, v - half_across)
            row_1 = np.searchsorted(offsets, v + half_across)
        count = cut_firsts[row_1] - cut_firsts[row_0]
        windows = np.empty((count, 2))
        for k in range(count):
            windows[k, 0] = cuts[cut_firsts[row_0] + k, 1] - half_along
            windows[k, 1] = cuts[cut_firsts[row_0] + k, 2] + half_along
        count = united(windows, 0, count)
        k = 0
        for j in range(starts[i], starts[i + 1]):
            while k < count and windows[k, 1] <= inside[j, 0]:
                k += 1
            w = k
            while w < count and windows[w, 0] < inside[j, 1]:
                low = max(windows[w, 0], inside[j, 0])
                high = min(windows[w, 1], inside[j, 1])
                w += 1
                # What is seen changes where a picture begins or ends.
                size = 2
                marks[0, 0], marks[1, 0] = low, high
                for p in range(firsts[row_0], firsts[row_1]):
                    begin, end, steps = pieces[p, 1], pieces[p, 2], pieces[p, 3]
                    if end + half_along < low or begin - half_along > high:
                        continue
                    step = (end - begin) / max(steps, 1.0)
                    first, last = 0, int(steps)
                    if step > 0.0:
                        first = max(first, math.floor((low - half_along - begin) / step))
                        last = min(last, math.ceil((high + half_along - begin) / step))
                    for n in range(first, last + 1):
                        for side in (-1.0, 1.0):
                            mark = begin + n * step + side * half_along
                            if low < mark < high:
                                if size == marks.shape[0]:
                                    marks = np.concatenate((marks, np.empty_like(marks)))
                                marks[size, 0] = mark
                                size += 1
                ordered = np.sort(marks[:size, 0])
                for m in range(size - 1):
                    length = ordered[m + 1] - ordered[m]
                    if length <= _TINY_M:
                        continue
                    u = (ordered[m] + ordered[m + 1]) / 2
                    lines, total = 0, 0
                    for p in range(firsts[row_0], firsts[row_1]):
                        seen = pictures_of(pieces[p, 1], pieces[p, 2], pieces[p, 3], u, half_along)
                        lines += 1 if seen > 0 else 0
                        total += seen
                    if lines >= passes and total >= pictures:
                        continue
                    parts = math.ceil(length / finest - _TINY_M)
                    for part in range(parts):
                        if used == found.shape[0]:
                            found = np.concatenate((found, np.empty_like(found)))
                        found[used, U] = ordered[m] + (part + 0.5) * length / parts
                        found[used, V] = v
                        found[used, LENGTH] = length / parts
                        found[used, WIDTH] = widths[i]
                        found[used, LINES] = lines
                        found[used, PICTURES] = total
                        used += 1
    return found[:used].copy()
