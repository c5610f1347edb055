"""Fill lines: short lines that see what a pattern cannot, or what a dive left out.

What must be seen is cut into small patches. Patches near one another are a cluster. For a cluster
lines are tried along the survey lines, across them, along the edges of the allowed area near by and
along the cluster itself, at many offsets; the line that sees most for its length is flown, until
almost nothing is left (the greedy rule for covering a set; V. Chvatal 1979).

What parallel lines leave unseen is found exactly along them and by thin strips across. Strips lie
between all offsets at which something changes: corners of the area, sides of the lines' swaths, and
where the area's edge crosses an end of what is seen next to a gap. On the middle of each strip the
parts that are seen too few times are found exactly.
"""

import heapq
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from shapely.geometry import MultiPolygon

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from missions.lines.rows import Places, Site, rooms, sort_pairs, to_uv, unite
from missions.route.ways import edges_of
from missions.values.area import Area
from missions.values.line import Line
from missions.values.pattern import Pattern

LEFT_SHARE = 0.0003
"""Share of the area that may be left: the least share that matters where 99.9 % is requested."""
_HOP_STEPS = 10.0
"""A line more costs about as much as this many steps of line more. Chosen: with pictures half a
metre apart, a stop and two turns at 0.2 m/s."""
U, V, LENGTH, WIDTH, LINES, PICTURES = range(6)
"""Columns of a patch: its middle along and across, its size, and how often it is seen."""
_OFFSETS = 16
_EDGES = 4
_TINY_M = 1e-9


def fill_table(
    site: Site, heading_rad: float, pattern: Pattern, pieces: Array, offsets: Array, cuts: Array
) -> Array:
    """Lines that see what the rows of a pattern cannot.

    Args:
        site: the area.
        heading_rad: of the rows.
        pattern: what lines see. A pattern that has gaps by itself is not filled.
        pieces: from `rows.lay_rows`.
        offsets: of the rows.
        cuts: from `rows.lay_rows`.

    Returns:
        (F, 6) north and east of start and end, course, steps.
    """
    if len(cuts) == 0 or _has_gaps(pattern):
        return np.empty((0, 6))
    survey = to_uv(site.survey, heading_rad)
    left_m2 = LEFT_SHARE * site.area_m2
    # No single patch may be worth more than what may be left.
    finest_m = min(_finest_m(pattern), math.sqrt(left_m2))
    patches = unseen(survey, pattern, offsets, pieces, cuts, finest_m)
    return _cover(patches, heading_rad, site.allowed, pattern, left_m2)


def lines_over(pieces: MultiPolygon, area: Area, pattern: Pattern) -> list[Line]:
    """Lay short lines that see given pieces as often as a pattern asks for.

    Args:
        pieces: what must be seen; x = north, y = east, metres.
        area: where lines may be.
        pattern: what lines see, and how often a place must be seen.

    Returns:
        Lines of kind fill, in no special order (`lay.ordered` puts them in one); none over what
        cannot be seen from the allowed area.
    """
    if pieces.is_empty:
        return []
    edges = edges_of(pieces)
    spans = edges[:, 2:] - edges[:, :2]
    longest = spans[int(np.argmax(np.hypot(*spans.T)))]
    heading_rad = math.atan2(longest[1], longest[0])
    patches = all_patches(to_uv(edges, heading_rad), _finest_m(pattern))
    left_m2 = LEFT_SHARE * float(pieces.area)
    table = _cover(patches, heading_rad, edges_of(area.allowed), pattern, left_m2)
    places = (np.round(table[:, :4], 12) + 0.0).tolist()
    return [
        Line(kind="fill", start_ne_m=(p[0], p[1]), end_ne_m=(p[2], p[3]), stations=int(n) + 1)
        for p, n in zip(places, table[:, 5].tolist(), strict=True)
    ]


def _has_gaps(pattern: Pattern) -> bool:
    across = 2 * pattern.half_across_m < pattern.spacing_m * (1 - _TINY_M)
    return across or 2 * pattern.half_along_m < pattern.step_m * (1 - _TINY_M)


