"""Reports of a Water Linked DVL (A50, A125): one JSON object a line, as its TCP port sends them.

`velocity` reports hold vx, vy, vz (m/s; forward, right, down of the transducer), the range along
its axis and when they were valid (`time_of_validity`, microseconds since 1970); `position_local`
reports hold roll, pitch and yaw (degrees) at `ts` (seconds since 1970). Their own x, y and z are
relative to the last reset and are not read. Reports of json_v1 are velocities without a `type`,
whose times count from the report before. The maker's page "DVL protocol" describes json_v2 to
json_v3.1.
"""

import itertools
import json
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.contents import ordinary_file
from alice_survey.core.errors import NavigationError, file_faults
from missions.logs.dive import LoggedDive, clean_signal, finite_number
from missions.logs.navigation_csv import DATED_AFTER_S

SUFFIXES = (".json", ".jsonl", ".log", ".txt", "")
_VELOCITY, _ATTITUDE = "velocity", "position_local"
_MAX_LINE = 100_000
_LOOKED_AT = 20
"""Lines at which a file is recognised: the first may be cut."""


def is_waterlinked(path: Path) -> bool:
    """Whether a file holds such reports."""
    if path.suffix.lower() not in SUFFIXES:
        return False
    first = itertools.islice(_read_reports(path), _LOOKED_AT)
    return any(report and report["type"] in (_VELOCITY, _ATTITUDE) for report in first)


def read_waterlinked(path: Path) -> LoggedDive:
    """Read a file of reports.

    Raises:
        NavigationError: it cannot be read, or holds no velocity.
    """
    lost: Counter[str] = Counter()
    velocities: list[list[float]] = []
    attitudes: list[list[float]] = []
    since_s, before = 0.0, None
    for report in _read_reports(path):
        if report is None:
            lost["lines that are no report"] += 1
        elif report["type"] == _ATTITUDE:
            attitudes.append([finite_number(report.get(k)) for k in ("ts", "roll", "pitch", "yaw")])
        elif report["type"] == _VELOCITY:
            if report == before:  # a logger wrote it again: its time would count twice
                lost["velocity reports that repeat the one before"] += 1
                continue
            before = report
            since_s += 1e-3 * np.nan_to_num(finite_number(report.get("time")))
            row = [finite_number(report.get(k)) for k in ("vx", "vy", "vz", "altitude", "fom")]
            if report.get("velocity_valid") is not True:
                lost["velocity reports without bottom lock"] += 1
                row = [math.nan] * len(row)  # the maker: then neither velocity nor altitude holds
            if not row[3] > 0:
                row[3] = math.nan
            valid_s = 1e-6 * finite_number(report.get("time_of_validity"))
            velocities.append([valid_s, since_s, *row])
    if not velocities:
        raise NavigationError(f"{path}: holds no velocity report of a Water Linked DVL")
    table, rotations = np.array(velocities), np.array(attitudes).reshape(-1, 4)
    stamped = bool(np.isfinite(table[:, 0]).all())
    times = table[:, 0] if stamped else table[:, 1]
    if not stamped and len(rotations):
        raise NavigationError(
            f"{path}: velocity reports have no time_of_validity, so attitudes cannot be tied to "
            "them: set the DVL's output to json_v3 or later"
        )
    notes = ["velocities are of the transducer: forward, right and down have to be the body's"]
    fom = table[np.isfinite(table[:, 6]), 6]
    if len(fom):
        notes.append(f"the DVL states errors of velocities (fom) of {np.median(fom):.2g} m/s")
    return LoggedDive(
        kind="reports of a Water Linked DVL",
        clock="the DVL's clock",
        dated=bool(np.nanmedian(times) > DATED_AFTER_S),
        attitude=clean_signal(_ATTITUDE, rotations[:, 0], rotations[:, 1:], lost),
        altitude=clean_signal(_VELOCITY, times, table[:, 5], Counter()),
        altitude_slant=True,
        velocity_body=clean_signal(_VELOCITY, times, table[:, 2:5], lost),
        lost=dict(lost),
        notes=tuple(notes),
    )


def _read_reports(path: Path) -> Iterator[dict[str, Any] | None]:
    """The report of each line, of any type; None for a line that is not a report."""
    with file_faults(path, NavigationError), ordinary_file(path, None).open("rb") as file:
        while line := file.readline(_MAX_LINE):
            try:
                report = json.loads(line) if line.strip() else {"type": "empty line"}
                if report.get("format") == "json_v1":
                    report["type"] = _VELOCITY
                yield report if report["type"] else None
            except (ValueError, RecursionError, TypeError, KeyError, AttributeError):
                yield None
