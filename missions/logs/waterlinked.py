"""Reports of a Water Linked DVL (A50, A125), one JSON object a line, as its TCP port sends them.

`velocity` reports hold vx, vy, vz (m/s; forward, right, down of the transducer), the range along
its axis and when they were valid (`time_of_validity`, microseconds since 1970); `position_local`
reports hold roll, pitch and yaw (degrees) at `ts` (seconds since 1970). Their own x, y and z count
from the last reset and are not read. The maker's page "DVL protocol" describes formats json_v2 to
json_v3.1.
"""

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.errors import NavigationError
from missions.logs.dive import DATED_AFTER_S, LoggedDive, clean_signal, finite_number

VELOCITY, ATTITUDE = "velocity", "position_local"
_MAX_LINE = 100_000
_LOOKED_AT = 20
"""Lines at which a file is recognised: the first may be cut."""
_MICRO, _MILLI = 1e-6, 1e-3


def is_waterlinked(path: Path) -> bool:
    """Whether a file holds such reports."""
    try:
        with path.open("rb") as file:
            lines = [file.readline(_MAX_LINE) for _ in range(_LOOKED_AT)]
    except OSError:
        return False
    return any(
        (report := _report(line)) and report["type"] in (VELOCITY, ATTITUDE) for line in lines
    )


def read_waterlinked(path: Path, requested: Mapping[str, str]) -> LoggedDive:
    """Read a file of reports.

    Raises:
        NavigationError: it cannot be read, holds no velocity, or a topic is chosen.
    """
    if requested:
        raise NavigationError(
            f"--topic {next(iter(requested))}: reports of a DVL have nothing to choose from"
        )
    lost: Counter[str] = Counter()
    velocities: list[list[float]] = []
    attitudes: list[list[float]] = []
    since_s, stamped = 0.0, True
    for report in _reports(path, lost):
        if report["type"] == ATTITUDE:
            attitudes.append([finite_number(report.get(k)) for k in ("ts", "roll", "pitch", "yaw")])
            continue
        since_s += _MILLI * np.nan_to_num(finite_number(report.get("time")))
        valid_s = _MICRO * finite_number(report.get("time_of_validity"))
        stamped = stamped and math.isfinite(valid_s)
        row = [finite_number(report.get(k)) for k in ("vx", "vy", "vz", "altitude")]
        locked = report.get("velocity_valid") is True
        if not locked:
            lost["velocity reports without bottom lock"] += 1
            row[:3] = [math.nan] * 3
        if not row[3] > 0:
            row[3] = math.nan
        velocities.append([valid_s, since_s, *row])
    if not velocities:
        raise NavigationError(f"{path}: holds no velocity report of a Water Linked DVL")
    table, turns = np.array(velocities), np.array(attitudes).reshape(-1, 4)
    times = table[:, 0] if stamped else table[:, 1]
    if not stamped and len(turns):
        raise NavigationError(
            f"{path}: velocity reports have no time_of_validity, so attitudes cannot be tied to "
            "them: set the DVL's output to json_v3 or later"
        )
    return LoggedDive(
        kind="reports of a Water Linked DVL",
        clock="the DVL's clock",
        dated=bool(np.nanmedian(times) > DATED_AFTER_S),
        attitude=clean_signal(ATTITUDE, turns[:, 0], turns[:, 1:], lost),
        altitude=clean_signal(VELOCITY, times, table[:, 5], Counter()),
        altitude_slant=True,
        velocity_body=clean_signal(VELOCITY, times, table[:, 2:5], lost),
        lost=dict(lost),
        notes=("velocities are of the transducer: forward, right and down have to be the body's",),
    )


def _reports(path: Path, lost: Counter[str]) -> Iterator[dict[str, Any]]:
    try:
        with path.open("rb") as file:
            while line := file.readline(_MAX_LINE):
                report = _report(line)
                if report is None and line.strip():
                    lost["lines that are no report"] += 1
                elif report is not None and report["type"] in (VELOCITY, ATTITUDE):
                    yield report
    except OSError as error:
        raise NavigationError(f"{path}: cannot be read: {error.strerror}") from None


def _report(line: bytes) -> dict[str, Any] | None:
    """The object of a line that names its type."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) and isinstance(found.get("type"), str) else None