def _finest_m(pattern: Pattern) -> float:
    """Size of patches: a few to what a line sees."""
    return min(pattern.half_across_m, pattern.half_along_m) / 4


def _cover(
    patches: Array, heading_rad: float, allowed: Array, pattern: Pattern, left_m2: float
) -> Array:
    """Lines, (F, 6), that see patches, (N, 6) in the frame of lines of a heading."""
    areas = patches[:, LENGTH] * patches[:, WIDTH]
    total = float(areas.sum())
    if total <= left_m2:
        return np.empty((0, 6))
    size_m = 2 * max(pattern.half_across_m, pattern.half_along_m)
    clusters = _clusters(patches[:, [U, V]], size_m)
    queue: list[tuple[float, int, Array]] = []
    courses, turned = [], to_uv(allowed, heading_rad)
    for number, cluster in enumerate(clusters):
        courses.append(heading_rad + _directions(patches[cluster], turned, size_m))
        _offer(queue, number, patches[cluster], heading_rad, courses[-1], allowed, pattern)
    lines = []
    while queue and total > left_m2:
        _, number, line = heapq.heappop(queue)
        chosen = patches[clusters[number]]
        total -= float((chosen[:, LENGTH] * chosen[:, WIDTH]).sum())
        counts = _seen_by(chosen, _line_uv(line, heading_rad), pattern)
        if counts.any():
            lines.append(line)
            patches[clusters[number], LINES] += counts > 0
            patches[clusters[number], PICTURES] += counts
            lacking = patches[clusters[number], LINES] < pattern.passes
            lacking |= patches[clusters[number], PICTURES] < pattern.passes * pattern.pictures
            clusters[number] = clusters[number][lacking]
        left = patches[clusters[number]]
        total += float((left[:, LENGTH] * left[:, WIDTH]).sum())
        if counts.any() and len(left):
            _offer(queue, number, left, heading_rad, courses[number], allowed, pattern)
    return np.array(lines) if lines else np.empty((0, 6))


def _offer(
    queue: list[tuple[float, int, Array]],
    number: int,
    patches: Array,
    heading_rad: float,
    courses: Array,
    allowed: Array,
    pattern: Pattern,
) -> None:
    """Queue the best line for a cluster, if there is any."""
    best_score, best = 0.0, np.empty(0)
    places = _turn(patches[:, [U, V]], -heading_rad)
    for course in courses.tolist():
        local = np.concatenate(
            [_turn(places, course), (patches[:, LENGTH] * patches[:, WIDTH])[:, None]], axis=1
        )
        reach = _patch_reach(patches, heading_rad - course)
        offsets = _try_offsets(local[:, 1], pattern.half_across_m - float(reach[1]))
        score, offset, begin, end, steps = _best_line(
            np.ascontiguousarray(local[np.argsort(local[:, 0])]),
            float(reach[0]),
            float(reach[1]),
            offsets,
            *rooms(to_uv(allowed, course), offsets),
            pattern.half_across_m,
            pattern.half_along_m,
            pattern.overhang_m,
            pattern.step_m,
            pattern.min_steps,
        )
        if score > best_score:
            ends = _turn(np.array([[begin, offset], [end, offset]]), -course).ravel()
            best_score, best = score, np.array([*ends, course, steps])
    if best_score > 0.0:
        heapq.heappush(queue, (-best_score, number, best))


def _try_offsets(v: Array, half_m: float) -> Array:
    """Offsets from which lines may see many patches: sides of their swath at patches, and these."""
    picked = np.linspace(0, len(v) - 1, min(_OFFSETS, len(v))).round().astype(np.intp)
    spread = np.sort(v)[picked]
    half = max(half_m, 0.0) - _TINY_M
    return np.unique(np.concatenate([spread - half, spread, spread + half]))


