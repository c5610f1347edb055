"""The overlaps that a flight reached, from the true poses and the true cameras."""

import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from alice_survey.core.manifest import ImageRecord
from alice_survey.core.trajectory import read_columns
from camera_calib.rig import Rig
from missions.values.footprint import footprint_polygon
from missions.values.plan_file import Plan

_PARALLEL = 1e-3
_SPACED = 0.2
"""Lines are neighbours when they are one spacing apart, give or take this share of it."""


def overlaps_reached(
    triggers: Path,
    plan: Plan,
    rig: Rig,
    records: Iterable[ImageRecord],
    poses: Mapping[str, RigidTransform],
) -> dict[str, float]:
    """Shares of a footprint seen again by the next picture and of a swath by the next line.

    Footprints are of the reference camera at its true poses, exactly through the port, on a level
    sea floor of the mean depth. Swaths are compared where both lines take pictures.

    Args:
        triggers: file of the flight's exposures, with station and line.
        plan: that was flown.
        rig: true cameras.
        records: of the pictures.
        poses: true `ned_from_cam` by picture.

    Returns:
        `forward_mean`, `forward_least`, `side_mean`, `side_least`; a key is left out where there
        are no two neighbours to compare.
    """
    camera = rig.cameras[rig.reference]
    image_of = {r.station: r.image for r in records if r.camera == rig.reference}
    lines: dict[int, list[Polygon]] = {}
    columns = read_columns(triggers, ("station", "line")).values()
    for station, line in np.column_stack(list(columns)).astype(int).tolist():
        pose = poses[image_of[station]]
        polygon = footprint_polygon(camera, pose, plan.seafloor_depth_m)
        lines.setdefault(line, []).append(polygon)
    forward = [
        one.intersection(other).area / one.area
        for line in lines.values()
        for one, other in pairwise(line)
    ]
    swaths = {i: unary_union(polygons) for i, polygons in lines.items()}
    side = [
        _shared(swaths[one].intersection(strip), swaths[other].intersection(strip))
        for one, other, strip in neighbours(plan)
        if one in swaths and other in swaths
        # A line that was aborted may have left nothing there.
        if swaths[one].intersects(strip) and swaths[other].intersects(strip)
    ]
    reached: dict[str, float] = {}
    for kind, shares in (("forward", forward), ("side", side)):
        if shares:
            reached |= {f"{kind}_mean": float(np.mean(shares)), f"{kind}_least": min(shares)}
    return reached


def neighbours(plan: Plan) -> Iterator[tuple[int, int, Polygon]]:
    """Pairs of survey lines one spacing apart, and the strip across both where both run.

    The lines of several cells or parts of an area need not be flown one after the other.
    """
    survey = [i for i, line in enumerate(plan.lines) if line.kind == "survey"]
    for i, j in combinations(survey, 2):
        one, other = plan.lines[i], plan.lines[j]
        ahead = np.array([math.cos(one.heading_rad), math.sin(one.heading_rad)])
        starboard = np.array([-ahead[1], ahead[0]])
        if abs(math.sin(one.heading_rad - other.heading_rad)) > _PARALLEL:
            continue
        start = np.array(one.start_ne_m)
        ends = np.array([other.start_ne_m, other.end_ne_m]) - start
        across_m = abs(float((ends @ starboard).mean()))
        if abs(across_m - plan.line_spacing_m) > _SPACED * plan.line_spacing_m:
            continue
        low = max(0.0, float((ends @ ahead).min()))
        high = min(one.length_m, float((ends @ ahead).max()))
        if high - low < plan.station_spacing_m:
            continue
        far = 10 * plan.footprint_m[0] * starboard
        corners = [start + low * ahead, start + high * ahead]
        yield i, j, Polygon([
            corners[0] - far, corners[1] - far, corners[1] + far, corners[0] + far
        ])  # fmt: skip


def _shared(one: BaseGeometry, other: BaseGeometry) -> float:
    """Share of the smaller of two swaths that both see."""
    return float(one.intersection(other).area / min(one.area, other.area))
