"""The scale of a model from altitudes: what a sonar measures down to the points below a camera."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.robust import MAD_TO_SIGMA

_BEAM = np.tan(np.deg2rad(15.0))
"""Radius of what a sonar's beam covers over the altitude: echo sounders' beams are 30 degrees wide,
and a Doppler log's four, about as far apart, are averaged."""
_SIGMA_M = 0.1
"""Used where navigation states no sigma."""
_MIN_POINTS, _MIN_STATIONS = 5, 3


def scale_by_altitudes(
    records: Sequence[ImageRecord], centres: Array, points: Array
) -> tuple[float, float] | None:
    """Metres in a unit of the model, and their relative sigma.

    The sigma holds what all altitudes have wrong together, as large as stated, the relief within
    the beam, of which a sonar may see the nearest point or the mean, and the scatter.

    Args:
        records: pictures.
        centres: (N, 3) their cameras in the levelled model, third axis down.
        points: (P, 3) points of the levelled model.

    Returns:
        Scale and sigma; None with fewer than three stations that have an altitude and points below.
    """
    tree = KDTree(points[:, :2])
    first = {r.station: i for i, r in reversed(list(enumerate(records))) if r.altitude_m > 0}
    logs, reliefs, sigmas, places = [], [], [], []
    for i in sorted(first.values()):
        near = points[tree.query(centres[i, :2], min(_MIN_POINTS, len(points)))[1]]
        reach = _BEAM * float(np.median(near[:, 2]) - centres[i, 2])
        if not reach > 0:
            continue
        below = points[tree.query_ball_point(centres[i, :2], reach), 2] - centres[i, 2]
        below = below[below > 0]
        if len(below) < _MIN_POINTS:
            continue
        middle = float(np.median(below))
        logs.append(np.log(records[i].altitude_m / middle))
        reliefs.append(MAD_TO_SIGMA * float(np.median(np.abs(below - middle))) / middle)
        stated = records[i].sigma_altitude_m
        sigmas.append((stated if stated > 0 else _SIGMA_M) / records[i].altitude_m)
        places.append(np.append(centres[i, :2], middle))
    if len(logs) < _MIN_STATIONS:
        return None
    way, middles = np.array(places)[:, :2], np.array(places)[:, 2]
    length = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    # Beams that overlap see the same relief: one beam's width of way counts once.
    count = min(len(logs), 1.0 + length / (2.0 * _BEAM * float(np.median(middles))))
    found = float(np.median(logs))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(np.array(logs) - found))) / np.sqrt(count)
    sigma = np.linalg.norm([np.median(sigmas), np.median(reliefs), scatter])
    return float(np.exp(found)), float(sigma)