def _patch_reach(patches: Array, turn_rad: float) -> Array:
    """Half the size of the largest patch along and across lines turned against it, (2,)."""
    c, s = abs(math.cos(turn_rad)), abs(math.sin(turn_rad))
    length, width = patches[:, LENGTH] / 2, patches[:, WIDTH] / 2
    return np.array([float((c * length + s * width).max()), float((s * length + c * width).max())])


def _turn(points: Array, heading_rad: float) -> Array:
    """Points (N, 2) in the frame of lines of a heading."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    result: Array = points @ np.array([[c, -s], [s, c]])
    return result


def _line_uv(line: Array, heading_rad: float) -> Array:
    """Ends of a line, (4,), in the frame of lines of a heading, and its steps, (5,)."""
    return np.append(_turn(line[:4].reshape(2, 2), heading_rad).ravel(), line[5])


def _seen_by(patches: Array, line: Array, pattern: Pattern) -> NDArray[np.int64]:
    """How many pictures of a line see patches, (N,): all of their width, and both their ends."""
    ahead = math.atan2(line[3] - line[1], line[2] - line[0])
    local = _turn(patches[:, [U, V]] - line[:2], ahead)
    length = math.hypot(line[2] - line[0], line[3] - line[1])
    c, s = abs(math.cos(ahead)), abs(math.sin(ahead))
    along = (c * patches[:, LENGTH] + s * patches[:, WIDTH]) / 2
    aside = (s * patches[:, LENGTH] + c * patches[:, WIDTH]) / 2
    near = np.abs(local[:, 1]) + aside <= pattern.half_across_m + 2 * _TINY_M
    counts = np.zeros(len(patches), np.int64)
    for i in np.flatnonzero(near).tolist():
        counts[i] = min(
            pictures_of(0.0, length, line[4], local[i, 0] + side * along[i], pattern.half_along_m)
            for side in (-1, 1)
        )
    return counts


def _clusters(points: Array, size_m: float) -> list[NDArray[np.intp]]:
    """Indices of points that are joined by cells of a grid that touch."""
    cell = np.floor(points / size_m).astype(np.int64)
    cells, owner = np.unique(cell, axis=0, return_inverse=True)
    owner = owner.ravel()
    pairs = cKDTree(cells).query_pairs(1.5, p=np.inf, output_type="ndarray")
    joined = pairs[:, 0], pairs[:, 1]
    graph = csr_array((np.ones(len(pairs)), joined), shape=(len(cells), len(cells)))
    groups, group = connected_components(graph, directed=False)
    order = np.argsort(group[owner], kind="stable")
    return np.split(order, np.searchsorted(group[owner][order], np.arange(1, groups)))


def _directions(patches: Array, allowed: Array, near_m: float) -> Array:
    """Directions, from the frame's, in which lines over patches may be good; radians."""
    low = patches[:, [U, V]].min(axis=0) - near_m
    high = patches[:, [U, V]].max(axis=0) + near_m
    directions = [0.0, math.pi / 2]
    if len(patches) > 1:
        spread = np.cov(patches[:, [U, V]].T, aweights=patches[:, LENGTH] * patches[:, WIDTH])
        directions.append(math.atan2(2 * spread[0, 1], spread[0, 0] - spread[1, 1]) / 2)
    near = (np.minimum(allowed[:, :2], allowed[:, 2:]) < high).all(axis=1)
    near &= (np.maximum(allowed[:, :2], allowed[:, 2:]) > low).all(axis=1)
    spans = np.clip(allowed[near, 2:], low, high) - np.clip(allowed[near, :2], low, high)
    along = np.arctan2(*(allowed[near, 2:] - allowed[near, :2]).T[::-1]) % math.pi
    longest = np.argsort(-np.hypot(*spans.T), kind="stable")[:_EDGES]
    return np.array(_different([*directions, *along[longest].tolist()]))


def _different(directions: Sequence[float]) -> list[float]:
    """Directions of lines that differ by more than a hundredth of a radian."""
    kept: list[float] = []
    for direction in directions:
        apart = [abs((direction - k + math.pi / 2) % math.pi - math.pi / 2) for k in kept]
        if all(a > 0.01 for a in apart):
            kept.append(direction)
    return kept


