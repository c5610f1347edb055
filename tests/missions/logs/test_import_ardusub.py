import math
from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from alice_survey.core.errors import NavigationError
from alice_survey.sim.vehicle.identification.problem import make_windows
from alice_survey.sim.vehicle.log import read_column_map, read_foreign_log, read_vehicle_log
from alice_survey.sim.vehicle.vehicle import vehicle_from
from missions.logs.navigation_csv import read_navigation
from tests.missions.logs.log_files import dataflash_log, dataflash_message, imported, numbers, tlog

# Week 2312 of GPS began on Sunday 28 April 2024; 302418 s into it are 1 May 12:00:18 by GPS, whose
# clock was 18 s ahead of UTC.
WEEK, GPS_MS = 2312, 302_418_000
FIX_UTC = datetime(2024, 5, 1, 12, 0, 0, tzinfo=UTC)
BOOT_US = 50_000_000
"""Microseconds since boot at which the vehicle had that fix."""
LAT, LON = 60.1, 5.25


def gps(time_us: int, status: int = 3, week: int = WEEK) -> tuple[Any, ...]:
    ms = GPS_MS + (time_us - BOOT_US) // 1000
    return ("GPS", time_us, 0, status, ms, week, 12, 0.8, LAT, LON, 3.0, 0.1, 0.0, 0.0, 0.0, 1)


def dive_messages(count: int = 20) -> list[tuple[Any, ...]]:
    """Row i is 0.1 s after the last; the heading passes through north."""
    messages: list[tuple[Any, ...]] = [gps(BOOT_US)]
    for i in range(count):
        t = BOOT_US + 1_000_000 + i * 100_000
        yaw = (358.0 + 0.3 * i) % 360.0
        messages += [
            ("ATT", t - 20_000, 0.0, 1.5, 0.0, -2.25, 0.0, (yaw - 0.06) % 360.0, 0.0, 0.0, 3),
            ("POS", t, LAT + 1e-6 * i, LON - 1e-6 * i, 1.0, -(4.0 + 0.25 * i), -99.0),
            ("RFND", t + 10_000, 0, 2.5, 4, 25),
            ("RCOU", t + 5_000, *(1500 + 10 * k + i for k in range(8))),
            ("XKF1", t, 0, 1.5, -2.25, yaw, 0.5, 0.0, 0.1, 0.1, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0),
            ("XKF1", t, 1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0),
            ("IMU", t + 1_000, 0, 0.1, 0.2, 0.3),
        ]
    last = BOOT_US + 1_000_000 + count * 100_000
    yaw = (358.0 + 0.3 * count) % 360.0
    messages.append(("ATT", last, 0.0, 1.5, 0.0, -2.25, 0.0, yaw, 0.0, 0.0, 3))
    return messages


def bin_log(folder: Path, messages: Iterable[tuple[Any, ...]] | None = None) -> Path:
    """An on-board log as a file."""
    path = folder / "dive.BIN"
    path.write_bytes(dataflash_log(dive_messages() if messages is None else messages))
    return path


def test_an_on_board_log_becomes_navigation(tmp_path: Path) -> None:
    data = imported(bin_log(tmp_path), vehicle_log=tmp_path / "v.csv")

    assert data["left_out"] == {}
    assert data["sources"] == {
        "position": "POS", "depth": "POS", "attitude": "ATT", "altitude": "RFND",
    }  # fmt: skip
    read = read_navigation(tmp_path / "n.csv", UTC)
    assert read.start_utc is not None
    assert (read.start_utc - FIX_UTC).total_seconds() == pytest.approx(1.0, abs=2e-6)
    i = np.arange(20)
    np.testing.assert_allclose(read.time_s, 0.1 * i, atol=2e-6)
    np.testing.assert_allclose(read.columns["latitude_deg"], LAT + 1e-6 * i, atol=1e-7)
    np.testing.assert_allclose(read.columns["longitude_deg"], LON - 1e-6 * i, atol=1e-7)
    np.testing.assert_allclose(read.columns["depth_m"], 4.0 + 0.25 * i, atol=1e-5)
    # ATT is 20 ms before POS, and its heading as far behind: interpolated through north. ATT holds
    # hundredths of a degree.
    np.testing.assert_allclose(read.columns["heading_deg"], (358 + 0.3 * i) % 360, atol=0.011)
    np.testing.assert_allclose(read.columns["roll_deg"], 1.5, atol=1e-6)
    np.testing.assert_allclose(read.columns["pitch_deg"], -2.25, atol=1e-6)
    upright = 2.5 * math.cos(math.radians(1.5)) * math.cos(math.radians(2.25))
    np.testing.assert_allclose(read.columns["altitude_m"][1:], upright, atol=1e-5)
    vehicle = read_vehicle_log(tmp_path / "v.csv")
    np.testing.assert_allclose(vehicle.time_s, 0.1 * np.arange(20), atol=1e-6)
    np.testing.assert_allclose(vehicle.others["pwm_3_us"][1:], 1520 + np.arange(1, 20) - 0.05)
    # North at 0.5 and down at 0.1 m/s, heading 358: nearly all of it ahead, a little to starboard.
    u, v, w = vehicle.velocity_body[0]
    assert v == pytest.approx(0.5 * math.sin(math.radians(2.0)), abs=0.005)
    assert math.hypot(u, v, w) == pytest.approx(math.hypot(0.5, 0.1), abs=1e-6)
    assert u > 0.49


