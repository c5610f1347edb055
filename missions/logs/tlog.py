"""A ground station's telemetry log (.tlog) as tables of numbers.

A record is a big-endian count of microseconds since 1970 by the ground station's clock, 8 bytes,
and a packet of MAVLink, version 1 or 2.

The form of packets, the checksum and its CRC_EXTRA, the order of fields on the wire and the
cutting of trailing zeros: mavlink.io/en/guide/serialization.html. Signatures, which are passed over
unchecked, as only the holder of the key can check them: mavlink.io/en/guide/message_signing.html.
The messages: mavlink.io/en/messages/common.html and, of RANGEFINDER, .../ardupilotmega.html.
"""

import binascii
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from alice_survey.core.errors import NavigationError
from missions.logs.dataflash import LogTable

RECORDED = "recorded_s"
"""Column of the ground station's time, seconds since 1970."""
SYSTEM, COMPONENT = "system", "component"
V1, V2 = 0xFE, 0xFD
"""First byte of a packet."""
LONGEST = 280
"""Bytes of the longest packet: 10 of head, 255 of payload, 2 of checksum, 13 of signature."""
_HEAD = {V1: 6, V2: 10}
_CHECKSUM, _SIGNATURE = 2, 13
_SIGNED = 0x01
"""Incompatibility flag: a signature follows. A reader must refuse flags that it does not know."""
_FORMS = {
    "uint64_t": "<u8", "int64_t": "<i8", "double": "<f8", "uint32_t": "<u4", "int32_t": "<i4",
    "float": "<f4", "uint16_t": "<u2", "int16_t": "<i2", "uint8_t": "u1", "int8_t": "i1",
}  # fmt: skip
_MIRRORED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
_STAMP = 8
_REACH = _STAMP + LONGEST + _STAMP + 1
"""Bytes that a record and the start of the next can take."""
_CHUNK = 1 << 20
_DAY_US = 86_400_000_000
_START = re.compile(bytes([ord("["), V1, V2, ord("]")]))


def checksum(data: bytes) -> int:
    """The CRC of MAVLink: that of X.25, with polynomial 0x1021 and start 0xFFFF, not inverted.

    It takes each byte's lowest bit first. The standard library's takes the highest first, and thus
    gives the mirror image for mirrored bytes.
    """
    mirrored = binascii.crc_hqx(data.translate(_MIRRORED), 0xFFFF)
    return (_MIRRORED[mirrored & 0xFF] << 8) | _MIRRORED[mirrored >> 8]


@dataclass(frozen=True)
class Message:
    """What one message holds.

    Extensions, which version 2 may append to the fields, are not part of the checksum's seed; none
    is used here, so that none is listed.
    """

    number: int
    name: str
    listing: str
    """Types and names in the order of the message's definition."""

    @cached_property
    def on_wire(self) -> tuple[tuple[str, str], ...]:
        """Types and names as sent: the largest types first, otherwise as they are defined."""
        pairs = (field.split() for field in self.listing.split(", "))
        fields = [(kind, name) for kind, name in pairs]
        return tuple(sorted(fields, key=lambda field: -np.dtype(_FORMS[field[0]]).itemsize))

    @cached_property
    def payload(self) -> np.dtype[np.void]:
        """The payload without extensions, as it is in memory."""
        return np.dtype([(name, _FORMS[kind]) for kind, name in self.on_wire])

    @cached_property
    def length(self) -> int:
        """Bytes of the payload without extensions."""
        return self.payload.itemsize

    @cached_property
    def crc_extra(self) -> int:
        """The byte that enters checksums: it differs where sender and reader define differently."""
        words = [self.name, *(word for field in self.on_wire for word in field)]
        seed = checksum("".join(f"{word} " for word in words).encode())
        return (seed & 0xFF) ^ (seed >> 8)


