"""A mission read back from a file, whichever format it is in."""

import math
from pathlib import Path

from alice_survey.core.contents import one_line
from alice_survey.core.errors import PlanError, why
from missions.exports.registry import format_named, format_names
from missions.values.mission import Mission, MissionStep

_MAX_BYTES = 64_000_000
_MAX_LATITUDE_DEG, _MAX_LONGITUDE_DEG = 90.0, 180.0


def read_mission(path: Path) -> Mission:
    """Read a mission as the vehicle that the file is for does.

    Raises:
        PlanError: the file cannot be read, or holds no mission that can be flown.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise PlanError(f"{path}: cannot be read: {why(error)}") from None
    if len(raw) > _MAX_BYTES:
        raise PlanError(f"{path}: is larger than {_MAX_BYTES // 1_000_000} MB: no mission is")
    readable = []
    text = raw.decode("utf-8", errors="replace")
    for name in format_names():
        format_ = format_named(name)
        if format_.read is None:
            continue
        readable.append(name)
        try:
            mission = format_.read(text)
            if mission is not None:
                _check(mission)
                return mission
        except ValueError as error:
            raise PlanError(f"{path}: {one_line(error)}") from None
    raise PlanError(f"{path}: holds no mission in any of the formats {', '.join(readable)}")


def _check(mission: Mission) -> None:
    """Raise a `ValueError` of what no vehicle can fly."""
    if not mission.steps:
        raise ValueError("the mission has no step")
    for number, step in enumerate(mission.steps, start=1):
        places = [(step.latitude_deg, step.longitude_deg)]
        places += [step.start_deg] if step.start_deg else []
        for lat, lon in places:
            if abs(lat) > _MAX_LATITUDE_DEG or abs(lon) > _MAX_LONGITUDE_DEG:
                raise ValueError(f"step {number} is at latitude {lat:g}, longitude {lon:g}")
        if step.speed_mps <= 0.0:
            raise ValueError(f"step {number} has the speed {step.speed_mps:g} m/s")
        if step.hold_s < 0.0 or step.tolerance_m < 0.0:
            raise ValueError(f"step {number} has a negative time or tolerance")
        _check_heave(number, step)


def _check_heave(number: int, step: MissionStep) -> None:
    by_depth, by_altitude = step.heave != "altitude", step.heave != "depth"
    if by_depth and not (math.isfinite(step.depth_m) and step.depth_m >= 0.0):
        raise ValueError(f"step {number} is at the depth {step.depth_m:g} m")
    if by_altitude and not (math.isfinite(step.altitude_m) and step.altitude_m > 0.0):
        raise ValueError(f"step {number} is at the altitude {step.altitude_m:g} m")
