"""The formats there are: the modules of `missions.exports.formats`, imported when they are used.

And missions read back from files, whichever of the formats they are in.
"""

import math
import pkgutil
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from alice_survey.core.contents import one_line, ordinary_file
from alice_survey.core.errors import PlanError, why
from missions.exports import formats

if TYPE_CHECKING:
    from missions.exports.format import ExportFormat
    from missions.values.mission import Mission

_MAX_BYTES = 64_000_000


def format_names() -> list[str]:
    """Names of all formats, in alphabetical order; imports none of them."""
    found = pkgutil.iter_modules(formats.__path__)
    return sorted(module.name.replace("_", "-") for module in found)


def format_named(name: str) -> "ExportFormat":
    """A format by its name.

    Raises:
        PlanError: there is none of this name.
    """
    if name not in format_names():
        raise PlanError(f"format {name!r} is not known; known are {', '.join(format_names())}")
    module = import_module(f"{formats.__name__}.{name.replace('-', '_')}")
    found: ExportFormat = module.FORMAT
    return found


def read_mission(path: Path) -> "Mission":
    """Read a mission as the vehicle that the file is for does.

    Raises:
        PlanError: the file cannot be read, or holds no mission that can be flown.
    """
    try:
        with ordinary_file(path, None).open("rb") as file:
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


def _check(mission: "Mission") -> None:
    """Raise a `ValueError` of what no vehicle can fly."""
    if not mission.steps:
        raise ValueError("the mission has no step")
    for number, step in enumerate(mission.steps, start=1):
        places = (step.latitude_deg, step.longitude_deg), step.start_deg or (0.0, 0.0)
        below = math.isfinite(step.depth_m) and step.depth_m >= 0.0
        above = math.isfinite(step.altitude_m) and step.altitude_m > 0.0
        fault = ""
        if not all(abs(lat) <= 90.0 and abs(lon) <= 180.0 for lat, lon in places):
            fault = (
                f"the place {step.latitude_deg:g}, {step.longitude_deg:g}, or start, beyond a pole"
            )
        elif not step.speed_mps > 0.0:
            fault = f"the speed {step.speed_mps:g} m/s"
        elif step.hold_s < 0.0 or step.tolerance_m < 0.0:
            fault = "a negative time or tolerance"
        elif step.heave != "altitude" and not below:
            fault = f"the depth {step.depth_m:g} m"
        elif step.heave != "depth" and not above:
            fault = f"the altitude {step.altitude_m:g} m"
        if fault:
            raise ValueError(f"step {number} has {fault}")
