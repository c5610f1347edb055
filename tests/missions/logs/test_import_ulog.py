"""PX4's logs become navigation; written here by the format's description alone."""

import struct
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Datum
from missions.logs.dead_reckoning import TrackErrors
from tests.missions.logs import log_files
from tests.missions.logs.log_files import numbers

BOOT_US = 60_000_000
FIX_US = round(datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp() * 1e6)
ORIGIN = Datum(43.05, 5.92)
FORMATS = {
    "vehicle_local_position": (
        "uint64_t timestamp;bool xy_valid;bool z_valid;bool v_xy_valid;bool v_z_valid;"
        "uint8_t[4] _padding0;double ref_lat;double ref_lon;float x;float y;float z;float vx;"
        "float vy;float vz;float eph;float epv;bool xy_global;uint8_t[7] _padding1;",
        "<Q4?4xdd8f?",
    ),
    "vehicle_global_position": (
        "uint64_t timestamp;double lat;double lon;float alt;float eph;", "<Qddff",
    ),
    "vehicle_attitude": ("uint64_t timestamp;float[4] q;", "<Q4f"),
    "sensor_gps": (
        "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
        "uint8_t fix_type;uint8_t[7] _padding0;",
        "<QQddB",
    ),
    "distance_sensor": (
        "uint64_t timestamp;float min_distance;float max_distance;float current_distance;"
        "int8_t signal_quality;uint8_t orientation;",
        "<Q3fbB",
    ),
    "inner": ("float a;char[3] text;", ""),
    "nested": ("uint64_t timestamp;inner[2] pair;", "<Qf3sf3s"),
}  # fmt: skip


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<Hc", len(content), kind.encode()) + content


def ulog(records: list[tuple[Any, ...]], *, incompatible: int = 0, appended: int = 0) -> bytes:
    """A log of (name, instance, values ...)."""
    flags = struct.pack("<8s8s3Q", b"", bytes([incompatible]), appended, 0, 0)
    log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", BOOT_US) + message("B", flags)
    log += message("I", b"\x11char[3] sys_name" + b"PX4")
    for name, (fields, _) in FORMATS.items():
        log += message("F", f"{name}:{fields}".encode())
    numbers_of: dict[tuple[str, int], int] = {}
    for name, instance, *_ in records:
        if (name, instance) not in numbers_of:
            number = numbers_of[name, instance] = 7 + len(numbers_of)
            log += message("A", struct.pack("<BH", instance, number) + name.encode())
    log += message("S", bytes.fromhex("2f731320250cbb12"))
    for name, instance, *values in records:
        content = struct.pack(FORMATS[name][1], *values)
        log += message("D", struct.pack("<H", numbers_of[name, instance]) + content)
    return log


def gps(at_us: int, fix: int = 3) -> tuple[Any, ...]:
    utc = FIX_US + at_us - BOOT_US
    return ("sensor_gps", 0, at_us, utc, ORIGIN.latitude_deg, ORIGIN.longitude_deg, fix)


def local(at_us: int, ned: Any, velocity: Any, valid: bool = True) -> tuple[Any, ...]:
    origin = (ORIGIN.latitude_deg, ORIGIN.longitude_deg)
    return ("vehicle_local_position", 0, at_us, valid, True, True, True, *origin, *ned, *velocity,
            2.0, 0.5, True)  # fmt: skip


def dive(count: int = 50) -> list[tuple[Any, ...]]:
    """North by 0.5 m/s and down by 0.1 m/s; rolled to starboard by 10 degrees, heading east."""
    records = [gps(BOOT_US, 2), gps(BOOT_US), gps(BOOT_US + 1000)]
    q = Rotation.from_euler("ZX", [90.0, 10.0], degrees=True).as_quat(scalar_first=True)
    for i in range(count):
        at = BOOT_US + 2_000_000 + 100_000 * i
        records.append(local(at, (0.05 * i, 1.0, 2.0 + 0.01 * i), (0.5, 0.0, 0.1)))
        records.append(("vehicle_attitude", 0, at, *q))
        records.append(("distance_sensor", 0, at, 0.2, 50.0, 3.0, 100, 25))
        records.append(("distance_sensor", 1, at + 10, 0.2, 50.0, 9.0, 100, 0))
        records.append(("nested", 0, at, 1.0, b"abc", 2.0, b"def"))
    return records