@compiled
def _best_line(
    points: Array,
    reach_along: float,
    reach_across: float,
    offsets: Array,
    begins: Places,
    counts: Places,
    found: Array,
    half_across: float,
    half_along: float,
    overhang: float,
    step: float,
    min_steps: int,
) -> tuple[float, float, float, float, int]:
    """The line that sees most for its length.

    Args:
        points: (N, 3) u, v and worth of places, by u.
        reach_along: half the size of what a point stands for, along.
        reach_across: the same across.
        offsets: (O,) ascending, to try.
        begins: of the `rooms` of the offsets.
        counts: of the same.
        found: of the same.
        half_across: what a line sees.
        half_along: what a picture sees.
        overhang: of a line over what it must see.
        step: most from picture to picture.
        min_steps: of a line.

    Returns:
        Worth per metre (0: no line sees anything), offset, begin, end, steps.
    """
    hop = _HOP_STEPS * step
    best, best_v, best_begin, best_end, best_steps = 0.0, 0.0, 0.0, 0.0, 0
    for i in range(offsets.size):
        v = offsets[i]
        for r in range(begins[i], begins[i] + counts[i]):
            room_begin, room_end = found[r, 0], found[r, 1]
            if room_end - room_begin < 1e-3:
                continue
            first, last, gain = np.nan, np.nan, 0.0
            for k in range(points.shape[0] + 1):
                ends = k == points.shape[0]
                if not ends:
                    if abs(points[k, 1] - v) > max(half_across - reach_across, 0.0) + _TINY_M:
                        continue
                    u = points[k, 0]
                    reach = half_along - reach_along
                    if u < room_begin - reach or u > room_end + reach:
                        continue
                    if gain == 0.0:
                        first = u
                    elif u - last > hop:
                        ends = True
                if ends and gain > 0.0:
                    begin = max(room_begin, first - reach_along - overhang)
                    end = min(room_end, last + reach_along + overhang)
                    if end < begin:
                        begin = end = min(max((begin + end) / 2, room_begin), room_end)
                    steps = max(min_steps, math.ceil((end - begin) / step - _TINY_M))
                    lack = steps * step - (end - begin)
                    begin = max(room_begin, begin - lack / 2)
                    end = min(room_end, begin + steps * step)
                    begin = max(room_begin, end - steps * step)
                    score = gain / (end - begin + hop)
                    if score > best:
                        best, best_v = score, v
                        best_begin, best_end, best_steps = begin, end, steps
                    first, gain = points[min(k, points.shape[0] - 1), 0], 0.0
                if k < points.shape[0]:
                    last = points[k, 0]
                    gain += points[k, 2]
    return best, best_v, best_begin, best_end, best_steps


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
    strips = _strips(np.unique(sides), low, high, finest_m)
    seen = pattern.half_across_m, pattern.half_along_m
    minimum = pattern.passes, pattern.passes * pattern.pictures
    return _seek(survey, strips, offsets, pieces, cuts, seen, minimum, finest_m)


def all_patches(survey: Array, finest_m: float) -> Array:
    """An area as patches that nothing has seen yet; arguments and result as of `unseen`."""
    v, cuts = np.unique(survey[:, 1]), np.array([[0.0, -np.inf, np.inf]])
    strips, none = _strips(v, v[:1], v[-1:], finest_m), np.empty((0, 4))
    return _seek(survey, strips, np.zeros(1), none, cuts, (np.inf, 0.0), (1, 1), finest_m)


