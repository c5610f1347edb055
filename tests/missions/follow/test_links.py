import functools
import json
import math
import operator
import socket
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array
from missions.follow.links import (
    MavlinkSource,
    OdometryRows,
    UdpSource,
    altimeter_from_glass,
    altitude_of_range,
)
from missions.follow.rows import ROW, Piece, Reordered, SteadyTimes, row_of_text
from missions.live.mavlink_pilot import odometry_from
from tests.missions.follow.dives import (
    DATUM,
    PLAN,
    RIG,
    Followed,
    at_once,
    route_rows,
    same,
    text_of,
)


def json_of(row: Array) -> str:
    """A row as a packet, to the digits of a file."""
    decimals = (3, 10, 10, 4, 4, 4, 4, 4)
    return json.dumps(
        {name: round(float(v), d) for name, v, d in zip(ROW, row, decimals, strict=True)}
    )


def sent(source: UdpSource, packets: list[bytes]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for packet in packets:
            out.sendto(packet, ("127.0.0.1", source.port))


def test_packets_say_what_they_say_in_any_of_the_forms() -> None:
    ne = np.array([[12.5, -3.25, 0.0]])
    place = DATUM.geodetic_from_ned(ne)[0].tolist()
    as_ne = row_of_text(
        '{"time_s": 5, "north_m": 12.5, "east_m": -3.25, "depth_m": 13, "altitude_m": 2.1,'
        ' "heading_deg": 350, "roll": 1.5, "pitch": -2}',
        DATUM,
    )
    np.testing.assert_allclose(as_ne, [5, *place[:2], 13, 1.5, -2, 350, 2.1], rtol=0, atol=1e-12)
    numbers = f"5,{place[0]!r},{place[1]!r},13,1.5,-2,350,2.1"
    np.testing.assert_array_equal(row_of_text(numbers, DATUM), as_ne)
    body = f"PANAV,{numbers}"
    total = functools.reduce(operator.xor, body.encode())
    np.testing.assert_array_equal(row_of_text(f"${body}*{total:02x}\r\n", DATUM), as_ne)
    with pytest.raises(ValueError, match="checksum"):
        row_of_text(f"${body}*{total ^ 1:02X}", DATUM)
    partly = row_of_text('{"time_s": 5.5, "latitude_deg": 1, "longitude": 2}', DATUM)
    assert np.isnan(partly[3:]).all()
    assert partly[:3].tolist() == [5.5, 1.0, 2.0]


@given(st.text(max_size=60) | st.sampled_from(
    ["{", "{}", '{"time_s": 1}', '{"time_s": "x", "latitude_deg": 1, "longitude_deg": 2}',
     "1,2", "1,91,2", "nan,1,2", '{"time_s": 1e400, "latitude_deg": 1, "longitude_deg": 2}',
     "[" * 3000, '{"a":' * 3000]))  # fmt: skip
def test_garbage_is_refused_or_a_row(text: str) -> None:
    try:
        row = row_of_text(text, DATUM)
    except ValueError:
        return
    assert np.isfinite(row[:3]).all()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_datagrams_lost_doubled_shuffled_and_garbage_give_what_the_log_gives(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rows = route_rows(PLAN, 0.2, rng)
    rows = rows[rng.random(len(rows)) > 0.1]  # lost on the way
    path = tmp_path_factory.mktemp("udp") / "nav.csv"
    path.write_bytes(text_of(rows))
    # Each overtakes others of up to 0.4 s; some come twice; some are none.
    order = np.argsort(rows[:, 0] + rng.uniform(0, 0.4, len(rows)), kind="stable")
    packets, doubled, garbage = [], 0, 0
    for index in order.tolist():
        packets.append(json_of(rows[index]).encode())
        if rng.random() < 0.05:
            packets.append(packets[-1])
            doubled += 1
        if rng.random() < 0.05:
            packets.append(bytes(rng.integers(0, 256, 40, dtype=np.uint8)).replace(b"\n", b"x"))
            packets[-1] = packets[-1].replace(b"\r", b"x").replace(b"\x0b", b"x")
            garbage += 1

    source, followed = UdpSource(DATUM, 0), Followed()
    times = SteadyTimes(source.left_out)
    wall_s = 0.0
    try:
        for first in range(0, len(packets), 60):
            sent(source, packets[first : first + 60])
            wall_s += 0.3
            for piece in source.poll(wall_s):
                followed.take(times.passed(piece))
        for piece in source.poll(wall_s + 5.0):
            followed.take(times.passed(piece))
    finally:
        source.close()

    same(followed.certificate(), at_once(path))
    assert source.left_out["a time that came already"] == doubled
    assert source.left_out["packets that are no navigation"] >= garbage
    assert source.left_out["late, or a time that jumps"] == 0


def test_a_packet_that_comes_too_late_is_counted_and_a_clock_that_is_off_does_not_matter() -> None:
    rows = route_rows(PLAN, 0.2, np.random.default_rng(3))[:200]
    rows[:, 0] += 86400.0 * 365  # the vehicle's clock is a year ahead
    left_out: Counter[str] = Counter()
    ordered, times = Reordered(1.0, left_out), SteadyTimes(left_out)
    out = []
    for i, row in enumerate(rows):
        late = [] if i == 50 else [row]
        if i == 100:
            late.append(rows[50])  # ten seconds after its time
        due = ordered.passed(late, i * 0.2)
        out += [p.rows for p in times.passed(Piece(rows=due))]
    out += [p.rows for p in times.passed(Piece(rows=ordered.passed([], 1e3)))]
    np.testing.assert_array_equal(np.concatenate(out), np.delete(rows, 50, axis=0))
    assert left_out["late, or a time that jumps"] == 1


def test_a_port_that_is_taken_is_refused_in_a_line() -> None:
    source = UdpSource(DATUM, 0)
    try:
        with pytest.raises(NavigationError, match="another port"):
            UdpSource(DATUM, source.port)
    finally:
        source.close()


def test_the_range_of_a_leaning_vehicle_is_the_height_of_the_glass() -> None:
    lever = altimeter_from_glass(RIG, (0.1, 0.0, 0.2))
    level = altitude_of_range(2.0, np.zeros(3), lever)
    assert level == pytest.approx(2.0 + lever[2])
    roll = math.radians(20.0)
    # Rolled about the x axis: y down by its sine, z by its cosine.
    leaning = altitude_of_range(2.0, np.array([roll, 0.0, 1.0]), lever)
    assert leaning == pytest.approx((2.0 + lever[2]) * math.cos(roll) + lever[1] * math.sin(roll))


def messages(
    time_s: float, place_ned: Array, heading: float
) -> tuple[SimpleNamespace, SimpleNamespace]:
    position = SimpleNamespace(
        time_boot_ms=round(1e3 * time_s), x=place_ned[0], y=place_ned[1], z=place_ned[2],
        vx=0.2, vy=0.0, vz=0.0,
    )  # fmt: skip
    attitude = SimpleNamespace(
        time_boot_ms=round(1e3 * time_s), roll=0.02, pitch=-0.01, yaw=heading,
        rollspeed=0.0, pitchspeed=0.0, yawspeed=0.0,
    )  # fmt: skip
    return position, attitude


def test_odometry_becomes_rows_of_the_same_place_and_attitude() -> None:
    builder = OdometryRows(DATUM, np.zeros(3))
    origin = np.array([3.0, -4.0, 0.0])
    position, attitude = messages(7.0, np.array([1.0, 2.0, 13.0]), 1.2)
    builder.hear_range(6.9, 2.0)
    row = builder.row(odometry_from(position, attitude, origin))
    assert row is not None
    ned = DATUM.ned_from_geodetic(np.array([[row[1], row[2], 0.0]]))[0]
    np.testing.assert_allclose(ned[:2], [4.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(row[3:7], [13.0, *np.rad2deg([0.02, -0.01, 1.2])], rtol=0, atol=1e-9)
    assert row[7] == pytest.approx(2.0 * math.cos(0.02) * math.cos(-0.01))
    stale = builder.row(odometry_from(*messages(9.0, np.zeros(3), 0.0), origin))
    assert stale is not None
    assert np.isnan(stale[7])
    assert builder.row(odometry_from(*messages(9.0, np.zeros(3), math.nan), origin)) is None


def test_a_vehicle_is_heard_over_mavlink(tmp_path: Path) -> None:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    source = MavlinkSource(f"udpin:127.0.0.1:{port}", DATUM, np.zeros(3))
    vehicle = mavutil.mavlink_connection(
        f"udpout:127.0.0.1:{port}", dialect="ardupilotmega", source_system=1, source_component=1
    )
    rows = []
    try:
        for i in range(40):
            mav, ms = vehicle.mav, 1000 + 100 * i
            if i % 10 == 0:
                mav.heartbeat_send(12, 3, 0, 0, 4)
            if i == 5:
                mav.gps_global_origin_send(
                    round(DATUM.latitude_deg * 1e7), round(DATUM.longitude_deg * 1e7), 0
                )
            mav.attitude_send(ms, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
            mav.rangefinder_send(2.0, 0.0)
            mav.local_position_ned_send(ms, 0.02 * i, 1.0, 13.0, 0.2, 0.0, 0.0)
            rows += [p.rows for p in source.poll(0.1 * i)]
        rows += [p.rows for p in source.poll(100.0)]
        asked = {m.command for m in iter(lambda: vehicle.recv_match(
            type="COMMAND_LONG", blocking=False), None)}  # fmt: skip
    finally:
        source.close()
        vehicle.close()
    heard = np.concatenate(rows)
    assert len(heard) == 35
    ned = DATUM.ned_from_geodetic(np.column_stack([heard[:, 1:3], np.zeros(len(heard))]))
    np.testing.assert_allclose(ned[:, 0], 0.02 * np.arange(5, 40), atol=0.02)
    np.testing.assert_allclose(heard[:, 0], 1.0 + 0.1 * np.arange(5, 40), atol=1e-9)
    np.testing.assert_allclose(heard[:, 7], 2.0, atol=1e-6)
    assert 512 in asked  # the origin
    assert source.left_out["positions before an attitude and the origin were heard"] == 5
