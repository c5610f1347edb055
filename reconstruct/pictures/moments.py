"""Which pictures of several cameras were taken at one moment, by their times."""

from collections.abc import Mapping, Sequence

import numpy as np

from alice_survey.core.errors import ImageError, warn
from alice_survey.core.frames import Array

_WITHIN_SHARE = 0.25
"""Pictures this share of the shortest usual interval apart are of one moment: a dropped picture
leaves a gap of a whole interval, and no trigger jitters by so much."""
_WORST_SHARE = 0.1
"""Pairs that are further apart than this share of the interval are worth a warning."""


def moments_of(times_s: Mapping[str, Array]) -> list[dict[str, int]]:
    """Group pictures by their times.

    The earliest picture that is left opens a moment; of every other camera its next picture joins
    it if it is within a quarter of the shortest of the cameras' median intervals.

    Args:
        times_s: by camera (N,) increasing times on one clock.

    Returns:
        For each moment, in order, the index of the picture of each camera that has one.

    Raises:
        ImageError: times do not increase, or no moment has two cameras.
    """
    for camera, times in times_s.items():
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise ImageError(f"times of the pictures of {camera} do not increase")
    intervals = [float(np.median(np.diff(t))) for t in times_s.values() if len(t) > 1]
    within_s = _WITHIN_SHARE * min(intervals, default=0.0)
    found = _groups(list(times_s), [np.asarray(t) for t in times_s.values()], within_s)
    if len(times_s) < 2:
        return found
    shared = [moment for moment in found if len(moment) > 1]
    if not shared:
        raise ImageError(
            f"no pictures of {' and '.join(times_s)} are within {1e3 * within_s:.3g} ms of each "
            "other: are their times of one clock?"
        )
    _say(times_s, found, shared, min(intervals, default=np.inf))
    return found


def _groups(names: Sequence[str], times: Sequence[Array], within_s: float) -> list[dict[str, int]]:
    at = [0] * len(names)
    found = []
    while any(i < len(t) for i, t in zip(at, times, strict=True)):
        first = min(float(t[i]) for i, t in zip(at, times, strict=True) if i < len(t))
        moment = {}
        for k, (name, own) in enumerate(zip(names, times, strict=True)):
            if at[k] < len(own) and own[at[k]] - first <= within_s:
                moment[name] = at[k]
                at[k] += 1
        found.append(moment)
    return found


def _say(
    times_s: Mapping[str, Array],
    found: Sequence[Mapping[str, int]],
    shared: Sequence[Mapping[str, int]],
    interval_s: float,
) -> None:
    """Warn of pictures without partners, and of pairs that are far apart."""
    alone = {name: sum(len(m) == 1 and name in m for m in found) for name in times_s}
    if any(alone.values()):
        counts = ", ".join(f"{count} of {name}" for name, count in alone.items() if count)
        warn(f"pictures without one of another camera at the same moment: {counts}")
    apart = [np.ptp([times_s[name][i] for name, i in m.items()]) for m in shared]
    worst = float(np.median(apart))
    if worst > _WORST_SHARE * interval_s:
        warn(
            f"pictures of one moment are {1e3 * worst:.3g} ms apart in the median, and pictures of "
            f"one camera {1e3 * interval_s:.3g} ms: a rig counts them as taken at once"
        )