MESSAGES = {
    message.number: message
    for message in (
        Message(
            0, "HEARTBEAT",
            "uint8_t type, uint8_t autopilot, uint8_t base_mode, uint32_t custom_mode, "
            "uint8_t system_status, uint8_t mavlink_version",
        ),
        Message(
            24, "GPS_RAW_INT",
            "uint64_t time_usec, uint8_t fix_type, int32_t lat, int32_t lon, int32_t alt, "
            "uint16_t eph, uint16_t epv, uint16_t vel, uint16_t cog, uint8_t satellites_visible",
        ),
        Message(
            30, "ATTITUDE",
            "uint32_t time_boot_ms, float roll, float pitch, float yaw, float rollspeed, "
            "float pitchspeed, float yawspeed",
        ),
        Message(
            33, "GLOBAL_POSITION_INT",
            "uint32_t time_boot_ms, int32_t lat, int32_t lon, int32_t alt, int32_t relative_alt, "
            "int16_t vx, int16_t vy, int16_t vz, uint16_t hdg",
        ),
        Message(
            36, "SERVO_OUTPUT_RAW",
            "uint32_t time_usec, uint8_t port, uint16_t servo1_raw, uint16_t servo2_raw, "
            "uint16_t servo3_raw, uint16_t servo4_raw, uint16_t servo5_raw, uint16_t servo6_raw, "
            "uint16_t servo7_raw, uint16_t servo8_raw",
        ),
        Message(
            74, "VFR_HUD",
            "float airspeed, float groundspeed, int16_t heading, uint16_t throttle, float alt, "
            "float climb",
        ),
        Message(
            132, "DISTANCE_SENSOR",
            "uint32_t time_boot_ms, uint16_t min_distance, uint16_t max_distance, "
            "uint16_t current_distance, uint8_t type, uint8_t id, uint8_t orientation, "
            "uint8_t covariance",
        ),
        Message(173, "RANGEFINDER", "float distance, float voltage"),
    )
}  # fmt: skip
"""Messages by number: those about navigation, and the one that every system sends."""


class Packet(NamedTuple):
    """One packet as it was sent."""

    length: int
    """Bytes from its first to its last, a signature included."""
    number: int
    system: int
    component: int
    payload: bytes
    """Payload as sent: version 2 cuts zeros off its end."""
    whole: bool | None
    """Whether its checksum is right; None for a message not in `MESSAGES`, whose is not known."""


def packet_at(data: bytes, start: int) -> Packet | None:
    """The packet that starts at a place; None where none can, or where it does not end in `data`.

    Args:
        data: what was received.
        start: index of a byte of `data`.
    """
    head = _HEAD.get(data[start])
    if head is None or start + head > len(data):
        return None
    checked = start + head + data[start + 1]
    end = checked + _CHECKSUM
    if head == _HEAD[V1]:
        system, component, number = data[start + 3], data[start + 4], data[start + 5]
    else:
        flags = data[start + 2]
        if flags & ~_SIGNED:
            return None
        end += _SIGNATURE if flags else 0
        system, component = data[start + 5], data[start + 6]
        number = int.from_bytes(data[start + 7 : start + 10], "little")
    if end > len(data):
        return None
    message, whole = MESSAGES.get(number), None
    if message is not None:
        stated = int.from_bytes(data[checked : checked + _CHECKSUM], "little")
        whole = checksum(data[start + 1 : checked] + bytes([message.crc_extra])) == stated
    return Packet(end - start, number, system, component, data[start + head : checked], whole)