def test_declination_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Norway, 3.4 degrees east: a compass that shows 358.0 points to 1.4."""
    log = bin_log(tmp_path)
    imported(log, declination_deg=3.4)
    assert numbers(tmp_path, "heading_deg")[0] == pytest.approx(1.4, abs=0.011)
    assert not capsys.readouterr().err

    log.write_bytes(dataflash_log([("PARM", 1, "COMPASS_AUTODEC", 1.0), *dive_messages()]))
    imported(log, declination_deg=3.4)
    assert "COMPASS_AUTODEC" in capsys.readouterr().err
    log.write_bytes(
        dataflash_log([("PARM", 1, "COMPASS_DEC", math.radians(2.0)), *dive_messages()])
    )
    imported(log, declination_deg=3.4)
    assert "2.00 degrees" in capsys.readouterr().err


def test_tide_by_hand(tmp_path: Path) -> None:
    """1.2 m of tide above the datum: what is 4 m below the surface is 2.8 m below the datum."""
    log = bin_log(tmp_path)
    data = imported(log, tide="1.2")
    assert data["depths_from"] == "level of the tide"
    assert numbers(tmp_path, "depth_m")[0] == pytest.approx(2.8, abs=1e-5)

    # Rising by 0.6 m in 60 s from 12:00:00 UTC: at the first position, 12:00:01, it is 0.51 m.
    tides = tmp_path / "tides.csv"
    tides.write_text("time_utc,height_m\n2024-05-01T12:00:00Z,0.5\n2024-05-01T14:01:00+02:00,1.1\n")
    data = imported(log, tide=str(tides))
    assert data["depths_from"] == "level of the tide"
    depth = numbers(tmp_path, "depth_m")
    np.testing.assert_allclose(depth, 4.0 + 0.25 * np.arange(20) - 0.51 - 0.001 * np.arange(20),
                               atol=2e-5)  # fmt: skip

    tides.write_text("time_utc,height_m\n2024-05-01T12:00:02Z,0.5\n2024-05-01T13:00:00Z,1.1\n")
    with pytest.raises(NavigationError, match="2024-05-01 12:00:01"):
        imported(log, tide=str(tides))
    tides.write_text("time_utc,height_m\n2024-05-01T12:00:00Z,-9999\n2024-05-01T13:00:00Z,1\n")
    with pytest.raises(NavigationError, match="line 2"):
        imported(log, tide=str(tides))
    tides.write_text("time_s,height_m\n0,0.5\n")
    with pytest.raises(NavigationError, match="time_utc"):
        imported(log, tide=str(tides))
    with pytest.raises(NavigationError, match="--tide"):
        imported(log, tide="high")

    data = imported(log)
    assert data["depths_from"] == "sea surface"


def test_a_lever_arm_moves_positions_to_the_body(tmp_path: Path) -> None:
    """Heading 358, level: what is 1 m ahead of the body has the body 1 m south of it."""
    messages = [
        ("ATT", *m[1:3], 0.0, 0.0, 0.0, *m[6:]) if m[0] == "ATT" else m for m in dive_messages()
    ]
    log = bin_log(tmp_path, messages)
    imported(log, lever_body_m=(1.0, 0.0, 0.3))
    latitude, longitude, depth = numbers(tmp_path, "latitude_deg", "longitude_deg", "depth_m")[0]
    # A minute of latitude at 60 degrees is 1856.9 m, of longitude 927.2 m (WGS 84).
    assert (latitude - LAT) * 60 * 1856.9 == pytest.approx(-math.cos(math.radians(2)), abs=0.01)
    assert (longitude - LON) * 60 * 927.2 == pytest.approx(math.sin(math.radians(2)), abs=0.01)
    assert depth == pytest.approx(4.0 - 0.3, abs=1e-4)


def test_filter_positions_count_from_its_origin(tmp_path: Path) -> None:
    """Without ORGN it is said that XKF1 needs one, and with --datum it counts from there."""
    messages = [m for m in dive_messages() if m[0] != "POS"]
    origins = [("ORGN", BOOT_US, 0, LAT + off_deg, LON, 0.0) for off_deg in (0.0, 1.0)]
    chosen: dict[str, Any] = {"topics": ("navigation=XKF1",)}
    with pytest.raises(NavigationError, match=r"XKF1 gives no navigation: .*ORGN.*--datum"):
        imported(bin_log(tmp_path, messages), **chosen)
    given = chosen | {"datum_deg": (LAT, LON)}
    for origin, options in ((origins[:1], {}), ([], given), (origins[1:], given)):
        data = imported(bin_log(tmp_path, [*origin, *messages]), **options)
        assert data["sources"]["position"] == "XKF1"
        assert any("XKF1 0" in note for note in data["notes"])
        latitude, depth = numbers(tmp_path, "latitude_deg", "depth_m")[0]
        assert (latitude - LAT) * 60 * 1856.9 == pytest.approx(9.0, abs=0.01)
        assert depth == pytest.approx(9.0, abs=1e-6)


def test_a_tank_log_without_position_reaches_the_identification(tmp_path: Path) -> None:
    """A .BIN without GPS: attitude, rates, velocities and pulses are what a fit needs."""
    kept = [m for m in dive_messages(60) if m[0] in ("ATT", "XKF1", "RCOU")]
    imported(bin_log(tmp_path, kept), vehicle_log=tmp_path / "v.csv")
    names = ("t1", "t2", "t3", "t4", "t5", "t6", "t7", "t8")
    pulses = ", ".join(
        f'{name} = "{"-" if i == 2 else ""}pwm_{i}_us"' for i, name in enumerate(names, 1)
    )
    (tmp_path / "map.toml").write_text(
        'time = "time_s"\nangles_deg = ["roll_deg", "pitch_deg", "heading_deg"]\n'
        f'velocity = ["u_mps", "v_mps", "w_mps"]\npulses = {{ {pulses} }}\n'
        "thrust_of_pulse = [[1100, -40], [1475, 0], [1525, 0], [1900, 50]]\n"
    )
    log = read_foreign_log(tmp_path / "v.csv", read_column_map(tmp_path / "map.toml"))
    assert not np.isfinite(log.position_ned[:, :2]).any()
    # Row i holds 1500 + 10 k + i microseconds for the thruster k, less the time between messages.
    pulse = 1500.0 + 10.0 * 3 + np.arange(1, 60) - 0.05
    np.testing.assert_allclose(
        log.thrust_n["t4"][1:60], np.maximum(pulse - 1525.0, 0.0) / 375.0 * 50.0, atol=1e-3
    )
    mirrored = 3000.0 - (pulse - 20.0)
    np.testing.assert_allclose(
        log.thrust_n["t2"][1:60], np.minimum(mirrored - 1475.0, 0.0) / 375.0 * 40.0, atol=1e-3
    )
    bare = vehicle_from("alice")
    eight = replace(
        bare, thrusters=tuple(replace(bare.thrusters[0], name=name) for name in names)
    )  # fmt: skip
    windows = make_windows(log, eight)
    assert len(windows) == 1
    assert np.isfinite(windows[0].measured[:, :3]).all()
    assert np.abs(windows[0].record.wrench).max() > 10.0


def test_one_of_several_depth_sensors_must_be_chosen(tmp_path: Path) -> None:
    messages = dive_messages()
    for i in range(21):
        t = BOOT_US + 1_000_000 + i * 100_000
        messages += [("BARO", t, 0, 0.4, 1e5), ("BARO", t, 1, -7.5, 1.7e5)]
    log = bin_log(tmp_path, messages)
    with pytest.raises(NavigationError, match=r"depth=BARO\[1\]"):
        imported(log, topics=("depth=BARO",))
    imported(log, topics=("depth=BARO[1]",))
    np.testing.assert_allclose(numbers(tmp_path, "depth_m"), 7.5, atol=1e-6)
    with pytest.raises(NavigationError, match="0, 1"):
        imported(log, topics=("depth=BARO[2]",))
    with pytest.raises(NavigationError, match="POS"):
        imported(log, topics=("depth=SONAR",))


@pytest.mark.parametrize(
    ("messages", "known"),
    [
        (("XKF1",), {"depth_m", "roll_deg", "pitch_deg", "heading_deg"}),
        (("XKF1", "ATT"), {"depth_m", "roll_deg", "pitch_deg", "heading_deg"}),
        (("ATT",), {"roll_deg", "pitch_deg", "heading_deg"}),
        (("ATT", "RFND"), {"roll_deg", "pitch_deg", "heading_deg", "altitude_m"}),
    ],
)
def test_a_vehicle_without_positions_logs_what_it_measures(
    tmp_path: Path, messages: tuple[str, ...], known: set[str]
) -> None:
    """A BlueROV2 without GPS: the filter has a depth, but no origin to count from."""
    kept = [m for m in dive_messages() if m[0] in messages]
    data = imported(bin_log(tmp_path, kept))
    assert {name for name, count in data["filled"].items() if count} == known
    read = read_navigation(tmp_path / "n.csv", UTC, ())
    if "depth_m" in known:
        np.testing.assert_allclose(read.columns["depth_m"], 9.0)
    if "heading_deg" in known:
        at = read.at(np.array([BOOT_US * 1e-6 + 1.5]))
        assert at["heading_deg"][0] == pytest.approx(359.5, abs=0.02)


def test_damage_costs_what_is_damaged_and_is_counted(tmp_path: Path) -> None:
    whole = dataflash_log(dive_messages())
    att = dataflash_message("ATT", 1, 0.0, 1.5, 0.0, -2.25, 0.0, 10.0, 0.0, 0.0, 3)
    log = tmp_path / "dive.BIN"
    first_pos = whole.index(dataflash_message(*dive_messages()[2]))
    log.write_bytes(whole[:first_pos] + b"\x00\xa3\x95\xff rubbish" + whole[first_pos:-5])
    data = imported(log)
    assert data["rows"] == 20
    assert data["left_out"] == {
        "bytes that are not a message, or of one that is cut off": 12 + len(att) - 5
    }
    log.write_bytes(whole[2000:])
    with pytest.raises(NavigationError, match=r"dive\.BIN"):
        imported(log)


def test_rows_of_a_message_without_a_usable_one_are_counted(tmp_path: Path) -> None:
    late = [(m[0], 10**17 + i, *m[2:]) if m[0] == "RFND" else m
            for i, m in enumerate(dive_messages())]  # fmt: skip
    data = imported(bin_log(tmp_path, late))
    assert data["left_out"] == {"RFND: the time is not a number, or after 2200": 20}


def telemetry(count: int = 20, boot_ms: int = 90_000) -> list[tuple[float, Any]]:
    """What a ground station records: late by 20 ms, now and then by more."""
    start = FIX_UTC.timestamp()
    records: list[tuple[float, Any]] = []
    for i in range(count):
        t, ms = start + 0.2 * i, boot_ms + 200 * i
        late = 0.02 + (0.15 if i % 3 == 1 else 0.0)
        yaw = math.radians(-1.0 + 0.5 * i)
        records += [
            (t + late, mavlink.MAVLink_heartbeat_message(12, 3, 81, 0, 3, 3)),
            (t + late, mavlink.MAVLink_attitude_message(ms, 0.1, -0.05, yaw, 0.01, 0.02, 0.03)),
            (
                t + late,
                mavlink.MAVLink_global_position_int_message(
                    ms, round(LAT * 1e7) + 10 * i, round(LON * 1e7), 0, -(3000 + 50 * i), 30, -40,
                    5, 65535,
                ),
            ),
            (
                t + late,
                mavlink.MAVLink_distance_sensor_message(ms, 20, 3000, 180 + i, 0, 0, 25, 255),
            ),
        ]  # fmt: skip
    return records


@pytest.mark.parametrize("version", [1, 2])
def test_a_ground_stations_log_becomes_navigation(tmp_path: Path, version: int) -> None:
    log = tmp_path / "dive.tlog"
    log.write_bytes(tlog(telemetry(), version=version))

    data = imported(log, vehicle_log=tmp_path / "v.csv")

    read = read_navigation(tmp_path / "n.csv", UTC)
    assert read.start_utc is not None
    assert data["left_out"] == {}
    # The vehicle's own steps, without the link's jitter.
    assert (read.start_utc - FIX_UTC).total_seconds() == pytest.approx(0.02, abs=1e-5)
    i = np.arange(20)
    np.testing.assert_allclose(read.time_s, 0.2 * i, atol=2e-6)
    np.testing.assert_allclose(read.columns["latitude_deg"], LAT + 1e-6 * i, atol=1e-9)
    np.testing.assert_allclose(read.columns["depth_m"], 3.0 + 0.05 * i, atol=1e-5)
    np.testing.assert_allclose(read.columns["heading_deg"], (-1 + 0.5 * i) % 360, atol=1e-4)
    upright = math.cos(0.1) * math.cos(0.05)
    np.testing.assert_allclose(read.columns["altitude_m"], (1.8 + 0.01 * i) * upright, atol=1e-5)
    vehicle = read_vehicle_log(tmp_path / "v.csv")
    speed = np.linalg.norm(vehicle.velocity_body, axis=1)
    np.testing.assert_allclose(speed, math.hypot(0.3, 0.4, 0.05), atol=1e-6)
    np.testing.assert_allclose(vehicle.rates_body, [[0.01, 0.02, 0.03]] * 20, atol=1e-6)


@pytest.mark.parametrize(
    ("stated", "kept"), [((0,), 20), ((95, 100), 20), ((0, 32, 95, 100), 10), ((0, 32), 0)]
)
def test_ranges_of_low_quality_are_left_out(
    tmp_path: Path, stated: tuple[int, ...], kept: int
) -> None:
    """A 0 alone is MAVLink's "unknown"; RANGEFINDER repeats the ranges and knows no quality."""
    records = telemetry()
    ranges = [message for _, message in records if message.msgname == "DISTANCE_SENSOR"]
    for i, message in enumerate(ranges):
        message.signal_quality = stated[i % len(stated)]
    records += [(t, mavlink.MAVLink_rangefinder_message(1.9, 0.0)) for t, _ in telemetry()[::4]]
    log = tmp_path / "dive.tlog"
    log.write_bytes(tlog(sorted(records, key=lambda record: record[0])))
    left_out = imported(log)["left_out"]
    altitude = numbers(tmp_path, "altitude_m")
    assert list(left_out.values()) == [20 - kept] * (kept < 20)
    assert np.isfinite(altitude).any() == (kept > 0)
    assert "RANGEFINDER" not in str(left_out)


