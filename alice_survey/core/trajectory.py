"""Poses of the body over time: the true track of a simulation, the navigation log of a dive."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import read_csv, write_csv
from alice_survey.core.contents import parse_number
from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array, attitude_from_rotation, rotation_from_attitude

TRACK_COLUMNS = (
    "time_s", "north_m", "east_m", "depth_m", "roll_deg", "pitch_deg", "heading_deg",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Poses of the body over time."""

    time_s: Array
    """(T,) seconds since mission start, strictly increasing."""

    ned_from_body: RigidTransform
    """(T,) poses, FRD body to local NED, metres."""

    def __post_init__(self) -> None:
        if self.time_s.shape != (len(self.ned_from_body),):
            raise ValueError(f"{self.time_s.shape} times for {len(self.ned_from_body)} poses")
        if not np.all(np.diff(self.time_s) > 0):
            raise ValueError("time_s must increase strictly")


def write_track(path: Path, track: Trajectory) -> None:
    """Write a track as CSV (`TRACK_COLUMNS`), exact to 1e-9 m and degrees."""
    angles = np.rad2deg(attitude_from_rotation(track.ned_from_body.rotation))
    rows = np.column_stack([track.time_s, track.ned_from_body.translation, angles])
    write_csv(path, TRACK_COLUMNS, ([f"{value:.9f}" for value in row] for row in rows))


def read_track(path: Path) -> Trajectory:
    """Read what `write_track` wrote.

    Raises:
        NavigationError: the file is missing, lacks a column, holds a non-number, has
            no rows, or its times do not increase.
    """
    columns = read_columns(path, TRACK_COLUMNS)
    time_s, north, east, depth, roll, pitch, heading = (columns[c] for c in TRACK_COLUMNS)
    if not len(time_s):
        raise NavigationError(f"{path}: has no rows")
    late = np.flatnonzero(np.diff(time_s) <= 0)
    if len(late):
        raise NavigationError(
            f"{path} line {late[0] + 3}: time_s {time_s[late[0] + 1]:g} does not increase"
        )
    rotation = rotation_from_attitude(*(np.deg2rad(a) for a in (roll, pitch, heading)))
    poses = RigidTransform.from_components(np.stack([north, east, depth], axis=1), rotation)
    return Trajectory(time_s=time_s, ned_from_body=poses)


def read_columns(
    path: Path, required: Sequence[str], known: Collection[str] = ()
) -> dict[str, Array]:
    """Read the required columns of a CSV file as finite numbers; `known` as of `read_csv`.

    Raises:
        NavigationError: the file is missing, lacks a column, or holds a value that is not a finite
            number (the message gives its line).
    """
    table = [
        [_number(path, line, row, name) for name in required]
        for line, row in read_csv(path, required, known=known)[1]
    ]
    values = np.asarray(table, dtype=np.float64).reshape(-1, len(required))
    return {name: values[:, i] for i, name in enumerate(required)}


def _number(path: Path, line: int, row: dict[str, str], name: str) -> float:
    try:
        value = parse_number(row[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise NavigationError(f"{path} line {line}: {name} is {row[name]!r}, not a finite number")
    return value