def imported(folder: Path, data: bytes, **options: Any) -> dict[str, Any]:
    log = folder / "dive.ulg"
    log.write_bytes(data)
    return log_files.imported(log, **options)


def test_a_dive_is_read(tmp_path: Path) -> None:
    data = imported(tmp_path, ulog(dive()))
    assert data["rows"] == 50 and data["dated"]
    assert data["start"] == "2024-05-01T12:00:02.000000Z"
    place = numbers(tmp_path, "latitude_deg", "longitude_deg", "depth_m")
    ned = ORIGIN.ned_from_geodetic(place)
    expected = np.array([[0.05 * i, 1.0, 2.0 + 0.01 * i] for i in range(50)])
    np.testing.assert_allclose(ned, expected, atol=1e-5)
    angles = numbers(tmp_path, "roll_deg", "pitch_deg", "heading_deg")
    np.testing.assert_allclose(angles, [[10.0, 0.0, 90.0]] * 50, atol=1e-4)
    altitude = numbers(tmp_path, "altitude_m")
    np.testing.assert_allclose(altitude, 3.0 * np.cos(np.deg2rad(10.0)), atol=1e-5)
    # eph is the root of the sum of both variances.
    sigmas = numbers(tmp_path, "sigma_horizontal_m", "sigma_depth_m")
    np.testing.assert_allclose(sigmas, [[2.0 / np.sqrt(2.0), 0.5]] * 50, rtol=1e-5)
    assert data["sources"]["position"] == "vehicle_local_position"


def test_global_positions_are_preferred_and_others_can_be_chosen(tmp_path: Path) -> None:
    records = dive()
    for i in range(50):
        at = BOOT_US + 2_000_000 + 100_000 * i
        records.append(("vehicle_global_position", 0, at, 43.06, 5.93, 12.0, 4.0))
    data = imported(tmp_path, ulog(records))
    assert data["sources"]["position"] == "vehicle_global_position"
    np.testing.assert_allclose(numbers(tmp_path, "latitude_deg"), 43.06, atol=1e-9)
    data = imported(tmp_path, ulog(records), topics=["navigation=vehicle_local_position"])
    assert data["sources"]["position"] == "vehicle_local_position"
    with pytest.raises(NavigationError, match="navigation can come from"):
        imported(tmp_path, ulog(records), topics=["navigation=truth"])


def test_velocities_reckon_between_fixes(tmp_path: Path) -> None:
    records = [gps(BOOT_US + 2_000_000)]
    for i in range(50):
        at = BOOT_US + 2_000_000 + 100_000 * i
        records.append(local(at, (np.nan, np.nan, 2.0), (0.5, 0.25, 0.0), valid=False))
        records.append(("vehicle_attitude", 0, at, 1.0, 0.0, 0.0, 0.0))
    data = imported(tmp_path, ulog(records), dead_reckon=TrackErrors())
    place = numbers(tmp_path, "latitude_deg", "longitude_deg", "depth_m")
    ned = ORIGIN.ned_from_geodetic(place)
    np.testing.assert_allclose(ned[-1] - ned[0], [0.5 * 4.9, 0.25 * 4.9, 0.0], atol=1e-3)
    assert data["sources"]["position"] == "vehicle_local_position, dead reckoning"


def test_damaged_and_other_logs_end_in_one_line(tmp_path: Path) -> None:
    whole = ulog(dive())
    assert imported(tmp_path, whole[:-5])["rows"] == 50
    nested = ulog([("nested", 0, BOOT_US, 1.0, b"abc", 2.0, b"def")])
    for wrong, words in (
        (b"", "does not begin with ULog"),
        (ulog(dive(), incompatible=2), "incompatible"),
        (nested, "it has nested"),
        (whole.replace(b"inner[2] pair", b"nested[2] pai"), "over 4096 fields"),
    ):
        with pytest.raises(NavigationError, match=words):
            imported(tmp_path, wrong)
    damaged = whole.replace(b"float x;", b"fl0at x;")  # its other messages are read
    assert imported(tmp_path, damaged)["sources"]["attitude"] == "vehicle_attitude"