def test_telemetry_of_other_systems_and_damage_are_counted(tmp_path: Path) -> None:
    records = telemetry()
    whole = tlog(records)
    other = tlog(telemetry(2), system=7)
    broken = bytearray(whole)
    # A byte of the tenth latitude flips: its checksum fails, and that position is gone.
    target = tlog([records[4 * 10 + 2]])
    broken[whole.index(target[8 + 14 : 8 + 24]) + 2] ^= 0x55
    log = tmp_path / "dive.tlog"
    log.write_bytes(bytes(broken) + b"\x01" * 37 + other + whole[:20])
    data = imported(log)
    assert data["rows"] == 19
    assert data["left_out"]["GLOBAL_POSITION_INT: messages of another system than 1"] == 2
    noise = data["left_out"]["bytes that are not a message, or of one that is cut off"]
    assert 37 <= noise <= 37 + 20 + len(target)


def test_telemetry_without_a_position(tmp_path: Path) -> None:
    log = tmp_path / "dive.tlog"
    log.write_bytes(tlog(r for r in telemetry() if r[1].msgname == "HEARTBEAT"))
    with pytest.raises(NavigationError, match="it has HEARTBEAT"):
        imported(log)
    log.write_bytes(tlog(r for r in telemetry() if r[1].msgname in ("HEARTBEAT", "ATTITUDE")))
    assert imported(log)["sources"] == {"attitude": "ATTITUDE"}
    zero = [
        (t, mavlink.MAVLink_global_position_int_message(i, 0, 0, 0, -1000, 0, 0, 0, 0))
        for i, (t, _) in enumerate(telemetry(3))
    ]
    log.write_bytes(tlog(zero))
    data = imported(log)
    assert data["left_out"] == {"GLOBAL_POSITION_INT: the position is 0, 0: no fix": len(zero)}
    np.testing.assert_allclose(numbers(tmp_path, "depth_m"), 1.0)


