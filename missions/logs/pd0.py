"""PD0, the binary output of Teledyne RDI's Doppler logs: bottom tracks as a logged dive.

An ensemble is 7F 7F, its length without the checksum, the offsets of its parts, and these: fixed
leader (00 00), variable leader (80 00), bottom track (00 06); then the sum of all its bytes
(Teledyne RD Instruments, "WorkHorse Commands and Output Data Format", PD0). Beams become velocities
by the same maker's "ADCP Coordinate Transformation", sections 5.3 and 5.6; instrument and ship axes
are starboard, forward, up for a log that looks down with beam 3 ahead.

The bottom's velocity is that of the bottom past the log (water past it less the bottom past it is
the water's own), so that the vehicle's over ground is its negative.
"""

import calendar
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array, rotation_from_attitude
from missions.logs.dive import LoggedDive, Signal, cleaned
from missions.logs.ros_bag import DENSITY_KG_M3, GRAVITY_MPS2

_HEAD = b"\x7f\x7f"
_FIXED, _VARIABLE, _BOTTOM = 0x0000, 0x0080, 0x0600
_NEEDED = {_FIXED: 42, _VARIABLE: 52, _BOTTOM: 44}
"""Bytes of each part that are read."""
_BEAM, _INSTRUMENT, _SHIP, _EARTH = range(4)
"""Bits 3 and 4 of the coordinate transform."""
_ANGLES_DEG = {0: 15.0, 1: 20.0, 2: 30.0}
_BAD = -32768
_CENTURY_FROM = 80
"""Years of two digits from this one are of the 20th century."""
_PA_OF_PRESSURE = 10.0
_LOOKED_AT = 65536
_VELOCITY, _LEADER = "PD0 bottom track", "PD0 variable leader"


@dataclass(frozen=True, kw_only=True)
class _Ensemble:
    time_s: float
    depth_m: float
    pressure_pa: float
    angles_deg: tuple[float, float, float]
    """Roll, pitch, heading."""
    range_m: float
    """Along the axis of the instrument."""
    moved: tuple[float, float, float]
    """Velocity over ground: u, v, w of the body, or north, east, down."""
    earth: bool
    """Whether `moved` is north, east and down."""


def is_pd0(path: Path) -> bool:
    """Whether a file begins with such ensembles."""
    try:
        with path.open("rb") as file:
            data = file.read(_LOOKED_AT)
    except OSError:
        return False
    return next(_ensembles(data, Counter()), None) is not None