def _seek(
    survey: Array,
    strips: tuple[Array, Array],
    offsets: Array,
    pieces: Array,
    cuts: Array,
    seen: tuple[float, float],
    minimum: tuple[int, int],
    finest_m: float,
) -> Array:
    """Patches of `unseen` in strips; what pictures see across and along; lines and pictures."""
    levels, widths = strips
    near = np.searchsorted(offsets, np.stack([levels - seen[0], levels + seen[0]]))
    rows = np.arange(len(offsets) + 1)
    patches: Array = _patches(
        *rooms(survey, levels, 0.0), levels, widths,
        np.searchsorted(pieces[:, 0], rows)[near], pieces,
        np.searchsorted(cuts[:, 0], rows)[near], cuts, seen[1], *minimum, finest_m,
    )  # fmt: skip
    return patches


def _strips(sides: Array, low: Array, high: Array, finest_m: float) -> tuple[Array, Array]:
    """Middles and widths of strips between sides, within intervals low to high, (R,) ascending."""
    widths = np.diff(sides)
    middles = sides[:-1] + widths / 2
    row = np.searchsorted(low, middles) - 1
    requested = (row >= 0) & (middles < high[np.maximum(row, 0)]) & (widths > _TINY_M)
    begins, widths = sides[:-1][requested], widths[requested]
    parts = np.ceil(widths / finest_m - _TINY_M).astype(np.intp)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    thin = np.repeat(widths / parts, parts)
    return np.repeat(begins, parts) + (part + 0.5) * thin, thin


def _corners(
    survey: Array, offsets: Array, cuts: Array, half_across: float, half_along: float
) -> Array:
    """Offsets, (N,), where the area's edge crosses an end of what is seen next to a cut.

    There what is unseen has a corner: without them the middle of a strip may miss most of it.
    """
    u0, v0, u1, v1 = survey.T
    found = [np.empty(0)]
    for row, begin, end in cuts:
        for u in (begin + half_along, end - half_along):
            at = (u0 < u) != (u1 < u)
            v = v0[at] + (u - u0[at]) / (u1[at] - u0[at]) * (v1[at] - v0[at])
            found.append(v[np.abs(v - offsets[int(row)]) < half_across])
    return np.concatenate(found)


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
    begins: Places,
    counts: Places,
    inside: Array,
    levels: Array,
    widths: Array,
    near: Places,
    pieces: Array,
    near_cuts: Places,
    cuts: Array,
    half_along: float,
    passes: int,
    pictures: int,
    finest: float,
) -> Array:
    """Patches of `unseen`, level by level; see there."""
    found = np.empty((256, 6))
    used = 0
    marks = np.empty((64, 2))
    for i in range(levels.size):
        count = near_cuts[1, i] - near_cuts[0, i]
        windows = np.empty((count, 2))
        for k in range(count):
            windows[k, 0] = cuts[near_cuts[0, i] + k, 1] - half_along
            windows[k, 1] = cuts[near_cuts[0, i] + k, 2] + half_along
        count = unite(windows, np.int64(0), count)
        k = 0
        for j in range(begins[i], begins[i] + counts[i]):
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
                for p in range(near[0, i], near[1, i]):
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
                sort_pairs(marks, np.int64(0), np.int64(size))
                for m in range(size - 1):
                    length = marks[m + 1, 0] - marks[m, 0]
                    if length <= _TINY_M:
                        continue
                    u = (marks[m, 0] + marks[m + 1, 0]) / 2
                    lines, total = 0, 0
                    for p in range(near[0, i], near[1, i]):
                        seen = pictures_of(pieces[p, 1], pieces[p, 2], pieces[p, 3], u, half_along)
                        lines += 1 if seen > 0 else 0
                        total += seen
                    if lines >= passes and total >= pictures:
                        continue
                    parts = math.ceil(length / finest - _TINY_M)
                    for part in range(parts):
                        if used == found.shape[0]:
                            found = np.concatenate((found, np.empty_like(found)))
                        found[used, U] = marks[m, 0] + (part + 0.5) * length / parts
                        found[used, V] = levels[i]
                        found[used, LENGTH] = length / parts
                        found[used, WIDTH] = widths[i]
                        found[used, LINES] = lines
                        found[used, PICTURES] = total
                        used += 1
    return found[:used].copy()