@pytest.mark.parametrize("height_m", [-9999.0, -32768.0, 3.4e38])
def test_what_stands_for_unknown_in_a_log_is_no_depth(tmp_path: Path, height_m: float) -> None:
    messages = [
        (*m[:5], height_m, m[6]) if m[0] == "POS" and i % 4 else m
        for i, m in enumerate(dive_messages())
    ]
    altered = sum(m[0] == "POS" and m[5] == height_m for m in messages)
    left_out = imported(bin_log(tmp_path, messages))["left_out"]
    assert altered and sum(left_out.values()) == altered
    assert np.nanmax(numbers(tmp_path, "depth_m")) < 10.0


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.txt", "hello"),
        ("text.log", "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"),
        ("nav.csv", "time_s,latitude_deg,longitude_deg,depth_m\n"),
        ("dvl.pd0", "\x7f\x7f"),
        ("dvl.ENR", "\x7f\x7f"),
        ("dive.BIN", ""),
        ("a.tlog", "not a log at all, but long enough to be looked at"),
    ],
)
def test_other_files_are_refused_by_name(tmp_path: Path, name: str, content: str) -> None:
    with pytest.raises(NavigationError, match=name):
        imported(tmp_path / name)
    (tmp_path / name).write_text(content)
    with pytest.raises(NavigationError, match=name):
        imported(tmp_path / name)