def read_tlog(
    path: Path, wanted: Collection[str], lost: Counter[str]
) -> tuple[dict[str, LogTable], list[str]]:
    """Read the messages of some names.

    Args:
        path: the file.
        wanted: names of messages, of `MESSAGES`.
        lost: counts what cannot be read; is added to.

    Returns:
        Tables by name with the columns `RECORDED`, `SYSTEM` and `COMPONENT`; and the names of what
        messages there are in the log.

    Raises:
        NavigationError: the file cannot be read, or holds no MAVLink packet.
    """
    rows: dict[int, bytearray] = defaultdict(bytearray)
    present: set[int] = set()
    numbers = {message.name: number for number, message in MESSAGES.items()}
    numbers_wanted = {numbers[name] for name in wanted}
    try:
        with path.open("rb") as file:
            for stamp, packet in packets(file, lost):
                present.add(packet.number)
                if packet.number in numbers_wanted:
                    length = MESSAGES[packet.number].length
                    rows[packet.number] += stamp
                    rows[packet.number] += bytes((packet.system, packet.component))
                    rows[packet.number] += packet.payload[:length].ljust(length, b"\0")
    except OSError as error:
        raise NavigationError(f"{path}: cannot be read: {error.strerror}") from None
    if not present:
        raise NavigationError(f"{path}: no telemetry log: it holds no MAVLink packet")
    tables = {
        MESSAGES[number].name: _table(MESSAGES[number], bytes(of_one))
        for number, of_one in rows.items()
    }
    names = sorted(MESSAGES[number].name for number in present if number in MESSAGES)
    others = len(present) - len(names)
    if others:
        names.append(f"{others} more that do not say where a vehicle is")
    return tables, names


def packets(
    file: BinaryIO, lost: Counter[str], chunk_bytes: int = _CHUNK
) -> Iterator[tuple[bytes, Packet]]:
    """Stamp and packet, one record after the other; a chunk of the file is in memory.

    A packet counts where its checksum holds. One whose checksum does not hold, or is not known,
    is taken for one (to be left out, and to be passed over) where a record of about the same time
    follows, or the end of the log; anything else is damage, out of which the next record is looked
    for byte by byte.

    Args:
        file: the log, open at its start.
        lost: counts packets with a wrong checksum, and bytes that are not a message; is added to.
        chunk_bytes: how much to read at once.
    """
    data, place, skipped = b"", 0, 0
    ended, previous = False, b""
    while True:
        if not ended and len(data) - place < _REACH:
            more = file.read(chunk_bytes)
            ended = not more
            data, place = data[place:] + more, 0
            continue
        if place + _STAMP >= len(data):
            break
        packet = packet_at(data, place + _STAMP)
        if packet is not None:
            following = place + _STAMP + packet.length
            if packet.whole or _leads_on(data, place, following, previous):
                if packet.whole is False:
                    lost[f"{MESSAGES[packet.number].name}: the checksum is wrong"] += 1
                else:
                    yield data[place : place + _STAMP], packet
                place, previous = following, data[place : place + _STAMP]
                continue
        previous = b""
        start = _START.search(data, place + _STAMP + 1)
        # Without a start in sight, the last bytes may be the stamp of one out of sight.
        step = (start.start() if start else len(data)) - _STAMP - place
        place += step
        skipped += step
    skipped += len(data) - place
    if skipped:
        lost["bytes that are not a message, or of one that is cut off"] += skipped


def _leads_on(data: bytes, place: int, following: int, previous: bytes) -> bool:
    """Whether after the record at a place comes another, within a day of it.

    At the end of the log, with no room for another, it is the record right before that must be
    within a day: `previous` is its stamp, empty where there is damage before.
    """
    other = data[following : following + _STAMP]
    if following + _STAMP >= len(data):
        other = previous
    elif data[following + _STAMP] not in (V1, V2):
        return False
    stamp = data[place : place + _STAMP]
    apart_us = int.from_bytes(stamp, "big") - int.from_bytes(other, "big")
    return bool(other) and abs(apart_us) < _DAY_US


def _table(message: Message, records: bytes) -> LogTable:
    """Stamps, origins and payloads, one after the other, as columns."""
    kind = np.dtype(
        [(RECORDED, ">u8"), (SYSTEM, "u1"), (COMPONENT, "u1"), ("payload", message.payload)]
    )
    rows = np.frombuffer(records, kind)
    columns = {name: rows[name].astype(np.float64) for name in (RECORDED, SYSTEM, COMPONENT)}
    columns[RECORDED] *= 1e-6
    for name in message.payload.names or ():
        columns[name] = rows["payload"][name].astype(np.float64)
    return LogTable(name=message.name, columns=columns, texts={})
