"""The side overlap that pictures really have, measured point by point.

Independent of footprints and spacing: points of the sea floor across each picture are projected
into the pictures of the next line through the flat port, and those counted that fall in.
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array, rotation_from_attitude
from camera_calib.rig import Rig
from missions.coverage.stations import Stations

_POINTS = 1001
_PARALLEL = math.cos(math.radians(10.0))
_BESIDE_M = 0.05
"""Pictures less far aside are of the same line flown twice."""


def measured_side_overlap(rig: Rig, stations: Stations) -> tuple[Array, NDArray[np.intp]]:
    """Measure the side overlap of neighbouring lines.

    Of each picture, 1001 points of the sea floor on its middle row, evenly from its left edge to
    its right, are projected into the pictures of the nearest parallel line to starboard; the share
    that is seen there is its overlap. Pictures beyond the ends of that line are left out.

    Args:
        rig: the cameras, in water, of which the first takes the pictures.
        stations: of the pictures, with their lines of two and more.

    Returns:
        (N,) shares of those that have a line to starboard of them, and (N,) which these are.
    """
    ways = {}
    for index in np.unique(stations.line[stations.line >= 0]).tolist():
        places = stations.glass_ne[stations.line == index]
        ways[index] = (places[-1] - places[0]) / np.linalg.norm(places[-1] - places[0])
    shares, measured = [], []
    for s, index in enumerate(stations.line.tolist()):
        neighbour = _neighbour(stations, s, index, ways) if index >= 0 else None
        if neighbour is not None:
            points = _middle_row(rig, stations, s)
            seen = [_sees(rig, stations, n, points) for n in _nearest(stations, s, neighbour)]
            shares.append(float(np.any(seen, axis=0).mean()))
            measured.append(s)
    return np.array(shares), np.array(measured)


def _neighbour(stations: Stations, s: int, line: int, ways: dict[int, Array]) -> int | None:
    """The nearest parallel line to starboard of a picture that it does not lie beyond an end of."""
    ahead = ways[line]
    starboard = np.array([-ahead[1], ahead[0]])
    best, best_m = None, math.inf
    for other, way in ways.items():
        if other == line or abs(float(way @ ahead)) < _PARALLEL:
            continue
        off = stations.glass_ne[stations.line == other] - stations.glass_ne[s]
        along, across = off @ ahead, off @ starboard
        near = int(np.argmin(np.abs(along)))
        if along.min() <= 0.0 <= along.max() and _BESIDE_M < across[near] < best_m:
            best, best_m = other, float(across[near])
    return best


def _nearest(stations: Stations, s: int, line: int) -> list[int]:
    """The pictures of a line that are nearest to another picture: three to either side."""
    rows = np.flatnonzero(stations.line == line)
    away = np.linalg.norm(stations.glass_ne[rows] - stations.glass_ne[s], axis=1)
    return rows[np.argsort(away, kind="stable")[:6]].tolist()


def _pose(rig: Rig, stations: Stations, s: int) -> tuple[Array, Array, float]:
    """Rotation `ned_from_cam` (3, 3), the pupil about the glass (3,), and the altitude."""
    reference = rig.cameras[rig.reference]
    glass_body = rig.body_from_cam(rig.reference).apply(reference.front_cam)
    body_from_cam = rig.body_from_cam(rig.reference)
    ned_from_body = rotation_from_attitude(*stations.attitude_rad[s])
    rotation: Array = (ned_from_body * body_from_cam.rotation).as_matrix()
    pupil: Array = ned_from_body.apply(body_from_cam.translation - glass_body)
    return rotation, pupil, float(stations.altitude_m[s])


def _middle_row(rig: Rig, stations: Stations, s: int) -> Array:
    """Points on the sea floor, (P, 3) about the datum's vertical with the glass at depth 0."""
    camera = rig.cameras[rig.reference]
    rotation, pupil, altitude_m = _pose(rig, stations, s)
    ends = np.array([[0.0, camera.height_px / 2], [camera.width_px, camera.height_px / 2]])
    glass_cam, rays_cam = camera.unproject(ends)
    starts, rays = glass_cam @ rotation.T + pupil, rays_cam @ rotation.T
    hits = starts + ((altitude_m - starts[:, 2]) / rays[:, 2])[:, None] * rays
    share = ((np.arange(_POINTS) + 0.5) / _POINTS)[:, None]
    points = hits[0] * (1 - share) + hits[1] * share
    points[:, :2] += stations.glass_ne[s]
    return points


def _sees(rig: Rig, stations: Stations, s: int, points: Array) -> Array:
    """Which points fall into a picture, (P,); they lie on the sea floor below it."""
    camera = rig.cameras[rig.reference]
    rotation, pupil, altitude_m = _pose(rig, stations, s)
    below = np.column_stack(
        [points[:, :2] - stations.glass_ne[s], np.full(len(points), altitude_m)]
    )
    pixels = camera.project((below - pupil) @ rotation)
    with np.errstate(invalid="ignore"):
        inside: Array = np.all(
            (pixels >= 0) & (pixels <= [camera.width_px, camera.height_px]), axis=1
        )
    return inside
