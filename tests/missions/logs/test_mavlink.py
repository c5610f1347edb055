"""Packets of MAVLink against pymavlink, written independently, and the protocol's text."""

import io
import itertools
import struct
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from missions.logs.tlog import (
    COMPONENT,
    MESSAGES,
    RECORDED,
    SYSTEM,
    Message,
    Packet,
    checksum,
    packet_at,
    packets,
    read_tlog,
)
from tests.missions.logs.log_files import tlog

CRC_EXTRA = {0: 50, 24: 24, 30: 39, 33: 104, 36: 222, 74: 20, 132: 85, 173: 83}
LENGTHS = {0: 9, 24: 30, 30: 28, 33: 28, 36: 21, 74: 20, 132: 14, 173: 8}
"""Both as in the C headers generated from the public definitions (_CRC and _MIN_LEN)."""
NOISE = "bytes that are not a message, or of one that is cut off"
T0 = 1_714_564_800.0


def slow_checksum(data: bytes) -> int:
    """Bit by bit, the lowest first: the polynomial 0x1021 mirrored is 0x8408."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0x8408 if register & 1 else 0)
    return register


def sender(system: int = 1, component: int = 1) -> Any:
    return mavlink.MAVLink(None, srcSystem=system, srcComponent=component)


def packed(message: Any, version: int = 2, **origin: int) -> bytes:
    return bytes(message.pack(sender(**origin), force_mavlink1=version == 1))


def record(recorded_s: float, packet: bytes) -> bytes:
    return struct.pack(">Q", round(recorded_s * 1e6)) + packet


def position(ms: int = 1000, latitude: int = 601_000_000) -> Any:
    return mavlink.MAVLink_global_position_int_message(
        ms, latitude, 52_500_000, 0, -3000, 30, -40, 5, 65535
    )


def text(words: bytes = b"hello") -> Any:
    """A message that the table does not hold."""
    return mavlink.MAVLink_statustext_message(6, words)


def found(
    log: bytes, chunk_bytes: int = 1 << 20
) -> tuple[list[tuple[bytes, Packet]], Counter[str]]:
    lost: Counter[str] = Counter()
    return list(packets(io.BytesIO(log), lost, chunk_bytes)), lost


def random_messages(rng: np.random.Generator, message: Message, count: int) -> Iterator[Any]:
    """Any bits in any field; extensions, which come last, stay at their defaults."""
    make = mavlink.mavlink_map[message.number]
    for _ in range(count):
        values = np.frombuffer(rng.bytes(message.length), message.payload)[0]
        given = {name: values[name].item() for name in message.payload.names or ()}
        own = {name: 0.0 if isinstance(v, float) and v != v else v for name, v in given.items()}
        yield make(**own)


@given(st.binary(max_size=300))
def test_the_checksum_is_that_of_the_shift_register(data: bytes) -> None:
    assert checksum(data) == slow_checksum(data)


def test_the_checksum_of_the_standard_digits() -> None:
    # CRC-16/MCRF4XX in the catalogue of parametrised CRC algorithms: check value 0x6F91.
    assert checksum(b"123456789") == 0x6F91


def test_the_seed_of_checksums_follows_from_names_and_fields() -> None:
    assert {number: message.crc_extra for number, message in MESSAGES.items()} == CRC_EXTRA


@pytest.mark.parametrize("message", MESSAGES.values(), ids=lambda m: m.name)
def test_messages_are_those_of_the_public_definitions(message: Message) -> None:
    other = mavlink.mavlink_map[message.number]
    names = [name for _, name in message.on_wire]
    assert other.msgname == message.name
    assert other.ordered_fieldnames[: len(names)] == names
    kinds = dict(zip(other.fieldnames, other.fieldtypes, strict=True))
    assert [kinds[name] for name in names] == [kind for kind, _ in message.on_wire]
    assert other.crc_extra == message.crc_extra
    assert message.length == LENGTHS[message.number]


@pytest.mark.parametrize("version", [1, 2])
def test_every_field_of_every_message_reads_as_sent(tmp_path: Path, version: int) -> None:
    rng = np.random.default_rng(version)
    sent = {m.name: list(random_messages(rng, m, 50)) for m in MESSAGES.values()}
    mixed = [(T0 + i, m) for i, m in enumerate(itertools.chain(*zip(*sent.values(), strict=True)))]
    (tmp_path / "a.tlog").write_bytes(tlog(mixed, version=version, system=9))
    lost: Counter[str] = Counter()

    tables, present = read_tlog(tmp_path / "a.tlog", sent.keys(), lost)

    assert not lost
    assert present == sorted(sent)
    for name, messages in sent.items():
        columns = tables[name].columns
        np.testing.assert_array_equal(columns[SYSTEM], 9)
        np.testing.assert_array_equal(columns[COMPONENT], 1)
        expected = [t for t, message in mixed if message.msgname == name]
        np.testing.assert_allclose(columns[RECORDED], expected, rtol=0, atol=1e-6)
        for field in columns.keys() - {RECORDED, SYSTEM, COMPONENT}:
            np.testing.assert_array_equal(columns[field], [getattr(m, field) for m in messages])


def test_zeros_cut_off_the_end_are_put_back(tmp_path: Path) -> None:
    whole = mavlink.MAVLink_global_position_int_message(7, 0, 0, 0, 0, 0, 0, 0, 0)
    none = mavlink.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 0)
    one, other = packed(whole), packed(none)
    # Version 2 leaves one byte at least.
    assert (one[1], other[1]) == (1, 1)
    (tmp_path / "a.tlog").write_bytes(record(T0, one) + record(T0, other))
    tables, _ = read_tlog(tmp_path / "a.tlog", ["GLOBAL_POSITION_INT"], Counter())
    columns = tables["GLOBAL_POSITION_INT"].columns
    np.testing.assert_array_equal(columns["time_boot_ms"], [7, 0])
    np.testing.assert_array_equal(columns["hdg"], [0, 0])


def test_extensions_are_passed_over(tmp_path: Path) -> None:
    far = mavlink.MAVLink_distance_sensor_message(
        5, 20, 3000, 181, 0, 2, 25, 255, 0.5, 0.25, [1.0, 0.0, 0.0, 0.5], 90
    )
    packet = packed(far)
    assert packet[1] == 39 > MESSAGES[132].length
    (tmp_path / "a.tlog").write_bytes(record(T0, packet))
    tables, _ = read_tlog(tmp_path / "a.tlog", ["DISTANCE_SENSOR"], Counter())
    columns = tables["DISTANCE_SENSOR"].columns
    assert [columns[name].tolist() for name in ("current_distance", "id", "covariance")] == [
        [181], [2], [255],
    ]  # fmt: skip


def test_a_signed_packet_ends_after_its_signature() -> None:
    signing = sender()
    signing.signing.secret_key = bytes(range(32))
    signing.signing.sign_outgoing = True
    signed = bytes(position().pack(signing))
    plain = packed(position())
    assert len(signed) == len(plain) + 13

    packet = packet_at(signed, 0)

    assert packet is not None
    assert packet == (len(signed), 33, 1, 1, plain[10:-2], True)
    assert packet_at(signed[:-1], 0) is None
    read, lost = found(record(T0, signed) + record(T0, plain) + record(T0, signed))
    assert [p.whole for _, p in read] == [True] * 3
    assert not lost


def test_a_packet_of_another_incompatible_form_is_refused() -> None:
    packet = bytearray(packed(position()))
    packet[2] = 0x02
    packet[-2:] = checksum(bytes(packet[1:-2]) + bytes([104])).to_bytes(2, "little")
    assert packet_at(bytes(packet), 0) is None
    log = record(T0, bytes(packet)) + record(T0, packed(position(2000)))
    read, lost = found(log)
    assert [p.payload[:2] for _, p in read] == [struct.pack("<H", 2000)]
    assert lost == {NOISE: len(packet) + 8}


@pytest.mark.parametrize("version", [1, 2])
def test_no_flipped_bit_passes(version: int) -> None:
    packet = packed(position(), version)
    checked = range(len(packet))
    for place, bit in itertools.product(checked, range(8)):
        broken = bytearray(packet + bytes(300))
        broken[place] ^= 1 << bit
        read = packet_at(bytes(broken), 0)
        if version == 2 and (place, bit) == (2, 0):
            # The flag of a signature is part of what is checked, too.
            assert read is not None
            assert read.length == len(packet) + 13
        assert read is None or read.whole is not True


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("chunk_bytes", [1, 61, 1 << 20])
def test_a_damaged_packet_costs_itself_alone(version: int, chunk_bytes: int) -> None:
    """Whatever byte of the third of five records is hit, the others are read, and it is counted."""
    records = [record(T0 + i, packed(position(1000 * i), version)) for i in range(5)]
    head, good = len(b"".join(records[:2])), {0, 1000, 3000, 4000}
    for place in range(8, len(records[2])):
        log = bytearray(b"".join(records))
        log[head + place] ^= 0x5A
        read, lost = found(bytes(log), chunk_bytes)
        times = [int.from_bytes(p.payload[:4], "little") for _, p in read if p.whole]
        assert sorted(times) == sorted(good)
        # Damage in the number makes another message of it, which only its length shows.
        others = [p.number for _, p in read if p.whole is None]
        assert lost.total() == (0 if others else 1) or lost == {NOISE: len(records[2])}
        assert bool(others) == (place - 8 in ((5,) if version == 1 else (7, 8, 9)))


@pytest.mark.parametrize("chunk_bytes", [1, 300, 1000, 1 << 20])
def test_garbage_between_records_is_passed_over(chunk_bytes: int) -> None:
    rng = np.random.default_rng(3)
    log, garbage = b"", 0
    for i in range(60):
        # Every other byte could be the first of a packet.
        junk = rng.choice(
            [0xFD, 0xFE, *range(254)], rng.integers(40), p=[0.25, 0.25, *[0.5 / 254] * 254]
        )
        log += junk.astype(np.uint8).tobytes()
        garbage += len(junk)
        log += record(T0 + i, packed(position(i), 1 + i % 2))
    read, lost = found(log, chunk_bytes)
    assert [int.from_bytes(p.payload[:4], "little") for _, p in read] == list(range(60))
    assert [int.from_bytes(stamp, "big") for stamp, _ in read] == [
        round((T0 + i) * 1e6) for i in range(60)
    ]
    assert lost == {NOISE: garbage}


@pytest.mark.parametrize("version", [1, 2])
def test_messages_that_are_not_known_are_passed_over_whole(tmp_path: Path, version: int) -> None:
    """Also one whose payload holds a record; it is not damage, nor at the end of the log."""
    inner = record(T0, packed(position(666)))
    carrier = mavlink.MAVLink_data96_message(1, len(inner), inner.ljust(96, b"\x07"))
    log = [(T0, text()), (T0, position(1)), (T0, carrier), (T0, position(2)), (T0, text())]
    (tmp_path / "a.tlog").write_bytes(tlog(log, version=version))
    lost: Counter[str] = Counter()
    tables, present = read_tlog(tmp_path / "a.tlog", ["GLOBAL_POSITION_INT"], lost)
    assert tables["GLOBAL_POSITION_INT"].columns["time_boot_ms"].tolist() == [1, 2]
    assert present == ["GLOBAL_POSITION_INT", "2 more that do not say where a vehicle is"]
    assert not lost


def test_a_tail_that_is_cut_off_is_counted() -> None:
    records = [record(T0, packed(m)) for m in (position(1), text(), position(2), text())]
    log, starts = b"".join(records), [0, *itertools.accumulate(map(len, records))]
    for end in range(starts[1], len(log)):
        read, lost = found(log[:end])
        complete = sum(start <= end for start in starts) - 1
        assert len(read) == complete
        assert lost.total() == end - starts[complete]


def test_a_clock_that_is_set_costs_no_known_message() -> None:
    """A ground station without a clock starts at 1970 and is set by its network."""
    log = record(1.0, packed(position(1))) + record(T0, packed(position(2)))
    read, lost = found(log)
    assert [p.whole for _, p in read] == [True, True]
    assert not lost


def test_a_packet_by_hand() -> None:
    """Version 1 without extensions, as the protocol has it; pymavlink still sends them."""
    payload = struct.pack("<QiiiHHHHBB", 5, 601_000_000, -52_500_000, 7, 1, 2, 3, 4, 3, 9)
    packet = bytes([0xFE, 30, 77, 4, 2, 24]) + payload
    packet += slow_checksum(packet[1:] + bytes([24])).to_bytes(2, "little")

    assert packet_at(packet, 0) == (38, 24, 4, 2, payload, True)

    values = np.frombuffer(payload, MESSAGES[24].payload)[0]
    assert (values["time_usec"], values["lat"], values["lon"]) == (5, 601_000_000, -52_500_000)
    assert (values["cog"], values["fix_type"], values["satellites_visible"]) == (4, 3, 9)


def test_memory_holds_a_chunk_and_not_the_log() -> None:
    one = record(T0, packed(text(b"x" * 50)))
    log = io.BytesIO(one * (1_000_000 // len(one)))
    tracemalloc.start()
    count = sum(1 for _ in packets(log, Counter(), 30_000))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 1_000_000 // len(one)
    assert peak < 150_000


def test_pymavlink_reads_what_is_read_here() -> None:
    """Bytes of both versions, with some flipped: both find the same whole packets."""
    rng = np.random.default_rng(8)
    stream = b"".join(packed(position(i, i), 1 + i % 2) for i in range(300))
    broken = bytearray(stream)
    for place in rng.integers(len(stream), size=40):
        broken[place] ^= int(rng.integers(1, 256))
    reader = mavlink.MAVLink(None)
    reader.robust_parsing = True
    theirs = [
        m.time_boot_ms
        for m in reader.parse_buffer(bytes(broken)) or ()
        if m.get_type() == "GLOBAL_POSITION_INT"
    ]
    ours, place = [], 0
    while place < len(broken):
        packet = packet_at(bytes(broken), place)
        if packet is not None and packet.whole:
            ours.append(int.from_bytes(packet.payload[:4], "little"))
        place += packet.length if packet is not None and packet.whole else 1
    lengths = [len(packed(position(i, i), 1 + i % 2)) for i in range(300)]
    spans = itertools.pairwise([0, *itertools.accumulate(lengths)])
    assert ours == [i for i, (a, b) in enumerate(spans) if broken[a:b] == stream[a:b]]
    # Theirs believes a broken length, and so loses whole packets after it.
    assert set(theirs) <= set(ours)
    assert 150 < len(theirs) < len(ours) < 300
