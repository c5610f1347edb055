"""Bottom tracks of Teledyne's PD0 become velocities of the vehicle, whatever their axes."""

import struct
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array, rotation_from_attitude
from missions.logs.dead_reckoning import TrackErrors
from missions.logs.import_log import ImportOptions, import_log, read_dive
from missions.logs.pd0 import is_pd0
from tests.missions.logs.test_import_bag import numbers
from tests.missions.logs.test_import_dvl import DATUM, FIX, SPEED_MPS, STEP_S, circle

START = datetime(2024, 5, 1, 12, 0, 0, tzinfo=UTC)
BEAM, INSTRUMENT, SHIP, EARTH = 0x00, 0x08, 0x10, 0x18
TILTS = 0x04
ROLL, PITCH = np.deg2rad([6.0, -4.0])
RANGE_M = 700.0
"""Beyond what two bytes of centimetres hold."""


def ensemble(
    transform: int,
    time: datetime,
    velocities: Array,
    heading_rad: float = 0.0,
    *,
    alignment_deg: float = 0.0,
    system: int = 0x0208,
    pressure: int = 8042,
) -> bytes:
    """One ensemble by the maker's tables: fields at their offsets, counted from 0.

    Args:
        transform: the byte of the coordinate transform.
        time: of the real-time clock.
        velocities: (4,) as stored, m/s; NaN is bad.
        heading_rad: of the log.
        alignment_deg: of beam 3 from ahead.
        system: configuration: convex, beams of 30 degrees, down-looking.
        pressure: decapascals.
    """
    fixed, variable, bottom = bytearray(59), bytearray(65), bytearray(81)
    struct.pack_into("<H", fixed, 4, system)
    fixed[8], fixed[25], fixed[30] = 4, transform, 0x75
    struct.pack_into("<h", fixed, 26, round(100 * alignment_deg))
    struct.pack_into("<H", variable, 0, 0x0080)
    variable[4:11] = bytes([time.year - 2000, time.month, time.day, time.hour, time.minute,
                            time.second, time.microsecond // 10000])  # fmt: skip
    struct.pack_into("<H", variable, 16, 79)
    struct.pack_into("<H", variable, 18, round(100 * np.rad2deg(heading_rad)) % 36000)
    struct.pack_into("<hh", variable, 20, *(round(100 * np.rad2deg(a)) for a in (PITCH, ROLL)))
    struct.pack_into("<I", variable, 48, pressure)
    struct.pack_into("<H", bottom, 0, 0x0600)
    centimetres = round(100 * RANGE_M)
    struct.pack_into("<4H", bottom, 16, *[centimetres % 65536] * 4)
    stored = [-32768 if np.isnan(v) else round(1000 * v) for v in velocities]
    struct.pack_into("<4h", bottom, 24, *stored)
    bottom[77:81] = bytes([centimetres // 65536] * 4)
    parts = [fixed, variable, bytearray(b"\x00\x01" + bytes(30)), bottom]
    at, offsets = 6 + 2 * len(parts), []
    for part in parts:
        offsets.append(at)
        at += len(part)
    whole = struct.pack("<2sHBB4H", b"\x7f\x7f", at, 0, len(parts), *offsets) + b"".join(parts)
    return whole + struct.pack("<H", sum(whole) % 65536)


def stored(transform: int, body: Array, heading: float, alignment: float = 0.0) -> Array:
    """What a log whose vehicle moves by `body` (forward, right, down; m/s) states, (4,)."""
    frame = transform & 0x18
    past = -body  # the bottom's
    if frame == EARTH:
        north, east, down = rotation_from_attitude(ROLL, PITCH, heading).apply(past)
        return np.array([east, north, -down, 0.0])
    if frame == SHIP:
        if transform & TILTS:
            past = rotation_from_attitude(ROLL, PITCH, 0.0).apply(past)
        return np.array([past[1], past[0], -past[2], 0.0])
    ahead = rotation_from_attitude(0.0, 0.0, np.deg2rad(alignment)).apply(np.eye(3)[0])
    right = np.cross(np.eye(3)[2], ahead)
    if frame == INSTRUMENT:
        return np.array([past @ right, past @ ahead, -past[2], 0.0])
    slope = np.deg2rad(30.0)
    sides = (-right, right, ahead, -ahead)  # beams 1 to 4
    beams = [np.sin(slope) * side + np.cos(slope) * np.eye(3)[2] for side in sides]
    return np.array([-past @ beam for beam in beams])  # towards the log is positive


def log_of(transform: int, path: Path, count: int | None = None, **others: Any) -> Path:
    """The circle of `test_import_dvl`, crabbing, as PD0."""
    time_s, course, _ = circle()
    heading = course + np.deg2rad(-10.0)
    data = b""
    for t, way, at in list(zip(time_s, course, heading, strict=True))[:count]:
        ned = SPEED_MPS * np.array([np.cos(way), np.sin(way), 0.0])
        body = rotation_from_attitude(ROLL, PITCH, at).inv().apply(ned)
        values = stored(transform, body, at, others.get("alignment_deg", 0.0))
        data += ensemble(transform, START + timedelta(seconds=t), values, at, **others)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("transform", [BEAM, INSTRUMENT, SHIP, SHIP | TILTS, EARTH | TILTS])
@pytest.mark.parametrize("alignment_deg", [0.0, 45.0])
def test_a_circle_closes_in_any_coordinates(
    tmp_path: Path, transform: int, alignment_deg: float
) -> None:
    log = log_of(transform, tmp_path / "dvl.pd0", alignment_deg=alignment_deg)
    options = ImportOptions(dead_reckon=TrackErrors(), start_at=(*FIX[:2], 2.0))
    _, data = import_log(log, tmp_path / "n.csv", options)
    places = numbers(tmp_path / "n.csv", "latitude_deg", "longitude_deg", "depth_m")
    assert len(places) == len(circle()[0])
    found = DATUM.ned_from_geodetic(places)
    # Velocities are stored to 1 mm/s, angles to 0.01 degrees.
    np.testing.assert_allclose(found[:, :2], circle()[2], atol=0.03)
    np.testing.assert_allclose(found[:, 2], 80420.0 / (1025.0 * 9.80665), rtol=1e-6, atol=1e-3)
    angles = numbers(tmp_path / "n.csv", "roll_deg", "pitch_deg", "heading_deg", "altitude_m")
    np.testing.assert_allclose(angles[:, :2], [[6.0, -4.0]] * len(angles), atol=0.006)
    assert angles[0, 2] == pytest.approx(350.0, abs=0.006)
    np.testing.assert_allclose(angles[:, 3], RANGE_M * np.cos(ROLL) * np.cos(PITCH), rtol=1e-4)
    assert data["dated"] and data["start"] == "2024-05-01T12:00:00.000000Z"
    assert data["median_interval_s"] == pytest.approx(STEP_S, abs=1e-6)
    assert not data["left_out"]


def test_ahead_is_ahead_unless_turned_round(tmp_path: Path) -> None:
    """The bottom runs aft past a vehicle that goes ahead: beam 3, ahead, hears it come closer."""
    values = np.array([0.0, 0.0, 0.2, -0.2])
    log = tmp_path / "one.pd0"
    log.write_bytes(ensemble(BEAM, START, values) + ensemble(BEAM, START + timedelta(1), values))
    velocity = read_dive(log, ImportOptions()).velocity_body
    assert velocity is not None
    np.testing.assert_allclose(velocity.values, [[0.4, 0.0, 0.0]] * 2, atol=1e-9)
    there, back = (tmp_path / name for name in ("there.csv", "back.csv"))
    log = log_of(INSTRUMENT, tmp_path / "dvl.pd0", 50)
    places = []
    for out, flip in ((there, False), (back, True)):
        options = ImportOptions(
            dead_reckon=TrackErrors(), start_at=(*FIX[:2], 2.0), flip_velocity=flip
        )
        import_log(log, out, options)
        place = numbers(out, "latitude_deg", "longitude_deg", "depth_m")
        places.append(DATUM.ned_from_geodetic(place)[-1, :2])
    assert places[0][0] > 3.0
    np.testing.assert_allclose(places[0], -places[1], atol=1e-3)


def test_what_is_damaged_is_counted(tmp_path: Path) -> None:
    whole = log_of(INSTRUMENT, tmp_path / "a.pd0", 4).read_bytes()
    size = len(whole) // 4
    lost = np.array([0.1, np.nan, 0.0, 0.0])
    data = b"noise" + whole[:size] + bytes([*whole[size : size + 30], 0xAB]) + whole[size + 31 :]
    data += ensemble(INSTRUMENT, START + timedelta(seconds=9), lost) + whole[: size // 2]
    (tmp_path / "b.pd0").write_bytes(data)
    dive = read_dive(tmp_path / "b.pd0", ImportOptions())
    assert dive.velocity_body is not None
    assert np.isfinite(dive.velocity_body.values).all(axis=1).sum() == 3
    assert dive.lost["ensembles with a wrong checksum"] == 1
    assert dive.lost["ensembles without bottom lock"] == 1
    assert dive.lost["bytes that are not of an ensemble"] >= 5 + size - 2


@pytest.mark.parametrize(
    ("others", "words"),
    [({"system": 0x0288}, "looks up"), ({"system": 0x0308}, "angle that PD0 does not state")],
)
def test_logs_that_cannot_be_used_are_refused(
    tmp_path: Path, others: dict[str, int], words: str
) -> None:
    log = log_of(BEAM, tmp_path / "dvl.pd0", 3, **others)
    with pytest.raises(NavigationError, match=words):
        import_log(log, tmp_path / "n.csv")


def test_pd0_is_known_by_its_content(tmp_path: Path) -> None:
    assert is_pd0(log_of(SHIP, tmp_path / "dvl.bin", 2))
    (tmp_path / "other.bin").write_bytes(b"\x7f" * 70_000)
    assert not is_pd0(tmp_path / "other.bin")
    (tmp_path / "empty.pd0").write_bytes(b"")
    with pytest.raises(NavigationError, match="no whole ensemble"):
        import_log(tmp_path / "empty.pd0", tmp_path / "n.csv")