@pytest.mark.parametrize("form", ["dive.BIN", "dive.tlog"])
def test_damaged_logs_end_in_a_table_or_in_one_line(tmp_path: Path, form: str) -> None:
    whole = {"dive.BIN": dataflash_log(dive_messages()), "dive.tlog": tlog(telemetry())}[form]
    rng = np.random.default_rng(11)
    outcomes = []
    for _ in range(20):
        data = bytearray(whole)
        for place in rng.integers(len(data), size=rng.integers(1, 15)):
            data[place] = rng.integers(256)
        start, end = sorted(rng.integers(len(data), size=2))
        del data[start : min(end, start + 100)]
        (tmp_path / form).write_bytes(bytes(data))
        try:
            report = imported(tmp_path / form)
        except NavigationError as error:
            assert "\n" not in str(error)
            outcomes.append(0)
        else:
            read = read_navigation(tmp_path / "n.csv", UTC, ())
            assert len(read.time_s) == report["rows"]
            assert report["rows"] <= 21  # of ATT, where all else is lost
            outcomes.append(report["rows"])
    # Damage is local: most of the rows of most logs are still there.
    assert np.median(outcomes) >= 15


def test_what_is_no_submarine_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "flight.tlog"
    log.write_bytes(tlog(telemetry()))
    imported(log)
    assert "submarine" not in capsys.readouterr().err
    high = []
    for i, (t, message) in enumerate(telemetry()):
        if message.msgname == "HEARTBEAT":
            message = mavlink.MAVLink_heartbeat_message(21, 3, 81, 0, 3, 3)
        if message.msgname == "GLOBAL_POSITION_INT":
            message = mavlink.MAVLink_global_position_int_message(
                message.time_boot_ms, message.lat, message.lon, 0, 63_400 - i, 0, 0, 0, 65535
            )
        high.append((t, message))
    log.write_bytes(tlog(high))
    data = imported(log)
    said = capsys.readouterr().err
    assert "the log is of a vehicle of MAV_TYPE_VTOL_TILTROTOR, not of a submarine" in said
    assert f"{data['rows']} of {data['rows']} rows lie above the water, by 63.4 m" in said
