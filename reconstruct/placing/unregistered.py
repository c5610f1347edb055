"""Pictures that are not in the model, with their reasons, and where navigation puts them.

Navigation errs slowly: what the model finds it off by just before and just after such a picture is
off there too. How well that predicts is measured on pictures in the model, across gaps as long.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import read_csv, write_csv
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from alice_survey.core.manifest import ImageRecord
from camera_calib.rig import Rig
from reconstruct.mapping.unregistered import UNREGISTERED
from reconstruct.placing.track import TrackRow

_FEWEST = 4
"""Pictures in the model from which navigation's error is known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NavigationPlaces:
    """Where navigation puts cameras; arrays of N pictures."""

    images: tuple[str, ...]
    ned: Array
    """(N, 3)."""
    sigma: Array
    """(N, 2) horizontal, each of north and east, and of depth."""
    corrected: bool
    """Whether by what the model finds navigation off before and after."""


def read_reasons(mapping: Path) -> dict[str, str]:
    """Why pictures are not in the model, by name, as the mapping wrote it; empty if all are."""
    path = mapping / UNREGISTERED
    if not path.exists():
        return {}
    rows = read_csv(path, ("image", "reason"), exact=True, fault=WorkspaceError)[1]
    return {row["image"]: row["reason"] for _, row in rows}


def navigation_places(
    lost: Sequence[ImageRecord],
    known: Mapping[str, ImageRecord],
    rows: Sequence[TrackRow],
    rig: Rig | None,
    datum: Datum,
) -> NavigationPlaces:
    """Place pictures by navigation, corrected by its misses at pictures in the model.

    Args:
        lost: pictures that are not in the model, those with a position count.
        known: all pictures by name.
        rows: the track.
        rig: with its mount, or None.
        datum: of the model's frame.
    """
    lost = [record for record in lost if record.has_position]
    places = np.array([_place(record, rig, datum) for record in lost]).reshape(-1, 3)
    sigma = np.array([[r.sigma_horizontal_m, r.sigma_depth_m] for r in lost]).reshape(-1, 2)
    names = tuple(record.image for record in lost)
    based = [row for row in rows if known[row.image].has_position]
    corrected = len(based) >= _FEWEST and bool(lost)
    if corrected:
        timed = bool(np.isfinite([one.time_s for one in lost]).all())
        timed &= bool(np.isfinite([row.time_s for row in based]).all())
        based = sorted(based, key=lambda row: row.time_s if timed else row.station)
        times = np.array([row.time_s if timed else float(row.station) for row in based])
        spacing = float(np.median(np.diff(np.unique(times)))) if np.ptp(times) else 0.0
        misses = np.array([
            row.world_from_cam.translation - _place(known[row.image], rig, datum) for row in based
        ])  # fmt: skip
        when = np.array([one.time_s if timed else float(one.station) for one in lost])
        for n, at in enumerate(when):
            places[n] += _between(times, misses, at, 0.0)
            apart = max(float(np.abs(times - at).min()), spacing)
            left = misses - np.array([_between(times, misses, t, apart) for t in times])
            rms = np.sqrt(np.nanmean(np.square(left), axis=0))
            sigma[n] = np.sqrt(np.mean(np.square(rms[:2]))), rms[2]
    return NavigationPlaces(images=names, ned=places, sigma=sigma, corrected=corrected)


def _place(record: ImageRecord, rig: Rig | None, datum: Datum) -> Array:
    """(3,) where navigation puts a camera, NED."""
    reading = np.array([[record.latitude_deg, record.longitude_deg, record.depth_m]])
    place: Array = datum.ned_from_geodetic(reading)[0]
    if rig is not None and record.has_attitude:
        angles = np.deg2rad([record.roll_deg, record.pitch_deg, record.heading_deg])
        place = place + rotation_from_attitude(*angles).apply(
            rig.body_from_cam(record.camera).translation
        )
    return place


def _between(times: Array, values: Array, at: float, apart: float) -> Array:
    """(3,) values at a time from those just before and after it, at least so far apart from it.

    At the ends, where there is one side alone, that counts.
    """
    before, after = np.flatnonzero(times <= at - apart), np.flatnonzero(times >= at + apart)
    if not len(before) and not len(after):
        return np.full(values.shape[1], np.nan)
    first = before[-1] if len(before) else after[0]
    last = after[0] if len(after) else before[-1]
    span = times[last] - times[first]
    share = (at - times[first]) / span if span > 0 else 0.0
    return np.asarray(values[first] + share * (values[last] - values[first]))


def write_unregistered(
    path: Path,
    lost: Sequence[ImageRecord],
    words: Mapping[str, str],
    places: NavigationPlaces | None,
    datum: Datum | None,
) -> None:
    """Write pictures that are not in the model, why, and where navigation puts them."""
    at = {} if places is None else {name: n for n, name in enumerate(places.images)}
    lines = []
    for record in lost:
        cells = ["", *[""] * 7]
        if places is not None and datum is not None and record.image in at:
            n = at[record.image]
            lat, lon, _ = datum.geodetic_from_ned(places.ned[n : n + 1])[0]
            cells = [
                "navigation, corrected" if places.corrected else "navigation",
                *(f"{v:.4f}" for v in places.ned[n]),
                f"{lat:.10f}", f"{lon:.10f}",
                *("" if np.isnan(s) else f"{s:.4g}" for s in places.sigma[n]),
            ]  # fmt: skip
        lines.append([record.image, record.camera, record.station, words[record.image], *cells])
    header = (
        "image", "camera", "station", "reason", "placed_by", "north_m", "east_m", "depth_m",
        "latitude_deg", "longitude_deg", "sigma_horizontal_m", "sigma_depth_m",
    )  # fmt: skip
    write_csv(path, header, lines)