def read_pd0(path: Path, requested: Mapping[str, str]) -> LoggedDive:
    """Read a file of ensembles.

    Raises:
        NavigationError: it cannot be read, holds no bottom track, looks up, has its axes changed in
            the middle, or a topic is chosen.
    """
    if requested:
        raise NavigationError(
            f"--topic {next(iter(requested))}: PD0 of a DVL has nothing to choose from"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise NavigationError(f"{path}: cannot be read: {error.strerror}") from None
    lost: Counter[str] = Counter()
    found = []
    for parts in _ensembles(data, lost):
        if set(_NEEDED) - set(parts):
            lost["ensembles without leaders or bottom track"] += 1
            continue
        one = _ensemble(path, *(parts[part] for part in (_FIXED, _VARIABLE, _BOTTOM)))
        if np.isnan(one.moved).any():
            lost["ensembles without bottom lock"] += 1
        found.append(one)
    if not found:
        raise NavigationError(f"{path}: holds no whole ensemble of PD0 with a bottom track")
    if len({one.earth for one in found}) > 1:
        raise NavigationError(f"{path}: its coordinate transform changes: give one setting a file")
    times = np.array([one.time_s for one in found])

    def signal(source: str, rows: list[tuple[float, ...]]) -> Signal | None:
        return cleaned(source, times, np.array(rows, dtype=np.float64), Counter())

    velocity = cleaned(_VELOCITY, times, np.array([one.moved for one in found]), lost)
    earth = found[0].earth
    return LoggedDive(
        kind="PD0 of a Teledyne DVL",
        clock="the DVL's clock",
        dated=True,
        depth=signal(_LEADER, _depths(found)),
        attitude=signal(_LEADER, [one.angles_deg for one in found]),
        altitude=signal(_VELOCITY, [(one.range_m,) for one in found]),
        altitude_slant=True,
        velocity_ned=velocity if earth else None,
        velocity_body=None if earth else velocity,
        lost=dict(lost),
        notes=(
            "velocities are those of the DVL over ground, minus the bottom's: if a known leg runs "
            "backwards, --flip-velocity",
            "attitudes are those of the DVL: its heading has to be the vehicle's",
        ),
    )


def _depths(found: list[_Ensemble]) -> list[tuple[float, ...]]:
    """By pressure where there is any, else as the leader states them, to 0.1 m; NaN if all 0."""
    if any(one.pressure_pa for one in found):
        return [(one.pressure_pa / (DENSITY_KG_M3 * GRAVITY_MPS2),) for one in found]
    if any(one.depth_m for one in found):
        return [(one.depth_m,) for one in found]
    return [(np.nan,)] * len(found)


def _ensembles(data: bytes, lost: Counter[str]) -> Iterator[dict[int, bytes]]:
    """The known parts of every whole ensemble, by their numbers."""
    place = 0
    sums = np.append(0, np.cumsum(np.frombuffer(data, np.uint8), dtype=np.uint16))  # modulo 65536
    while (start := data.find(_HEAD, place)) >= 0:
        if start > place:
            lost["bytes that are not of an ensemble"] += start - place
        size = int.from_bytes(data[start + 2 : start + 4], "little")
        end = start + size
        if size < 6 or end + 2 > len(data):
            place = start + 1
            lost["bytes that are not of an ensemble"] += 1
            continue
        stated = int.from_bytes(data[end : end + 2], "little")
        if (int(sums[end]) - int(sums[start])) % 65536 != stated:
            lost["ensembles with a wrong checksum"] += 1
            place = start + 2
            continue
        parts = {}
        offsets = data[start + 6 : start + 6 + 2 * data[start + 5]]
        for (offset,) in struct.iter_unpack("<H", offsets[: len(offsets) // 2 * 2]):
            number = int.from_bytes(data[start + offset : start + offset + 2], "little")
            length = _NEEDED.get(number)
            if length is not None and offset + length <= size:
                parts[number] = data[start + offset : end]
        yield parts
        place = end + 2


def _ensemble(path: Path, fixed: bytes, variable: bytes, bottom: bytes) -> _Ensemble:
    system = int.from_bytes(fixed[4:6], "little")
    if system & 0x80:
        raise NavigationError(f"{path}: its log looks up: a bottom track needs one that looks down")
    depth, heading, pitch, roll = struct.unpack_from("<HHhh", variable, 16)
    tilt = np.deg2rad([roll / 100.0, pitch / 100.0])
    if fixed[30] & 0x08:  # the pitch of its own sensor, which is no gimbal's (equation 18)
        tilt[1] = np.arctan(np.tan(tilt[1]) * np.cos(tilt[0]))
    ranges = np.array(struct.unpack_from("<4H", bottom, 16)) / 100.0
    if len(bottom) > 80:
        ranges += np.array(list(bottom[77:81])) * 655.36
    raw = np.array(struct.unpack_from("<4h", bottom, 24), dtype=np.float64)
    seen = np.where(raw == _BAD, np.nan, raw) * 1e-3
    frame = fixed[25] >> 3 & 3
    angles = np.array([*tilt, np.deg2rad(heading / 100.0)])
    return _Ensemble(
        time_s=_clock(variable),
        depth_m=depth / 10.0,
        pressure_pa=_PA_OF_PRESSURE * struct.unpack_from("<I", variable, 48)[0],
        angles_deg=tuple(np.rad2deg(angles).tolist()),
        range_m=float(ranges[ranges > 0].mean()) if (ranges > 0).any() else np.nan,
        moved=tuple(_moved(path, frame, seen, fixed, angles).tolist()),
        earth=frame == _EARTH,
    )


def _moved(path: Path, frame: int, seen: Array, fixed: bytes, angles: Array) -> Array:
    """Velocity over ground, (3,): forward, right, down of the body, or north, east, down.

    Args:
        path: of the file.
        frame: of the coordinate transform.
        seen: (4,) the bottom's velocities, m/s; NaN is not known.
        fixed: the fixed leader.
        angles: roll, pitch, heading, radians.
    """
    if frame == _EARTH:
        east, north, up = seen[:3]
        return np.array([-north, -east, up])
    if frame == _BEAM:
        seen = _beam_matrix(path, int.from_bytes(fixed[4:6], "little")) @ seen
    starboard, forward, up = seen[:3]
    if frame != _SHIP:
        # Beam 3 is turned by the heading alignment (EA), clockwise from ahead.
        turn = np.deg2rad(int.from_bytes(fixed[26:28], "little", signed=True) / 100.0)
        starboard, forward = (
            starboard * np.cos(turn) + forward * np.sin(turn),
            forward * np.cos(turn) - starboard * np.sin(turn),
        )
    body = np.array([-forward, -starboard, up])
    if frame == _SHIP and fixed[25] & 4:  # levelled by pitch and roll
        body = rotation_from_attitude(angles[0], angles[1], 0.0).inv().apply(body)
    return body


def _beam_matrix(path: Path, system: int) -> Array:
    """(3, 4) from beam velocities, towards the log positive, to instrument axes."""
    angle_deg = _ANGLES_DEG.get(system >> 8 & 3)
    if angle_deg is None:
        raise NavigationError(
            f"{path}: beams of an angle that PD0 does not state: set the DVL to instrument, ship "
            "or earth coordinates"
        )
    across = (1.0 if system & 0x08 else -1.0) / (2.0 * np.sin(np.deg2rad(angle_deg)))
    along = 1.0 / (4.0 * np.cos(np.deg2rad(angle_deg)))
    return np.array([[across, -across, 0, 0], [0, 0, -across, across], [along] * 4])


def _clock(variable: bytes) -> float:
    """Seconds since 1970 of the real-time clock; NaN where it holds no date."""
    year, month, day, hour, minute, second, hundredth = variable[4:11]
    century = variable[57] if len(variable) > 57 and variable[57] in (19, 20) else 0
    century = century or (19 if year >= _CENTURY_FROM else 20)
    if not (1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and minute < 60 and second < 61):
        return np.nan
    date = (100 * century + year, month, day, hour, minute, second)
    return calendar.timegm(date) + hundredth / 100.0
